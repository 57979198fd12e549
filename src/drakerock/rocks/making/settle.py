"""Letting rocks fall and come to rest in the site, without a machine (method section 3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drakerock.errors import SimulationFailure
from drakerock.rocks.drake.add_rocks import AddRocks
from drakerock.rocks.drake.drift import AddDrift
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.drake.plant_engine import AddRockBodies
from drakerock.rocks.engine.engine import NonsmoothEngine
from drakerock.rocks.making.recipe import PileRecipe
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.site import Site, make_site, make_surroundings
from drakerock.rocks.state import PileState

# A rock that no longer falls may go on so fast in its hole, on average [m/s].
RATTLE_SPEED = 0.1


def settle(
    pile: PileState,
    shapes: tuple[RockShape, ...],
    recipe: PileRecipe,
    duration: float,
    *,
    site: Site | None = None,
    until_rest: bool = False,
    until: Callable[[PileState], bool] | None = None,
    window: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[PileState, bool]:
    """Simulate rocks in the site, without a machine.

    Args:
        pile: where they start.
        shapes: the rock shapes.
        recipe: site, rocks, rest criterion, dynamics.
        duration: longest simulated time [s].
        site: the surroundings, if not the recipe's.
        until_rest: stop as soon as 99 % of the moving rocks moved less than settle_speed * settle_window over
            the last settle_window, or all but one that rattles in its hole.
        until: stop as soon as this holds of the pile.
        window: how often to look [s], if not every settle_window.
        progress: called with the share of the duration done.

    Returns:
        The pile afterwards, and whether it rests.

    Raises:
        SimulationFailure: the dynamics failed.
    """
    advance = _make_plant_advance if recipe.dynamics.rocks == "plant" else _make_nonsmooth_advance
    advance_to = advance(pile, shapes, recipe, site or make_site(recipe.site))
    window, resting, time = window or recipe.pile.settle_window, False, 0.0
    before = pile
    while time < duration - 1e-9 and not (until_rest and resting) and not (time and until and until(before)):
        time = min(time + window, duration)
        try:
            after = advance_to(time)
        except RuntimeError as error:
            raise SimulationFailure(f"settling the pile failed at {time:.2f} s: {error}") from None
        moved = np.linalg.norm(after.p_WRs - before.p_WRs, axis=1)[~pile.fixed]
        resting = _is_resting(moved / window, recipe.pile.settle_speed)
        before = after
        if progress:
            progress(time / duration)
    return before, resting


def _is_resting(speeds: NDArray[np.float64], limit: float) -> bool:
    """Return whether 99 % of the rocks are slower than the limit [m/s]; a single one may rattle in its hole."""
    if len(speeds) == 0 or np.percentile(speeds, 99) < limit:
        return True
    return bool(np.sum(speeds >= limit) == 1 and speeds.max() < RATTLE_SPEED)


def calc_creep(
    pile: PileState, shapes: tuple[RockShape, ...], recipe: PileRecipe, duration: float
) -> NDArray[np.float64]:
    """Return how far each moving rock (m,) moves within `duration` [s] when all are woken [m]: rest, checked.

    Raises:
        SimulationFailure: the dynamics failed.
    """
    woken = pile
    if pile.contacts is not None:
        contacts = replace(pile.contacts, resting=np.zeros(len(pile), np.bool_))
        woken = replace(pile, contacts=contacts)
    after, _ = settle(woken, shapes, recipe, duration)
    moved: NDArray[np.float64] = np.linalg.norm(after.p_WRs - pile.p_WRs, axis=1)[~pile.fixed]
    return moved


def _make_plant_advance(
    pile: PileState, shapes: tuple[RockShape, ...], recipe: PileRecipe, site: Site
) -> Callable[[float], PileState]:
    builder, dynamics = DiagramBuilder(), recipe.dynamics
    plant, scene_graph = add_plant(builder, dynamics)
    AddDrift(plant, site, dynamics.plant)
    bodies = AddRockBodies(plant, pile, recipe.rocks, dynamics.plant, dynamics.reference_overlap, shapes)
    plant.Finalize()
    rocks = AddRocks(builder, plant, scene_graph, pile, recipe.rocks, engine=bodies)
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    rocks.set_pile(root, pile)

    def advance_to(time: float) -> PileState:
        simulator.AdvanceTo(time)
        return rocks.get_pile(root)

    return advance_to


def _make_nonsmooth_advance(
    pile: PileState, shapes: tuple[RockShape, ...], recipe: PileRecipe, site: Site
) -> Callable[[float], PileState]:
    engine = NonsmoothEngine(
        recipe.rocks, shapes, make_surroundings(site), recipe.dynamics.nonsmooth, recipe.dynamics.time_step,
        pile.shape, pile.size, pile.fixed,
    )  # fmt: skip
    arrays = engine.make_arrays(pile)
    steps = 0

    def advance_to(time: float) -> PileState:
        nonlocal arrays, steps
        while steps < round(time / engine.time_step):
            arrays, _ = engine.advance(arrays)
            steps += 1
        return engine.make_pile(arrays, pile.provenance)

    return advance_to
