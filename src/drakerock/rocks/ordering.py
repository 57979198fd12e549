"""The order of a pile's rocks: along a space-filling curve, so that neighbours are near each other in memory too."""

from __future__ import annotations

import numpy as np
from hilbertcurve.hilbertcurve import HilbertCurve
from numpy.typing import NDArray

# Width of the curve's cells [m]; hardly ever do two rocks of the default pile have their centres in one.
CELL = 0.3


def order_by_place(p_WRs: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the numbers (n,) of rocks at `p_WRs` (n, 3) [m] along a Hilbert curve; within a cell as they were.

    A solve goes from contact to contact, and what two rocks in contact need is then often in the same few kilobytes.
    """
    if len(p_WRs) == 0:
        return np.zeros(0, np.int64)
    cells = np.floor((p_WRs - p_WRs.min(axis=0)) / CELL).astype(np.int64)
    curve = HilbertCurve(max(int(cells.max()).bit_length(), 1), cells.shape[1])
    return np.argsort(curve.distances_from_points(cells), kind="stable")
