"""Drawing rocks from the gradation and emitting them from above (method section 3, pile making)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drakerock.rocks.config import START_SPEED, PileConfig, RocksConfig, SiteConfig
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]

# Side of the columns in which the pile's level is looked for: that of a large rock [m].
COLUMN = 0.8
# Rocks slower than this lie on the pile, faster ones are falling [m/s].
STILL_SPEED = 1.0


def sample_rocks(
    n: int, rocks: RocksConfig, shapes: tuple[RockShape, ...], rng: np.random.Generator
) -> PileState:
    """Draw n rocks, at the origin: sizes so that the expected mass shares are the gradation's.

    Args:
        n: number of rocks.
        rocks: gradation.
        shapes: the shapes, equally likely.
        rng: source of randomness.
    """
    sizes, by_number = _calc_number_shares(rocks)
    return PileState(
        p_WRs=np.zeros((n, 3)),
        q_WRs=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        V_WRs=np.zeros((n, 6)),
        shape=rng.integers(len(shapes), size=n),
        size=rng.choice(sizes, size=n, p=by_number),
        fixed=np.zeros(n, bool),
    )


def calc_mean_volume(rocks: RocksConfig, shapes: tuple[RockShape, ...]) -> float:
    """Return the expected volume of a rock that `sample_rocks` draws [m^3]."""
    sizes, by_number = _calc_number_shares(rocks)
    return float(np.mean([shape.volume for shape in shapes]) * (by_number @ sizes**3))


def _calc_number_shares(rocks: RocksConfig) -> tuple[Array, Array]:
    sizes = np.array([item.size_m for item in rocks.gradation])
    shares = np.array([item.mass_fraction for item in rocks.gradation])
    # All classes draw from the same shapes, so a rock's expected mass goes with the cube of its size.
    by_number = shares / sizes**3
    return sizes, by_number / by_number.sum()


@dataclass(frozen=True, eq=False)
class Emitter:
    """A box in which rocks appear, moving downwards; between two batches it empties by their fall.

    Attributes:
        low, high: (3,) corners in W [m].
        interval: time between batches [s].
    """

    low: Array
    high: Array
    interval: float


def make_emitter(site: SiteConfig, config: PileConfig) -> Emitter:
    """Return the emitter of the void: all of its plan before the static rocks, from the emission height up."""
    return _make_emitter(site, config, -config.emission_reach, site.void_depth - site.rear_layer)


def make_rear_emitter(site: SiteConfig, config: PileConfig) -> Emitter:
    """Return the emitter of the layer of static rocks on the rear wall."""
    return _make_emitter(site, config, site.void_depth - site.rear_layer, site.void_depth)


def _make_emitter(site: SiteConfig, config: PileConfig, x_low: float, x_high: float) -> Emitter:
    half = 0.5 * site.drift_width
    low, high = [x_low, -half, config.emission_height], [x_high, half, config.emission_top]
    return Emitter(np.array(low), np.array(high), config.emission_interval)


def place_rocks(
    waiting: PileState,
    pile: PileState,
    shapes: tuple[RockShape, ...],
    emitter: Emitter,
    rng: np.random.Generator,
    tries: int = 30,
    misses: int = 5,
) -> tuple[PileState, PileState]:
    """Place as many of the waiting rocks, in their order, as find room in the emitter.

    A rock finds room at a drawn turn and place where it is inside the box and its bounding sphere touches no
    other's. Rocks that find none wait, and come first in the next batch: the gradation stays.

    Args:
        waiting: rocks without a pose.
        pile: rocks that are there already.
        shapes: the rock shapes.
        emitter: where rocks appear.
        rng: source of the poses.
        tries: poses tried for each rock.
        misses: the batch is complete when so many rocks have found no room.

    Returns:
        The placed rocks, and those still waiting.
    """
    radii = np.array([shape.radius for shape in shapes])
    there = radii[pile.shape] * pile.size
    near = np.all(
        (pile.p_WRs > emitter.low - there[:, None]) & (pile.p_WRs < emitter.high + there[:, None]), axis=1
    )
    centres, spheres = pile.p_WRs[near], there[near]
    n_near = len(centres)
    turns: list[Array] = []
    placed: list[int] = []
    missed = 0
    for rock in range(len(waiting)):
        if missed >= misses:
            break
        radius = radii[waiting.shape[rock]] * waiting.size[rock]
        corners = waiting.size[rock] * shapes[waiting.shape[rock]].vertices
        for turn in Rotation.random(tries, rng=rng):
            p_RVs_W = turn.apply(corners)
            low, high = emitter.low - p_RVs_W.min(axis=0), emitter.high - p_RVs_W.max(axis=0)
            if np.any(low > high):
                continue
            centre = rng.uniform(low, high)
            if np.all(np.sum((centres - centre) ** 2, axis=1) > (spheres + radius) ** 2):
                placed.append(rock)
                turns.append(turn.as_quat(scalar_first=True))
                centres = np.vstack([centres, centre])
                spheres = np.append(spheres, radius)
                break
        else:
            missed += 1
    chosen = np.zeros(len(waiting), bool)
    chosen[placed] = True
    velocities = np.zeros((len(placed), 6))
    velocities[:, 5] = -START_SPEED
    rocks = replace(
        waiting.select(chosen),
        p_WRs=centres[n_near:],
        q_WRs=np.array(turns).reshape(-1, 4),
        V_WRs=velocities,
    )
    return rocks, waiting.select(~chosen)


def calc_level(pile: PileState, emitter: Emitter) -> float:
    """Return the height of the pile below an emitter [m]: the median over columns of the highest still rock."""
    level = np.zeros(np.maximum(np.ceil((emitter.high - emitter.low)[:2] / COLUMN), 1).astype(int))
    cells = np.floor((pile.p_WRs[:, :2] - emitter.low[:2]) / COLUMN).astype(int)
    still = np.linalg.norm(pile.V_WRs[:, 3:], axis=1) < STILL_SPEED
    inside = still & np.all((cells >= 0) & (cells < level.shape), axis=1)
    np.maximum.at(level, tuple(cells[inside].T), (pile.p_WRs[:, 2] + 0.5 * pile.size)[inside])
    return float(np.median(level))
