"""Bringing the contact forces of a settled pile into balance with the weights of its rocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.making.recipe import PileRecipe
from drakerock.rocks.making.settle import settle
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.site import Site, make_site
from drakerock.rocks.state import PileState
from drakerock.rocks.summary import calc_imbalance, calc_support

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
BALANCE_ROUNDS = 8
LOOSE_DISTANCE = 0.01
FEW_SHARE = 0.002


def balance(
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
