"""Drawing rocks from the gradation and placing them above a pile (method section 3)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from drakerock.pile.config import RocksConfig
from drakerock.pile.shapes import RockShape
from drakerock.pile.state import PileState

Array = NDArray[np.float64]


def sample_rocks(
    n: int, rocks: RocksConfig, shapes: tuple[RockShape, ...], rng: np.random.Generator
) -> PileState:
    """Draw n rocks at random turns, at the origin: sizes so that the expected mass shares are the gradation's.

    Args:
        n: number of rocks.
        rocks: gradation.
        shapes: the shapes, equally likely.
        rng: source of randomness.
    """
    sizes = np.array([item.size_m for item in rocks.gradation])
    shares = np.array([item.mass_fraction for item in rocks.gradation])
    # All classes draw from the same shapes, so a rock's expected mass goes with the cube of its size.
    by_number = shares / sizes**3
    return PileState(
        p_WRs=np.zeros((n, 3)),
        q_WRs=Rotation.random(n, rng=rng).as_quat(scalar_first=True) if n else np.zeros((0, 4)),
        V_WRs=np.zeros((n, 6)),
        shape=rng.integers(len(shapes), size=n),
        size=rng.choice(sizes, size=n, p=by_number / by_number.sum()),
        fixed=np.zeros(n, bool),
    )


def place_rocks(
    waiting: PileState,
    pile: PileState,
    shapes: tuple[RockShape, ...],
    low: Array,
    high: Array,
    rng: np.random.Generator,
    tries: int = 40,
) -> tuple[PileState, PileState]:
    """Place as many of the waiting rocks, in their order, as find room in a box above a pile.

    A rock finds room where its bounding sphere touches no other's and stays above the pile's surface
    around it.

    Args:
        waiting: rocks without a place.
        pile: rocks that are there already.
        shapes: the rock shapes.
        low, high: (3,) corners of the box that bounding spheres stay inside, in W [m].
        rng: source of randomness.
        tries: positions tried for each rock before it has to wait.

    Returns:
        The placed rocks, and those still waiting.
    """
    radii = np.array([shape.radius for shape in shapes])
    there = pile.p_WRs, radii[pile.shape] * pile.size
    tree = cKDTree(there[0][:, :2]) if len(pile) else None
    centres = np.zeros((0, 3))
    spheres = np.zeros(0)
    placed = []
    for rock in range(len(waiting)):
        radius = radii[waiting.shape[rock]] * waiting.size[rock]
        room_low, room_high = low + radius, high - radius
        if np.any(room_low > room_high):
            continue
        for _ in range(tries):
            centre = rng.uniform(room_low, room_high)
            if tree is not None:
                near = tree.query_ball_point(centre[:2], radius + there[1].max())
                top = max((there[0][k, 2] + there[1][k] for k in near), default=low[2])
                if centre[2] - radius < top:
                    continue
            if np.all(np.linalg.norm(centres - centre, axis=1) > spheres + radius):
                placed.append(rock)
                centres = np.vstack([centres, centre])
                spheres = np.append(spheres, radius)
                break
    chosen = np.zeros(len(waiting), bool)
    chosen[placed] = True
    return replace(waiting.select(chosen), p_WRs=centres), waiting.select(~chosen)
