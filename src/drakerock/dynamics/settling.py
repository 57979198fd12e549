"""Letting rocks fall and come to rest in the site, and making a pile so (method section 3, pile making)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

import drakerock
from drakerock.config import Config, calc_config_hash
from drakerock.dynamics.assembly import add_plant, add_site
from drakerock.dynamics.config import DynamicsConfig
from drakerock.dynamics.contact_graph import find_loose
from drakerock.dynamics.nonsmooth.engine import NonsmoothEngine
from drakerock.dynamics.plant.rocks import add_plant_rocks, add_rock_bodies
from drakerock.errors import InputError, SimulationFailure
from drakerock.pile.config import PileConfig, RocksConfig, SiteConfig
from drakerock.pile.emission import place_rocks, sample_rocks
from drakerock.pile.shapes import RockShape, load_rock_shapes
from drakerock.pile.site import make_site
from drakerock.pile.state import PileState, load_pile, make_empty_pile, save_pile
from drakerock.randomness import make_generator

Progress = Callable[[str, float], None]
"""Called with what is being done and its share done in [0, 1]."""


class PileRecipe(Config):
    """All that a made pile depends on; its hash names the pile in the cache."""

    seed: int
    site: SiteConfig
    rocks: RocksConfig
    pile: PileConfig
    dynamics: DynamicsConfig


def settle(
    pile: PileState,
    shapes: tuple[RockShape, ...],
    recipe: PileRecipe,
    duration: float,
    *,
    until_rest: bool = False,
    progress: Callable[[float], None] | None = None,
) -> tuple[PileState, bool]:
    """Simulate rocks in the site, without a machine.

    Args:
        pile: where they start.
        shapes: the rock shapes.
        recipe: site, rocks, rest criterion, dynamics.
        duration: longest simulated time [s].
        until_rest: stop as soon as 99 % of the rocks moved less than settle_speed * settle_window over the
            last settle_window.
        progress: called with the share of the duration done.

    Returns:
        The pile afterwards, and whether it rests.

    Raises:
        SimulationFailure: the dynamics failed.
    """
    advance = _make_plant_advance if recipe.dynamics.rocks == "plant" else _make_nonsmooth_advance
    advance_to = advance(pile, shapes, recipe)
    window, resting, time = recipe.pile.settle_window, False, 0.0
    before = pile
    while time < duration - 1e-9 and not (until_rest and resting):
        time = min(time + window, duration)
        try:
            after = advance_to(time)
        except RuntimeError as error:
            raise SimulationFailure(f"settling the pile failed at {time:.2f} s: {error}") from None
        moved = np.linalg.norm(after.p_WRs - before.p_WRs, axis=1)
        resting = bool(np.percentile(moved, 99) < recipe.pile.settle_speed * window)
        before = after
        if progress:
            progress(time / duration)
    return before, resting


def _make_plant_advance(
    pile: PileState, shapes: tuple[RockShape, ...], recipe: PileRecipe
) -> Callable[[float], PileState]:
    builder = DiagramBuilder()
    plant, _ = add_plant(builder, recipe.dynamics)
    add_site(plant, make_site(recipe.site), recipe.dynamics)
    geometries = add_rock_bodies(plant, pile, shapes, recipe.rocks, recipe.dynamics)
    plant.Finalize()
    rocks = add_plant_rocks(builder, plant, pile, geometries)
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    rocks.set_pile(root, pile)

    def advance_to(time: float) -> PileState:
        simulator.AdvanceTo(time)
        return rocks.get_pile(root)

    return advance_to


def _make_nonsmooth_advance(
    pile: PileState, shapes: tuple[RockShape, ...], recipe: PileRecipe
) -> Callable[[float], PileState]:
    engine = NonsmoothEngine(
        recipe.rocks, shapes, make_site(recipe.site), recipe.dynamics.nonsmooth, recipe.dynamics.time_step,
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
    """Make a pile: rocks emitted in batches from above, each falling on what is there, then all to rest.

    Same recipe, same pile, bit for bit.

    Raises:
        InputError: the rocks do not fit under the emission height.
        SimulationFailure: the dynamics failed, or the pile did not come to rest in time.
    """
    shapes = load_rock_shapes(recipe.rocks.shapes)
    rng = make_generator(recipe.seed, "pile")
    waiting = sample_rocks(recipe.pile.rocks, recipe.rocks, shapes, rng)
    pile = drop_rocks(waiting, make_empty_pile(), shapes, recipe, rng, progress)
    # The pile starts as a sequence leaves it after each loading: without loose rocks on the floor.
    pile = pile.select(~find_loose(pile, shapes, recipe.pile.contact_gap))
    provenance = {
        "made_by": f"drakerock {drakerock.__version__}",
        "recipe": calc_config_hash(recipe),
        "seed": recipe.seed,
    }
    return replace(pile, provenance=provenance)


def drop_rocks(
    waiting: PileState,
    pile: PileState,
    shapes: tuple[RockShape, ...],
    recipe: PileRecipe,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> PileState:
    """Emit rocks in batches from above onto a pile, and let all come to rest.

    Args:
        waiting: the rocks to emit, in this order; their turns are kept, their positions drawn.
        pile: what is there already.
        shapes: the rock shapes.
        recipe: site, emission box, rest criterion, dynamics.
        rng: source of the positions.
        progress: called as things proceed.

    Returns:
        The pile at rest, the emitted rocks last, in the order in which they found room.

    Raises:
        InputError: the rocks do not fit under the emission height.
        SimulationFailure: the dynamics failed, or the pile did not come to rest in time.
    """
    total = len(pile) + len(waiting)
    half = 0.5 * recipe.site.drift_width
    low = np.array([-recipe.pile.emission_reach, -half, 0.0])
    high = np.array([recipe.site.void_depth, half, recipe.pile.emission_height])
    while len(waiting):
        if progress:
            progress("dropping rocks", 0.8 * len(pile) / total)
        placed, waiting = place_rocks(waiting, pile, shapes, low, high, rng)
        if len(placed) == 0:
            raise InputError(
                f"pile.rocks: only {len(pile)} of {total} rocks fit below pile.emission_height = "
                f"{recipe.pile.emission_height:g} m; raise it, widen the site, or ask for fewer rocks"
            )
        pile, _ = settle(pile.join(placed), shapes, recipe, recipe.pile.batch_time)
    pile, resting = settle(
        pile,
        shapes,
        recipe,
        recipe.pile.max_time,
        until_rest=True,
        progress=(lambda share: progress("settling", 0.8 + 0.2 * share)) if progress else None,
    )
    if not resting:
        raise SimulationFailure(f"the pile did not come to rest within {recipe.pile.max_time:g} s")
    return replace(pile, V_WRs=np.zeros_like(pile.V_WRs))


def refill(
    pile: PileState,
    removed: NDArray[np.bool_],
    shapes: tuple[RockShape, ...],
    recipe: PileRecipe,
    rng: np.random.Generator,
) -> PileState:
    """Return the pile with the removed rocks emitted anew from above, so that its level is restored, at rest.

    The new rocks have the removed ones' shapes and sizes, so that the gradation stays over a long sequence, and
    new turns and places.

    Args:
        pile: all rocks, the removed ones among them.
        removed: (n,) rocks taken away, in the bucket or as debris.
        shapes: the rock shapes.
        recipe: as in `drop_rocks`.
        rng: source of the turns and places.

    Raises:
        SimulationFailure, InputError: as `drop_rocks`.
    """
    waiting = pile.select(removed)
    turns = (
        Rotation.random(len(waiting), rng=rng).as_quat(scalar_first=True) if len(waiting) else waiting.q_WRs
    )
    waiting = replace(waiting, q_WRs=turns, V_WRs=np.zeros((len(waiting), 6)))
    return drop_rocks(waiting, pile.select(~removed), shapes, recipe, rng)


def fetch_pile(recipe: PileRecipe, progress: Progress | None = None) -> tuple[PileState, Path]:
    """Return the recipe's pile and its file: the one `pile.source` names, or from the cache, or made now.

    Raises:
        InputError: an unreadable pile file. Otherwise as `make_pile`.
    """
    if recipe.pile.source is not None:
        path = Path(recipe.pile.source)
        return check_pile(load_pile(path), recipe, path), path
    path = user_cache_path("drakerock") / "piles" / f"{calc_config_hash(recipe, drakerock.__version__)}.npz"
    if path.exists():
        try:
            return load_pile(path), path
        except InputError:
            path.unlink()  # a damaged cache entry is made anew
    pile = make_pile(recipe, progress)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial")
        save_pile(pile, partial)
        partial.replace(path)
    except OSError:
        pass  # a cache that cannot be written only costs time
    return pile, path


def check_pile(pile: PileState, recipe: PileRecipe, path: Path) -> PileState:
    """Return the pile if it fits the scenario's shapes and site.

    Raises:
        InputError: a shape index that the scenario does not have, or rocks outside the site.
    """
    if len(pile) == 0:
        raise InputError(f"{path}: the pile holds no rocks")
    if pile.shape.min() < 0 or pile.shape.max() >= len(recipe.rocks.shapes):
        raise InputError(
            f"{path}: rock shape {pile.shape.max()} is not among the scenario's {len(recipe.rocks.shapes)} "
            "(rocks.shapes)"
        )
    outside = int(np.sum(np.abs(pile.p_WRs[:, 1]) > 0.5 * recipe.site.drift_width))
    if outside > 0.01 * len(pile):
        raise InputError(
            f"{path}: {outside} of {len(pile)} rocks lie outside the drift "
            f"(site.drift_width = {recipe.site.drift_width:g} m)"
        )
    return pile
