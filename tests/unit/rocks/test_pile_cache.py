"""Contract: a cache of piles that cannot be read or written costs time, and nothing else.

Caught: a folder that cannot be written ended the run after the pile was made.
"""

import logging

import numpy as np
import pytest

from drakerock.identity import calc_config_hash
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.rocks.making import cache
from drakerock.rocks.making.cache import fetch_pile
from drakerock.rocks.state import load_pile

RECIPE = make_recipe(Scenario(seed=17))


@pytest.fixture
def made(heap, monkeypatch):
    """The recipes that a pile is made of: always the same one, at once."""
    recipes = []
    monkeypatch.setattr(cache, "make_pile", lambda recipe, _progress: recipes.append(recipe) or heap)
    return recipes


def test_a_pile_is_made_once(made, heap, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first, path = fetch_pile(RECIPE)
    second, again = fetch_pile(RECIPE)
    assert (len(made), path) == (1, again)
    assert np.array_equal(first.p_WRs, second.p_WRs)
    fetch_pile(RECIPE.replace(seed=18))
    assert len(made) == 2
    assert [file.suffix for file in path.parent.iterdir()] == 2 * [".npz"]


def test_a_damaged_pile_is_made_anew(made, tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _, path = fetch_pile(RECIPE)
    path.write_bytes(b"damaged")
    fetch_pile(RECIPE)
    assert "the pile is made anew" in caplog.text
    assert len(made) == 2
    assert len(load_pile(path)) == 12


@pytest.mark.parametrize("harm", ["file", "folder"])
def test_a_cache_that_cannot_be_used_is_a_warning(made, heap, tmp_path, monkeypatch, caplog, harm):
    caplog.set_level(logging.WARNING)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    if harm == "file":
        (tmp_path / "cache").write_text("no folder")
    else:  # where the file should be
        _, path = fetch_pile(RECIPE)
        path.unlink()
        path.mkdir()
    pile, _ = fetch_pile(RECIPE)
    assert np.array_equal(pile.p_WRs, heap.p_WRs)
    assert "the pile is not kept for next time" in caplog.text


def test_the_shipped_pile_is_that_of_the_default_recipe_alone(made):
    pile, path = fetch_pile(make_recipe(Scenario()))
    assert path.name == "default_pile.npz"
    assert pile.provenance["recipe"] == calc_config_hash(make_recipe(Scenario()))
    assert made == []
