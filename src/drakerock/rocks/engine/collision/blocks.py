"""Blocks of rocks: which rocks may be in a box, without a look at all of them.

Rocks that follow each other in memory are near each other in the pile (`rocks.ordering`), so that the boxes around
blocks of them are small. What is not in the order of its place costs time and never changes a result.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.compiling import Array, kernel

# Rocks of a block.
BLOCK = 64


class Blocks(NamedTuple):
    """Boxes around the centres of the rocks `BLOCK` k to `BLOCK` (k + 1).

    Attributes:
        lower, upper: (blocks, 3) their corners [m].
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]


def make_blocks(n_rocks: int) -> Blocks:
    """Return the blocks of so many rocks, which have no place yet."""
    shape = (-(-n_rocks // BLOCK), 3)
    return Blocks(np.full(shape, np.inf), np.full(shape, -np.inf))


@kernel
def update_blocks(moved: Array, positions: Array, blocks: Blocks) -> None:
    """Set the boxes of blocks with rocks that have moved.

    Reads:
        moved: (m,) rocks; in ascending order each block is set once.
        positions: (n, 3) of all rocks [m].
    Writes:
        blocks: these.
    """
    last = -1
    for s in range(len(moved)):
        block = moved[s] // BLOCK
        if block == last:
            continue
        last = block
        for d in range(3):
            low, high = np.inf, -np.inf
            for i in range(BLOCK * block, min(BLOCK * (block + 1), len(positions))):
                low = min(low, positions[i, d])
                high = max(high, positions[i, d])
            blocks.lower[block, d], blocks.upper[block, d] = low, high


@kernel
def is_block_near(block: int, low: Array, high: Array, reach: float, blocks: Blocks) -> bool:
    """Return whether a block has rocks within reach of the box from `low` to `high` [m]."""
    for d in range(3):
        if blocks.lower[block, d] > high[d] + reach or blocks.upper[block, d] < low[d] - reach:
            return False
    return True
