"""What speaks against an entry, read from the height field: debris in the way, a boulder, a face that may overhang."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from drakerock.autonomy.entry import PileGrid
from drakerock.exploration.problem import Array

HazardKind = Literal["debris in the way", "boulder at the entry", "overhang"]


# A bump or a face is unusual if it is greater than those of so many piles of the training set.
_USUAL = 0.98


@dataclass(frozen=True)
class HazardLimits:
    """From when on it is a hazard; `calibrate_limits` raises boulders and faces to what is unusual.

    Attributes:
        debris_height: a rock on the machine's way to the pile that is higher [m].
        boulder_height: a bump that stands out of the pile's surface at the entry by more [m].
        entry_depth: how far behind the front the entry reaches [m].
        face_angle_deg: a face steeper than this may overhang: a height field cannot tell [deg] ...
        face_height: ... where it is higher than this [m].
    """

    debris_height: float = 0.3
    boulder_height: float = 0.6
    entry_depth: float = 1.5
    face_angle_deg: float = 70.0
    face_height: float = 1.5


@dataclass(frozen=True)
class Hazard:
    """Something that speaks against entering at a slice.

    Attributes:
        kind: what.
        y: of the entry [m].
        x: where it is [m].
        size: height of the debris, the bump or the face [m].
    """

    kind: HazardKind
    y: float
    x: float
    size: float

    def __str__(self) -> str:
        return f"{self.kind}: {self.size:.1f} m at x = {self.x:.1f} m, entry y = {self.y:.1f} m"


def find_hazards(grid: PileGrid, h: Array, machine_width: float, limits: HazardLimits) -> tuple[Hazard, ...]:
    """Return the hazards of each slice at which the machine fits, at most one of a kind and slice.

    Args:
        grid: the grid.
        h: (nx, ny) heights [m].
        machine_width: its largest [m].
        limits: from when on.
    """
    pile = find_pile(grid, h)
    # A bump is what an opening by a square of a metre takes away.
    size = max(3, 2 * round(0.5 / grid.cell) + 1)
    bump = ndimage.white_tophat(h, size=(size, size), mode="nearest")
    face = _calc_faces(grid, h, limits.face_angle_deg)
    found: list[Hazard] = []
    for j in np.flatnonzero(grid.fits):
        under = np.abs(grid.y - grid.y[j]) <= 0.5 * grid.bucket_width
        cells = np.argwhere(pile & under)
        if len(cells) == 0:
            continue
        front = grid.x[cells[:, 0].min()]
        # Of the pile: what lies there may be loose or a part of it. The way is where it is not the pile.
        driven = np.abs(grid.y - grid.y[j]) <= 0.5 * machine_width
        entry = (grid.x >= front) & (grid.x <= front + limits.entry_depth)
        looked_at: tuple[tuple[HazardKind, Array, NDArray[np.bool_], float], ...] = (
            ("debris in the way", h, ~pile & driven & (grid.x < front)[:, None], limits.debris_height),
            ("boulder at the entry", bump, under & entry[:, None], limits.boulder_height),
            ("overhang", face, under & (grid.x >= front)[:, None], limits.face_height),
        )
        for kind, values, where, limit in looked_at:
            there = np.where(where, values, -np.inf)
            i, _ = np.unravel_index(int(np.argmax(there)), there.shape)
            if there.max() > limit:
                found.append(Hazard(kind, float(grid.y[j]), float(grid.x[i]), float(there.max())))
    return tuple(found)


def calibrate_limits(grid: PileGrid, H: Array, machine_width: float) -> HazardLimits:
    """Return limits above the bumps and faces of 98 % of piles (n, nx, ny): rocks of the usual size are no boulders."""
    least = HazardLimits()
    all_ = HazardLimits(boulder_height=0.0, face_height=0.0)
    sizes: dict[str, list[float]] = {"boulder at the entry": [], "overhang": []}
    for h in H:
        found = find_hazards(grid, h, machine_width, all_)
        for kind, values in sizes.items():
            values.append(max((hazard.size for hazard in found if hazard.kind == kind), default=0.0))
    boulder, face = (float(np.quantile(values, _USUAL)) for values in sizes.values())
    return HazardLimits(
        boulder_height=max(least.boulder_height, boulder), face_height=max(least.face_height, face)
    )


def find_pile(grid: PileGrid, h: Array) -> NDArray[np.bool_]:
    """Return which cells (nx, ny) belong to the pile: high, and connected to the brow through such cells.

    Where nothing reaches the brow: to the body of the largest volume (`calc_pile_profile`).
    """
    labels, count = ndimage.label(h > grid.front_height, structure=np.ones((3, 3)))
    bodies = np.unique(labels[-1][labels[-1] > 0])
    if len(bodies) == 0 and count > 0:
        bodies = np.array([1 + int(np.argmax(ndimage.sum_labels(h, labels, np.arange(1, count + 1))))])
    return np.isin(labels, bodies) & (labels > 0)


def _calc_faces(grid: PileGrid, h: Array, angle_deg: float) -> Array:
    """Return the height [m] of the steep face that ends at each cell (nx, ny): of successive steep rises along x."""
    rise = np.diff(h, axis=0, prepend=h[:1])
    steep = rise > np.tan(np.radians(angle_deg)) * grid.cell
    faces = np.zeros_like(h)
    for i in range(1, len(h)):
        faces[i] = np.where(steep[i], faces[i - 1] + rise[i], 0.0)
    return faces
