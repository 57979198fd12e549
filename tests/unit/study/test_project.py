"""`drakerock new`: what it writes can be used where it lies, is scaled by the stated powers, and overwrites nothing."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
import yaml
from pydrake.multibody.plant import MultibodyPlant

from drakerock.errors import InputError
from drakerock.lhd.config import SHIPPED_DATA
from drakerock.lhd.model import add_machine
from drakerock.loading.parts import load_function
from drakerock.loading.scenario import load_scenario
from drakerock.models.scaling import calc_exponent, scale_design
from drakerock.resources import find_data
from drakerock.study.project import (
    make_controller_project,
    make_machine_project,
    make_site_project,
    make_study_project,
)
from drakerock.study.schema import load_study

DESIGN = find_data("models", "lhd", "design.yaml").read_text()


def collect(node, path=()):
    if isinstance(node, dict):
        for key, value in node.items():
            yield from collect(value, (*path, key))
    elif isinstance(node, list):
        for value in node:
            yield from collect(value, path)
    elif isinstance(node, int | float) and not isinstance(node, bool):
        yield path, float(node)


def test_scaled_design_has_each_number_at_its_power_and_all_comments():
    scaled = scale_design(DESIGN, 0.5, "half")
    before, after = (list(collect(yaml.safe_load(text))) for text in (DESIGN, scaled))
    assert [path for path, _ in before] == [path for path, _ in after]
    for (path, old), (_, new) in zip(before, after, strict=True):
        assert new == pytest.approx(old * 0.5 ** calc_exponent(path), rel=1e-4), path
    expected = {
        ("boom", "length"): 1, ("wheel", "mass"): 3, ("wheel", "lugs"): 0, ("motors", "boom", "effort"): 4,
        ("motors", "damping"): 5, ("articulation", "stiffness"): 4, ("tyre", "stiffness"): 2, ("tyre", "friction"): 0,
        ("cylinders", "tilt", "damping"): 3, ("colors", "red"): 0, ("motors", "wheel", "velocity"): -1,
    }  # fmt: skip
    assert {path: calc_exponent(path) for path in expected} == expected
    assert scaled.count("#") == DESIGN.count("#")


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("project") / "mine"
    return folder, make_machine_project(folder, "mine", 9000.0)


def test_machine_is_written_whole_and_can_be_moved(machine, tmp_path):
    folder, paths = machine
    assert set(folder.iterdir()) == set(paths)
    moved = tmp_path / "elsewhere"
    shutil.copytree(folder, moved)
    scenario = load_scenario(moved / "scenario.yaml")
    plant = MultibodyPlant(0.01)
    found = add_machine(plant, scenario.machine)
    plant.Finalize()
    mass = plant.CalcTotalMass(plant.CreateDefaultContext(), [found.instance])
    assert mass == pytest.approx(scenario.machine.expected.total_mass, rel=1e-3)
    assert mass == pytest.approx(SHIPPED_DATA.total_mass * 9 / 21, rel=1e-3)
    assert scenario.tau_c == pytest.approx(145e3 * 9 / 21, rel=1e-4)
    assert scenario.machine.data.payload == 9000.0
    for path in folder.glob("*.sdf"):
        assert "package://" not in path.read_text()


def test_nothing_is_overwritten_and_bad_numbers_are_told(machine, tmp_path):
    folder, paths = machine
    before = {path: path.read_bytes() for path in paths}
    with pytest.raises(InputError, match=r"design.yaml, scenario.yaml, mine.sdf would be overwritten"):
        make_machine_project(folder, "mine", 5000.0)
    assert {path: path.read_bytes() for path in paths} == before
    with pytest.raises(InputError, match=r"from 0.5 to 100 t"):
        make_machine_project(tmp_path, "mine", 9.0)
    with pytest.raises(InputError, match="letters, digits"):
        make_machine_project(tmp_path, "my machine", 9000.0)
    with pytest.raises(InputError, match=r"3.4 to 30 m wide"):
        make_site_project(tmp_path, 2.0, 5.0)


def test_site_study_and_controller_are_read_as_they_are(tmp_path):
    (site,) = make_site_project(tmp_path / "site", 4.5, 5.5)
    scenario = load_scenario(site)
    assert (scenario.site.drift_width, scenario.site.drift_height) == (4.5, 5.5)
    study, _ = make_study_project(tmp_path / "study")
    assert load_study(study, ()).name == "first"
    _, scenario = make_controller_project(tmp_path / "controller")
    part = load_scenario(scenario).loading.parts.controller
    assert callable(load_function(part.system, "here"))
    assert part.parameters == {"limit": 3e5}


def test_another_machine_keeps_no_number_of_the_shipped_one():
    scenario = load_scenario()
    assert scenario.tau_c == 145e3
    assert scenario.loading.planning.r_ft is None
    with pytest.raises(InputError, match=r"machine.expected.critical_moment"):
        scenario.replace(**{"machine.model": "package://drakerock/lhd_small/lhd_small.sdf"})
    given = scenario.replace(
        **{
            "machine.model": "package://drakerock/lhd_small/lhd_small.sdf",
            "machine.expected.critical_moment": 6e4,
        }
    )
    assert given.tau_c == 6e4
    assert given.machine.data.payload is None
    assert given.resolve().loading.performance.tau_c == 6e4
    assert np.isfinite(scenario.resolve().loading.performance.tau_c)
