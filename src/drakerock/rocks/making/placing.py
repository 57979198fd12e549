"""Placing rocks at chosen places, just above what lies there, in the gradation's shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drakerock.rocks.config import RocksConfig
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.site import Site
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]

# Air between a placed rock and what is below it [m].
AIR = 0.01
# Rocks that are placed start so fast, downwards: they have not fallen far [m/s].
PLACED_SPEED = 0.5
_MANY = 4096


class ShareKeeper:
    """Chooses the class of the next rock so that the masses keep the gradation's shares."""

    def __init__(self, pile: PileState, rocks: RocksConfig) -> None:
        self._classes = sorted((item.size_m, item.mass_fraction) for item in rocks.gradation)
        moving = pile.size[~pile.fixed]
        # Masses up to a factor: all classes draw from the same shapes.
        self._masses = {size: float(np.sum(np.isclose(moving, size)) * size**3) for size, _ in self._classes}

    def choose(self, allowed: Array) -> float | None:
        """Return the allowed size whose share is farthest behind, relative to what it should be; None of none."""
        wanted = dict(self._classes)
        sizes = [size for size in wanted if np.isclose(allowed, size).any()]
        # With half of its next rock, so that a class's first rock does not come before its time.
        return min(sizes, key=lambda size: (self._masses[size] + 0.5 * size**3) / wanted[size], default=None)

    def add(self, size: float) -> None:
        """Count a rock of that size."""
        self._masses[size] += size**3


class Placer:
    """Puts rocks in the air above a pile, so that no bounding sphere meets another, the floor, a wall or the roof."""

    def __init__(
        self, pile: PileState, shapes: tuple[RockShape, ...], site: Site, rng: np.random.Generator
    ) -> None:
        self._shapes, self._rng = shapes, rng
        radii = np.array([shape.radius for shape in shapes])
        n = len(pile)
        self._spheres = np.empty((n + _MANY, 4))
        self._spheres[:n, :3], self._spheres[:n, 3] = pile.p_WRs, radii[pile.shape] * pile.size
        self._first = self._n = n
        self._planes = np.array([[*plane.normal, plane.offset] for plane in site.planes])
        self._pieces = [ConvexHull(piece.vertices).equations for piece in site.pieces]
        self._kinds: list[tuple[int, float, Array]] = []

    @property
    def count(self) -> int:
        """Number of rocks placed so far."""
        return len(self._kinds)

    def place(self, place: Array, size: float) -> bool:
        """Place a rock of that sieve width over (or, at a wall, near) `place` (2,); False if there is no room."""
        if self._n == len(self._spheres):
            return False
        shape = int(self._rng.integers(len(self._shapes)))
        radius = self._shapes[shape].radius * size
        turn = Rotation.random(rng=self._rng)
        place = self._move_off_walls(place, turn.apply(size * self._shapes[shape].vertices))
        spheres = self._spheres[: self._n]
        apart = np.sum((spheres[:, :2] - place) ** 2, axis=1)
        reach = spheres[:, 3] + radius
        near = apart < reach**2
        # One layer: not on top of a rock that has just been placed.
        if near[self._first :].any():
            return False
        top = float(np.max(spheres[near, 2] + np.sqrt(reach[near] ** 2 - apart[near]), initial=radius))
        centre = np.array([*place, top + AIR])
        # The roof's and the taper's pieces are kept off by the bounding sphere, the walls by the corners.
        if not all(np.max(piece[:, :3] @ centre + piece[:, 3]) >= radius for piece in self._pieces):
            return False
        self._spheres[self._n] = *centre, radius
        self._n += 1
        self._kinds.append((shape, size, turn.as_quat(scalar_first=True)))
        return True

    def _move_off_walls(self, place: Array, corners: Array) -> Array:
        """Return the place (2,) moved so far off the upright walls that a rock's corners (k, 3) about it clear them."""
        moved = place.copy()
        for *normal, offset in self._planes:
            if abs(normal[2]) < 0.5:
                inside = float(np.min(corners @ normal)) + float(np.dot(normal[:2], moved)) - offset
                moved += max(AIR - inside, 0.0) * np.array(normal[:2])
        return moved

    def make_rocks(self) -> PileState:
        """Return the placed rocks, on their way down."""
        n = self.count
        V_WRs = np.zeros((n, 6))
        V_WRs[:, 5] = -PLACED_SPEED
        return PileState(
            p_WRs=self._spheres[self._first : self._n, :3].copy(),
            q_WRs=np.array([kind[2] for kind in self._kinds]).reshape(-1, 4),
            V_WRs=V_WRs,
            shape=np.array([kind[0] for kind in self._kinds], np.int64),
            size=np.array([kind[1] for kind in self._kinds], float),
            fixed=np.zeros(n, bool),
        )
