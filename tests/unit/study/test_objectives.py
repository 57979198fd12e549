"""What an objective may return, and what becomes of it on its way to the table."""

import math

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

import study_work
from drakerock.config import parse_config
from drakerock.errors import InputError
from drakerock.exploration.problem import Objective
from drakerock.exploration.table import ResponseTable
from drakerock.loading.mining import MINING
from drakerock.study.objectives import (
    RegisteredObjective,
    get_objective,
    import_module,
    register_objective,
)
from drakerock.study.resimulation import Resimulation
from drakerock.study.runner import run_study
from drakerock.study.schema import StudyConfig

NUMBERS = st.floats(-1e50, 1e50)


def make(function, **fields):
    return RegisteredObjective(Objective(name="trial", **fields), function)


@given(
    st.one_of(st.none(), st.floats(-1e50, 1e50), st.just(math.inf), st.just(-math.inf), st.just(math.nan)),
    NUMBERS,
)
def test_no_value_is_none_and_worst_bounds_all_others(value, worst):
    for sense, sign in (("min", 1.0), ("max", -1.0)):
        got = make(lambda _: value, sense=sense, worst=worst).evaluate(None)
        if value is None or math.isnan(value):
            assert math.isnan(got)
        elif math.isinf(value):
            assert got == worst
        else:
            assert got == (value if sign * value <= sign * worst else worst)
        free = make(lambda _: value, sense=sense).evaluate(None)
        assert free == value if value is not None and math.isfinite(value) else math.isnan(free)


def test_a_division_by_zero_is_the_worst_value():
    assert make(lambda _: 1.0 / 0.0, worst=7.0).evaluate(None) == 7.0
    assert math.isnan(make(lambda _: 1.0 / 0.0).evaluate(None))


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda _: {}["mass"], "objective 'trial': KeyError: 'mass'"),
        (lambda _: "much", "objective 'trial': ValueError"),
        (lambda _: [1.0, 2.0], "objective 'trial': TypeError"),
        (lambda _: 1e300, "objective 'trial': 1e.300; numbers up to 1e.60"),
    ],
)
def test_mistakes_are_told(function, message):
    with pytest.raises(InputError, match=message):
        make(function).evaluate(None)


@register_objective(Objective(name="trial_ratio", unit="J/kg", worst=50.0))
def calc_ratio(outcome):
    return 10.0 / (0.0 if outcome.strategy["alpha"] > 1.4 else 1.0)


@register_objective(Objective(name="trial_gap", sense="max"))
def calc_gap(outcome):
    return None if outcome.strategy["alpha"] < 0.8 else 3.0


def test_a_campaign_goes_on_and_the_table_has_the_values(tmp_path, monkeypatch):
    monkeypatch.setattr(study_work, "DURATION", 0.0)
    study = parse_config(
        "loadings: 3\nexecutor: {kind: serial}\nobjectives: [production, trial_ratio, trial_gap]\n"
        "exploration: {sampling: {n_initial: 8, n_corners: 4, n_samples: 16, n_validation: 2, batch_size: 4}}\n",
        StudyConfig,
    )
    folder = tmp_path / "study"
    status = run_study(study, folder, work="study_work:run")
    assert status["complete"]
    assert status["cycles"]["failed"] == 0
    for path in (folder / "responses.parquet", folder / "responses.csv", folder / "loadings.csv"):
        table = ResponseTable.load(path)
        alpha = table.X[:, 0]
        assert set(table.n_failed) == {0}, "no value is no failure"
        assert set(table.failure) == {""}
        assert np.isfinite(table.Y[:, 0]).all()
        assert np.array_equal(table.Y[:, 1], np.where(alpha > 1.4, 50.0, 10.0))
        assert np.array_equal(np.isnan(table.Y[:, 2]), alpha < 0.8)
        assert (alpha > 1.4).any()
        assert (alpha < 0.8).any()
    assert pq.read_table(folder / "loadings.parquet")["trial_gap"].null_count == 3 * int((alpha < 0.8).sum())
    assert table.problem.objectives[1].worst == 50.0
    again = Resimulation(folder, work="study_work:run")
    mean, _ = again.evaluate(np.array([0.5, 0.5, 0.5, 0.5]))
    assert np.isnan(mean[2])
    assert mean[1] == 10.0
    assert again.evaluate(np.array([1.8, 0.5, 0.5, 0.5]))[0][1] == 50.0


def test_an_empty_bucket_takes_the_worst_energy():
    class Outcome:
        energy_J, bucket_mass_kg = 1e6, 0.0

    item = get_objective("specific_energy")
    assert item.evaluate(Outcome) == item.objective.worst
    Outcome.bucket_mass_kg = None
    assert math.isnan(item.evaluate(Outcome))


def test_numbers_of_mining_are_objectives():
    class Outcome:
        mining = dict.fromkeys(MINING, 0.5)

    names = ["payload", "fill", "digging_energy", "loading_energy", "slip_distance", "breakout", "spillage"]
    items = [get_objective(name) for name in names]
    assert [item.evaluate(Outcome) for item in items] == [0.5] * 7
    assert [item.objective.sense for item in items] == ["max", "max", *["min"] * 5]
    # Without a load: the worst energy, and no value where there is none.
    Outcome.mining = dict.fromkeys(MINING) | {"load_t": 0.0, "payload_percent": 0.0, "spillage_share": 1.0}
    assert [get_objective(name).evaluate(Outcome) for name in ("digging_energy", "loading_energy")] == [
        2.8,
        2.8,
    ]
    assert get_objective("spillage").evaluate(Outcome) == 1.0
    assert math.isnan(get_objective("breakout").evaluate(Outcome))
    Outcome.mining = None
    assert all(math.isnan(item.evaluate(Outcome)) for item in items)


def test_a_module_of_ones_own_may_hold_dataclasses_with_postponed_annotations(tmp_path):
    """They look their module up by its name, which a file loaded by its path does not have by itself."""
    path = tmp_path / "mine.py"
    path.write_text(
        "from __future__ import annotations\nfrom dataclasses import dataclass\n\n"
        "from drakerock.exploration.problem import Objective\n"
        "from drakerock.study.objectives import register_objective\n\n\n"
        "@dataclass\nclass Scale:\n    factor: float = 2.0\n\n\n"
        '@register_objective(Objective(name="twice_the_load", meaning="for a test"))\n'
        "def calc(outcome):\n    return Scale().factor * outcome.bucket_mass_kg\n"
    )
    import_module(str(path))
    assert get_objective("twice_the_load").objective.meaning == "for a test"
