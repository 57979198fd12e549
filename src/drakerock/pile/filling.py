"""Filling the void: rocks emitted in layers from above until the void is full, then simulated to rest."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from drakerock.pile.config import PileConfig, SiteConfig
from drakerock.pile.state import PileState

Array = NDArray[np.float64]

# The void is full when this many layers in a row found no room.
FULL_AFTER = 8
# A layer that takes a smaller share of the rocks on offer (at most 50) found no room.
FEW = 0.1
# How much faster than free fall from rest rocks start, so that layers clear the emitter in time [m/s].
START_SPEED = 3.0
PLACING_TRIES = 12


class RockStepper[ArraysT](Protocol):
    """What filling needs of a rock engine; `ArraysT` is the engine's state, opaque here.

    The engine's own attributes: `time_step` [s], and `radius`, (n,) bounding radii about the rocks' centres
    of mass [m].
    """

    @property
    def time_step(self) -> float: ...  # noqa: D102

    @property
    def radius(self) -> Array: ...  # noqa: D102

    def make_arrays(self, pile: PileState) -> ArraysT:
        """Return the engine's state for a pile; rocks outside the site are out of the simulation."""
        ...

    def make_pile(self, arrays: ArraysT) -> PileState:
        """Return the pile of a state."""
        ...

    def place(self, arrays: ArraysT, rocks: NDArray[np.int64], p_WRs: Array, V_WRs: Array) -> ArraysT:
        """Return the state with rocks put at positions (m, 3) with velocities (m, 6), awake."""
        ...

    def advance(self, arrays: ArraysT) -> tuple[ArraysT, Any]:
        """Step all rocks, without a machine; return the state and a report."""
        ...


def fill[ArraysT](
    engine: RockStepper[ArraysT],
    pile: PileState,
    waiting: NDArray[np.int64],
    site: SiteConfig,
    config: PileConfig,
    rng: np.random.Generator,
    on_step: Callable[[float, int, Any], None] | None = None,
) -> tuple[PileState, NDArray[np.int64]]:
    """Emit rocks above the void until it is full or none is left, and simulate to rest.

    Args:
        engine: made for the rocks of `pile`.
        pile: all rocks; those that wait to be emitted are outside the site, with the attitudes they fall with.
        waiting: indices of the rocks to emit, in this order.
        site: dimensions of the void.
        config: emission height, interval between layers, and when the pile counts as settled.
        rng: source of the positions.
        on_step: called after each step with the time [s], the number of rocks still waiting and the report.

    Returns:
        the pile, rocks that found no room still outside the site, and the indices of those rocks.
    """
    arrays = engine.make_arrays(pile)
    queue = np.asarray(waiting, np.int64)
    half = 0.5 * site.drift_width
    dt = engine.time_step
    layer = START_SPEED * config.batch_time + 0.5 * 9.81 * config.batch_time**2
    time, next_layer, missed, last_check = 0.0, 0.0, 0, 0.0
    last_positions = pile.p_WRs
    while time < config.max_time:
        if len(queue) and missed < FULL_AFTER and time >= next_layer - 1e-9:
            occupied = engine.make_pile(arrays).p_WRs
            chosen, places = _find_places(
                queue, engine.radius, occupied, config.emission_height, layer, site.void_depth, half, rng
            )
            missed = 0 if len(chosen) > FEW * len(queue[:50]) else missed + 1
            velocities = np.zeros((len(chosen), 6))
            velocities[:, 5] = -START_SPEED
            arrays = engine.place(arrays, chosen, places, velocities)
            queue = queue[~np.isin(queue, chosen)]
            next_layer = time + config.batch_time
        arrays, report = engine.advance(arrays)
        time += dt
        if on_step is not None:
            on_step(time, len(queue), report)
        if time - last_check >= config.settle_window - 1e-9:
            positions = engine.make_pile(arrays).p_WRs
            moved = np.linalg.norm(positions - last_positions, axis=1)
            quiet = np.mean(moved <= config.settle_speed * (time - last_check)) >= 0.99
            last_positions, last_check = positions, time
            if quiet and (len(queue) == 0 or missed >= FULL_AFTER):
                break
    return engine.make_pile(arrays), queue


def _find_places(
    queue: NDArray[np.int64],
    radius: Array,
    occupied: Array,
    height: float,
    thickness: float,
    depth: float,
    half_width: float,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], Array]:
    """Return the next rocks of the queue that find room in a layer above `height`, and their positions."""
    # About a third of the layer, spheres counted, so that rocks seldom meet before they land.
    room = 0.35 * depth * 2.0 * half_width * thickness
    near = occupied[np.abs(occupied[:, 2] - height) < thickness + 2.0 * radius.max()]
    near_radius = np.full(len(near), float(radius.max()))
    chosen: list[int] = []
    places: list[Array] = []
    for rock in queue:
        r = float(radius[rock])
        room -= 4.0 * r**3
        if room < 0.0 and chosen:
            break
        for _ in range(PLACING_TRIES):
            p = np.array(
                [
                    rng.uniform(r, max(depth - r, r)),
                    rng.uniform(-half_width + r, half_width - r),
                    height + r + rng.uniform(0.0, max(thickness - 2.0 * r, 0.02)),
                ]
            )
            others = np.vstack([near, *places]) if places else near
            radii = np.append(near_radius, radius[chosen])
            if len(others) == 0 or (np.linalg.norm(others - p, axis=1) > radii + r).all():
                chosen.append(int(rock))
                places.append(p[None, :])
                break
    return np.array(chosen, np.int64), np.vstack([np.zeros((0, 3)), *places])
