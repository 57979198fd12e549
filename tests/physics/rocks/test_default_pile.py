"""The shipped pile: that of the default scenario, at rest, in balance, as the method describes it."""

from dataclasses import replace

import numpy as np
import pytest

from drakerock.identity import calc_config_hash
from drakerock.loading.scenario import Scenario, load_scenario, make_recipe
from drakerock.resources import find_data
from drakerock.rocks.making.cache import check_pile, fetch_pile
from drakerock.rocks.making.settle import settle
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.site import make_site
from drakerock.rocks.summary import calc_gradation, calc_imbalance, calc_packing, calc_slope, calc_support

RECIPE = make_recipe(Scenario())
SITE = make_site(RECIPE.site)


@pytest.fixture(scope="module")
def pile():
    pile, path = fetch_pile(RECIPE)
    # Not so? The default scenario or the engine's settings have changed: python src/drakerock/data/make_default_pile.py
    assert path == find_data("data", "default_pile.npz")
    assert pile.provenance["recipe"] == calc_config_hash(RECIPE)
    return pile


def test_full_size_study_takes_the_shipped_pile():
    scenario = load_scenario(find_data("studies", "demo.yaml"))
    assert calc_config_hash(make_recipe(scenario)) == calc_config_hash(RECIPE)


def test_shipped_pile_is_small_and_inside_the_site(pile):
    path = find_data("data", "default_pile.npz")
    assert path.stat().st_size < 1_000_000
    check_pile(pile, RECIPE, path)


def test_number_and_gradation_are_the_methods(pile, shapes):
    moving = int((~pile.fixed).sum())
    assert abs(moving - 5500) <= 0.05 * 5500
    for item in calc_gradation(pile, shapes, RECIPE.rocks):
        assert abs(item["share"] - item["wanted"]) < 3 * item["standard_error"]


def test_forces_carry_the_weight_within_one_percent(pile, shapes):
    support = calc_support(pile, shapes, RECIPE.rocks, SITE, RECIPE.dynamics.time_step)
    assert support.floor + support.walls + support.static == pytest.approx(support.weight, rel=0.01)
    assert 0.6 < support.floor / support.weight < 0.95
    assert 3.5 < support.contacts_per_rock < 6.0


def test_forces_carry_each_rocks_weight(pile, shapes):
    """Each rock's own contacts, sideways as well as upwards."""
    share = calc_imbalance(pile, shapes, RECIPE.rocks, RECIPE.dynamics.time_step)
    assert np.percentile(share, 90) < 0.1


def test_slope_and_packing_are_those_of_broken_rock(pile, shapes):
    assert 25.0 < np.rad2deg(calc_slope(pile, shapes, RECIPE.site)) < 45.0
    assert 0.52 < calc_packing(pile, shapes, RECIPE.site) < 0.66


@pytest.mark.parametrize("centre", [(-2.0, 0.0, 2.0), (3.0, 1.0, 3.0)])
def test_300_woken_rocks_stay_where_they_are(pile, centre):
    nearest = np.argsort(np.linalg.norm(pile.p_WRs - np.array(centre), axis=1))
    woken = nearest[~pile.fixed[nearest]][:300]
    resting = ~pile.fixed
    resting[woken] = False
    start = replace(pile, contacts=replace(pile.contacts, resting=resting))
    # Without the rest rule, so that they stay awake for all of the time.
    recipe = RECIPE.replace(**{"dynamics.nonsmooth.rest.time": 1e9})
    after, _ = settle(start, load_rock_shapes(RECIPE.rocks), recipe, 5.0)
    moved = np.linalg.norm(after.p_WRs - pile.p_WRs, axis=1)[woken]
    assert moved.mean() < 0.005
    assert np.percentile(moved, 99) < 0.030
