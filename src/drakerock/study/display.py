"""A running study as a person sees it: a live table in a terminal, plain lines otherwise."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Any, Self

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

# Seconds between updates of a live table, and between plain lines.
_LIVE_INTERVAL, _PLAIN_INTERVAL = 1.0, 30.0


class Display:
    """Shows a study's status (`read_status`) and messages while it runs.

    Args:
        console: where; a terminal gets a live table, anything else a line now and then.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._shown = -1e9

    def __enter__(self) -> Self:
        if self._live:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._live.stop()

    def is_due(self) -> bool:
        """Return whether it is time for an update: a table's every second, plain lines every half minute."""
        interval = _LIVE_INTERVAL if self._live else _PLAIN_INTERVAL
        return time.monotonic() - self._shown >= interval

    def update(self, status: dict[str, Any]) -> None:
        """Show the status."""
        self._shown = time.monotonic()
        if self._live:
            self._live.update(make_status_table(status), refresh=True)
        else:
            self.say(make_status_line(status))

    def say(self, text: str) -> None:
        """Show a message."""
        self._console.print(Text(text), soft_wrap=True)


def make_status_line(status: dict[str, Any]) -> str:
    """Return the status in one line."""
    points, cycles = status["points"], status["cycles"]
    parts = [
        f"points {points['done']}/{points['total']}",
        f"cycles {cycles['recorded']}/{cycles['total']}",
        f"failed {cycles['failed']} cycles, {points['failed']} points",
    ]
    if status["seconds_per_cycle"] is not None:
        parts.append(f"{status['seconds_per_cycle']:.3g} s/cycle")
    if status["awake_rocks_mean"] is not None:
        parts.append(f"{status['awake_rocks_mean']:.0f} rocks awake")
    if status["eta_s"] is not None and not status["complete"]:
        parts.append(f"ETA {format_duration(status['eta_s'])}")
    return ", ".join(parts)


def make_status_table(status: dict[str, Any]) -> Table:
    """Return the status as a table."""
    points, cycles = status["points"], status["cycles"]
    table = Table(title=f"Study {status['name']}", show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    state = "complete" if status["complete"] else "running" if status["running"] else "not running"
    run = status["last_run"]
    if run and not status["running"] and not status["complete"]:
        state += f" (last run {run['ending'] or 'killed'})"
    table.add_row("state", state)
    table.add_row(
        "points",
        f"{points['done']} done, {points['running']} running, {points['failed']} failed, "
        f"{points['to_do']} to do, of {points['total']}",
    )
    table.add_row(
        "cycles", f"{cycles['recorded']} recorded, {cycles['failed']} failed; {cycles['total']} wanted"
    )
    for item in status["sequences_running"][:16]:
        attempt = f", attempt {item['attempt'] + 1}" if item["attempt"] else ""
        table.add_row("running", f"{item['point']}{attempt}: {item['cycles']} cycles done")
    _add_cost_rows(table, status)
    if status["eta_s"] is not None and not status["complete"]:
        workers = f" with {run['workers']} workers" if run else ""
        table.add_row("ETA", format_duration(status["eta_s"]) + workers)
    if status["worker_deaths"]:
        table.add_row("workers lost", str(status["worker_deaths"]))
    for item in status["points_failed"]:
        table.add_row("point failed", Text(f"{item['point']}: {item['reason']}"))
    for item in status["failures"][-8:]:
        where = f"{item['point']} attempt {item['attempt'] + 1}"
        where += "" if item["loading"] is None else f" loading {item['loading'] + 1}"
        table.add_row("failure", Text(f"{where}: {item['reason']}"))
    if len(status["failures"]) > 8:
        table.add_row("", f"and {len(status['failures']) - 8} failures before (all with --json)")
    if len(status["versions"]) > 1:
        table.add_row("versions", f"results of {len(status['versions'])} different versions")
    return table


def _add_cost_rows(table: Table, status: dict[str, Any]) -> None:
    if status["awake_rocks_mean"] is not None:
        table.add_row("awake rocks", f"{status['awake_rocks_mean']:.0f} on average")
    if status["seconds_per_cycle"] is not None:
        table.add_row("time per cycle", f"{status['seconds_per_cycle']:.3g} s")
    if status["loadings_per_hour"] is not None:
        table.add_row("speed", f"{status['loadings_per_hour']:.3g} loadings per hour")
    if status["cpu_hours_used"] is not None:
        table.add_row(
            "CPU hours",
            f"{status['cpu_hours_used']:.3g} used, about {status['cpu_hours_left'] or 0.0:.3g} left",
        )
    if status["worker_memory_max_MB"] is not None:
        table.add_row("memory", f"{status['worker_memory_max_MB']:.0f} MB at most in a worker")


def format_duration(seconds: float) -> str:
    """Return a duration as h:mm:ss."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
