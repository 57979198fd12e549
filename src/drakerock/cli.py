"""The `drakerock` command: parses arguments, calls one function each."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from drakerock.errors import InputError, RunStopped, SimulationFailure

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Simulation-based development of robotic rock loading, built on Drake.",
)
console = Console(stderr=True)
output = Console()

ScenarioArgument = Annotated[
    Path | None, typer.Argument(help="Scenario YAML file; left out: the shipped studies/demo.yaml.")
]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results; made if missing.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a scenario key (dotted).")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print only JSON on standard output.")]
SeedOption = Annotated[int | None, typer.Option(help="Seed of all randomness.")]


def main() -> None:
    """Run the command line; bad input prints one message and exits with 2, a failed simulation with 1."""
    logging.getLogger("drake").addFilter(_is_for_users)
    try:
        app()
    except InputError as error:
        _print_error("error", error)
        sys.exit(2)
    except SimulationFailure as error:
        _print_error("failed", error)
        sys.exit(1)
    except RunStopped as error:
        _print_error("stopped", error)
        console.print("what was finished is stored; the same command goes on")
        sys.exit(1)
    except KeyboardInterrupt:
        console.print("interrupted")
        sys.exit(130)


def _is_for_users(record: logging.LogRecord) -> bool:
    """Return False for Drake's notes on how a scene was built and on the server of a page that is only written."""
    return record.levelno >= logging.WARNING and "half spaces" not in record.getMessage()


def _print_error(word: str, error: Exception) -> None:
    # Text, not markup: a message may hold brackets.
    console.print(Text(f"{word}: ", "bold red").append(str(error), "default"), soft_wrap=True)


@app.command()
def pile(
    scenario: ScenarioArgument = None,
    out: OutOption = Path("out/pile"),
    seed: SeedOption = None,
    set_: SetOption = None,
    json_: JsonOption = False,
) -> None:
    """Make (or take from the cache) the rock pile of a scenario.

    Example: drakerock pile studies/demo.yaml --out out/pile
    """
    from drakerock.study.jobs import make_pile_files

    with _show_progress("pile") as advance:
        summary, paths = make_pile_files(_load(scenario, seed, set_), out, advance)
    if json_:
        print(json.dumps(summary))
        return
    gradation = Table(title="Gradation", title_justify="left")
    for name in ("sieve width", "rocks", "mass", "share", "wanted"):
        gradation.add_column(name, justify="right")
    for item in summary.pop("gradation"):
        gradation.add_row(
            f"{item['size_m']:g} m", f"{item['rocks']}", f"{item['mass_kg'] / 1e3:.1f} t",
            f"{100 * item['share']:.1f} +- {100 * item['standard_error']:.1f} %", f"{100 * item['wanted']:.0f} %",
        )  # fmt: skip
    _print_table("Pile", summary)
    output.print(gradation)
    _print_paths(paths)


@app.command()
def load(
    scenario: ScenarioArgument = None,
    out: OutOption = Path("out/load"),
    alpha: Annotated[float | None, typer.Option(help="Fill ratio aimed at, 0.2 to 2.")] = None,
    beta: Annotated[float | None, typer.Option(help="Dig height, 0 deep to 1 shallow.")] = None,
    gamma: Annotated[float | None, typer.Option(help="Entry point, 1 front-most, 0 rear-most.")] = None,
    kappa: Annotated[float | None, typer.Option(help="Share of the curl done while lifting, 0 to 1.")] = None,
    plan: Annotated[
        Path | None, typer.Option(help="A stored plan.json to execute instead of planning.")
    ] = None,
    loadings: Annotated[
        int | None, typer.Option(min=1, help="Run or resume a sequence of so many loadings.")
    ] = None,
    replay: Annotated[
        bool, typer.Option(help="Write replay.html, of each loading; about 13 MB at full size.")
    ] = True,
    figures: Annotated[bool, typer.Option("--figures", help="Write the pictures, too, as PNG.")] = False,
    meshcat: Annotated[
        bool, typer.Option("--meshcat", help="Show the cycle in a browser while it is computed.")
    ] = False,
    seed: SeedOption = None,
    set_: SetOption = None,
    json_: JsonOption = False,
) -> None:
    """Run one loading cycle, or a sequence, and write outcome, signals, piles and replay.

    Example: drakerock load studies/demo.yaml --alpha 1.3 --beta 0.85 --out out/load

    Example: drakerock load studies/small.yaml --loadings 5 --figures --out out/five
    """
    from drakerock.study.jobs import run_and_save, run_and_save_sequence

    strategy = {"alpha": alpha, "beta": beta, "gamma": gamma, "kappa": kappa}
    overrides = [f"loading.strategy.{key}={value}" for key, value in strategy.items() if value is not None]
    if plan is not None:
        overrides.append(f"loading.planning.source={json.dumps(str(plan))}")
    config = _load(scenario, seed, [*(set_ or []), *overrides])
    if meshcat and loadings is not None:
        raise InputError("--meshcat: shows one cycle; leave out --loadings")
    if loadings is not None:
        with _show_progress("load") as advance:
            summary, paths = run_and_save_sequence(
                config, loadings, out, advance, replay=replay, figures=figures
            )
        if json_:
            print(json.dumps(summary))
        else:
            _print_sequence(summary)
            _print_paths(paths)
        if summary["failed"]:
            raise SimulationFailure(summary["reasons"][-1])
        return
    live = _start_meshcat() if meshcat else None
    with _show_progress("load") as advance:
        result, paths = run_and_save(config, out, advance, replay=replay, figures=figures, meshcat=live)
    if json_:
        print(result.to_json(), end="")
    else:
        _print_outcome(result)
        _print_paths(paths)
    if live and sys.stdin.isatty():
        input("Press Enter to close the live view. ")
    if result.status == "failed":
        raise SimulationFailure(result.reason)


@app.command()
def replay(
    folder: Annotated[Path, typer.Argument(help="Folder of a finished cycle, or of a sequence.")],
) -> None:
    """Make replay.html anew from a stored recording; of a sequence, each loading's.

    Example: drakerock replay out/load
    """
    from drakerock.loading.recording import load_recording
    from drakerock.viewing.replay import write_replay

    places = sorted(path.parent for path in folder.glob("loading_*/recording.npz"))
    if (folder / "recording.npz").exists() or not places:
        places = [folder]
    with _show_progress("replay") as advance:
        for number, place in enumerate(places):
            advance("drawing", number / len(places), note=place.name)
            write_replay(load_recording(place / "recording.npz"), place / "replay.html")
    _print_paths([place / "replay.html" for place in places])


@app.command()
def lab(
    test: Annotated[
        str,
        typer.Argument(
            help="repose, shear, discharge, silo, settlement, plate, bucket or drag; see docs/laboratory.md."
        ),
    ],
    scenario: ScenarioArgument = None,
    out: OutOption = Path("out/lab"),
    repeats: Annotated[int | None, typer.Option(help="Specimens, each of rocks of its own.")] = None,
    with_: Annotated[
        list[str] | None,
        typer.Option(
            "--with", metavar="KEY=VALUE", help="Change one of the test's settings, such as rocks=500."
        ),
    ] = None,
    seed: SeedOption = None,
    set_: SetOption = None,
    json_: JsonOption = False,
) -> None:
    """Test a scenario's rocks as a material, and hold them against what is known of broken rock.

    Example: drakerock lab repose --out out/lab

    Example: drakerock lab shear --with 'stresses_kPa=[50, 100]' --set rocks.friction=0.6
    """
    from drakerock.study.laboratory import run_and_save_test
    from drakerock.viewing.lab_table import make_lab_table

    overrides = [*(with_ or []), *([f"repeats={repeats}"] if repeats is not None else [])]
    with _show_progress("lab") as advance:
        result, paths = run_and_save_test(test, _load(scenario, seed, set_), out, overrides, advance)
    if json_:
        print(json.dumps(result.to_dict()))
        return
    output.print(make_lab_table(result))
    output.print(f"{result.facts['cpu_s']:g} CPU s")
    _print_paths(paths)


machine_app = typer.Typer(no_args_is_help=True, help="The machine: its checks and its looks.")
app.add_typer(machine_app, name="machine")


@machine_app.command("check")
def machine_check(
    scenario: ScenarioArgument = None, set_: SetOption = None, json_: JsonOption = False
) -> None:
    """Measure the machine by simulation and compare it with its data.

    Example: drakerock machine check studies/demo.yaml
    """
    from drakerock.lhd.checks.checks import run_machine_checks
    from drakerock.lhd.checks.rows import make_check_data, make_check_table

    with _show_progress("machine check"):
        rows = run_machine_checks(_load(scenario, None, set_).machine)
    if json_:
        print(json.dumps(make_check_data(rows)))
    else:
        output.print(make_check_table(rows))
    if any(row.passed is False for row in rows):
        raise SimulationFailure(
            "the machine misses " + ", ".join(row.name for row in rows if row.passed is False)
        )


@machine_app.command("show")
def machine_show(
    scenario: ScenarioArgument = None, out: OutOption = Path("out/machine"), set_: SetOption = None
) -> None:
    """Write an HTML page of the machine moving through its workspace.

    Example: drakerock machine show --out out/machine
    """
    from drakerock.files import make_folder
    from drakerock.lhd.checks.page import write_machine_page

    make_folder(out)
    with _show_progress("machine show"):
        path = write_machine_page(_load(scenario, None, set_).machine, out / "machine.html")
    _print_paths([path])


study_app = typer.Typer(no_args_is_help=True, help="Campaigns: many sequences of loadings, stored.")
app.add_typer(study_app, name="study")
WorkersOption = Annotated[int | None, typer.Option(min=1, help="Processes [default: one per core].")]
SchedulerOption = Annotated[str | None, typer.Option(help="Address of a Dask scheduler to run on.")]
StudyFolder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a study.")]


@study_app.command("run")
def study_run(
    study: Annotated[Path, typer.Argument(help="Study YAML file.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the study; made if missing.")],
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a study key (dotted).")
    ] = None,
    json_: JsonOption = False,
) -> None:
    """Run a study, or go on with one that was interrupted. Ctrl-C once: finish the running cycles; twice: now.

    Example: drakerock study run studies/smoke.yaml --out out/smoke --workers 2
    """
    from drakerock.study.display import Display, make_status_table
    from drakerock.study.runner import run_study
    from drakerock.study.schema import load_study

    config = load_study(study, set_ or ())
    with Display(console) as display:
        status = run_study(config, out, workers=workers, scheduler=scheduler, display=display)
    if json_:
        print(json.dumps(status))
        return
    output.print(make_status_table(status))
    _print_paths(
        [out / f"{name}.{suffix}" for suffix in ("csv", "parquet") for name in ("responses", "loadings")]
    )


@study_app.command("status")
def study_status(folder: StudyFolder, json_: JsonOption = False) -> None:
    """Show what is done, running, failed (with reasons) and to do; from the store alone.

    Example: drakerock study status out/smoke
    """
    from drakerock.study.db import Store
    from drakerock.study.display import make_status_table
    from drakerock.study.status import read_status

    with Store.open(folder) as store:
        status = read_status(store)
    if json_:
        print(json.dumps(status))
    else:
        output.print(make_status_table(status))


@study_app.command("export")
def study_export(
    folder: StudyFolder,
    format_: Annotated[str, typer.Option("--format", help="csv or parquet.")] = "csv",
) -> None:
    """Write the tables: responses (one row per finished point) and loadings (one row per cycle).

    Example: drakerock study export out/smoke --format parquet
    """
    from drakerock.study.tables import export_tables

    _print_paths(export_tables(folder, [format_]))


@study_app.command("verify")
def study_verify(folder: StudyFolder, json_: JsonOption = False) -> None:
    """Check the store: database, checksums, missing files, files that belong to nothing.

    Example: drakerock study verify out/smoke
    """
    from drakerock.study.db import Store
    from drakerock.study.verify import verify_store

    with Store.open(folder) as store:
        faults = verify_store(store)
    if json_:
        print(json.dumps([vars(fault) for fault in faults]))
    else:
        for fault in faults:
            output.print(Text(f"{fault.kind}: {fault.path} {fault.message}"), soft_wrap=True)
        output.print(f"{len(faults)} faults" if faults else "no faults")
    if faults:
        raise typer.Exit(1)


@study_app.command("report")
def study_report(
    source: Annotated[Path, typer.Argument(metavar="DIR", help="Study folder or response table.")],
    out: Annotated[Path | None, typer.Option(help="Folder to write into [default: DIR/report].")] = None,
) -> None:
    """Fit, validate and explore; write one self-contained report.html with figures and numbers.

    Example: drakerock study report out/paper
    """
    from drakerock.study.analysis import run_report

    with _show_progress("report") as advance:
        paths = run_report(source, out, advance)
    _print_paths(paths)


@study_app.command("confirm")
def study_confirm(
    folder: StudyFolder,
    points: Annotated[int | None, typer.Option(help="How many front points to simulate again.")] = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    json_: JsonOption = False,
) -> None:
    """Simulate chosen Pareto points again: predicted against simulated. Interrupted, it goes on when called again.

    Example: drakerock study confirm out/paper --points 5
    """
    from drakerock.study.analysis import format_confirmation, run_confirm
    from drakerock.study.resimulation import Resimulation

    def say(text: str) -> None:
        console.print(Text(text), soft_wrap=True)

    again = Resimulation(folder, workers=workers, scheduler=scheduler, say=say)
    with _show_progress("confirm") as advance:
        confirmation = run_confirm(folder, again.evaluate, points, again.run, advance)
    if json_:
        print(json.dumps(confirmation.to_rows(), indent=2))
    else:
        print(format_confirmation(confirmation))
        _print_paths([folder / "confirmation.json"])


@app.command()
def strategy(
    source: Annotated[Path, typer.Argument(metavar="DIR", help="Study folder or response table.")],
    weights: Annotated[
        str | None, typer.Option(help="Trade-off, such as production=0.6,damage=0.2,debris=0.2.")
    ] = None,
    bound: Annotated[
        list[str] | None,
        typer.Option("--bound", "--bounds", help="Limit, such as 'debris<=500'; repeatable."),
    ] = None,
    knee: Annotated[bool, typer.Option("--knee", help="The knee point (what no weights mean).")] = False,
    json_: JsonOption = False,
) -> None:
    """Print the Pareto-optimal strategy for a trade-off.

    Example: drakerock strategy out/paper --weights production=0.6,damage=0.2,debris=0.2
    """
    from drakerock.study.analysis import run_strategy

    if knee and weights is not None:
        raise InputError("--knee and --weights exclude each other")
    limits = [part for text in bound or [] for part in text.split(",") if part.strip()]
    with _show_progress("strategy") as advance:
        chosen = run_strategy(source, weights, limits, advance)
    print(json.dumps(chosen.to_dict(), indent=2) if json_ else chosen.to_text())


class FileKind(StrEnum):
    """Kinds of files that a schema describes."""

    scenario = "scenario"
    study = "study"


@app.command()
def schema(kind: Annotated[FileKind, typer.Argument(help="Which files.")]) -> None:
    """Print the JSON Schema of scenario or study files, for editors.

    Example: drakerock schema scenario > scenario.schema.json

    Example: drakerock schema study > study.schema.json
    """
    from drakerock.config import make_json_schema
    from drakerock.loading.scenario import Scenario
    from drakerock.study.schema import StudyConfig

    described = Scenario if kind == FileKind.scenario else StudyConfig
    print(json.dumps(make_json_schema(described, f"drakerock {kind}"), indent=2))


def _start_meshcat() -> Any:
    """Return a Meshcat server whose address is printed."""
    from pydrake.geometry import Meshcat

    try:
        meshcat = Meshcat()
    except RuntimeError as error:
        raise InputError(f"--meshcat: no server can be started: {error}") from None
    output.print(f"live view: {meshcat.web_url()}")
    return meshcat


def _load(path: Path | None, seed: int | None, overrides: list[str] | None) -> Any:
    from drakerock.loading.scenario import load_scenario

    extra = [f"seed={seed}"] if seed is not None else []
    return load_scenario(path, [*(overrides or []), *extra])


@contextmanager
def _show_progress(name: str) -> Iterator[Callable[..., None]]:
    """Show what is being done on standard error; plain (and silent) when that is not a terminal."""
    columns = (TextColumn("[bold]{task.fields[stage]:<18}"), BarColumn(), TextColumn("{task.fields[note]}"))
    with Progress(
        *columns, TimeElapsedColumn(), console=console, transient=True, disable=not console.is_terminal
    ) as progress:
        task = progress.add_task(name, total=None, stage=name, note="")

        def advance(stage: str, share: float | None = None, note: str = "") -> None:
            progress.update(
                task, stage=stage, total=None if share is None else 1.0, completed=share or 0, note=note
            )

        yield advance


def _print_outcome(outcome: Any) -> None:
    table = Table(title="Loading cycle", show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    s = outcome.strategy

    def show(value: float | None, form: str) -> str:
        return "-" if value is None else form.format(value)

    table.add_row("strategy", "  ".join(f"{key} {value:g}" for key, value in s.items()))
    table.add_row("ended", f"{outcome.status}: {outcome.reason}")
    table.add_row("production", show(outcome.objectives["production"], "{:.0f} kg/s"))
    table.add_row("damage", show(outcome.objectives["damage"], "{:.4f}"))
    table.add_row("debris", show(outcome.objectives["debris"], "{:.0f} kg"))
    mass = show(outcome.bucket_mass_kg, "{:.0f} kg")
    table.add_row("bucket load", f"{mass} in {show(outcome.bucket_rocks, '{:d}')} rocks")
    counted = show(outcome.counted_when_weighed_kg, "{:.0f} kg")
    table.add_row("weighed", f"{show(outcome.weighed_mass_kg, '{:.0f} kg')} (counted then: {counted})")
    table.add_row("loading time t4 - t0", show(outcome.loading_time_s, "{:.2f} s"))
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
    output.print(table)


def _print_sequence(summary: dict[str, Any]) -> None:
    strategy = "  ".join(f"{key} {value:g}" for key, value in summary["strategy"].items())
    title = f"{summary['loadings']} loadings, {strategy}"
    table = Table(title=title, title_justify="left")
    rows = {
        "production": ("production [kg/s]", "{:.0f}"),
        "damage": ("damage", "{:.4f}"),
        "debris": ("debris [kg]", "{:.0f}"),
        "bucket_mass_kg": ("bucket load [kg]", "{:.0f}"),
        "weighed_mass_kg": ("weighed [kg]", "{:.0f}"),
        "loading_time_s": ("loading time [s]", "{:.2f}"),
        "energy_J": ("motors' work [J]", "{:.3g}"),
        "wall_time_s": ("wall time of a cycle [s]", "{:.1f}"),
    }
    table.add_column("")
    for heading in ("mean", "standard error", "spread", "values"):
        table.add_column(heading, justify="right")
    for name, (label, form) in rows.items():
        row = summary["quantities"][name]
        numbers = [
            "-" if row[key] is None else form.format(row[key]) for key in ("mean", "standard_error", "spread")
        ]
        values = "  ".join("-" if value is None else form.format(value) for value in row["values"])
        table.add_row(Text(label), *numbers, values)  # text, not markup: the units' brackets stay
    output.print(table)
    events = ", ".join(f"{name} {count}" for name, count in summary["events"].items()) or "none"
    output.print(f"events: {events}", soft_wrap=True)


def _kilo(value: float | None) -> float | None:
    return None if value is None else value / 1e3


def _print_table(title: str, rows: dict[str, Any]) -> None:
    table = Table(title=title, show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    for key, value in rows.items():
        shown = f"{value:.4g}" if isinstance(value, float) else str(value)
        table.add_row(key.replace("_", " "), shown)
    output.print(table)


def _print_paths(paths: list[Path]) -> None:
    for path in paths:
        output.print(Text(f"wrote {path}"), soft_wrap=True)
