import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from drakerock.errors import InputError
from drakerock.exploration.config import Bound, ParetoConfig
from drakerock.exploration.pareto import ParetoFront, pareto_front
from drakerock.exploration.problem import Objective, Problem, Variable
from drakerock.exploration.problems import make_noisy_loading
from drakerock.exploration.strategy import choose_strategy, parse_weights
from drakerock.exploration.surrogate import Surrogate
from drakerock.exploration.validation import Accuracy, Comparison
from drakerock.exploration.verdict import judge

KNOWN = make_noisy_loading()
NAMES = KNOWN.problem.objective_names


@pytest.fixture(scope="module")
def front():
    X = KNOWN.problem.unscale(np.random.default_rng(0).uniform(-1, 1, (100, 4)))
    surrogate = Surrogate(KNOWN.problem).fit(X, KNOWN.evaluate(X))
    return pareto_front(surrogate, config=ParetoConfig(population=120, evaluations=12_000, n_draws=8))


def test_all_weight_on_one_objective_gives_its_best(front):
    for j, name in enumerate(NAMES):
        assert choose_strategy(front, {name: 1.0}).y[j] == pytest.approx(front.ideal[j])
    # Production is the one shown as a positive number to be made large.
    assert front.ideal[0] == front.Y[:, 0].max() > 200.0


@settings(deadline=None, max_examples=50)
@given(st.tuples(*[st.floats(0.05, 1.0)] * 3), st.integers(0, 2), st.floats(1.1, 20.0))
def test_more_weight_never_makes_an_objective_worse(front, weights, j, factor):
    before = choose_strategy(front, dict(zip(NAMES, weights, strict=True)))
    heavier = [w * factor if i == j else w for i, w in enumerate(weights)]
    after = choose_strategy(front, dict(zip(NAMES, heavier, strict=True)))
    sign = KNOWN.problem.signs[j]
    # Up to the small sum that breaks ties.
    slack = 5e-3 * abs(front.nadir[j] - front.ideal[j])
    assert sign * after.y[j] <= sign * before.y[j] + slack


def test_weights_reach_into_hollows_of_the_front():
    """On three points of a hollow front a weighted sum could only ever choose an end."""
    problem = Problem(
        variables=(Variable(name="x", low=0, high=1),), objectives=(Objective(name="a"), Objective(name="b"))
    )
    Y = np.array([[0.0, 1.0], [0.6, 0.6], [1.0, 0.0]])
    ends = np.array([0.0, 0.0]), np.array([1.0, 1.0])
    front = ParetoFront(
        problem,
        np.array([[0.0], [0.5], [1.0]]),
        Y,
        0 * Y,
        *ends,
        ends[1] + 0.1,
        np.array([1.0]),
        np.array([0.1]),
    )
    assert choose_strategy(front, {"a": 1, "b": 1}).index == 1
    assert choose_strategy(front, {"a": 3, "b": 1}).index == 0
    assert choose_strategy(front).index == 0  # the knee is no point of a hollow


@given(st.floats(0.01, 100.0))
def test_only_the_ratio_of_weights_counts(front, factor):
    one = choose_strategy(front, {"production": 0.6, "damage": 0.2, "debris": 0.2})
    other = choose_strategy(
        front, {"production": 0.6 * factor, "damage": 0.2 * factor, "debris": 0.2 * factor}
    )
    assert one.index == other.index


def test_bounds_are_kept(front):
    bounds = [Bound(objective="debris", relation="<=", value=500.0)]
    chosen = choose_strategy(front, {"production": 1.0}, bounds)
    # So far below that it holds with 90 %: 1.2816 standard deviations.
    inside = front.Y[front.Y[:, 2] + 1.2816 * front.std[:, 2] <= 500.0]
    assert chosen.y[2] <= 500.0
    ((bound, probability),) = chosen.bounds
    assert bound == bounds[0]
    assert probability >= 0.9
    assert probability == pytest.approx(norm.cdf((500.0 - chosen.y[2]) / chosen.std[2]))
    assert f"debris<=500: holds with a probability of {100 * probability:.0f} %" in chosen.to_text()
    assert chosen.y[0] == inside[:, 0].max()
    assert "debris<=500" in chosen.chosen_by
    with pytest.raises(InputError, match=r"satisfies production>=999; the front has production"):
        choose_strategy(front, bounds=[Bound(objective="production", relation=">=", value=999.0)])


def test_a_bound_that_has_to_be_surer_leaves_fewer_points(front):
    counts = []
    front = replace(front, std=np.full_like(front.std, 60.0))
    for probability in (0.5, 0.9, 0.999):
        bound = Bound(objective="debris", relation="<=", value=700.0, probability=probability)
        inside = bound.calc_violation(KNOWN.problem, front.Y, front.std) <= 0.0
        assert np.array_equal(
            inside, bound.calc_probability(KNOWN.problem, front.Y, front.std) >= probability
        )
        counts.append(inside.sum())
    assert counts[0] == (front.Y[:, 2] <= 700.0).sum() > counts[1] > counts[2] > 0


def test_what_the_surrogate_is_unfit_for_is_not_told(front):
    compared = Comparison(np.arange(20.0), np.arange(20.0)[::-1], np.ones(20))
    bad = Accuracy("damage", 19.0, compared, compared, 0.6, 0.6, 0.01, (0.1, 0.1, 0.1))
    good = Comparison(np.arange(20.0), np.arange(20.0), np.ones(20))
    fine = [
        Accuracy(name, 19.0, good, good, 0.0, 0.0, 0.01, (1.0, 1.0, 1.0)) for name in ("production", "debris")
    ]
    verdict = judge([fine[0], bad, fine[1]], 100)
    bounds = [Bound(objective="damage", relation="<=", value=1e6)]
    chosen = replace(choose_strategy(front, {"production": 1.0}, bounds), verdict=verdict)
    text, data = chosen.to_text(), chosen.to_dict()
    assert f"damage      {chosen.y[1]:.4g}"[:14] not in text
    assert "not known (see the verdict)" in text
    assert "damage<=1e+06: not known" in text
    assert "Not fit for decisions" in text
    assert data["objectives"]["damage"] is data["standard_deviations"]["damage"] is None
    assert data["objectives"]["production"] == chosen.y[0]
    assert data["bounds"] == {"damage<=1e+06": None}
    assert data["verdict"]["objectives"]["damage"]["fit"] == "unfit"


def test_knee_gives_up_little_of_everything(front):
    knee = choose_strategy(front)
    regret = front.calc_regret()
    assert regret[knee.index].sum() == regret.sum(axis=1).min()
    assert regret[knee.index].max() < 0.75
    assert knee.chosen_by == "knee point"


def test_result_is_a_point_of_the_front_with_its_uncertainty(front):
    s = choose_strategy(front, {"production": 0.5, "debris": 0.5})
    assert np.array_equal(s.x, front.X[s.index])
    assert np.array_equal(s.std, front.std[s.index])
    assert 0.0 <= s.p_optimal <= 1.0
    data = json.loads(json.dumps(s.to_dict()))
    assert set(data["strategy"]) == {"alpha", "beta", "gamma", "kappa"}
    assert data["objectives"]["production"] == pytest.approx(s.y[0])
    assert data["standard_deviations"]["debris"] > 0.0
    text = s.to_text()
    assert "weights production 0.5, debris 0.5" in text
    assert f"{s.y[0]:.4g} +- {s.std[0]:.2g} kg/s" in text


def test_weights_are_read_and_checked(front):
    assert parse_weights("production=0.6, damage=.2,debris=2e-1", KNOWN.problem) == {
        "production": 0.6, "damage": 0.2, "debris": 0.2,
    }  # fmt: skip
    for text in ("production", "production=x", "production=1,,", ""):
        with pytest.raises(InputError, match=r"expected objective=number|unknown objective"):
            parse_weights(text, KNOWN.problem)
    with pytest.raises(InputError, match="unknown objective 'dust'"):
        parse_weights("dust=1", KNOWN.problem)
    with pytest.raises(InputError, match="not negative"):
        choose_strategy(front, {"production": -1.0})
    with pytest.raises(InputError, match="at least one weight"):
        choose_strategy(front, {"production": 0.0})
