"""Letting rocks fall and come to rest in the site, and making a pile so (method section 3, pile making)."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drakerock.errors import InputError, SimulationFailure
from drakerock.identity import calc_config_hash, get_versions
from drakerock.randomness import make_generator
from drakerock.resources import find_data
from drakerock.rocks.config import MAX_ROCKS
from drakerock.rocks.contact_graph import find_loose
from drakerock.rocks.drake.add_rocks import AddRocks
from drakerock.rocks.drake.drift import AddDrift
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.drake.plant_engine import AddRockBodies
from drakerock.rocks.engine.engine import NonsmoothEngine
from drakerock.rocks.making.emission import (
    Emitter,
    calc_level,
    calc_mean_volume,
    make_emitter,
    make_rear_emitter,
    place_rocks,
    sample_rocks,
)
from drakerock.rocks.making.recipe import PileRecipe
from drakerock.rocks.ordering import order_by_place
from drakerock.rocks.shapes import RockShape, load_rock_shapes
from drakerock.rocks.site import Site, make_confined_site, make_site, make_surroundings
from drakerock.rocks.state import PileState, load_pile, make_empty_pile, save_pile
from drakerock.rocks.summary import calc_imbalance, calc_support

Progress = Callable[[str, float], None]
"""Called with what is being done and its share done in [0, 1]."""

_log = logging.getLogger(__name__)

# Share of the room under the emitter that rocks fill.
PACKING = 0.6
# The void is full when its level has stayed at the emitter for so many batches: rocks still flow out.
FULL_BATCHES = 4
# So many batches without room for a single rock, and it is the others' turn.
MISSED_BATCHES = 20
# A batch is complete when so many rocks have found no room.
EMITTER_MISSES = 5
MANY_MISSES = 500
# In a pile's provenance: shapes and sizes of rocks that a refill had no room for; they come first in the next.
WAITING = "waiting_rocks"
# The forces of a pile balance when site and static rocks carry its weight to within this share, and 90 % of the
# rocks' own contacts theirs to within that; looked at every so often [s].
CARRIED_TOLERANCE = 0.003
IMBALANCE_P90 = 0.03
BALANCE_WINDOW = 0.1
# All are kept awake at least so long [s].
BALANCE_LEAST = 0.3
# Rocks that are set off by all being awake have so long to fall [s]; then all are kept awake again, at most so often,
# until they are so small a share of the rocks that the others' balance stays; in a new pile until no rock has moved
# farther than this [m].
FALL_TIME = 5.0
# A rock that no longer falls may go on so fast in its hole, on average [m/s].
RATTLE_SPEED = 0.1
BALANCE_ROUNDS = 8
LOOSE_DISTANCE = 0.01
FEW_SHARE = 0.002


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


def make_pile(recipe: PileRecipe, progress: Progress | None = None) -> PileState:
    """Make a pile: the static rocks of the rear wall, then rocks emitted from above, then all to rest.

    With `pile.rocks` null, rocks are emitted until the void is full to the emitter. Same recipe, same pile, bit
    for bit.

    Raises:
        InputError: more rocks than the engine takes, or a rock finds no room in the emitter.
        SimulationFailure: the dynamics failed, or the pile did not come to rest in time.
    """
    _announce_number(recipe)
    shapes = load_rock_shapes(recipe.rocks.shapes, recipe.rocks.max_corners)
    rng = make_generator(recipe.seed, "pile")
    site, n = recipe.site, recipe.pile.rocks
    pile = make_empty_pile()
    if site.rear_layer:
        waiting = sample_rocks(_count_filling(recipe, site.rear_layer), recipe.rocks, shapes, rng)
        emitter = make_rear_emitter(site, recipe.pile)
        mould = make_confined_site(site)
        layer, _ = drop_rocks(
            waiting, pile, shapes, recipe, emitter, rng, until_full=True, site=mould, stage="rear wall",
            progress=progress,
        )  # fmt: skip
        # What holds the static rocks is no longer the contacts they settled with.
        pile = replace(layer, fixed=np.ones(len(layer), bool), contacts=None)
    number = n or _count_filling(recipe, site.void_depth + 1.5 * site.drift_height)
    waiting = sample_rocks(number, recipe.rocks, shapes, rng)
    emitter = make_emitter(site, recipe.pile)
    pile, left = drop_rocks(
        waiting, pile, shapes, recipe, emitter, rng, until_full=n is None, until_still=True, progress=progress
    )
    if n is not None and len(left):
        raise InputError(
            f"pile.rocks: only {n - len(left)} of {n} rocks find room in the emitter, "
            f"{np.round(emitter.high - emitter.low, 2).tolist()} m; raise pile.emission_height, "
            "pile.emission_reach or pile.emission_interval, widen the site, or ask for fewer rocks"
        )
    # The pile starts as a sequence leaves it after each loading: without loose rocks on the floor.
    pile = pile.select(pile.fixed | ~find_loose(pile, shapes, recipe.pile.contact_gap))
    provenance = {
        "recipe": calc_config_hash(recipe),
        "seed": recipe.seed,
        "versions": get_versions(),
    }
    return replace(pile, provenance=provenance)


def _announce_number(recipe: PileRecipe) -> None:
    """Say how many rocks are about to be simulated; InputError if the gradation makes too many of them."""
    rocks = recipe.rocks
    volume = calc_mean_volume(rocks, load_rock_shapes(rocks.shapes, rocks.max_corners))
    depth = recipe.site.rear_layer if recipe.pile.rocks else recipe.site.void_depth
    room = PACKING * depth * recipe.site.drift_width * recipe.pile.emission_height
    number = (recipe.pile.rocks or 0) + round(room / volume)
    if number > MAX_ROCKS:
        least = min(rocks.gradation, key=lambda item: item.size_m)
        raise InputError(
            f"rocks.gradation: it makes a pile of about {number} rocks, most of them of size_m {least.size_m:g}; at "
            f"most {MAX_ROCKS} are allowed: leave the smallest out, or make size_m larger or the site smaller"
        )
    _log.warning("drakerock: making a pile of about %d rocks (once)", number)


def _count_filling(recipe: PileRecipe, depth: float) -> int:
    """Return more rocks than fit under the emitter over a depth [m]: as if they filled it without gaps."""
    shapes = load_rock_shapes(recipe.rocks.shapes, recipe.rocks.max_corners)
    room = depth * recipe.site.drift_width * (recipe.pile.emission_height + 1.0)
    return int(np.ceil(room / calc_mean_volume(recipe.rocks, shapes)))


def drop_rocks(
    waiting: PileState,
    pile: PileState,
    shapes: tuple[RockShape, ...],
    recipe: PileRecipe,
    emitter: Emitter,
    rng: np.random.Generator,
    *,
    until_full: bool = False,
    until_balanced: bool = False,
    until_still: bool = False,
    site: Site | None = None,
    stage: str = "dropping rocks",
    progress: Progress | None = None,
) -> tuple[PileState, PileState]:
    """Emit rocks in batches from above onto a pile, and let all come to rest.

    Where rocks have found no room for some batches, all that wait are tried, not only the first of them; if still
    none finds room, emission ends.

    Args:
        waiting: the rocks to emit, in this order, at drawn turns and places.
        pile: what is there already.
        shapes: the rock shapes.
        recipe: site, rest criterion, dynamics.
        emitter: where rocks appear.
        rng: source of the turns and places.
        until_full: emit only while the pile's level is below the emitter, and stop when it stays there, whatever
            still waits.
        until_balanced: at the end, keep all rocks awake no longer than until their forces balance; else for
            `pile.balance_time`.
        until_still: and again, until none moves any more when all are awake.
        site: the surroundings, if not the recipe's.
        stage: what to call it in the progress.
        progress: called as things proceed.

    Returns:
        The pile at rest, its rocks numbered by place (`order_by_place`); and those that still wait.

    Raises:
        SimulationFailure: the dynamics failed, or the pile did not come to rest in time.
    """
    total, missed, full, misses = len(waiting), 0, 0, EMITTER_MISSES
    while len(waiting) and full < FULL_BATCHES and missed <= MISSED_BATCHES:
        level = calc_level(pile, emitter)
        full = full + 1 if until_full and level >= emitter.low[2] else 0
        if not full:
            if missed == MISSED_BATCHES:
                misses = MANY_MISSES
            placed, waiting = place_rocks(waiting, pile, shapes, emitter, rng, misses=misses)
            missed = 0 if len(placed) else missed + 1
            pile = pile.join(placed)
        pile, _ = settle(pile, shapes, recipe, emitter.interval, site=site)
        if progress:
            share = level / emitter.low[2] if until_full else 1.0 - len(waiting) / total
            progress(stage, 0.8 * min(share, 1.0))
    pile, resting = settle(
        pile, shapes, recipe, recipe.pile.max_time, site=site, until_rest=True,
        progress=(lambda share: progress("settling", 0.8 + 0.2 * share)) if progress else None,
    )  # fmt: skip
    if not resting:
        raise SimulationFailure(f"the pile did not come to rest within {recipe.pile.max_time:g} s")
    if pile.contacts is not None:
        pile = _balance(pile, shapes, recipe, site, until_balanced, until_still)
    pile = pile.select(order_by_place(pile.p_WRs))
    return replace(pile, V_WRs=np.zeros_like(pile.V_WRs)), waiting


def _balance(
    pile: PileState,
    shapes: tuple[RockShape, ...],
    recipe: PileRecipe,
    site: Site | None,
    until_balanced: bool,
    until_still: bool,
) -> PileState:
    """Return a settled pile with its contact forces in balance with the weights, and its rocks at rest.

    Rocks come to rest one after the other, each with the forces of that moment, which later rest changes. So all
    are kept awake for a while at the end; with `until_balanced` no longer than until the forces balance. A rock that
    this sets off falls and comes to rest before all are kept awake again; with `until_still` that goes on until no
    rock moves any more while all are awake.
    """
    awake = recipe.replace(**{"dynamics.nonsmooth.reduction": "none"})
    surroundings, time_step = site or make_site(recipe.site), recipe.dynamics.time_step

    def is_balanced(pile: PileState) -> bool:
        support = calc_support(pile, shapes, recipe.rocks, surroundings, time_step)
        if support is None or support.weight == 0.0:
            return True
        carried = (support.floor + support.walls + support.static) / support.weight
        imbalance = calc_imbalance(pile, shapes, recipe.rocks, time_step)
        return bool(abs(carried - 1.0) < CARRIED_TOLERANCE and np.percentile(imbalance, 90) < IMBALANCE_P90)

    def find_fast(pile: PileState) -> NDArray[np.bool_]:
        fast: NDArray[np.bool_] = (
            np.linalg.norm(pile.V_WRs[:, 3:], axis=1) > recipe.dynamics.nonsmooth.rest.speed
        )
        return fast & ~pile.fixed

    few = FEW_SHARE * len(pile)
    for _ in range(BALANCE_ROUNDS):
        before = pile
        if until_balanced:
            # A rock that only leans shows it only after a while.
            first = min(BALANCE_LEAST, recipe.pile.balance_time)
            pile, _ = settle(pile, shapes, awake, first, site=site)
            pile, _ = settle(
                pile, shapes, awake, recipe.pile.balance_time - first, site=site, until=is_balanced,
                window=BALANCE_WINDOW,
            )  # fmt: skip
        else:
            pile, _ = settle(pile, shapes, awake, recipe.pile.balance_time, site=site)
        assert pile.contacts is not None
        fast = find_fast(pile)
        pile = replace(pile, contacts=replace(pile.contacts, resting=~pile.fixed & ~fast))
        if fast.any():
            # A rock may rattle in its hole for good, which does not count as falling.
            pile, _ = settle(
                pile, shapes, recipe, FALL_TIME, site=site, until=lambda pile: not find_fast(pile).any()
            )
        moved = np.linalg.norm(pile.p_WRs - before.p_WRs, axis=1)
        if fast.sum() <= few and (not until_still or moved.max(initial=0.0) < LOOSE_DISTANCE):
            break
    return pile


def refill(
    pile: PileState,
    removed: NDArray[np.bool_],
    shapes: tuple[RockShape, ...],
    recipe: PileRecipe,
    rng: np.random.Generator,
) -> PileState:
    """Return the pile without the removed rocks, new ones emitted from above until its level is restored, at rest.

    The new rocks have the removed ones' shapes and sizes, so that the gradation stays over a long sequence. With
    `pile.rocks` set, all are emitted and their number stays too; those that find no room, because the pile reaches
    up to the emitter, wait for the next refill (in the provenance). With null, the void is filled to the emitter
    again: none is emitted while the void's level has not sunk, and further ones are drawn when the pile has slid.

    Args:
        pile: all rocks, the removed ones among them.
        removed: (n,) rocks taken away, in the bucket or as debris.
        shapes: the rock shapes.
        recipe: as in `drop_rocks`.
        rng: source of the further rocks, the turns and places.

    Raises:
        SimulationFailure: as `drop_rocks`.
    """
    waiting, until_full = replace(pile.select(removed), contacts=None), recipe.pile.rocks is None
    if WAITING in pile.provenance:
        waiting = _make_waiting(**pile.provenance[WAITING]).join(waiting)
    if until_full:
        number = _count_filling(recipe, recipe.site.void_depth)
        waiting = waiting.join(sample_rocks(number, recipe.rocks, shapes, rng))
    emitter = make_emitter(recipe.site, recipe.pile)
    after, left = drop_rocks(
        waiting,
        pile.select(~removed),
        shapes,
        recipe,
        emitter,
        rng,
        until_full=until_full,
        until_balanced=True,
    )
    provenance = {key: value for key, value in pile.provenance.items() if key != WAITING}
    if len(left) and not until_full:
        provenance[WAITING] = {"shape": left.shape.tolist(), "size": left.size.tolist()}
    return replace(after, provenance=provenance)


def _make_waiting(shape: list[int], size: list[float]) -> PileState:
    n = len(size)
    return PileState(
        p_WRs=np.zeros((n, 3)),
        q_WRs=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        V_WRs=np.zeros((n, 6)),
        shape=np.array(shape, np.int64),
        size=np.array(size, float),
        fixed=np.zeros(n, bool),
    )


def fetch_pile(recipe: PileRecipe, progress: Progress | None = None) -> tuple[PileState, Path]:
    """Return the recipe's pile and its file: the one `pile.source` names, the shipped one, from the cache, or made.

    The shipped pile (``data/default_pile.npz``) is that of the default recipe; any other has to be made once.

    Raises:
        InputError: an unreadable pile file. Otherwise as `make_pile`.
    """
    if recipe.pile.source is not None:
        path = Path(recipe.pile.source)
        return check_pile(load_pile(path), recipe, path), path
    shipped = find_data("data", "default_pile.npz")
    pile = load_pile(shipped)
    if pile.provenance.get("recipe") == calc_config_hash(recipe):
        return pile, shipped
    path = (
        user_cache_path("drakerock") / "piles" / f"{calc_config_hash(recipe, *get_versions().values())}.npz"
    )
    try:
        if path.exists():
            return load_pile(path), path
    except (OSError, InputError) as error:
        _log.warning("the pile is made anew: %s", error)
    pile = make_pile(recipe, progress)
    partial = path.with_suffix(f".{os.getpid()}.partial")  # workers may make the same pile at once
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        save_pile(pile, partial)
        partial.replace(path)
    except (OSError, InputError) as error:
        _log.warning("the pile is not kept for next time: %s", error)
        with suppress(OSError):
            partial.unlink(missing_ok=True)
    return pile, path


def check_pile(pile: PileState, recipe: PileRecipe, path: Path) -> PileState:
    """Return the pile if it fits the scenario's shapes and site.

    Raises:
        InputError: no rocks, a shape or size that the scenario does not have, or rocks outside the site.
    """
    if len(pile) == 0:
        raise InputError(f"{path}: the pile holds no rocks")
    if pile.shape.min() < 0 or pile.shape.max() >= len(recipe.rocks.shapes):
        raise InputError(
            f"{path}: rock shape {pile.shape.max()} is not among the scenario's {len(recipe.rocks.shapes)} "
            "(rocks.shapes)"
        )
    known = np.array([item.size_m for item in recipe.rocks.gradation])
    unknown = ~np.isclose(pile.size[:, None], known).any(axis=1)
    if unknown.any():
        raise InputError(
            f"{path}: rocks of {pile.size[unknown][0]:g} m are not in the scenario's gradation "
            f"({', '.join(f'{size:g}' for size in known)} m)"
        )
    site = recipe.site
    for axis, low, high, key in (
        (0, -site.drift_length, site.void_depth, f"site.void_depth = {site.void_depth:g} m"),
        (1, -0.5 * site.drift_width, 0.5 * site.drift_width, f"site.drift_width = {site.drift_width:g} m"),
        (2, 0.0, np.inf, "the floor"),
    ):
        outside = int(np.sum((pile.p_WRs[:, axis] < low) | (pile.p_WRs[:, axis] > high)))
        if outside:
            raise InputError(f"{path}: {outside} of {len(pile)} rocks lie outside the site ({key})")
    return pile
