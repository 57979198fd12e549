"""What the commands write: tables, paths and errors, and progress while they run.

rich is imported when something is written: `drakerock --help` takes half as long without it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console


@cache
def get_console() -> Console:
    """Return standard error."""
    from rich.console import Console

    return Console(stderr=True)


@cache
def get_output() -> Console:
    """Return standard output."""
    from rich.console import Console

    return Console()


def print_line(text: str, console: Console | None = None) -> None:
    """Print a line as it is, not as markup, unbroken; on standard output if no other console is given."""
    from rich.text import Text

    (console or get_output()).print(Text(text), soft_wrap=True)


def say(text: str) -> None:
    """Print a line on standard error."""
    print_line(text, get_console())


def print_error(word: str, error: Exception) -> None:
    """Print an error after a word in red."""
    from rich.text import Text

    # Text, not markup: a message may hold brackets.
    get_console().print(Text(f"{word}: ", "bold red").append(str(error), "default"), soft_wrap=True)


@contextmanager
def show_progress(name: str, stopped: str = "") -> Iterator[Callable[..., None]]:
    """Show what is being done on standard error; plain (and silent) when that is not a terminal.

    Ctrl-C is answered with where it stopped, and `stopped`, what that means.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    console, where = get_console(), name
    columns = (TextColumn("[bold]{task.fields[stage]:<18}"), BarColumn(), TextColumn("{task.fields[note]}"))
    with Progress(
        *columns, TimeElapsedColumn(), console=console, transient=True, disable=not console.is_terminal
    ) as progress:
        task = progress.add_task(name, total=None, stage=name, note="")

        def advance(stage: str, share: float | None = None, note: str = "") -> None:
            nonlocal where
            where = f"{stage}, {note}" if note else stage
            progress.update(
                task, stage=stage, total=None if share is None else 1.0, completed=share or 0, note=note
            )

        try:
            yield advance
        except KeyboardInterrupt:
            progress.stop()
            print_line(f"interrupted at: {where}", console)
            if stopped:
                print_line(stopped, console)
            raise typer.Exit(130) from None


def print_pile(summary: dict[str, Any]) -> None:
    """Print a pile's summary, and its gradation as a table of its own."""
    from rich.table import Table

    gradation = Table(title="Gradation", title_justify="left")
    for name in ("sieve width", "rocks", "mass", "share", "wanted"):
        gradation.add_column(name, justify="right")
    for item in summary.pop("gradation"):
        gradation.add_row(
            f"{item['size_m']:g} m", f"{item['rocks']}", f"{item['mass_kg'] / 1e3:.1f} t",
            f"{100 * item['share']:.1f} +- {100 * item['standard_error']:.1f} %", f"{100 * item['wanted']:.0f} %",
        )  # fmt: skip
    print_table("Pile", summary)
    get_output().print(gradation)


def print_outcome(outcome: Any) -> None:
    """Print what a cycle came to."""
    from rich.table import Table

    from drakerock.loading.mining import describe_mining

    table = Table(title="Loading cycle", show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    s = outcome.strategy

    def show(value: float | None, form: str) -> str:
        return "-" if value is None else form.format(value)

    table.add_row("strategy", "  ".join(f"{key} {value:g}" for key, value in s.items()))
    table.add_row("ended", f"{outcome.status}: {outcome.reason}")
    # First what a mine reads first.
    mining = dict(describe_mining(outcome.mining or {}))
    for label in ("load", "fill factor"):
        table.add_row(label, mining.pop(label))
    table.add_row("loading time t4 - t0", show(outcome.loading_time_s, "{:.2f} s"))
    table.add_row("production", show(outcome.objectives["production"], "{:.0f} kg/s"))
    table.add_row("damage", show(outcome.objectives["damage"], "{:.4f}"))
    table.add_row("debris", show(outcome.objectives["debris"], "{:.0f} kg"))
    for label, text in mining.items():
        table.add_row(label, text)
    mass = show(outcome.bucket_mass_kg, "{:.0f} kg")
    table.add_row("rocks in the bucket", f"{show(outcome.bucket_rocks, '{:d}')}, {mass}")
    counted = show(outcome.counted_when_weighed_kg, "{:.0f} kg")
    table.add_row("weighed", f"{show(outcome.weighed_mass_kg, '{:.0f} kg')} (counted then: {counted})")
    table.add_row("t0 ... t4", "  ".join(show(t, "{:.2f}") for t in outcome.waypoint_times_s) + " s")
    if "volume_m3" in outcome.plan:
        plan = outcome.plan
        note = "" if plan["volume_reached"] else " (the nearest that can be reached)"
        table.add_row("planned volume", f"{plan['volume_m3']:.2f} of {plan['volume_wanted_m3']:.2f} m3{note}")
    table.add_row("push force mean, peak", f"{show(_kilo(outcome.mean_push_force_N), '{:.0f}')}, "
                  f"{show(_kilo(outcome.peak_push_force_N), '{:.0f}')} kN")  # fmt: skip
    table.add_row("motors' work", show(_kilo(outcome.energy_J), "{:.0f} kJ"))
    events = ", ".join(f"{item['event']} at {item['time_s']:.2f} s" for item in outcome.events) or "none"
    table.add_row("events", events)
    rocks = outcome.rocks
    table.add_row(
        "rocks",
        f"{rocks['total']:.0f}, awake {rocks['awake_mean']:.0f} mean, {rocks['awake_max']:.0f} max; "
        f"{rocks['lost']} lost; overlap up to {1e3 * rocks['penetration_max_m']:.0f} mm; "
        f"{rocks['flagged_steps']} steps flagged",
    )
    table.add_row(
        "cost",
        f"{outcome.wall_time_s:.1f} s for {outcome.sim_time_s:.1f} s, {outcome.ms_per_step:.1f} CPU ms per step",
    )
    get_output().print(table)


def print_sequence(summary: dict[str, Any]) -> None:
    """Print means and spreads of a sequence, as wide as the terminal."""
    from rich.table import Table
    from rich.text import Text

    strategy = "  ".join(f"{key} {value:g}" for key, value in summary["strategy"].items())
    title = f"{summary['loadings']} loadings, {strategy}"
    table = Table(title=title, title_justify="left", expand=True)
    rows = {
        "bucket_mass_kg": ("bucket load [kg]", "{:.0f}"),
        "payload_percent": ("payload [%]", "{:.1f}"),
        "fill_factor": ("fill factor", "{:.2f}"),
        "loading_time_s": ("loading time [s]", "{:.2f}"),
        "production": ("production [kg/s]", "{:.0f}"),
        "damage": ("damage", "{:.4f}"),
        "debris": ("debris [kg]", "{:.0f}"),
        "weighed_mass_kg": ("weighed [kg]", "{:.0f}"),
        "energy_J": ("motors' work [J]", "{:.3g}"),
        "bucket_phase_kWh_per_t": ("energy of the bucket phase [kWh/t]", "{:.3f}"),
        "loading_kWh_per_t": ("energy of the loading [kWh/t]", "{:.3f}"),
        "tractive_effort_mean_N": ("tractive effort, mean [N]", "{:.3g}"),
        "tractive_effort_peak_N": ("tractive effort, peak [N]", "{:.3g}"),
        "wheel_slip_m": ("wheel slip [m]", "{:.2f}"),
        "breakout_use": ("breakout use", "{:.2f}"),
        "spillage_share": ("spillage share", "{:.4f}"),
        "wall_time_s": ("wall time of a cycle [s]", "{:.1f}"),
    }
    table.add_column("", no_wrap=True)
    for heading in ("mean", "standard error", "spread"):
        table.add_column(heading, justify="right")
    # The list of values takes what the terminal leaves, and goes on in the next line.
    table.add_column("values", overflow="fold", ratio=1)
    for name, (label, form) in rows.items():
        row = summary["quantities"][name]
        numbers = [
            "-" if row[key] is None else form.format(row[key]) for key in ("mean", "standard_error", "spread")
        ]
        values = "  ".join("-" if value is None else form.format(value) for value in row["values"])
        table.add_row(Text(label), *numbers, values)  # text, not markup: the units' brackets stay
    get_output().print(table)
    spread = summary["payload_spread_percent"]
    if spread is not None:
        get_output().print(f"payload spread: {spread:.1f} % of the mean load")
    events = ", ".join(f"{name} {count}" for name, count in summary["events"].items()) or "none"
    get_output().print(f"events: {events}", soft_wrap=True)


def print_autoload(summary: dict[str, Any]) -> None:
    """Print what a sequence of autonomous loadings came to: a row a loading, and the mean."""
    from rich.table import Table

    kinds = (
        f"{summary['fell_back']} fell back, {summary['cleaned']} cleaned first, {summary['failed']} failed"
    )
    table = Table(
        title=f"{summary['loadings']} loadings by {summary['choice']}: {kinds}", title_justify="left"
    )
    strategy, objectives = ("alpha", "beta", "gamma", "kappa"), ("production", "damage", "debris")
    units = {"production": "kg/s", "debris": "kg"}
    for name in ("loading", *strategy, *(f"{name} {units.get(name, '')}".strip() for name in objectives)):
        table.add_column(name, justify="right")
    for number, decision in enumerate(summary["decisions"]):
        values = [f"{decision['strategy'][name]:.2f}" for name in strategy]
        came = [summary["quantities"][name]["values"][number] for name in objectives]
        shown = ["-" if value is None else f"{value:.4g}" for value in came]
        table.add_row(f"{number + 1}", *values, *shown)
    means = [summary["quantities"][name]["mean"] for name in objectives]
    table.add_section()
    table.add_row("mean", "", "", "", "", *("-" if value is None else f"{value:.4g}" for value in means))
    get_output().print(table)


def print_calibration(result: dict[str, Any]) -> None:
    """Print what `run_calibration` found: values with intervals."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title=f"Calibration, {result['simulations']} simulations", title_justify="left")
    for name in ("parameter", "best", f"{100 * result['confidence']:g} % interval", "range"):
        table.add_column(name, justify="right")
    for name, item in result["parameters"].items():
        interval, ends = f"{item['low']:.4g} to {item['high']:.4g}", item["range"]
        label = name if item["unit"] == "-" else f"{name} [{item['unit']}]"
        table.add_row(Text(label), f"{item['best']:.4g}", interval, f"{ends[0]:g} to {ends[1]:g}")
    get_output().print(table)


def print_comparison(rows: list[dict[str, str]], a: str, b: str) -> None:
    """Print two loadings side by side.

    Args:
        rows: of `drakerock.viewing.replay.write_comparison`.
        a, b: their folders.
    """
    from rich.table import Table
    from rich.text import Text

    table = Table("", "A", "B", "B - A", title=f"A: {a}   B: {b}", title_justify="left")
    for row in rows:
        label = f"{row['label']} [{row['unit']}]" if row["unit"] else row["label"]
        table.add_row(Text(label), row["a"], row["b"], row["difference"])
    get_output().print(table)


def _kilo(value: float | None) -> float | None:
    return None if value is None else value / 1e3


def print_table(title: str, rows: dict[str, Any]) -> None:
    """Print names and values."""
    from rich.table import Table

    table = Table(title=title, show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    for key, value in rows.items():
        shown = f"{value:.4g}" if isinstance(value, float) else str(value)
        table.add_row(key.replace("_", " "), shown)
    get_output().print(table)


def print_paths(paths: list[Path]) -> None:
    """Print which files were written."""
    for path in paths:
        print_line(f"wrote {path}")
