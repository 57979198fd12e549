"""Calibration from file to result with a stand-in simulation: files as they come, planted values, resumption."""

from __future__ import annotations

import json

import numpy as np
import pytest

import calibration_work
import study_work
from drakerock.config import parse_config
from drakerock.errors import InputError
from drakerock.study.calibration import SIGNAL_UNITS, run_calibration
from drakerock.study.measured import load_measured
from drakerock.study.schema import CurveConfig, StudyConfig

TEXT = """
seed: 3
loadings: 1
independent_piles: true
executor: {kind: serial}
variables:
  - {name: density, key: rocks.density, low: 1800, high: 3200, unit: kg/m^3}
  - {name: friction, key: rocks.friction, low: 0.4, high: 1.4}
exploration: {sampling: {n_samples: 14, batch_size: 8}}
calibration:
  curves:
    - {signal: phi_l, over: time, column: boom, over_column: t, noise: 0.003}
    - {signal: bucket_force_x, over: x_T, column: force, over_column: tip, noise: 500}
  bins: 12
"""
PLANTED = {"density": 2700.0, "friction": 0.7}


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(study_work, "DURATION", 0.0)


@pytest.fixture
def measured(tmp_path):
    """Other names and units, semicolons, uneven steps, a gap, an empty cell."""
    rng = np.random.default_rng(5)
    time = np.sort(rng.uniform(0.1, 5.9, 150))
    time = time[(time < 2.0) | (time > 2.6)]
    angle, force = calibration_work.calc_curves(PLANTED["density"], PLANTED["friction"], time)
    angle, force = angle + 0.003 * rng.normal(size=len(time)), force + 500 * rng.normal(size=len(time))
    rows = [f"{1e3 * t:.1f};{np.rad2deg(a):.4f};{-3 + 0.4 * t:.4f};{f / 1e3:.4f}"
            for t, a, f in zip(time, angle, force, strict=True)]  # fmt: skip
    rows[7] = rows[7].rpartition(";")[0] + ";"
    path = tmp_path / "measured.csv"
    path.write_text("t [ms];boom [deg];tip [m];force [kN]\n" + "\n".join(rows) + "\n")
    return path


def test_planted_parameters_are_found_and_kept(tmp_path, measured):
    study, notes = parse_config(TEXT, StudyConfig), []
    calibration_work.RUNS.clear()
    result, paths = run_calibration(
        study, measured, tmp_path / "store", work="calibration_work:run", say=notes.append
    )
    assert result["simulations"] == len(calibration_work.RUNS) == 14
    for name, value in PLANTED.items():
        item = result["parameters"][name]
        assert item["low"] < value < item["high"]
        assert item["high"] - item["low"] < 0.35 * (item["range"][1] - item["range"][0])
    assert all(path.exists() for path in paths)
    assert json.loads(paths[0].read_text())["parameters"] == result["parameters"]
    text = "\n".join(notes)
    assert "deg is converted to rad" in text
    assert "1 of" in text
    assert "a gap of" in text
    # What is simulated is kept: with more points only those are run.
    more = study.replace(**{"exploration.sampling.n_samples": 15})
    run_calibration(more, measured, tmp_path / "store", work="calibration_work:run")
    assert len(calibration_work.RUNS) == 15


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        ("time,push", ["0,1"] * 9, "no column 'force'; there are: time, push"),
        ("time,force [stone]", ["0,1"] * 9, "force is in stone"),
        ("time,force", ["0,1", "1,2"], "at least 5"),
        ("time,force", [f"{t},1" for t in (0, 1, 2, 1, 2, 3)], "turns back from 2 to 1 s"),
        ("time,force", ["3,1"] * 9, "does not change"),
        ("time,force", ["0,one"] * 9, "no number"),
    ],
)
def test_a_useless_measurement_is_refused(tmp_path, header, rows, message):
    path = tmp_path / "m.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    curve = CurveConfig(signal="bucket_force_x", column="force")
    with pytest.raises(InputError, match=message):
        load_measured(path, (curve,), SIGNAL_UNITS, 10)


def test_units_below_the_header_and_noise_from_scatter(tmp_path):
    rng = np.random.default_rng(0)
    time = np.linspace(0, 5, 400)
    values = 20 * np.sin(time) + rng.normal(scale=0.5, size=400)
    rows = "\n".join(f"{t},{v}" for t, v in zip(time, values, strict=True))
    path = tmp_path / "m.csv"
    path.write_text(f"time,force\n[s],[kN]\n{rows}\n")
    (curve,), _ = load_measured(
        path, (CurveConfig(signal="bucket_force_x", column="force"),), SIGNAL_UNITS, 10
    )
    assert curve.values[:3] == pytest.approx(1e3 * values[:3])
    single = curve.noise * np.sqrt(np.bincount(curve.bins))
    assert single == pytest.approx(500, rel=0.15)
    assert curve.means == pytest.approx(curve.average(2e4 * np.sin(time)), abs=400)


def test_a_measurement_of_another_run_is_refused(tmp_path, measured):
    study = parse_config(TEXT.replace("over_column: t,", "over_column: t, shift: 100,").replace(
        "over_column: tip,", "over_column: tip, shift: 50,"), StudyConfig)  # fmt: skip
    with pytest.raises(InputError, match="shift"):
        run_calibration(study, measured, tmp_path / "store", work="calibration_work:run")


def test_a_study_without_curves_is_refused(tmp_path):
    with pytest.raises(InputError, match="no 'calibration'"):
        run_calibration(StudyConfig(), tmp_path / "m.csv", tmp_path / "store")
