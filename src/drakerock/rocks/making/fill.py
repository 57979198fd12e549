"""Filling a measured surface with rocks at rest (`pile.scan`).

Rocks rain, layer by layer, from just above what lies there already onto wherever the pile is still too low, and each
layer settles before the next; what rolls out of the measured volume is taken away. At rest the pile is looked at from
above as a scanner's cloud is, and corrected where it differs: rocks whose removal brings the surface nearer are taken
out, rocks that would fill a hollow are added, and all settles again. Every state that is measured is one at rest.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drakerock.errors import InputError, SimulationFailure
from drakerock.rocks.config import MAX_ROCKS
from drakerock.rocks.contact_graph import find_loose
from drakerock.rocks.making.balance import balance
from drakerock.rocks.making.drop import Progress
from drakerock.rocks.making.emission import calc_mean_volume
from drakerock.rocks.making.placing import Placer, ShareKeeper
from drakerock.rocks.making.recipe import PileRecipe
from drakerock.rocks.making.settle import settle
from drakerock.rocks.ordering import order_by_place
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.site import make_site
from drakerock.rocks.state import PileState
from drakerock.rocks.surveying.surface import View, calc_rms, view_pile
from drakerock.rocks.surveying.survey import Survey, calc_median_rock

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_log = logging.getLogger(__name__)

# Share of a settled pile's volume that is rock, to foresee how many there will be.
PACKING = 0.58
# By how much of its width a rock raises the surface where it comes to lie.
RISE = 0.7
# Half the width of a rock's footprint over its sieve width.
FOOTPRINT = 0.42
# A layer of rain has so long to fall [s]; corrections, of single rocks, so long.
LAYER_TIME = 0.4
CORRECTION_TIME = 1.0
# So many layers at most; it has rained enough when so many have not brought the share of what was to be filled.
MAX_LAYERS, VAIN_LAYERS, LAYER_SHARE = 80, 4, 0.01
# Rounds of corrections in all; and as many end it as have brought nothing.
MAX_CORRECTIONS, VAIN_CORRECTIONS = 24, 5
# Corrected and brought to rest so often at most, each time from the best so far.
MAX_ATTEMPTS = 6
# A rock whose middle is so far above the surface, in its widths, has rolled out of the measured volume.
OUT = 0.35
# A correction must bring so much, as sum over cells of squared differences [m^2].
LEAST_GAIN = 0.01


def fill_surface(
    survey: Survey,
    pile: PileState,
    shapes: tuple[RockShape, ...],
    recipe: PileRecipe,
    rng: np.random.Generator,
    progress: Progress | None = None,
) -> tuple[PileState, dict[str, float | bool]]:
    """Return rocks at rest whose sensed surface is as near to the measured one as corrections brought it.

    Args:
        survey: the measured surface.
        pile: what is there already: the static rocks of the rear wall.
        shapes: the rock shapes.
        recipe: gradation, site, rest criterion, dynamics.
        rng: source of kinds, turns and places.
        progress: called as things proceed.

    Returns:
        The pile, and how it compares: ``rms_m`` and ``bias_m`` of the sensed surface over the scan's, ``wanted_m``,
        half a median rock, and ``reached``.

    Raises:
        InputError: more rocks than the engine takes.
        SimulationFailure: the dynamics failed, or the pile did not come to rest.
    """
    _announce_number(survey, shapes, recipe)
    filling = _Filling(survey, shapes, recipe, rng, progress or (lambda _stage, _share: None))
    pile = filling.rain(pile)
    best: tuple[float, PileState] | None = None
    wanted = 0.5 * calc_median_rock(recipe.rocks)
    for attempt in range(MAX_ATTEMPTS):
        start = best[1] if best else pile
        pile = filling.rest(filling.correct(start, (0.6 if attempt % 2 else 0.7) * wanted))
        rms = calc_rms(filling.view(pile).h, survey.surface)[0]
        if best is None or rms < best[0]:
            best = rms, pile
        if rms <= wanted:
            break
    assert best is not None
    pile = best[1]
    rms, bias = calc_rms(filling.view(pile).h, survey.surface)
    if rms > wanted:
        _log.warning(
            "pile.scan: the rocks' surface is %.2f m rms off the scan's, more than half a median rock (%.2f m): "
            "rocks of this gradation do not stand as the scan does", rms, wanted,
        )  # fmt: skip
    pile = pile.select(order_by_place(pile.p_WRs))
    result = {
        "rms_m": round(rms, 4),
        "bias_m": round(bias, 4),
        "wanted_m": wanted,
        "reached": bool(rms <= wanted),
    }
    return replace(pile, V_WRs=np.zeros_like(pile.V_WRs)), result


def _announce_number(survey: Survey, shapes: tuple[RockShape, ...], recipe: PileRecipe) -> None:
    number = round(PACKING * survey.surface.volume / calc_mean_volume(recipe.rocks, shapes))
    if number > MAX_ROCKS:
        raise InputError(
            f"pile.scan: {survey.surface.volume:.0f} m3 of this gradation are about {number} rocks; at most "
            f"{MAX_ROCKS} are allowed: make the rocks larger, or cut the scan"
        )
    _log.warning(
        "drakerock: filling the scan's %.1f m3 with about %d rocks (once)", survey.surface.volume, number
    )


class _Filling:
    """The steps of the filling, each from a pile to a pile."""

    def __init__(
        self,
        survey: Survey,
        shapes: tuple[RockShape, ...],
        recipe: PileRecipe,
        rng: np.random.Generator,
        tell: Progress,
    ) -> None:
        self._surface, self._shapes, self._recipe, self._rng = survey.surface, shapes, recipe, rng
        self._tell = tell
        self._site = make_site(recipe.site)
        self._sizes = np.array(sorted(item.size_m for item in recipe.rocks.gradation))
        grid = np.meshgrid(self._surface.x, self._surface.y, indexing="ij")
        self._cells = np.stack(grid, axis=-1).reshape(-1, 2)

    def view(self, pile: PileState) -> View:
        return view_pile(pile, self._shapes, self._surface)

    def rain(self, pile: PileState) -> PileState:
        """Let rocks rain, layer by layer, until none finds room below the surface."""
        target = self._surface.h
        lacks: list[float] = []
        for layer in range(MAX_LAYERS):
            lack = target - self.view(pile).h
            lacks.append(float(np.sum(np.maximum(lack, 0.0))))
            if layer >= VAIN_LAYERS and lacks[-1 - VAIN_LAYERS] - lacks[-1] < LAYER_SHARE * lacks[0]:
                break
            self._tell(f"layer {layer + 1}", 0.6 * (1.0 - lacks[-1] / max(lacks[0], 1e-9)))
            placer = Placer(pile, self._shapes, self._site, self._rng)
            shares = ShareKeeper(pile, self._recipe.rocks)
            lack = lack.ravel().copy()
            for cell in self._rng.permutation(np.flatnonzero(lack > RISE * self._sizes[0])):
                self._rain_on(cell, lack, placer, shares)
            if not placer.count:
                break
            pile = self._fall(pile.join(placer.make_rocks()), LAYER_TIME)
        return pile

    def _rain_on(self, cell: int, lack: Array, placer: Placer, shares: ShareKeeper) -> None:
        place = self._cells[cell] + self._surface.cell * self._rng.uniform(-0.5, 0.5, 2)
        distance = np.linalg.norm(self._cells - place, axis=1)
        room = np.array(
            [lack[distance <= max(FOOTPRINT * s, 0.75 * self._surface.cell)].mean() for s in self._sizes]
        )
        size = shares.choose(self._sizes[room >= RISE * self._sizes])
        if size is None or not placer.place(place, size):
            return
        shares.add(size)
        lack[distance <= FOOTPRINT * size] -= RISE * size

    def correct(self, pile: PileState, wanted: float) -> PileState:
        """Take rocks out and add others until the surface is `wanted` near, or nothing brings it nearer."""
        best, vain = (np.inf, pile), 0
        for number in range(MAX_CORRECTIONS):
            view = self.view(pile)
            rms = calc_rms(view.h, self._surface)[0]
            self._tell(f"surface {rms:.2f} m off", 0.6 + 0.3 * number / MAX_CORRECTIONS)
            vain = 0 if rms < best[0] - 1e-3 else vain + 1
            best = min(best, (rms, pile), key=lambda item: item[0])
            if rms <= wanted or vain >= VAIN_CORRECTIONS:
                break
            removed = self._find_superfluous(pile, view)
            added = self._find_missing(pile, view, removed)
            if not removed.any() and not len(added):
                break
            pile = self._fall(pile.select(~removed).join(added), CORRECTION_TIME)
        return best[1]

    def _find_superfluous(self, pile: PileState, view: View) -> Mask:
        """Return the rocks (n,) that are nearer to the surface when gone, apart from each other."""
        target = self._surface.h
        error = view.h - target
        removed = np.zeros(len(pile), bool)
        rocks = np.unique(view.rock[error > 0.0])
        gains: list[tuple[float, int, NDArray[np.int64]]] = []
        for rock in rocks[rocks >= 0]:
            if pile.fixed[rock]:
                continue
            mine = view.rock == rock
            cells = mine.any(axis=2)
            after = np.median(np.where(mine, view.below, view.top)[cells], axis=1) - target[cells]
            gain = float(np.sum(error[cells] ** 2) - np.sum(after**2))
            if gain > LEAST_GAIN:
                gains.append((gain, int(rock), np.flatnonzero(cells)))
        taken = np.zeros(target.size, bool)
        for _, rock, flat in sorted(gains, key=lambda item: -item[0]):
            if not taken[flat].any():
                removed[rock] = taken[flat] = True
        return removed

    def _find_missing(self, pile: PileState, view: View, removed: Mask) -> PileState:
        """Return rocks that fill hollows of the surface, in the air above them."""
        h, target = view.h.ravel(), self._surface.h.ravel()
        error = h - target
        placer = Placer(pile.select(~removed), self._shapes, self._site, self._rng)
        taken = np.isin(view.rock, np.flatnonzero(removed)).any(axis=2).ravel()
        for cell in np.argsort(error):
            if error[cell] > -0.3 * self._sizes[0]:
                break
            place = self._cells[cell]
            distance = np.linalg.norm(self._cells - place, axis=1)
            choices: list[tuple[float, float]] = []
            for size in self._sizes:
                under = distance <= max(FOOTPRINT * size, 0.5 * self._surface.cell)
                if taken[under].any():
                    continue
                # Round on top: it lies in its hollow, lower at its rim than in its middle.
                lift = RISE * size * (1.0 - 0.5 * (distance[under] / (0.5 * size)) ** 2)
                after = np.maximum(h[under], h[under].mean() + lift) - target[under]
                choices.append((float(np.sum(error[under] ** 2) - np.sum(after**2)), float(size)))
            gain, size = max(choices, default=(0.0, 0.0))
            if gain > LEAST_GAIN and placer.place(place, size):
                taken[distance <= FOOTPRINT * size] = True
        return placer.make_rocks()

    def _fall(self, pile: PileState, duration: float) -> PileState:
        pile, _ = settle(pile, self._shapes, self._recipe, duration)
        return pile.select(~self._find_out(pile))

    def _find_out(self, pile: PileState) -> Mask:
        """Return the rocks (n,) whose middle is above the surface: they rolled out, or never got in."""
        surface = self._surface
        i = np.clip(np.searchsorted(surface.x, pile.p_WRs[:, 0] - 0.5 * surface.cell), 0, len(surface.x) - 1)
        j = np.clip(np.searchsorted(surface.y, pile.p_WRs[:, 1] - 0.5 * surface.cell), 0, len(surface.y) - 1)
        still = np.linalg.norm(pile.V_WRs[:, 3:], axis=1) < 0.3
        out: Mask = ~pile.fixed & still & (pile.p_WRs[:, 2] > surface.h[i, j] + OUT * pile.size)
        return out

    def rest(self, pile: PileState) -> PileState:
        """Bring all to rest, forces in balance, and take loose rocks away."""
        config = self._recipe.pile
        self._tell("settling", 0.92)
        pile, resting = settle(pile, self._shapes, self._recipe, config.max_time, until_rest=True)
        if not resting:
            raise SimulationFailure(f"the filled scan did not come to rest within {config.max_time:g} s")
        if pile.contacts is not None:
            pile = balance(pile, self._shapes, self._recipe, None, until_balanced=False, until_still=True)
        return pile.select(pile.fixed | ~find_loose(pile, self._shapes, config.contact_gap))
