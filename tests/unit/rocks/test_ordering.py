"""The order of a pile's rocks."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drakerock.rocks.ordering import CELL, order_by_place


@given(st.integers(0, 60), st.integers(0, 2**31))
def test_every_rock_has_one_number(n, seed):
    p_WRs = np.random.default_rng(seed).normal(scale=3.0, size=(n, 3))
    assert np.array_equal(np.sort(order_by_place(p_WRs)), np.arange(n))


def test_one_after_the_other_is_its_neighbour():
    grid = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * CELL
    shuffled = np.random.default_rng(2).permutation(grid + 0.01)
    steps = np.diff(shuffled[order_by_place(shuffled)], axis=0)
    assert np.allclose(np.linalg.norm(steps, axis=1), CELL)


def test_rocks_of_one_cell_keep_their_order():
    p_WRs = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.1, 0.1, 0.1], [3.1, 0.1, 0.0]])
    order = order_by_place(p_WRs).tolist()
    assert order.index(0) < order.index(2)
    assert order.index(1) < order.index(3)
