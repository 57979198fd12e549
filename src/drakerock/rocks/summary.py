"""A pile in numbers: amount, gradation, slope, packing, and the forces between its rocks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.config import GRAVITY, RocksConfig, SiteConfig
from drakerock.rocks.geometry import cast_rays, make_pile_mesh
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.site import Site
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]

# Cell of the grid on which the surface in the drift is looked at from above [m].
CELL = 0.13
# Rocks so near to a wall are left out where walls would show: of slope and packing [m].
WALL_MARGIN = 0.8
# The slope is taken between these shares of the pile's height at the brow: neither foot nor crest.
SLOPE_RANGE = (0.2, 0.8)


@dataclass(frozen=True, eq=False)
class Support:
    """Who carries the moving rocks, from a pile's stored contact forces.

    Attributes:
        weight: of the moving rocks [N].
        floor, walls, static: vertical force of the floor, of all other surfaces of the site, and of the static
            rocks on them [N]; they sum to the weight at rest.
        contacts_per_rock: number of loaded rock-rock pairs times two over the number of moving rocks.
    """

    weight: float
    floor: float
    walls: float
    static: float
    contacts_per_rock: float


def calc_profile(pile: PileState, shapes: tuple[RockShape, ...], site: SiteConfig) -> tuple[Array, Array]:
    """Return the mean height of the surface in the drift, h(x), over the middle of its width.

    Returns:
        x (k,) from the pile's toe to the brow [m], h (k,) [m].
    """
    margin = min(WALL_MARGIN, 0.25 * site.drift_width)
    half = 0.5 * site.drift_width - margin
    x = np.arange(min(float(pile.p_WRs[:, 0].min()), -CELL), 0.0, CELL) + 0.5 * CELL
    y = np.linspace(-half, half, max(int(2 * half / CELL), 2))
    roof = site.drift_height - site.roof_sag
    grid_x, grid_y = np.meshgrid(x, y, indexing="ij")
    origins = np.column_stack([grid_x.ravel(), grid_y.ravel(), np.full(grid_x.size, roof)])
    down = np.tile([0.0, 0.0, -1.0], (len(origins), 1))
    h = np.maximum(roof - cast_rays(make_pile_mesh(pile, shapes), origins, down), 0.0)
    return x, h.reshape(grid_x.shape).mean(axis=1)


def calc_slope(pile: PileState, shapes: tuple[RockShape, ...], site: SiteConfig) -> float:
    """Return the angle of the pile's slope in the drift [rad]; nan if there is none.

    Procedure: the surface's mean height over the width (0.8 m to the walls left out) as a function of x, a straight
    line fitted by least squares between 20 and 80 % of its greatest height. For a pile that flowed out of the void by
    itself this is its angle of repose, between the drift's walls.
    """
    x, h = calc_profile(pile, shapes, site)
    low, high = SLOPE_RANGE[0] * h.max(initial=0.0), SLOPE_RANGE[1] * h.max(initial=0.0)
    # The flank up to the first crest.
    stop = int(np.argmax(h >= high)) if len(h) else 0
    below = np.flatnonzero(h[:stop] <= low)
    start = int(below[-1]) + 1 if len(below) else 0
    if stop - start < 3:
        return float("nan")
    return float(np.arctan(np.polyfit(x[start:stop], h[start:stop], 1)[0]))


def calc_packing(pile: PileState, shapes: tuple[RockShape, ...], site: SiteConfig) -> float:
    """Return the share of space that rock fills inside the void, away from walls and surface; nan if too few.

    Rocks whose centre is in a box are counted with all of their volume; what sticks out of the box and what sticks
    into it cancel on average.
    """
    margin = min(WALL_MARGIN, 0.25 * site.drift_width)
    low = np.array([margin, -0.5 * site.drift_width + margin, margin])
    in_void = pile.p_WRs[:, 0] > 0
    top = float(np.quantile(pile.p_WRs[in_void, 2], 0.9)) if in_void.any() else 0.0
    high = np.array([site.void_depth - site.rear_layer - margin, -low[1], top - margin])
    if np.any(high - low < margin):
        return float("nan")
    inside = np.all((pile.p_WRs > low) & (pile.p_WRs < high), axis=1) & ~pile.fixed
    volumes = pile.calc_masses(np.array([shape.volume for shape in shapes]), 1.0)
    return float(volumes[inside].sum() / np.prod(high - low))


def calc_support(
    pile: PileState, shapes: tuple[RockShape, ...], rocks: RocksConfig, site: Site, time_step: float
) -> Support | None:
    """Return who carries the moving rocks; None for a pile without stored contacts.

    Args:
        pile: at rest.
        shapes: the rock shapes.
        rocks: density.
        site: its surfaces, as the contacts count them.
        time_step: of the simulation that the contact impulses come from [s].
    """
    if pile.contacts is None:
        return None
    moving = ~pile.fixed
    first, second = pile.contacts.pairs.T
    lift = -pile.contacts.impulses[:, 2].astype(float) / time_step  # on the first rock
    on_site, rock = second < 0, np.maximum(second, 0)
    on_floor = second == -(len(site.pieces) + 1)  # pieces first, then planes: the floor is the first plane
    carried = on_site & moving[first]
    mixed = ~on_site & (moving[first] != moving[rock])
    between = ~on_site & moving[first] & moving[rock]
    masses = pile.calc_masses(np.array([shape.volume for shape in shapes]), rocks.density)
    n_pairs = len(np.unique(pile.contacts.pairs[between], axis=0))
    return Support(
        weight=float(masses[moving].sum()) * GRAVITY,
        floor=float(lift[carried & on_floor].sum()),
        walls=float(lift[carried & ~on_floor].sum()),
        static=float(np.where(moving[first], lift, -lift)[mixed].sum()),
        contacts_per_rock=2.0 * n_pairs / max(int(moving.sum()), 1),
    )


def calc_imbalance(
    pile: PileState, shapes: tuple[RockShape, ...], rocks: RocksConfig, time_step: float
) -> Array:
    """Return each moving rock's (m,) sum of contact forces and weight, over its weight: 0 in balance.

    Args:
        pile: at rest, with its contacts.
        shapes: the rock shapes.
        rocks: density.
        time_step: of the simulation that the contact impulses come from [s].

    Raises:
        ValueError: a pile without stored contacts.
    """
    if pile.contacts is None:
        raise ValueError("the pile has no contacts")
    weights = GRAVITY * pile.calc_masses(np.array([shape.volume for shape in shapes]), rocks.density)
    first, second = pile.contacts.pairs.T
    forces = pile.contacts.impulses.astype(float) / time_step
    sums = np.zeros((len(pile), 3))
    np.subtract.at(sums, first, forces)
    np.add.at(sums, second[second >= 0], forces[second >= 0])
    sums[:, 2] -= weights
    share: Array = np.linalg.norm(sums, axis=1) / weights
    return share[~pile.fixed]


def calc_gradation(
    pile: PileState, shapes: tuple[RockShape, ...], rocks: RocksConfig
) -> list[dict[str, float]]:
    """Return, for each class of the gradation, the moving rocks' number, mass and share of the mass, and its error.

    ``standard_error`` is that of the share when so many rocks are drawn at random.
    """
    masses = pile.calc_masses(np.array([shape.volume for shape in shapes]), rocks.density)[~pile.fixed]
    sizes, total = pile.size[~pile.fixed], float(masses.sum())
    table = []
    for item in rocks.gradation:
        chosen = np.isclose(sizes, item.size_m)
        # Of a ratio of sums over independent rocks.
        error = np.sqrt(np.sum(masses**2 * (chosen - item.mass_fraction) ** 2)) / max(total, 1e-9)
        table.append(
            {
                "size_m": item.size_m,
                "rocks": int(chosen.sum()),
                "mass_kg": round(float(masses[chosen].sum()), 1),
                "share": round(float(masses[chosen].sum()) / max(total, 1e-9), 4),
                "wanted": item.mass_fraction,
                "standard_error": round(float(error), 4),
            }
        )
    return table


def calc_summary(
    pile: PileState, shapes: tuple[RockShape, ...], rocks: RocksConfig, site: Site, time_step: float
) -> dict[str, Any]:
    """Return number, mass, gradation, extent, slope, packing and support of a pile; keys end with their units.

    What a pile is too small for, or does not store, is None.
    """
    moving = ~pile.fixed
    gradation = calc_gradation(pile, shapes, rocks)
    summary: dict[str, Any] = {
        "rocks": int(moving.sum()),
        "static_rocks": int(pile.fixed.sum()),
        "mass_t": round(sum(item["mass_kg"] for item in gradation) / 1e3, 1),
        "gradation": gradation,
    }
    if not moving.any():
        return summary
    summary |= {
        "toe_x_m": round(float(pile.p_WRs[moving, 0].min()), 2),
        "top_z_m": round(float((pile.p_WRs[:, 2] + 0.5 * pile.size)[moving].max()), 2),
        "slope_deg": _round(np.rad2deg(calc_slope(pile, shapes, site.config)), 1),
        "packing": _round(calc_packing(pile, shapes, site.config), 3),
    }
    support = calc_support(pile, shapes, rocks, site, time_step)
    if support is not None:
        weight = support.weight
        summary |= {
            "contacts_per_rock": round(support.contacts_per_rock, 2),
            "carried_by_floor": round(support.floor / weight, 4),
            "carried_by_walls": round(support.walls / weight, 4),
            "carried_by_static_rocks": round(support.static / weight, 4),
        }
    return summary


def _round(value: float, digits: int) -> float | None:
    return round(float(value), digits) if np.isfinite(value) else None
