"""Surfaces as height fields over drift and void: of a measured cloud, and of a pile of rocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import distance_transform_edt, label

from drakerock.errors import InputError
from drakerock.rocks.config import PileConfig, ScanConfig, SiteConfig
from drakerock.rocks.geometry import make_pile_mesh
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.site import calc_roof_height
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Lower than this is floor, not pile [m]: as `loading.sensing.front_height`.
FLOOR_HEIGHT = 0.15
# Rays a cell's side on which a pile's surface is looked at from above.
RAYS = 3


@dataclass(frozen=True, eq=False)
class Surface:
    """Heights above the floor on a regular grid over drift and void.

    Attributes:
        x: (nx,) cell centres along the drift, rising towards the rear wall [m].
        y: (ny,) cell centres across [m].
        h: (nx, ny) heights [m], 0 where the floor is.
        seen: (nx, ny) True where points were measured; elsewhere the height is inferred.
        cell: grid spacing [m].
    """

    x: Array
    y: Array
    h: Array
    seen: Mask
    cell: float

    @property
    def volume(self) -> float:
        """Volume below the surface [m^3]."""
        return float(self.h.sum()) * self.cell**2


def make_surface(
    points: Array, site: SiteConfig, pile: PileConfig, scan: ScanConfig
) -> tuple[Surface, list[str]]:
    """Return the height field of a cloud, complete over the pile's drift and void, and what was inferred.

    A cell's height is the median of its points'. Holes no wider than `scan.max_hole` are filled linearly. Beyond the
    cloud's edges the surface goes on with `scan.edge_slope_deg`: behind it rising up to the emission height (in the
    drift: the roof), before it falling to the floor, at the sides level up to the walls. Floor goes on as floor.

    Args:
        points: (n, 3) in W, cleaned [m].
        site: drift and void.
        pile: emission height.
        scan: cell, `max_hole`, `edge_slope_deg`.

    Raises:
        InputError: too few cells with points, or a hole that is too wide.
    """
    from scipy.stats import binned_statistic_2d  # takes long to import, and only scans need it

    cell, notes = scan.cell, list[str]()
    reach = float(points[:, 0].min()) - 1.0
    first = max(int(np.ceil(min(-reach, site.drift_length) / cell)), 1)
    x = cell * (np.arange(-first, int(np.ceil(site.void_depth / cell - 1e-9))) + 0.5)
    ny = max(1, int(np.floor(site.drift_width / cell + 1e-9)))
    y = cell * (np.arange(ny, dtype=float) - 0.5 * (ny - 1))
    edges = [np.append(axis - 0.5 * cell, axis[-1] + 0.5 * cell) for axis in (x, y)]
    h = binned_statistic_2d(*points.T, "median", bins=edges).statistic
    seen = np.isfinite(h)
    spread = [len(np.unique(axis)) for axis in np.nonzero(seen)]
    if min(spread) < 4:
        raise InputError(
            f"the cloud covers {spread[0]} x {spread[1]} cells of {cell:g} m; a surface needs at least 4 x 4"
        )
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    linear = LinearNDInterpolator(grid[seen], h[seen])(grid)
    distance, nearest = distance_transform_edt(~seen, sampling=cell, return_indices=True)
    inside = ~seen & np.isfinite(linear)
    # From a cell's middle to its hole's edge: half of the hole, and half a cell.
    wide = inside & (distance > 0.5 * (scan.max_hole + cell))
    if wide.any():
        raise InputError(_describe_hole(grid, wide, scan, cell))
    h = np.where(inside, linear, h)
    if inside.any():
        notes.append(
            f"{inside.sum() * cell**2:.2f} m2 without points filled linearly between their neighbours"
        )
    outside = ~seen & ~inside
    near_h, near_x = h[tuple(nearest)], x[nearest[0]]
    slope = np.tan(np.deg2rad(scan.edge_slope_deg))
    rise = np.where(near_h > FLOOR_HEIGHT, slope * (grid[..., 0] - near_x), 0.0)
    roof = np.where(grid[..., 0] < 0.0, calc_roof_height(site, grid[..., 1]), pile.emission_height)
    cap = np.maximum(roof, near_h)
    h = np.where(outside, np.minimum(near_h + rise, cap), h)
    beyond = outside & (h > FLOOR_HEIGHT)
    if beyond.any():
        notes.append(
            f"{beyond.sum() * cell**2:.1f} m2 beyond the cloud's edges inferred: level to the sides, "
            f"{scan.edge_slope_deg:g} deg along the drift"
        )
    return Surface(np.asarray(x, float), y, np.maximum(h, 0.0), seen, cell), notes


def _describe_hole(grid: Array, wide: Mask, scan: ScanConfig, cell: float) -> str:
    parts, count = label(wide)
    sizes = np.bincount(parts.ravel())[1:]
    centre = grid[parts == 1 + int(np.argmax(sizes))].mean(axis=0)
    return (
        f"{count} hole{'s' if count > 1 else ''} wider than pile.scan.max_hole = {scan.max_hole:g} m, the largest "
        f"around x = {centre[0]:.2f}, y = {centre[1]:.2f} m; scan again from another side, or raise max_hole"
    )


@dataclass(frozen=True, eq=False)
class View:
    """A pile seen from above, `RAYS` x `RAYS` rays a cell (r rays in all).

    Attributes:
        top: (nx, ny, r) height of the first surface [m], 0 on the floor.
        rock: (nx, ny, r) the rock that it belongs to, -1: floor.
        below: (nx, ny, r) height of the first surface that belongs to another rock [m].
    """

    top: Array
    rock: NDArray[np.int64]
    below: Array

    @property
    def h(self) -> Array:
        """The sensed surface (nx, ny): the median of a cell's rays, as of a scan's points [m]."""
        return np.median(self.top, axis=2)


def view_pile(pile: PileState, shapes: tuple[RockShape, ...], surface: Surface) -> View:
    """Look at a pile from above on a surface's grid."""
    nx, ny = surface.h.shape
    offsets = surface.cell * ((np.arange(RAYS) + 0.5) / RAYS - 0.5)
    grid = np.stack(
        np.broadcast_arrays(
            surface.x[:, None, None, None] + offsets[:, None],
            surface.y[None, :, None, None] + offsets[None, :],
        ),
        axis=-1,
    )
    flat = grid.reshape(-1, 2)
    top, below = np.zeros(len(flat)), np.zeros(len(flat))
    rock = np.full(len(flat), -1, np.int64)
    if len(pile):
        ceiling = float((pile.p_WRs[:, 2] + pile.size).max()) + 1.0
        mesh = make_pile_mesh(pile, shapes)
        owner = np.repeat(np.arange(len(pile)), [len(shapes[k].triangles) for k in pile.shape])
        origins = np.column_stack([flat, np.full(len(flat), ceiling)])
        down = np.tile([0.0, 0.0, -1.0], (len(flat), 1))
        places, rays, triangles = mesh.ray.intersects_location(origins, down, multiple_hits=True)
        order = np.lexsort((-places[:, 2], rays))
        rays, z, hit = rays[order], places[order, 2], owner[triangles[order]]
        first = np.unique(rays, return_index=True)[1]
        top[rays[first]], rock[rays[first]] = z[first], hit[first]
        others = np.flatnonzero(hit != rock[rays])
        chosen = others[np.unique(rays[others], return_index=True)[1]]
        below[rays[chosen]] = z[chosen]
    form = (nx, ny, RAYS**2)
    return View(np.maximum(top, 0.0).reshape(form), rock.reshape(form), np.maximum(below, 0.0).reshape(form))


def calc_rms(h: Array, surface: Surface) -> tuple[float, float]:
    """Return rms and mean of the difference of heights (nx, ny) to a surface's, over the seen cells with pile [m].

    A cell holds pile where either surface is higher than `FLOOR_HEIGHT`: floor that both see does not count.
    """
    held = surface.seen & ((surface.h > FLOOR_HEIGHT) | (h > FLOOR_HEIGHT))
    if not held.any():
        return 0.0, 0.0
    difference = (h - surface.h)[held]
    return float(np.sqrt(np.mean(difference**2))), float(difference.mean())
