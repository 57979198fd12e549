import numpy as np
import pytest

from drakerock.rocks.engine.solve.acceleration import calc_factor, extrapolate, extrapolate_in_lanes


def test_factor_grows_to_its_limit():
    assert calc_factor(0, 0.8) == 0.0
    assert calc_factor(3, 0.8) == pytest.approx(0.5)
    assert calc_factor(1000, 0.8) == 0.8


def test_numbers_are_extrapolated_by_their_last_change():
    values, last = np.array([1.0, 5.0]), np.array([0.0, 6.0])
    extrapolate(0.5, values, last)
    np.testing.assert_array_equal(values, [1.5, 4.5])
    np.testing.assert_array_equal(last, [1.0, 5.0])
    # Nothing has changed since: what was added the last time is what changes now.
    extrapolate(0.5, values, last)
    np.testing.assert_array_equal(values, [1.75, 4.25])


def test_eight_at_a_time_are_chosen_columns_of_chosen_rows():
    rng = np.random.default_rng(1)
    values, last = rng.normal(size=(9, 40)).astype(np.float32), rng.normal(size=(4, 16)).astype(np.float32)
    rows, share = np.array([7, 0, 3, 8]), np.float32(0.7)
    now = values[rows, 5:21]
    expected = values.copy()
    expected[rows, 5:21] = now + share * (now - last)
    extrapolate_in_lanes(rows, 5, share, values, last)
    np.testing.assert_array_equal(values, expected)
    np.testing.assert_array_equal(last, now)


@pytest.mark.parametrize("slow", [0.5, 0.9, 0.99])
def test_a_linear_step_converges_faster(slow):
    """x -> A x with A symmetric and eigenvalues in [0, 1), as two sweeps make it."""
    rng = np.random.default_rng(1)
    basis, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    step = basis @ np.diag(np.linspace(0.0, slow, 6)) @ basis.T
    left = {}
    for limit in (0.0, 0.8):
        x = np.ones((1, 6))
        last = np.zeros((1, 6))
        for n in range(60):
            x = x @ step
            if n < 59:
                extrapolate(calc_factor(n, limit), x[0], last[0])
        left[limit] = np.linalg.norm(x)
    if slow > 0.8:
        assert left[0.8] < 0.5 * left[0.0]
    else:
        assert left[0.8] < 1e-3
