"""Where a pile comes from: a stored file, the shipped one, the cache, or made now."""

from __future__ import annotations

import logging
import os
from contextlib import suppress
from pathlib import Path

import numpy as np
from platformdirs import user_cache_path

from drakerock.errors import InputError
from drakerock.identity import calc_config_hash, get_versions
from drakerock.resources import find_data
from drakerock.rocks.making.drop import Progress
from drakerock.rocks.making.make import make_pile
from drakerock.rocks.making.recipe import PileRecipe
from drakerock.rocks.state import PileState, load_pile, save_pile

_log = logging.getLogger(__name__)


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
