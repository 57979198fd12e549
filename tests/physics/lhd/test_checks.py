"""The machine's data, measured; and the measurement itself, measured on machines with a known fault."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from drakerock.config import load_config
from drakerock.lhd.checks.bench import CheckConfig
from drakerock.lhd.checks.checks import run_machine_checks
from drakerock.lhd.checks.rows import make_check_data, make_check_table
from drakerock.lhd.config import FunctionConfig, MachineConfig, WheelConfig

SMALL = load_config(Path(__file__).with_name("lhd_small.yaml"), MachineConfig)


def get_failed(rows) -> set[str]:
    return {row.name for row in rows if row.passed is False}


@pytest.fixture(scope="module")
def rows():
    return run_machine_checks(MachineConfig())


def test_lhd_passes(rows):
    assert get_failed(rows) == set()
    assert sum(row.passed is True for row in rows) >= 24


def test_linkage_keeps_clear_of_bucket_front_unit_and_tyres(rows):
    """The crank once stood up to 0.26 m inside the bucket's back with the boom low and the bucket tilted."""
    clear = {row.name: row for row in rows if row.name.startswith("clearance of")}
    for part in ("bell_crank", "tilt_barrel", "tilt_rod"):
        assert clear[f"clearance of {part} to the bucket"].measured > 0.02
    assert clear["clearance of bell_crank to tyres and front unit"].passed is True


def test_every_body_has_contact_shapes(rows):
    (row,) = [row for row in rows if row.name.startswith("bodies without contact shapes")]
    assert row.measured == 0


def test_another_machine_passes_without_a_line_of_code():
    assert get_failed(run_machine_checks(SMALL)) == set()


@pytest.mark.parametrize("contact", ["similar", "sap"])
def test_other_contact_models_differ_for_sliding_tyres_only(contact):
    """Drake's `similar` and `sap` lift sliding contacts off by mu times the slip of a step: tyres hop."""
    rows = run_machine_checks(MachineConfig(), CheckConfig(contact_approximation=contact))
    assert get_failed(rows) <= {
        "traction against a wall",
        "wheels slip before they stall: slowest wheel",
        "chassis' drift in 2 s of standing",
    }
    traction = next(row for row in rows if row.name == "traction against a wall")
    assert traction.measured == pytest.approx(traction.expected, rel=0.1)


def test_faults_are_found():
    """A weak tilt motor, wheels that stall before they slip, and a payload too heavy for the boom."""
    config = MachineConfig(
        bucket=FunctionConfig(effort=5e5), wheel=WheelConfig(effort=1.2e5), boom=FunctionConfig(effort=7e5)
    )
    failed = get_failed(run_machine_checks(config))
    assert {"breakout force, chassis held", "traction against a wall"} <= failed
    assert "wheels slip before they stall: slowest wheel" in failed
    assert "boom lifts 21 t: angle reached" in failed


def test_table_and_data_say_the_same(rows):
    text = io.StringIO()
    Console(file=text, width=160).print(make_check_table(rows))
    data = json.loads(json.dumps(make_check_data(rows)))
    assert data["passed"] is True
    assert len(data["checks"]) == len(rows)
    for row in rows:
        assert row.name in text.getvalue()


def test_balances_converge_with_the_time_step():
    """What momentum and closure still err by is the discrete step's: a quarter of the step, less error."""
    coarse, fine = (
        {row.name: row.measured for row in run_machine_checks(MachineConfig(), CheckConfig(time_step=step))}
        for step in (0.01, 0.0025)
    )
    for name in ("momentum in free fall: error", "momentum afloat: error", "angular momentum afloat: error"):
        assert fine[name] < 0.4 * coarse[name]
    assert (
        fine["closure error of the linkage, all runs"]
        < 0.6 * coarse["closure error of the linkage, all runs"]
    )
    # Between the pump's torque and the relief: how much of the tip's blow the check valve traps depends on the step.
    assert fine["breakout force, chassis held"] == pytest.approx(
        coarse["breakout force, chassis held"], rel=0.07
    )
