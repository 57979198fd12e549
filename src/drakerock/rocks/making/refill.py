"""Refilling a pile between loadings: new rocks for those that were taken away."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.making.drop import drop_rocks
from drakerock.rocks.making.emission import make_emitter, sample_rocks
from drakerock.rocks.making.make import count_filling
from drakerock.rocks.making.recipe import PileRecipe
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState

# In a pile's provenance: shapes and sizes of rocks that a refill had no room for; they come first in the next.
WAITING = "waiting_rocks"


def refill(
    pile: PileState,
    removed: NDArray[np.bool_],
    shapes: tuple[RockShape, ...],
    recipe: PileRecipe,
    rng: np.random.Generator,
) -> PileState:
    """Return the pile without the removed rocks, new ones emitted from above until its level is restored, at rest.

    The new rocks have the removed ones' shapes and sizes, so that the gradation stays over a long sequence. With
    `pile.rocks` or `pile.scan` set, all are emitted and their number stays too; those that find no room, because the
    pile reaches up to the emitter, wait for the next refill (in the provenance). Else, the void is filled to the
    emitter again: none is emitted while the void's level has not sunk, and further ones are drawn when the pile has
    slid.

    Args:
        pile: all rocks, the removed ones among them.
        removed: (n,) rocks taken away, in the bucket or as debris.
        shapes: the rock shapes.
        recipe: as in `drop_rocks`.
        rng: source of the further rocks, the turns and places.

    Raises:
        SimulationFailure: as `drop_rocks`.
    """
    waiting, until_full = replace(pile.select(removed), contacts=None), recipe.pile.fills_void
    if WAITING in pile.provenance:
        waiting = _make_waiting(**pile.provenance[WAITING]).join(waiting)
    if until_full:
        number = count_filling(recipe, recipe.site.void_depth)
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
