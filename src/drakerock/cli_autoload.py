"""`drakerock autoload`: parses arguments, calls one function."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from drakerock import terminal
from drakerock.errors import SimulationFailure


def autoload(
    scenario: Annotated[
        Path | None, typer.Argument(help="Scenario YAML file; left out: the shipped studies/demo.yaml.")
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of a study, or of its tables exported as Parquet."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for the results; made if missing.")] = Path(
        "out/autoload"
    ),
    cycles: Annotated[int, typer.Option(min=1, help="Loadings in all.")] = 20,
    choice: Annotated[
        str,
        typer.Option(help="fixed, best_fixed, features, field, look_ahead or bandit; see docs/autonomy.md."),
    ] = "look_ahead",
    depth: Annotated[int, typer.Option(min=1, max=6, help="Loadings that look_ahead looks ahead.")] = 3,
    weights: Annotated[
        str | None, typer.Option(help="Trade-off, such as production=0.6,damage=0.2,debris=0.2.")
    ] = None,
    bound: Annotated[
        list[str] | None, typer.Option("--bound", help="Limit, such as 'debris<=500'; repeatable.")
    ] = None,
    then: Annotated[
        list[str] | None,
        typer.Option(
            "--then",
            metavar="N:WEIGHTS",
            help="Other weights from loading N on, such as 10:damage=1; repeatable.",
        ),
    ] = None,
    replay: Annotated[bool, typer.Option(help="Write each loading's replay.html.")] = True,
    seed: Annotated[int | None, typer.Option(help="Seed of all randomness.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a scenario key (dotted).")
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print only JSON on standard output.")] = False,
) -> None:
    """Load autonomously: each loading's strategy is chosen by the pile, with what a study has taught. Resumable.

    Example: drakerock autoload --model out/full_size --weights production=0.8,damage=0.2 --cycles 20 --out out/auto

    Example: drakerock autoload --model out/full_size --choice bandit --bound 'debris<=500' --then 10:damage=1
    """
    from drakerock.autonomy.job import AutoloadJob, run_autoload
    from drakerock.loading.scenario import load_scenario

    extra = [f"seed={seed}"] if seed is not None else []
    config = load_scenario(scenario, [*(set_ or []), *extra])
    job = AutoloadJob(model, choice, depth, weights, tuple(bound or ()), tuple(then or ()), cycles, replay)
    stopped = "loadings that were finished are stored; the same command goes on"
    say = (lambda _text: None) if json_ else terminal.say
    with terminal.show_progress("autoload", stopped) as advance:
        summary, paths = run_autoload(config, job, out, advance, say)
    if json_:
        print(json.dumps(summary))
    else:
        terminal.print_autoload(summary)
        terminal.print_paths(paths)
    if summary["failed"]:
        raise SimulationFailure(summary["reasons"][-1])
