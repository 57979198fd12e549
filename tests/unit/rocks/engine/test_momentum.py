import numpy as np
import pytest

from drakerock.rocks.engine.momentum import calc_share, go_on, go_on_in_lanes


def test_share_grows_to_its_limit():
    assert calc_share(0, 0.8) == 0.0
    assert calc_share(3, 0.8) == pytest.approx(0.5)
    assert calc_share(1000, 0.8) == 0.8


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_chosen_columns_of_chosen_rows_go_on(kind):
    values = np.arange(20, dtype=kind).reshape(4, 5)
    before, last = values.copy(), np.zeros((2, 2), kind)
    go_on(values, np.array([3, 1]), 2, last, kind(0.5))
    expected = before.copy()
    expected[[1, 3], 2:4] += 0.5 * before[[1, 3], 2:4]
    np.testing.assert_array_equal(values, expected)
    np.testing.assert_array_equal(last, before[[3, 1], 2:4])
    # Nothing has changed since: what was added the last time is what changes now.
    go_on(values, np.array([3, 1]), 2, last, kind(0.5))
    np.testing.assert_allclose(values[3, 2], expected[3, 2] + 0.5 * (expected[3, 2] - before[3, 2]))


def test_eight_at_a_time_is_the_same():
    rng = np.random.default_rng(1)
    values, last = rng.normal(size=(9, 40)).astype(np.float32), rng.normal(size=(4, 16)).astype(np.float32)
    rows = np.array([7, 0, 3, 8])
    one, two = (values.copy(), last.copy()), (values.copy(), last.copy())
    go_on(one[0], rows, 5, one[1], np.float32(0.7))
    go_on_in_lanes(two[0], rows, 5, two[1], 0.7)
    np.testing.assert_array_equal(two[0], one[0])
    np.testing.assert_array_equal(two[1], one[1])
    assert not np.array_equal(one[0], values)


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
                go_on(x, np.zeros(1, np.int64), 0, last, calc_share(n, limit))
        left[limit] = np.linalg.norm(x)
    if slow > 0.8:
        assert left[0.8] < 0.5 * left[0.0]
    else:
        assert left[0.8] < 1e-3
