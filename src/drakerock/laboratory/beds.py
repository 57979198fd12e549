"""Specimens: benches as large as their rocks make them, rocks let fall into them, and what their surface is like."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from drakerock.errors import InputError
from drakerock.laboratory.material import Material
from drakerock.laboratory.scene import Drive, Record, Rig, Scene, Slab
from drakerock.rocks.geometry import cast_rays, make_pile_mesh
from drakerock.rocks.making.scatter import scatter_rocks
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]
MakeRig = Callable[[Scene, PileState, Material], Rig]

# Shares of space that rocks fill: in a bed, for its size to be foreseen; in the air, so that all find a place.
PACKING, LOOSE = 0.57, 0.09
# A bench is at least so many largest rocks wide.
LEAST_WIDTH = 2.0
# Slabs are so thick that nothing passes [m].
THICKNESS = 4.0
# Rocks rest when they move slower on average, by mass [m/s]; looked at this often, for so long at most [s].
REST_SPEED, LOOK, LONGEST = 0.02, 0.25, 6.0


@dataclass(frozen=True, eq=False)
class Bin:
    """A box-shaped room: x from 0 to length, |y| up to half the width, z from 0 up.

    Attributes:
        length, width, height: [m]; rocks fill it to about the height.
    """

    length: float
    width: float
    height: float

    def make_walls(
        self, sides: str, friction: float, reach: float = 0.0, top: float = 40.0
    ) -> tuple[Slab, ...]:
        """Return the walls named: f floor, l left, r right, a at x = 0, e at x = length; floors are rough (0.9).

        Args:
            sides: which, such as ``"flre"``.
            friction: of the walls with rock.
            reach: how far floor and side walls go on before x = 0 and behind x = length [m].
            top: height of the walls [m].
        """
        t, half = THICKNESS, 0.5 * self.width
        length = self.length + 2 * (reach + t)
        middle, z = 0.5 * self.length, 0.5 * top - 0.5 * t
        walls = {
            "f": Slab((length, self.width + 2 * t, t), (middle, 0.0, -0.5 * t)),
            "l": Slab((length, t, top + t), (middle, half + 0.5 * t, z), friction=friction),
            "r": Slab((length, t, top + t), (middle, -half - 0.5 * t, z), friction=friction),
            "a": Slab((t, self.width, top + t), (-0.5 * t, 0.0, z), friction=friction),
            "e": Slab((t, self.width, top + t), (self.length + 0.5 * t, 0.0, z), friction=friction),
        }
        return tuple(walls[side] for side in sides)


def make_bin(material: Material, rocks: int, length: float, width: float) -> Bin:
    """Return a bin that so many rocks fill.

    Args:
        material: their sizes.
        rocks: how many.
        length, width: in heights.

    Raises:
        InputError: it would be too narrow for the largest rock.
    """
    height = (rocks * material.mean_volume / (PACKING * length * width)) ** (1.0 / 3.0)
    found = Bin(length * height, width * height, height)
    least = min(found.length, found.width, found.height) / material.largest
    if least < LEAST_WIDTH:
        raise InputError(
            f"rocks: {rocks} of these rocks make a specimen only {least:.1f} times as wide as the largest, "
            f"{material.largest:g} m; at least {LEAST_WIDTH:g} is allowed: raise rocks to "
            f"{int(np.ceil(rocks * (LEAST_WIDTH / least) ** 3))}, or leave the largest out of rocks.gradation"
        )
    return found


def scatter(
    material: Material, rocks: int, low: tuple[float, float, float], high: tuple[float, float], seed: int
) -> PileState:
    """Return rocks in the air over a rectangle.

    Args:
        material: what they are.
        rocks: how many.
        low: the rectangle's lower corner, and the height from which on they are [m].
        high: its upper corner [m].
        seed: the same seed, the same rocks.
    """
    area = (high[0] - low[0]) * (high[1] - low[1])
    height = max(rocks * material.mean_volume / (LOOSE * area), 1.5 * material.largest)
    for _ in range(8):
        try:
            return scatter_rocks(rocks, low, (*high, low[2] + height), material.config, seed)
        except InputError:
            height *= 1.25
    raise InputError(f"rocks: {rocks} find no place above a bench of {high[0] - low[0]:.2f} m; raise rocks")


def fill_bin(material: Material, rocks: int, room: Bin, seed: int) -> PileState:
    """Return rocks in the air over a bin."""
    half = 0.5 * room.width
    return scatter(material, rocks, (0.0, -half, 0.05), (room.length, half), seed)


def settle(rig: Rig, material: Material, drive: Drive | None = None, longest: float = LONGEST) -> Record:
    """Go on until the rocks rest, or so long [s] at most; return the last part's record."""
    before = rig.get_pile()
    masses = material.calc_masses(before)
    for _ in range(round(longest / LOOK)):
        record = rig.advance(LOOK, drive)
        after = rig.get_pile()
        if np.average(np.linalg.norm(after.p_WRs - before.p_WRs, axis=1), weights=masses) < REST_SPEED * LOOK:
            break
        before = after
    return record


def take_out(pile: PileState, floor: float) -> PileState:
    """Return the rocks that are above a height [m], at rest, without contacts: for another bench."""
    kept = replace(pile, contacts=None).select(pile.p_WRs[:, 2] > floor)
    return replace(kept, V_WRs=np.zeros((len(kept), 6)))


def calc_profile(
    pile: PileState, material: Material, x: Array, half_width: float, n_across: int = 12
) -> Array:
    """Return the surface's mean height h(x) over |y| < half_width [m], 0 where no rock is, for x (k,) [m]."""
    y = np.linspace(-half_width, half_width, n_across)
    top = float(pile.p_WRs[:, 2].max()) + 2.0 * material.largest
    grid_x, grid_y = np.meshgrid(x, y, indexing="ij")
    origins = np.column_stack([grid_x.ravel(), grid_y.ravel(), np.full(grid_x.size, top)])
    down = np.tile([0.0, 0.0, -1.0], (len(origins), 1))
    heights = np.maximum(top - cast_rays(make_pile_mesh(pile, material.shapes), origins, down), 0.0)
    mean: Array = heights.reshape(grid_x.shape).mean(axis=1)
    return mean


def fit_slope(x: Array, h: Array) -> tuple[float, float]:
    """Return slope and height at x = 0 of the flank of a surface: floor, straight flank, level crest, fitted together.

    nan if there is no such flank.

    Args:
        x: (k,) rising [m].
        h: (k,) the surface [m].
    """
    crest = float(np.quantile(h[h > 0.0], 0.9)) if (h > 0.0).any() else 0.0
    if crest <= 0.0 or h[0] > 0.5 * crest:
        return float("nan"), float("nan")
    foot, top = x[np.argmax(h > 0.1 * crest)], x[np.argmax(h > 0.9 * crest)]

    def calc_misses(ramp: Array) -> Array:
        return np.asarray(np.interp(x, ramp[:2], [0.0, ramp[2]]) - h)

    least = x[1] - x[0]
    ramp = least_squares(calc_misses, [foot, max(top, foot + least), crest]).x
    if not ramp[1] > ramp[0]:
        return float("nan"), float("nan")
    slope = ramp[2] / (ramp[1] - ramp[0])
    return float(slope), float(-slope * ramp[0])


def calc_packing(pile: PileState, material: Material, low: Array, high: Array) -> float:
    """Return the share of a box that rocks fill: those whose centre is in it, with all of their volume."""
    inside = np.all((pile.p_WRs > low) & (pile.p_WRs < high), axis=1)
    return float(material.calc_volumes(pile)[inside].sum() / np.prod(high - low))
