"""`drakerock new`: parses arguments, calls one function each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from drakerock import terminal

new_app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="A commented machine, site, study or controller of your own, in any folder; it runs as it is.",
)
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Where to write; made if missing.")]


@new_app.command("machine")
def new_machine(
    folder: Folder,
    payload: Annotated[
        float, typer.Option(prompt="Payload of the machine [t]", help="What its bucket carries [t].")
    ],
    name: Annotated[str, typer.Option(help="Of the machine.")] = "my_machine",
) -> None:
    """Write a machine to change: the shipped one at the size of a payload, and a loading with it.

    Example: drakerock new machine my_machine --payload 9
    """
    from drakerock.study.project import make_machine_project

    _tell(
        make_machine_project(folder, name, 1e3 * payload), f"drakerock machine check {folder}/scenario.yaml"
    )


@new_app.command("site")
def new_site(
    folder: Folder,
    width: Annotated[float, typer.Option(help="Of the drift [m].")] = 3.9,
    height: Annotated[float, typer.Option(help="Of the drift [m].")] = 5.0,
) -> None:
    """Write a drift with its pile to change.

    Example: drakerock new site my_site --width 4.5
    """
    from drakerock.study.project import make_site_project

    _tell(make_site_project(folder, width, height), f"drakerock load {folder}/scenario.yaml --out out/site")


@new_app.command("study")
def new_study(folder: Folder) -> None:
    """Write a study to change, small enough to see it run.

    Example: drakerock new study my_study
    """
    from drakerock.study.project import make_study_project

    _tell(make_study_project(folder), f"drakerock study run {folder}/study.yaml --out out/study")


@new_app.command("controller")
def new_controller(folder: Folder) -> None:
    """Write a controller to change, and a loading that it drives.

    Example: drakerock new controller my_controller
    """
    from drakerock.study.project import make_controller_project

    _tell(make_controller_project(folder), f"drakerock load {folder}/scenario.yaml --out out/controller")


def _tell(paths: list[Path], following: str) -> None:
    meshes = [path for path in paths if path.suffix == ".obj"]
    for path in paths:
        if path not in meshes:
            terminal.print_line(f"wrote {path}")
    if meshes:
        terminal.print_line(f"wrote {len(meshes)} meshes beside it")
    terminal.print_line(f"next: {following}")
