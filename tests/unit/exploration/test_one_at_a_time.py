"""One thing at a time: the design's points, and effects that are known."""

from __future__ import annotations

import numpy as np
import pytest

from drakerock.errors import InputError
from drakerock.exploration.config import SamplingConfig
from drakerock.exploration.one_at_a_time import calc_effects, make_one_at_a_time
from drakerock.exploration.problem import Problem, Variable
from drakerock.exploration.table import ResponseTable

PROBLEM = Problem(
    variables=(
        Variable(name="block", low=0, high=1),
        Variable(name="a", low=0, high=4),
        Variable(name="b", low=-1, high=1),
    ),
    objectives=Problem().objectives[:2],
)
CONFIG = SamplingConfig(design="one_at_a_time", block="block", centre={"a": 1.0, "b": -1.0})


def test_points_differ_from_their_centre_in_one_variable():
    X = make_one_at_a_time(PROBLEM, CONFIG)
    # Per block: the centre, two ends of a, and of b the one that is not the centre.
    assert len(X) == 2 * 4
    for value in (0.0, 1.0):
        rows = X[X[:, 0] == value]
        assert rows[0].tolist() == [value, 1.0, -1.0]
        assert ((rows[1:, 1:] != rows[0, 1:]).sum(axis=1) == 1).all()


def test_effects_are_differences_from_the_centre():
    X = make_one_at_a_time(PROBLEM, CONFIG)
    Y = np.column_stack([10 * X[:, 0] + 3 * X[:, 1] + X[:, 2] * X[:, 1], X[:, 2]])
    Y[1, 0] = np.nan
    effects = calc_effects(ResponseTable(PROBLEM, X, Y, np.full_like(Y, 0.3)), CONFIG)
    assert len(effects) == 2 * 2 * 2
    found = {(e.block, e.variable, e.objective): e for e in effects}
    effect = found[1.0, "a", "production"]
    assert effect.centre == pytest.approx(12.0)
    assert effect.values == (1.0, 0.0, 4.0)
    assert effect.changes == pytest.approx((-2.0, 6.0))
    assert effect.errors == pytest.approx((0.3 * np.sqrt(2),) * 2)
    assert effect.size == pytest.approx(6.0)
    assert np.isnan(found[0.0, "a", "production"].changes[0])
    assert found[0.0, "b", "production"].changes == pytest.approx((2.0,))
    assert found[0.0, "a", "damage"].changes == pytest.approx((0.0, 0.0))


@pytest.mark.parametrize("keys", [{"centre": {"c": 1.0}}, {"block": "c"}, {"centre": {"a": 9.0}}])
def test_what_names_no_variable_is_refused(keys):
    with pytest.raises(InputError):
        make_one_at_a_time(PROBLEM, CONFIG.replace(**keys))
