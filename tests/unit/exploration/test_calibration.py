"""The fit of parameters to curves, against the exact posterior of a linear model, and what it must warn of."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import qmc

from drakerock.exploration.calibration import calibrate, propose_points
from drakerock.exploration.problem import Problem, Variable

PROBLEM = Problem(
    variables=(Variable(name="a", low=0.0, high=2.0), Variable(name="b", low=-1.0, high=1.0)),
    objectives=Problem().objectives[:1],
)
T = np.linspace(0.0, 1.0, 20)
SIGMA = 0.2


def simulate(X, basis):
    return X @ basis


def fit(basis, truth, seed=0, bias=0.0):
    X = PROBLEM.low + qmc.Sobol(2, rng=np.random.default_rng(1)).random(16) * (PROBLEM.high - PROBLEM.low)
    rng = np.random.default_rng(seed)
    measured = simulate(np.array([truth]), basis)[0] + SIGMA * rng.normal(size=len(T)) + bias
    return measured, calibrate(PROBLEM, X, simulate(X, basis), measured, np.full(len(T), SIGMA))


def test_intervals_are_those_of_linear_regression():
    basis = np.array([np.ones(20), T])
    measured, result = fit(basis, [1.1, 0.2])
    covariance = np.linalg.inv(basis @ basis.T) * SIGMA**2
    exact = covariance @ basis @ measured / SIGMA**2
    widen = np.sqrt(max(result.misfit, 1.0))
    half = 1.96 * widen * np.sqrt(np.diag(covariance))
    middle = 0.5 * (result.low + result.high)
    np.testing.assert_allclose(middle, exact, atol=0.12 * half.min() + 0.02)
    np.testing.assert_allclose(result.high - result.low, 2 * half, rtol=0.15)
    assert result.correlation[0, 1] == pytest.approx(
        covariance[0, 1] / np.sqrt(np.prod(np.diag(covariance))), abs=0.1
    )
    assert result.weights.sum() == pytest.approx(1.0)
    assert not result.warnings
    near = propose_points(result, 5, 0)
    assert near.shape == (5, 2)
    assert (near >= PROBLEM.low).all()
    assert (near <= PROBLEM.high).all()
    assert np.ptp(near[:, 0]) < 2.0


def test_a_parameter_without_effect_is_called_so():
    _, result = fit(np.array([T, 0 * T]), [1.1, 0.2])
    assert [w for w in result.warnings if w.startswith("b is not identified")]
    assert not [w for w in result.warnings if w.startswith("a ")]


def test_parameters_that_are_known_together_only_are_called_so():
    _, result = fit(np.array([5 * T, 5 * T]), [1.0, 0.0])
    assert [w for w in result.warnings if "known together only" in w]


def test_a_model_that_misses_says_so_and_claims_less():
    basis = np.array([np.ones(20), T])
    _, good = fit(basis, [1.1, 0.2])
    _, bad = fit(basis, [1.1, 0.2], bias=np.where(T > 0.5, 3.0, -3.0) * (T - 0.5) * 40)
    assert bad.misfit >= good.misfit
    assert "misses" in " ".join(bad.warnings) or (bad.high - bad.low >= good.high - good.low).all()
