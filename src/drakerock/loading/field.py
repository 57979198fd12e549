"""The height field of a pile and the curves read from it (method section 5, pile analysis)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class HeightField:
    """Heights above the drift floor on a regular grid, from the machine to the brow.

    Attributes:
        x: (nx,) cell centres along the drift, rising towards the pile [m].
        y: (ny,) cell centres across the drift [m].
        h: (nx, ny) heights [m], 0 where the floor is seen.
        cell: grid spacing [m].
    """

    x: Array
    y: Array
    h: Array
    cell: float

    @property
    def x_end(self) -> float:
        """The field's rear end: the brow [m]."""
        return float(self.x[-1] + 0.5 * self.cell)


@dataclass(frozen=True, eq=False)
class PileProfile:
    """What the plan needs to know of each slice y of a height field; nan where a slice holds no pile.

    Attributes:
        y: (ny,) slices [m].
        x_front: (ny,) front curve x_f(y) [m].
        x_mass: (ny,) centre-of-mass curve x_m(y) [m].
        slope: (ny,) local slope xi(y) [rad].
    """

    y: Array
    x_front: Array
    x_mass: Array
    slope: Array


def calc_pile_profile(field: HeightField, front_height: float) -> PileProfile:
    """Return front curve, centre-of-mass curve and slope of every slice (method section 5).

    A cell belongs to the pile if it is higher than `front_height` and connected, through such cells, to
    the rear end of the field; where nothing reaches the rear end, to the body of largest volume. Loose rocks
    on the floor are so left out of the front curve and of the centre of mass.

    Args:
        field: the height field.
        front_height: [m].
    """
    labels, count = ndimage.label(field.h > front_height, structure=np.ones((3, 3)))
    rear = np.unique(labels[-1][labels[-1] > 0])
    if len(rear) == 0 and count > 0:
        volumes = ndimage.sum_labels(field.h, labels, index=np.arange(1, count + 1))
        rear = np.array([1 + int(np.argmax(volumes))])
    pile = np.isin(labels, rear) & (labels > 0)
    ny = len(field.y)
    x_front, x_mass, slope = (np.full(ny, np.nan) for _ in range(3))
    for j in range(ny):
        cells = np.flatnonzero(pile[:, j])
        if len(cells) == 0:
            continue
        x, h = field.x[cells[0] :], field.h[cells[0] :, j]
        x_front[j] = x[0]
        x_mass[j] = np.sum(x * h) / np.sum(h)
        run = x_mass[j] - x_front[j]
        height = np.interp(x_mass[j], x, h)
        # A front of one cell's depth has no run: its face is as steep as the grid can tell.
        slope[j] = np.arctan2(height, max(run, 0.5 * field.cell))
    return PileProfile(field.y, x_front, x_mass, slope)
