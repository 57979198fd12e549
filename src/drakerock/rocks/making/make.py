"""Making a pile from nothing (method section 3, pile making)."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from drakerock.errors import InputError
from drakerock.identity import calc_config_hash, get_versions
from drakerock.randomness import make_generator
from drakerock.rocks.config import MAX_ROCKS
from drakerock.rocks.contact_graph import find_loose
from drakerock.rocks.making.drop import Progress, drop_rocks
from drakerock.rocks.making.emission import calc_mean_volume, make_emitter, make_rear_emitter, sample_rocks
from drakerock.rocks.making.fill import fill_surface
from drakerock.rocks.making.recipe import PileRecipe
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.site import make_confined_site
from drakerock.rocks.state import PileState, make_empty_pile
from drakerock.rocks.surveying.survey import survey_scan

_log = logging.getLogger(__name__)

# Share of the room under the emitter that rocks fill.
PACKING = 0.6


def make_pile(recipe: PileRecipe, progress: Progress | None = None) -> PileState:
    """Make a pile: the static rocks of the rear wall, then rocks emitted from above, then all to rest.

    With `pile.rocks` null, rocks are emitted until the void is full to the emitter; with `pile.scan`, they fill the
    measured surface instead. Same recipe, same pile, bit for bit.

    Raises:
        InputError: more rocks than the engine takes, a rock finds no room in the emitter, or a scan is of no use.
        SimulationFailure: the dynamics failed, or the pile did not come to rest in time.
    """
    survey = recipe.pile.scan and survey_scan(recipe.pile.scan, recipe.site, recipe.pile, recipe.rocks)
    if not survey:
        _announce_number(recipe)
    shapes = load_rock_shapes(recipe.rocks)
    rng = make_generator(recipe.seed, "pile")
    site, n = recipe.site, recipe.pile.rocks
    pile = make_empty_pile()
    if site.rear_layer:
        waiting = sample_rocks(count_filling(recipe, site.rear_layer), recipe.rocks, shapes, rng)
        emitter = make_rear_emitter(site, recipe.pile)
        mould = make_confined_site(site)
        layer, _ = drop_rocks(
            waiting, pile, shapes, recipe, emitter, rng, until_full=True, site=mould, stage="rear wall",
            progress=progress,
        )  # fmt: skip
        # What holds the static rocks is no longer the contacts they settled with.
        pile = replace(layer, fixed=np.ones(len(layer), bool), contacts=None)
    provenance = {
        "recipe": calc_config_hash(recipe),
        "seed": recipe.seed,
        "versions": get_versions(),
    }
    if survey:
        pile, comparison = fill_surface(survey, pile, shapes, recipe, rng, progress)
        scan = {**comparison, "points": len(survey.points), "notes": survey.notes}
        return replace(pile, provenance=provenance | {"scan": scan})
    number = n or count_filling(recipe, site.void_depth + 1.5 * site.drift_height)
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
    return replace(pile, provenance=provenance)


def _announce_number(recipe: PileRecipe) -> None:
    """Say how many rocks are about to be simulated; InputError if the gradation makes too many of them."""
    rocks = recipe.rocks
    volume = calc_mean_volume(rocks, load_rock_shapes(rocks))
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


def count_filling(recipe: PileRecipe, depth: float) -> int:
    """Return more rocks than fit under the emitter over a depth [m]: as if they filled it without gaps."""
    shapes = load_rock_shapes(recipe.rocks)
    room = depth * recipe.site.drift_width * (recipe.pile.emission_height + 1.0)
    return int(np.ceil(room / calc_mean_volume(recipe.rocks, shapes)))
