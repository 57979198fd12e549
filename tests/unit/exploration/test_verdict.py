"""The verdict on a study: what is known to be good, noisy, hopeless or too small is called so."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drakerock.exploration.problems import make_noisy_loading, make_noisy_table
from drakerock.exploration.surrogate import fit_surrogate
from drakerock.exploration.validation import Accuracy, Comparison, calc_learning_curve, validate
from drakerock.exploration.verdict import Grade, Verdict, judge

KNOWN = make_noisy_loading()


def make_accuracy(error, noise=0.0, n=400, std=None, seed=0, spread=1.0):
    """Return the accuracy of predictions that are off by `error`, of means with `noise`, both in ranges."""
    rng = np.random.default_rng(seed)
    truth = spread * np.linspace(0.0, 1.0, n)
    simulated = truth + noise * rng.standard_normal(n)
    predicted = truth + error * rng.standard_normal(n)
    known = np.full(n, np.hypot(error, noise) if std is None else std)
    compared = Comparison(simulated, predicted, known)
    coverage = tuple(compared.calc_coverage(level) for level in (0.5, 0.8, 0.95))
    nrmse = compared.calc_nrmse(1.0)
    return Accuracy(
        "damage", 1.0, compared, compared, nrmse, nrmse, noise if noise else float("nan"), coverage
    )


def judge_one(accuracy, *args):
    return judge([accuracy], 100, *args).judgements[0]


@pytest.mark.parametrize(
    ("error", "noise", "grade"),
    [
        (0.03, 0.0, Grade.GOOD),
        (0.05, 0.15, Grade.GOOD),  # noisy means, but the surrogate itself is close
        (0.16, 0.05, Grade.ROUGH),
        (0.30, 0.05, Grade.UNFIT),
    ],
)
def test_the_surrogate_s_own_error_decides_not_the_noise(error, noise, grade):
    judgement = judge_one(make_accuracy(error, noise))
    assert judgement.grade == grade
    assert judgement.error == pytest.approx(error, abs=0.03)


def test_points_that_differ_by_their_noise_only_tell_nothing():
    judgement = judge_one(make_accuracy(0.02, noise=0.3, spread=0.0, n=4000))
    assert judgement.grade == Grade.UNFIT
    assert "noise" in judgement.to_text()
    assert "four times as many loadings" in judgement.advice


def test_intervals_that_are_too_narrow_are_told():
    judgement = judge_one(make_accuracy(0.08, std=0.02))
    assert judgement.grade == Grade.UNFIT
    assert "95 % intervals" in judgement.to_text()


def test_few_validation_points_give_way_to_leave_one_out():
    good, bad = make_accuracy(0.02), make_accuracy(0.5, n=4)
    judgement = judge_one(replace(good, validation=bad.validation))
    assert (judgement.compared, judgement.n_compared, judgement.grade) == ("leave-one-out", 400, Grade.GOOD)


def test_a_constant_response_is_known():
    flat = Comparison(np.ones(20), np.ones(20), np.zeros(20))
    accuracy = Accuracy("damage", 1.0, flat, flat, 0.0, 0.0, float("nan"), (1.0, 1.0, 1.0))
    assert judge_one(accuracy).grade == Grade.GOOD


def test_points_needed_follow_the_learning_curve():
    sizes = np.array([20, 30, 45, 60, 80, 100])
    judgement = judge_one(make_accuracy(0.2), sizes, 0.2 * (sizes[:, None] / 100.0) ** -0.5)
    # 0.2 falls to 0.1 with four times the points where the error falls with the root of their number.
    assert judgement.advice == "About 400 points would be needed, 100 there are."
    assert "narrower" in judge_one(make_accuracy(0.2), sizes, 0.2 * (sizes[:, None] / 100.0) ** -0.15).advice
    assert "do not show" in judge_one(make_accuracy(0.2), sizes, np.full((6, 1), 0.2)).advice


@given(st.floats(0.001, 0.6), st.floats(0.0, 0.3), st.floats(1.05, 3.0))
def test_a_larger_error_is_never_a_better_grade(error, noise, factor):
    first, second = (judge_one(make_accuracy(e, noise)).grade for e in (error, factor * error))
    assert second <= first


def test_the_worst_objective_decides():
    verdict = Verdict((judge_one(make_accuracy(0.02)), judge_one(make_accuracy(0.5))))
    assert verdict.grade == Grade.UNFIT
    assert verdict.title == "Not fit for decisions"
    assert verdict.to_dict()["fit"] == "unfit"


@pytest.mark.parametrize(("n", "n_loadings", "grade"), [(120, 20, Grade.GOOD), (14, 2, Grade.ROUGH)])
def test_studies_of_the_known_problem(n, n_loadings, grade):
    rng = np.random.default_rng(1)
    X = KNOWN.problem.unscale(rng.uniform(-1, 1, (n, 4)))
    table = make_noisy_table(X, rng, n_loadings=n_loadings, n_validation=n // 5)
    surrogate = fit_surrogate(table)
    verdict = judge(validate(surrogate, table), n - n // 5, *calc_learning_curve(surrogate, table))
    assert verdict.grade == grade, verdict.to_text()
