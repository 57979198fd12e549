"""Asking for memory changes nothing, for arrays of any shape."""

import numpy as np
import pytest

from drakerock.rocks.engine.compiling import kernel
from drakerock.rocks.engine.memory_access import prefetch


@kernel
def _add_up(array, flat, order):
    total = 0.0
    for k in range(len(order)):
        prefetch(array, order[min(k + 3, len(order) - 1)])
        total += flat[order[k]]
    return total


@pytest.mark.parametrize("shape", [(50,), (50, 3), (50, 3, 3)])
@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64])
def test_prefetch_changes_nothing(shape, dtype):
    rng = np.random.default_rng(0)
    array = rng.integers(0, 100, shape).astype(dtype)
    flat = np.ascontiguousarray(array.reshape(50, -1).sum(axis=1))
    before = array.copy()
    order = rng.permutation(50)
    assert _add_up(array, flat, order) == flat.sum()
    assert _add_up(array[::2], flat, order[order < 25]) == flat[:25].sum()
    assert (array == before).all()


def test_rows_may_be_asked_for_that_are_not_there():
    empty = np.zeros((0, 3))
    assert _add_up(empty, np.ones(4), np.arange(4)) == 4.0
