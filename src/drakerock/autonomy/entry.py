"""What a strategy meets where it enters: features of many height fields at once, as a look-ahead needs them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drakerock.exploration.problem import Array

ENTRY_FEATURES = ("slope", "front", "offset", "height_1m", "height_2m", "height_3m", "front_spread")
"""Of the entry: local slope [rad]; front before the front's mean, positive: nearer to the machine [m]; distance from
the drift's middle [m]; heights 1, 2 and 3 m behind the front [m]; spread of the front [m]; over the bucket's width."""
_BEHIND = (1.0, 2.0, 3.0)  # [m]


@dataclass(frozen=True, eq=False)
class PileGrid:
    """The grid of height fields, and where the machine can enter on it.

    Attributes:
        x, y: (nx,), (ny,) cell centres in W [m].
        cell: their spacing [m].
        front_height: the pile is what is higher [m].
        half_room: largest |y| at which the machine fits between the walls [m].
        bucket_width: its outer width [m].
    """

    x: Array
    y: Array
    cell: float
    front_height: float
    half_room: float
    bucket_width: float

    @property
    def fits(self) -> NDArray[np.bool_]:
        """(ny,) slices at which the machine fits."""
        return np.abs(self.y) <= self.half_room + 1e-9

    @property
    def window(self) -> Array:
        """(ny, ny) row j: weights of the slices under the bucket at slice j, 1 in sum."""
        under = np.abs(self.y[:, None] - self.y[None, :]) <= 0.5 * self.bucket_width
        return under / under.sum(axis=1, keepdims=True)


def calc_profiles(grid: PileGrid, H: Array) -> tuple[Array, Array, Array]:
    """Return front x_f, centre of mass x_m [m] and slope xi [rad] of each slice, (m, ny) each; NaN without pile.

    As `drakerock.loading.field.calc_pile_profile`, of many fields at once; but every cell that is high enough counts as
    pile, connected or not: predicted fields have no loose rocks.

    Args:
        grid: the grid.
        H: (m, nx, ny) heights [m].
    """
    high = grid.front_height < H
    there = high.any(axis=1)
    first = high.argmax(axis=1)
    behind = np.arange(len(grid.x))[None, :, None] >= first[:, None, :]
    mass = np.where(behind, H, 0.0)
    total = np.where(there, mass.sum(axis=1), 1.0)
    x_mass = np.einsum("i,mij->mj", grid.x, mass) / total
    x_front = grid.x[first]
    height = _interpolate(grid, H, x_mass)
    slope = np.arctan2(height, np.maximum(x_mass - x_front, 0.5 * grid.cell))
    return tuple(np.where(there, values, np.nan) for values in (x_front, x_mass, slope))  # type: ignore[return-value]


def choose_slices(grid: PileGrid, x_mass: Array, gamma: Array) -> NDArray[np.int_]:
    """Return the slice (m,) that each gamma (m,) enters at (`drakerock.loading.planning.choose_entry_slice`).

    Where no slice holds any pile, the one nearest to the middle is given.
    """
    candidates = np.where(grid.fits, x_mass, np.nan)
    order = np.argsort(candidates, axis=1, kind="stable")  # NaN last
    count = np.isfinite(candidates).sum(axis=1)
    place = np.round((1.0 - gamma) * np.maximum(count - 1, 0)).astype(int)
    chosen = np.take_along_axis(order, place[:, None], axis=1)[:, 0]
    return np.where(count > 0, chosen, int(np.argmin(np.abs(grid.y))))


def calc_entry_features(grid: PileGrid, H: Array, gamma: Array) -> tuple[Array, Array]:
    """Return `ENTRY_FEATURES` (m, 7) of each pile where its gamma enters, and the entries' y (m,) [m].

    Args:
        grid: the grid.
        H: (m, nx, ny) heights [m].
        gamma: (m,) which slice is entered, 1 the front-most.
    """
    x_front, x_mass, slope = calc_profiles(grid, H)
    chosen = choose_slices(grid, x_mass, gamma)
    weights = grid.window[chosen]
    rear = np.where(np.isfinite(x_front), x_front, 0.0)  # without pile the front is at the brow
    front = (weights * rear).sum(axis=1)
    spread = np.sqrt(np.maximum((weights * rear**2).sum(axis=1) - front**2, 0.0))
    columns = [
        (weights * np.nan_to_num(slope)).sum(axis=1),
        rear.mean(axis=1) - front,
        np.abs(grid.y[chosen]),
        *((weights * _interpolate(grid, H, rear + back)).sum(axis=1) for back in _BEHIND),
        spread,
    ]
    return np.stack(columns, axis=1), grid.y[chosen]


def _interpolate(grid: PileGrid, H: Array, x: Array) -> Array:
    """Return the heights (m, ny) of each field and slice at x (m, ny), linear between cells."""
    place = np.clip((x - grid.x[0]) / grid.cell, 0.0, len(grid.x) - 1.0)
    low = np.minimum(place.astype(int), max(len(grid.x) - 2, 0))
    share = place - low
    high = np.minimum(low + 1, len(grid.x) - 1)
    at = [np.take_along_axis(H, index[:, None, :], axis=1)[:, 0] for index in (low, high)]
    return (1.0 - share) * at[0] + share * at[1]
