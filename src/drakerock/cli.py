"""The `drakerock` command: parses arguments, calls one function each."""

from __future__ import annotations

import gc
import json
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from drakerock import terminal
from drakerock.cli_autoload import autoload
from drakerock.cli_new import new_app
from drakerock.errors import InputError, RunStopped, SimulationFailure
from drakerock.logs import show_only_ours

app = typer.Typer(
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # its help imports rich and a Markdown parser
)

ScenarioArgument = Annotated[
    Path | None, typer.Argument(help="Scenario YAML file; left out: the shipped studies/demo.yaml.")
]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results; made if missing.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a scenario key (dotted).")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print only JSON on standard output.")]
SeedOption = Annotated[int | None, typer.Option(help="Seed of all randomness.")]


# How many objects more than before make the collector look at them.
NEW_OBJECTS = 100_000

FIRST_STEPS = """drakerock simulates a load-haul-dump machine digging in thousands of rocks. Begin with

  drakerock load studies/small.yaml --out out/small      a loading in seconds; open out/small/replay.html
  drakerock new machine my_machine --payload 9           your own machine; likewise site, study, controller
  drakerock study run studies/smoke.yaml --out out/smoke   a whole campaign, in miniature
  drakerock --help                                     all commands; each has --help with an example
  drakerock --install-completion                       Tab completes commands and options"""


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"drakerock {version('drakerock')} (drake {version('drake')})")
        raise typer.Exit


@app.callback()
def start(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Simulation-based development of robotic rock loading, built on Drake."""
    if context.invoked_subcommand is None:
        terminal.print_line(FIRST_STEPS)


def main() -> None:
    """Run the command line; bad input prints one message and exits with 2, a failed simulation with 1."""
    # Imports make many objects and no garbage: to look for some takes an eighth of their time.
    gc.set_threshold(NEW_OBJECTS)
    show_only_ours()
    try:
        app()
    except InputError as error:
        terminal.print_error("error", error)
        sys.exit(2)
    except SimulationFailure as error:
        terminal.print_error("failed", error)
        sys.exit(1)
    except RunStopped as error:
        terminal.print_error("stopped", error)
        terminal.get_console().print("what was finished is stored; the same command goes on")
        sys.exit(1)
    except KeyboardInterrupt:
        terminal.get_console().print("interrupted")
        sys.exit(130)


@app.command()
def pile(
    scenario: ScenarioArgument = None,
    out: OutOption = Path("out/pile"),
    from_scan: Annotated[
        Path | None,
        typer.Option(
            metavar="CLOUD", help="Fill a measured surface: PLY, LAS, LAZ, XYZ or CSV (pile.scan.file)."
        ),
    ] = None,
    align: Annotated[
        Path | None, typer.Option(help="YAML file with the scan's keys: unit, rotation_deg, translation, ...")
    ] = None,
    seed: SeedOption = None,
    set_: SetOption = None,
    json_: JsonOption = False,
) -> None:
    """Make (or take from the cache) the rock pile of a scenario, or one that fills a scan.

    Example: drakerock pile studies/demo.yaml --out out/pile

    Example: drakerock pile studies/small.yaml --from-scan muckpile.las --align align.yaml --out out/measured
    """
    from drakerock.study.jobs import make_pile_files

    if align is not None and from_scan is None:
        raise InputError("--align: says how a scan lies in the site; give --from-scan, too")
    if from_scan is not None:
        from drakerock.study.survey import make_scan_overrides

        # What the scenario says of its pile's origin gives way; what --set says counts.
        set_ = [*make_scan_overrides(from_scan, align), *(set_ or [])]
    with terminal.show_progress("pile") as advance:
        summary, paths = make_pile_files(_load(scenario, seed, set_), out, advance)
    if json_:
        print(json.dumps(summary))
        return
    terminal.print_pile(summary)
    terminal.print_paths(paths)


@app.command()
def survey(
    scenario: ScenarioArgument = None,
    out: OutOption = Path("out/survey"),
    seed: SeedOption = None,
    set_: SetOption = None,
    json_: JsonOption = False,
) -> None:
    """Write a pile as a survey would: the simulated scanner's cloud, the height field, the rocks' surface.

    Site software opens them: PLY, LAS, GeoTIFF; npz for Python. A stored pile: --set pile.source=FILE.npz

    Example: drakerock survey studies/small.yaml --out out/survey
    """
    from drakerock.study.survey import write_survey

    with terminal.show_progress("survey") as advance:
        summary, paths = write_survey(_load(scenario, seed, set_), out, advance)
    if json_:
        print(json.dumps(summary))
        return
    terminal.print_table("Survey", summary)
    terminal.print_paths(paths)


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
        bool, typer.Option(help="Write replay.html, of each loading; about 3 MB at full size.")
    ] = True,
    figures: Annotated[bool, typer.Option("--figures", help="Write the pictures, too, as PNG.")] = False,
    meshcat: Annotated[
        bool, typer.Option("--meshcat", help="Show the cycle in a browser while it is computed.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the files of an earlier loading in the folder.")
    ] = False,
    seed: SeedOption = None,
    set_: SetOption = None,
    json_: JsonOption = False,
) -> None:
    """Run one loading cycle, or a sequence, and write outcome, signals, piles and replay.

    Example: drakerock load studies/demo.yaml --alpha 1.3 --beta 0.85 --out out/load

    Example: drakerock load studies/small.yaml --loadings 5 --figures --out out/five
    """
    from drakerock.study.job_folder import use_folder
    from drakerock.study.jobs import run_and_save, run_and_save_sequence

    overrides = _name_strategy(alpha=alpha, beta=beta, gamma=gamma, kappa=kappa)
    if plan is not None:
        overrides.append(f"loading.planning.source={json.dumps(str(plan))}")
    config = _load(scenario, seed, [*(set_ or []), *overrides])
    if meshcat and loadings is not None:
        raise InputError("--meshcat: shows one cycle; leave out --loadings")
    if loadings is not None:
        stopped = "loadings that were finished are stored; the same command goes on"
        with use_folder(out, force=force, sequence=True), terminal.show_progress("load", stopped) as advance:
            summary, paths = run_and_save_sequence(
                config, loadings, out, advance, replay=replay, figures=figures
            )
        if json_:
            print(json.dumps(summary))
        else:
            terminal.print_sequence(summary)
            terminal.print_paths(paths)
        if summary["failed"]:
            raise SimulationFailure(summary["reasons"][-1])
        return
    live = _start_meshcat() if meshcat else None
    stopped = f"nothing was written to {out}"
    with use_folder(out, force=force, sequence=False), terminal.show_progress("load", stopped) as advance:
        result, paths = run_and_save(config, out, advance, replay=replay, figures=figures, meshcat=live)
    if json_:
        print(result.to_json(), end="")
    else:
        terminal.print_outcome(result)
        terminal.print_paths(paths)
    if live and sys.stdin.isatty():
        input("Press Enter to close the live view. ")
    if result.status == "failed":
        raise SimulationFailure(result.reason)


LoadingFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished loading.")]


@app.command()
def replay(
    folder: Annotated[Path, typer.Argument(help="Folder of a finished cycle, or of a sequence.")],
) -> None:
    """Make replay.html anew from what is stored; of a sequence, each loading's.

    Example: drakerock replay out/load
    """
    from drakerock.viewing.replay import write_replay

    places = sorted(path.parent for path in folder.glob("loading_*/recording.npz"))
    if (folder / "recording.npz").exists() or not places:
        places = [folder]
    pages = []
    with terminal.show_progress("replay") as advance:
        for number, place in enumerate(places):
            advance("drawing", number / len(places), note=place.name)
            pages.append(write_replay(place, loadings=len(places)))
    terminal.print_paths(pages)


@app.command()
def compare(
    a: Annotated[Path, typer.Argument(metavar="A", help="Folder of a finished loading.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="Folder of another one.")],
    out: Annotated[Path, typer.Option("--out", help="The page to write.")] = Path("compare.html"),
    json_: JsonOption = False,
) -> None:
    """Compare two loadings: a table, and a page with both replays side by side and their histories overlaid.

    Example: drakerock compare out/first out/second --out out/compare.html
    """
    from drakerock.files import make_folder
    from drakerock.viewing.replay import write_comparison

    make_folder(out.parent)
    with terminal.show_progress("compare"):
        rows = write_comparison([a, b], out)
    if json_:
        print(json.dumps(rows))
        return
    terminal.print_comparison(rows, str(a), str(b))
    terminal.print_paths([out])


class Camera(StrEnum):
    """Where a film is seen from."""

    side = "side"
    driver = "driver"
    top = "top"
    bucket = "bucket"


@app.command()
def film(
    folder: LoadingFolder,
    out: Annotated[
        Path | None,
        typer.Option("--out", help=".mp4, .gif, or a folder for PNG pictures [default: RUN/film.mp4]."),
    ] = None,
    camera: Annotated[Camera, typer.Option(help="Where it is seen from.")] = Camera.side,
    cut: Annotated[
        float, typer.Option(min=0, max=1, help="Leave out rocks up to the machine's middle: 0 none, 1 all.")
    ] = 0.0,
    size: Annotated[str, typer.Option(help="Width x height in pixels, even.")] = "1280x720",
    fps: Annotated[float, typer.Option(min=1, max=60, help="Pictures per second.")] = 15.0,
    speed: Annotated[float, typer.Option(min=0.05, max=20, help="Times as fast as in truth.")] = 1.0,
) -> None:
    """Film a loading's replay, without a display: needs Chromium or Chrome and `pip install 'drakerock[film]'`.

    Example: drakerock film out/load --camera driver --speed 2 --out out/load/driver.gif
    """
    from drakerock.viewing.film import FilmSettings, write_film

    parts = size.lower().split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) > 0 for part in parts):
        raise InputError(f"--size {size}: width x height in pixels, such as 1280x720")
    settings = FilmSettings(fps, speed, int(parts[0]), int(parts[1]), camera.value, cut)
    out = out or folder / "film.mp4"
    with terminal.show_progress("film") as advance:
        write_film(folder, out, settings, lambda share: advance("filming", share))
    terminal.print_paths([out])


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
    with terminal.show_progress("lab") as advance:
        result, paths = run_and_save_test(test, _load(scenario, seed, set_), out, overrides, advance)
    if json_:
        print(json.dumps(result.to_dict()))
        return
    terminal.get_output().print(make_lab_table(result))
    terminal.get_output().print(f"{result.facts['cpu_s']:g} CPU s")
    terminal.print_paths(paths)


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

    with terminal.show_progress("machine check"):
        rows = run_machine_checks(_load(scenario, None, set_).machine)
    if json_:
        print(json.dumps(make_check_data(rows)))
    else:
        terminal.get_output().print(make_check_table(rows))
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
    with terminal.show_progress("machine show"):
        path = write_machine_page(_load(scenario, None, set_).machine, out / "machine.html")
    terminal.print_paths([path])


app.command()(autoload)
app.add_typer(new_app, name="new")
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
    with Display(terminal.get_console()) as display:
        status = run_study(config, out, workers=workers, scheduler=scheduler, display=display)
    if json_:
        print(json.dumps(status))
        return
    terminal.get_output().print(make_status_table(status))
    terminal.print_paths(
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
        terminal.get_output().print(make_status_table(status))


@study_app.command("export")
def study_export(
    folder: StudyFolder,
    format_: Annotated[str, typer.Option("--format", help="csv or parquet.")] = "csv",
) -> None:
    """Write the tables: responses (one row per finished point) and loadings (one row per cycle).

    Example: drakerock study export out/smoke --format parquet
    """
    from drakerock.study.tables import export_tables

    terminal.print_paths(export_tables(folder, [format_]))


@study_app.command("pack")
def study_pack(
    folder: StudyFolder,
    out: Annotated[Path | None, typer.Option("--out", help="File to write [default: DIR.tar.xz].")] = None,
    everything: Annotated[
        bool, typer.Option("--everything", help="Also signals, recordings and piles, where they are kept.")
    ] = False,
    without_plans: Annotated[
        bool, typer.Option("--without-plans", help="Leave the plans behind: a fifth of the size.")
    ] = False,
) -> None:
    """Pack a study that is not running into one file, to be carried elsewhere and gone on with.

    Example: drakerock study pack out/smoke --out smoke.tar.xz
    """
    from drakerock.study.packing import pack_study

    with terminal.show_progress("pack"):
        path = out or folder.with_name(f"{folder.resolve().name}.tar.xz")
        pack_study(folder, path, everything=everything, plans=not without_plans)
    terminal.print_paths([path])


@study_app.command("unpack")
def study_unpack(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="What `study pack` wrote.")],
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to; made if missing.")],
) -> None:
    """Unpack a packed study, checked; `study run` goes on there.

    Example: drakerock study unpack smoke.tar.xz out/smoke
    """
    from drakerock.study.packing import unpack_study

    with terminal.show_progress("unpack"):
        unpack_study(path, folder)
    terminal.print_paths([folder])


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
            terminal.print_line(f"{fault.kind}: {fault.path} {fault.message}")
        terminal.get_output().print(f"{len(faults)} faults" if faults else "no faults")
    if faults:
        raise typer.Exit(1)


@study_app.command("report")
def study_report(
    source: Annotated[Path, typer.Argument(metavar="DIR", help="Study folder or response table.")],
    out: Annotated[Path | None, typer.Option(help="Folder to write into [default: DIR/report].")] = None,
    replays: Annotated[
        bool, typer.Option("--replays", help="Make each loading's replay first; the report leads to them.")
    ] = False,
) -> None:
    """Fit, validate and explore; write one self-contained report.html with figures and numbers.

    Example: drakerock study report out/paper

    Example: drakerock study report out/paper --replays
    """
    from drakerock.study.analysis import run_report

    with terminal.show_progress("report") as advance:
        paths = run_report(source, out, advance, replays=replays)
    terminal.print_paths(paths)


@study_app.command("tornado")
def study_tornado(
    folder: StudyFolder,
    out: Annotated[Path | None, typer.Option(help="Folder to write into [default: DIR].")] = None,
    json_: JsonOption = False,
) -> None:
    """Draw what each variable changes of each objective, of a study that varies one thing at a time.

    Example: drakerock study tornado out/sensitivity
    """
    from drakerock.study.tornado import run_tornado

    rows, paths = run_tornado(folder, out)
    if json_:
        print(json.dumps(rows))
    else:
        terminal.print_paths(paths)


@study_app.command("confirm")
def study_confirm(
    folder: StudyFolder,
    points: Annotated[int | None, typer.Option(help="How many front points to simulate again.")] = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    json_: JsonOption = False,
) -> None:
    """Simulate chosen Pareto points again: predicted against simulated; the report then shows it.

    Interrupted, it goes on when called again.

    Example: drakerock study confirm out/paper --points 5
    """
    from drakerock.study.analysis import format_confirmation, run_confirm, run_report
    from drakerock.study.resimulation import Resimulation

    again = Resimulation(folder, workers=workers, scheduler=scheduler, say=terminal.say)
    with terminal.show_progress("confirm") as advance:
        confirmation = run_confirm(folder, again.evaluate, points, again.run, advance)
        report = run_report(folder, None, advance)[0]
    if json_:
        print(json.dumps(confirmation.to_rows(), indent=2))
    else:
        print(format_confirmation(confirmation))
        terminal.print_paths([folder / "confirmation.json", report])


@app.command()
def calibrate(
    study: Annotated[Path, typer.Argument(help="Study YAML file with `variables` and `calibration`.")],
    measured: Annotated[Path, typer.Option("--measured", help="CSV file of the measured curves.")],
    out: Annotated[Path, typer.Option("--out", help="Folder of the study; made if missing.")] = Path(
        "out/calibration"
    ),
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a study key (dotted).")
    ] = None,
    json_: JsonOption = False,
) -> None:
    """Fit a study's variables to measured curves: values with intervals. Interrupted, it goes on when called again.

    Example: drakerock calibrate studies/calibration.yaml --measured measured.csv --out out/calibration
    """
    from drakerock.study.calibration import run_calibration
    from drakerock.study.display import Display
    from drakerock.study.schema import load_study

    config = load_study(study, set_ or ())
    with Display(terminal.get_console()) as display:
        result, paths = run_calibration(
            config, measured, out, workers=workers, scheduler=scheduler, display=display, say=terminal.say
        )
    if json_:
        print(json.dumps(result))
        return
    terminal.print_calibration(result)
    for warning in result["warnings"]:
        terminal.say(f"warning: {warning}")
    terminal.print_paths(paths)


@app.command()
def strategy(
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="[DIR]", help="Study folder or response table [default: studies/full_size, shipped]."
        ),
    ] = None,
    weights: Annotated[
        str | None, typer.Option(help="Trade-off, such as production=0.6,damage=0.2,debris=0.2.")
    ] = None,
    bound: Annotated[
        list[str] | None,
        typer.Option("--bound", "--bounds", help="Limit, such as 'debris<=500'; repeatable."),
    ] = None,
    best: Annotated[
        str | None,
        typer.Option("--best", metavar="OBJECTIVE", help="The one objective that counts, within bounds."),
    ] = None,
    probability: Annotated[
        float | None, typer.Option(help="With which each bound has to hold, 0.5 to 1 [default: 0.9].")
    ] = None,
    knee: Annotated[bool, typer.Option("--knee", help="The knee point (what no weights mean).")] = False,
    json_: JsonOption = False,
) -> None:
    """Print the Pareto-optimal strategy for a trade-off, and how far the study can be relied on.

    Example: drakerock strategy --weights production=0.6,damage=0.2,debris=0.2

    Example: drakerock strategy out/smoke --best production --bound 'debris<=500'
    """
    from drakerock.study.analysis import FULL_SIZE, run_strategy

    if knee + (weights is not None) + (best is not None) > 1:
        raise InputError("--knee, --weights and --best exclude each other")
    limits = [part for text in bound or [] for part in text.split(",") if part.strip()]
    with terminal.show_progress("strategy") as advance:
        chosen = run_strategy(
            source or FULL_SIZE, weights, limits, advance, best=best, probability=probability
        )
    print(json.dumps(chosen.to_dict(), indent=2) if json_ else chosen.to_text())


@app.command()
def plan(
    scenario: ScenarioArgument = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for plan.json and plan.png.")] = None,
    alpha: Annotated[float | None, typer.Option(help="Fill ratio aimed at, 0.2 to 2.")] = None,
    beta: Annotated[float | None, typer.Option(help="Dig height, 0 deep to 1 shallow.")] = None,
    gamma: Annotated[float | None, typer.Option(help="Entry point, 1 front-most, 0 rear-most.")] = None,
    kappa: Annotated[float | None, typer.Option(help="Share of the curl done while lifting, 0 to 1.")] = None,
    pile: Annotated[
        Path | None, typer.Option(help="Another pile (.npz), or a plan.json whose height field is taken.")
    ] = None,
    study: Annotated[
        Path | None, typer.Option(help="Study folder or response table that predicts the outcome.")
    ] = None,
    serve: Annotated[bool, typer.Option("--serve", help="A page with sliders, in the browser.")] = False,
    set_: SetOption = None,
    json_: JsonOption = False,
) -> None:
    """Preview a strategy on a pile: the plan, and what a study predicts of it. Nothing is simulated.

    Example: drakerock plan --alpha 1.3 --beta 0.85 --gamma 1 --kappa 0.6 --out out/plan

    Example: drakerock plan studies/small.yaml --study out/small --serve
    """
    from drakerock.study.preview import Preview

    overrides = _name_strategy(alpha=alpha, beta=beta, gamma=gamma, kappa=kappa)
    config = _load(scenario, None, [*(set_ or []), *overrides])
    with terminal.show_progress("plan"):
        preview = Preview(config, pile, study)
    if serve:
        from drakerock.study.preview_server import serve_preview

        serve_preview(
            preview, lambda address: terminal.get_output().print(f"plan page: {address} (Ctrl-C ends it)")
        )
        return
    shown = preview.describe(config.loading.strategy)
    if json_:
        print(json.dumps(shown.to_dict()))
    else:
        print(shown.to_text())
    if out is not None:
        terminal.print_paths(shown.save(out))


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
    terminal.get_output().print(f"live view: {meshcat.web_url()}")
    return meshcat


def _name_strategy(**values: float | None) -> list[str]:
    """Return what was given of a strategy as overrides of a scenario."""
    return [f"loading.strategy.{key}={value}" for key, value in values.items() if value is not None]


def _load(path: Path | None, seed: int | None, overrides: list[str] | None) -> Any:
    from drakerock.loading.scenario import load_scenario

    extra = [f"seed={seed}"] if seed is not None else []
    return load_scenario(path, [*(overrides or []), *extra])
