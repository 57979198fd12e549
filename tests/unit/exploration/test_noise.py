import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drakerock.exploration.noise import calc_autocorrelation, calc_standard_error


def make_sequences(rho, n, m, rng):
    z = rng.standard_normal((m, n))
    y = z.copy()
    for i in range(1, n):
        y[:, i] = rho * y[:, i - 1] + np.sqrt(1 - rho**2) * z[:, i]
    return y


@pytest.mark.parametrize("rho", [-0.3, 0.0, 0.4, 0.7])
def test_pooled_estimates_recover_a_planted_autocorrelation(rho):
    y = make_sequences(rho, 20, 4000, np.random.default_rng(1))
    estimate = calc_autocorrelation(y)
    assert estimate == pytest.approx(rho, abs=0.04)
    # The true spread of the means, over many sequences, is what the standard error stands for.
    truth = y.mean(axis=1).std()
    claimed = np.sqrt(np.mean([calc_standard_error(s, estimate) ** 2 for s in y]))
    assert claimed == pytest.approx(truth, rel=0.06)
    # Independence would be wrong by this much:
    if rho >= 0.4:
        naive = np.sqrt(np.mean(y.var(axis=1, ddof=1) / 20))
        assert naive < 0.75 * truth


def test_independent_values_give_the_textbook_standard_error():
    y = np.array([1.0, 4.0, 2.0, 8.0, 5.0, 7.0])
    assert calc_standard_error(y, 0.0) == pytest.approx(y.std(ddof=1) / np.sqrt(6), rel=1e-12)


def test_failed_loadings_are_left_out():
    y = np.array([1.0, np.nan, 2.0, 8.0, np.nan])
    assert calc_standard_error(y, 0.0) == pytest.approx(calc_standard_error([1.0, 2.0, 8.0], 0.0))
    gaps = make_sequences(0.6, 20, 4000, np.random.default_rng(2))
    gaps[:, 7] = np.nan
    assert calc_autocorrelation(gaps) == pytest.approx(0.6, abs=0.05)


def test_too_short_sequences():
    assert np.isnan(calc_standard_error([3.0]))
    assert np.isnan(calc_standard_error([]))
    assert calc_autocorrelation([[1.0, 2.0]]) == 0.0
    assert calc_standard_error([2.0] * 20) == 0.0


numbers = st.floats(-1e6, 1e6, allow_nan=False).map(lambda v: round(v, 3))


@given(arrays(float, st.integers(2, 30), elements=numbers))
def test_a_single_sequence_never_claims_more_than_independence(y):
    se = calc_standard_error(y)
    assert se >= y.std(ddof=1) / np.sqrt(len(y)) * (1 - 1e-9)
    assert np.isfinite(se)


@given(arrays(float, st.integers(5, 30), elements=numbers), st.floats(0.1, 100.0), st.floats(-100.0, 100.0))
def test_standard_error_scales_with_the_unit(y, factor, shift):
    if np.ptp(y) < 1e-2:
        return
    assert calc_standard_error(factor * y + shift) == pytest.approx(factor * calc_standard_error(y), rel=1e-4)
