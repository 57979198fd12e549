from dataclasses import fields, replace

import numpy as np
import pytest

from drakerock.loading.outcome import CycleOutcome
from drakerock.study.jobs import calc_sequence_summary


def make_outcome(production, status="done"):
    values = {item.name: None for item in fields(CycleOutcome)}
    objectives = {
        "production": production,
        "damage": 0.5,
        "debris": None if production is None else 2 * production,
    }
    return CycleOutcome(
        **values
        | {
            "status": status,
            "reason": "s4 reached",
            "objectives": objectives,
            "wall_time_s": 3.0,
            "strategy": {"alpha": 1.0},
        }
    )


def test_summary_of_a_sequence():
    productions = [900.0, 1100.0, 1000.0, 950.0]
    summary = calc_sequence_summary([make_outcome(p) for p in productions])
    row = summary["quantities"]["production"]
    assert row["mean"] == pytest.approx(987.5)
    assert row["spread"] == pytest.approx(np.std(productions, ddof=1))
    # Four values say nothing about their correlation: as if independent.
    assert row["standard_error"] == pytest.approx(row["spread"] / 2)
    assert row["values"] == productions
    assert summary["quantities"]["damage"]["spread"] == 0.0
    assert summary["quantities"]["bucket_mass_kg"]["mean"] is None


def test_spread_of_the_payload():
    loads = [10e3, 12e3, 14e3]
    outcomes = [
        replace(make_outcome(1.0), bucket_mass_kg=load, mining={"load_t": load / 1e3}) for load in loads
    ]
    summary = calc_sequence_summary(outcomes)
    assert summary["payload_spread_percent"] == pytest.approx(100 * 2e3 / 12e3)
    assert summary["quantities"]["load_t"]["mean"] == pytest.approx(12.0)
    assert summary["quantities"]["fill_factor"]["mean"] is None
    assert calc_sequence_summary(outcomes[:1])["payload_spread_percent"] is None


def test_loadings_that_drift_are_less_certain_than_ones_that_scatter():
    drifting = [100.0 * k for k in range(12)]
    scattered = [100.0 * k for k in np.random.default_rng(4).permutation(12)]
    errors = [
        calc_sequence_summary([make_outcome(p) for p in values])["quantities"]["production"]["standard_error"]
        for values in (drifting, scattered)
    ]
    assert errors[0] > 1.5 * errors[1]


def test_failed_loadings_do_not_count():
    summary = calc_sequence_summary([make_outcome(10.0), make_outcome(None, "failed"), make_outcome(30.0)])
    assert summary["failed"] == 1
    assert summary["quantities"]["production"]["mean"] == 20.0
    assert calc_sequence_summary([make_outcome(10.0)])["quantities"]["production"]["standard_error"] is None
