"""`drakerock new`: commented files to begin a machine, site, study or controller of one's own; they run as they are."""

from __future__ import annotations

from pathlib import Path
from string import Template

import yaml

from drakerock.errors import InputError
from drakerock.files import make_folder, read_text, write_text
from drakerock.lhd.config import SHIPPED_DATA, MachineConfig
from drakerock.models.make_machine import write_machine
from drakerock.models.scaling import scale_design
from drakerock.resources import find_data

LOWEST_ROOF = 2.5
"""Of a site for a small machine [m]."""


def make_machine_project(folder: Path, name: str, payload: float) -> list[Path]:
    """Write a machine of one's own: the shipped LH621 at the size that carries `payload` [kg].

    Returns:
        The files written: design.yaml, what `make_machine.py` makes of it, scenario.yaml.

    Raises:
        InputError: a file of these names is there already, or the folder cannot be written.
    """
    if not name.isidentifier():
        raise InputError(
            f"name {name}: letters, digits and _ only, no digit first: links and files are named so"
        )
    if not 500 <= payload <= 100_000:
        raise InputError(f"payload {payload / 1e3:g}: from 0.5 to 100 t")
    _require_free(folder, "design.yaml", "scenario.yaml", f"{name}.sdf")
    known = SHIPPED_DATA.model_dump()
    factor = (payload / known["payload"]) ** (1 / 3)
    design = scale_design(read_text(find_data("models", "lhd", "design.yaml")), factor, name)
    head = (
        f"# {name}: the shipped LH621-class machine at {factor:.3g} times its size. Put your machine's in place\n"
        "# of these, and write it again: python -m drakerock.models.make_machine design.yaml (what each number does:\n"
        "# docs/own_machine.md).\n"
    )
    lines = design.split("\n")
    lines = [line for line in lines[1:] if "# Table:" not in line]  # of the LH621 alone
    write_text(folder / "design.yaml", head + "\n".join(lines))
    try:
        written = write_machine(folder / "design.yaml")
    except (OSError, ValueError) as error:
        raise InputError(str(error)) from None
    values = _measure(folder, name) | {
        "factor": f"{factor:.3g}",
        "payload": f"{payload:.0f}",
        "breakout": f"{known['breakout_force'] * factor**3:.0f}",
        "critical": f"{known['critical_moment'] * factor**3:.0f}",
        "rocks": f"{round(min(300, 260 * factor**2))}",  # as many as find room under the roof
        "drift": f"{max(3.9 * factor, 1.5):.2f}",
        "depth": f"{max(1.0 * factor, 0.6):.2f}",
        "height": f"{max(5.0 * factor, LOWEST_ROOF):.2f}",
        "emission": f"{max(5.0 * factor, LOWEST_ROOF) - 1.7:.2f}",
        "reach": f"{2.6 * factor:.2f}",
    }
    scenario = _write_template("machine", "scenario.yaml", folder, name=name, **values)
    return [folder / "design.yaml", *written, scenario]


def make_site_project(folder: Path, width: float, height: float) -> list[Path]:
    """Write a site of one's own: a drift so wide and so high [m] with a pile.

    Raises:
        InputError: scenario.yaml is there already, the folder cannot be written, or a drift that cannot be.
    """
    if not (3.4 <= width <= 30 and LOWEST_ROOF <= height <= 20):
        raise InputError(
            f"width {width:g}, height {height:g}: 3.4 to 30 m wide (the LH621 needs 3.4) and {LOWEST_ROOF} to 20 m "
            "high"
        )
    _require_free(folder, "scenario.yaml")
    reach, depth = 2.6, 1.0
    emission = height - 1.8  # under the roof, which is 0.5 m lower at the walls
    rocks = round(300 * (width / 3.9) * (height / 5.0))
    values = {
        "width": width,
        "height": height,
        "depth": depth,
        "rocks": rocks,
        "emission": emission,
        "reach": reach,
    }
    return [_write_template("site", "scenario.yaml", folder, **{k: f"{v:g}" for k, v in values.items()})]


def make_study_project(folder: Path) -> list[Path]:
    """Write a study of one's own, and the scenario it varies; InputError as above."""
    _require_free(folder, "study.yaml", "scenario.yaml")
    return [_write_template("study", name, folder) for name in ("study.yaml", "scenario.yaml")]


def make_controller_project(folder: Path) -> list[Path]:
    """Write a controller of one's own, and a scenario that names it; InputError as above."""
    _require_free(folder, "controller.py", "scenario.yaml")
    return [_write_template("controller", name, folder) for name in ("controller.py", "scenario.yaml")]


def _measure(folder: Path, name: str) -> dict[str, str]:
    """Return mass and bucket of the machine that was written."""
    from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
    from pydrake.systems.framework import DiagramBuilder

    from drakerock.lhd.geometry import calc_heaped_capacity, make_bucket_geometry
    from drakerock.lhd.model import add_machine

    plant, scene_graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01), DiagramBuilder())
    machine = add_machine(plant, MachineConfig(model=str(folder / f"{name}.sdf")))
    plant.Finalize()
    mass = plant.CalcTotalMass(plant.CreateDefaultContext(), [machine.instance])
    capacity = calc_heaped_capacity(make_bucket_geometry(plant, scene_graph, machine))
    return {"total_mass": f"{mass:.0f}", "capacity": f"{capacity:.3g}"}


def _write_template(kind: str, file: str, folder: Path, **values: str) -> Path:
    text = Template(read_text(find_data("templates", kind, file))).safe_substitute(values, folder=str(folder))
    if file.endswith(".yaml"):
        yaml.safe_load(text)
    write_text(folder / file, text)
    return folder / file


def _require_free(folder: Path, *names: str) -> None:
    make_folder(folder)
    taken = [name for name in names if (folder / name).exists()]
    if taken:
        raise InputError(f"{folder}: {', '.join(taken)} would be overwritten; take another folder")
