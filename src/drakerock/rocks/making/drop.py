"""Emitting rocks from above onto a pile, batch by batch, until all have come to rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drakerock.errors import SimulationFailure
from drakerock.rocks.making.balance import balance
from drakerock.rocks.making.emission import Emitter, calc_level, place_rocks
from drakerock.rocks.making.recipe import PileRecipe
from drakerock.rocks.making.settle import settle
from drakerock.rocks.ordering import order_by_place
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.site import Site
from drakerock.rocks.state import PileState

Progress = Callable[[str, float], None]
"""Called with what is being done and its share done in [0, 1]."""

# The void is full when its level has stayed at the emitter for so many batches: rocks still flow out.
FULL_BATCHES = 4
# So many batches without room for a single rock, and it is the others' turn.
MISSED_BATCHES = 20
# A batch is complete when so many rocks have found no room.
EMITTER_MISSES = 5
MANY_MISSES = 500


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
        pile = balance(pile, shapes, recipe, site, until_balanced, until_still)
    pile = pile.select(order_by_place(pile.p_WRs))
    return replace(pile, V_WRs=np.zeros_like(pile.V_WRs)), waiting
