"""Nesterov's momentum for a contact solve: after two sweeps, go on a share of the way that the last two made.

A sweep forwards and one backwards together are a symmetric step, which such a momentum accelerates as it does a
gradient (Nesterov 1983; for contacts Mazhar, Heyn, Negrut, Tasora 2015). Single sweeps it does not.
"""

from __future__ import annotations

import numpy as np

from drakerock.dynamics.nonsmooth.compiling import Array, kernel

# Nesterov's share n / (n + OFFSET) of the n-th time.
OFFSET = 3.0


@kernel
def calc_share(n: int, limit: float) -> float:
    """Return the share of the last step that the n-th is continued by (0 for the first)."""
    return min(n / (n + OFFSET), limit)


@kernel
def go_on(values: Array, rows: Array, first: int, last: Array, share: float | np.float32) -> None:
    """Continue columns of some rows of an array by a share of their change since the last time.

    Args:
        values: (n, m) changed in the columns from `first` on.
        rows: (k,) of the array.
        first: first of the columns.
        last: (k, columns) the values that they had the last time, before they were continued; set to those of now.
        share: of the change; for an array in single precision, in single precision.
    """
    for k in range(len(rows)):
        row = rows[k]
        for d in range(last.shape[1]):
            now = values[row, first + d]
            values[row, first + d] = now + share * (now - last[k, d])
            last[k, d] = now
