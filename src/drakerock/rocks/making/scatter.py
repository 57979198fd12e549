"""Rocks scattered in a box: what a small scene starts from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drakerock.errors import InputError
from drakerock.randomness import make_generator
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.making.emission import Emitter, place_rocks, sample_rocks
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.state import PileState

# Poses tried for a rock before the box is called full.
TRIES = 300


def scatter_rocks(
    n: int, low: ArrayLike, high: ArrayLike, config: RocksConfig | None = None, seed: int = 0
) -> PileState:
    """Return rocks at rest in the air, of the gradation's sizes, at random poses in a box; none touches another.

    Let them fall to have a heap.

    Args:
        n: how many.
        low, high: (3,) corners of the box that they are in, in W [m].
        config: shapes and gradation.
        seed: the same seed, the same rocks.

    Raises:
        InputError: a box that is none, or that has no room for so many.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    if low.shape != (3,) or high.shape != (3,) or not (low < high).all():
        raise InputError(
            f"scatter_rocks: low {low.tolist()} must be below high {high.tolist()} on three axes"
        )
    config = config or RocksConfig()
    shapes = load_rock_shapes(config)
    waiting = sample_rocks(n, config, shapes, make_generator(seed, "scattered rocks", "kinds"))
    # The largest first, while there is room.
    order: NDArray[np.int64] = np.argsort(-waiting.size, kind="stable")
    nothing = waiting.select(np.zeros(n, bool))
    poses = make_generator(seed, "scattered rocks", "poses")
    placed, left = place_rocks(
        waiting.select(order), nothing, shapes, Emitter(low, high, 0.0), poses, tries=TRIES, misses=1
    )
    if len(left):
        raise InputError(
            f"scatter_rocks: only {len(placed)} of {n} rocks found room between {low.tolist()} and {high.tolist()} m; "
            "make the box larger"
        )
    return replace(placed.select(np.argsort(order)), V_WRs=np.zeros((n, 6)))
