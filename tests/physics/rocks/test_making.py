"""Making, keeping and refilling piles with the nonsmooth engine: small voids, all of the procedure."""

from dataclasses import replace

import numpy as np
import pytest

from drakerock.errors import InputError
from drakerock.identity import calc_config_hash
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.rocks.contact_graph import find_loose
from drakerock.rocks.making.cache import check_pile, fetch_pile
from drakerock.rocks.making.emission import calc_level, make_emitter, sample_rocks
from drakerock.rocks.making.make import make_pile
from drakerock.rocks.making.refill import WAITING, refill
from drakerock.rocks.making.settle import calc_creep, settle
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.site import make_site
from drakerock.rocks.state import save_pile
from drakerock.rocks.summary import calc_support


def make_small_recipe(**changes):
    """A void of a few hundred rocks: another site by configuration alone."""
    values = {
        "seed": 3,
        "site": {
            "drift_width": 3.0, "drift_height": 2.6, "roof_sag": 0.2, "void_depth": 2.6, "void_height": 8.0,
            "rear_layer": 0.6,
        },
        "rocks": {
            "gradation": [{"size_m": 0.3, "mass_fraction": 0.4}, {"size_m": 0.4, "mass_fraction": 0.6}]
        },
        "pile": {"emission_height": 4.0},
    }  # fmt: skip
    for room, keys in changes.items():
        values[room] = {**values.get(room, {}), **keys}
    return make_recipe(Scenario.model_validate(values))


@pytest.fixture(scope="module")
def recipe():
    return make_small_recipe()


@pytest.fixture(scope="module")
def pile(recipe):
    return make_pile(recipe)


def test_void_is_full_and_the_pile_flowed_into_the_drift(pile, recipe):
    moving = ~pile.fixed
    assert moving.sum() > 200
    # The level sinks a little when the last rocks have come to rest.
    assert calc_level(pile, make_emitter(recipe.site, recipe.pile)) > recipe.pile.emission_height - 0.5
    assert pile.p_WRs[moving, 0].min() < -1.5


def test_static_rocks_cover_the_rear_wall_only(pile, recipe):
    static = pile.p_WRs[pile.fixed]
    depth, layer = recipe.site.void_depth, recipe.site.rear_layer
    assert pile.fixed.sum() > 20
    assert np.all((static[:, 0] > depth - layer) & (static[:, 0] < depth))
    assert static[:, 2].max() > recipe.pile.emission_height - 0.5
    assert not pile.contacts.resting[pile.fixed].any()


def test_all_rocks_are_inside_the_site_and_none_is_loose(pile, recipe, tmp_path):
    check_pile(pile, recipe, tmp_path)
    shapes = load_rock_shapes(recipe.rocks)
    loose = find_loose(pile, shapes, recipe.pile.contact_gap) & ~pile.fixed
    assert not loose.any()


def test_made_pile_rests_and_carries_its_weight(pile, recipe):
    shapes = load_rock_shapes(recipe.rocks)
    support = calc_support(pile, shapes, recipe.rocks, make_site(recipe.site), recipe.dynamics.time_step)
    total = support.floor + support.walls + support.static
    assert total == pytest.approx(support.weight, rel=0.02)
    moved = calc_creep(pile, shapes, recipe, 2.0)
    assert moved.mean() < 0.005
    assert np.percentile(moved, 99) < 0.030


def test_same_recipe_same_bits_made_or_from_the_cache(pile, recipe, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made, path = fetch_pile(recipe)
    assert path.is_relative_to(tmp_path)
    cached, _ = fetch_pile(recipe)
    for other in (made, cached):
        for name in ("p_WRs", "q_WRs", "shape", "size", "fixed"):
            assert np.array_equal(getattr(other, name), getattr(pile, name)), name
        for name in ("pairs", "points", "impulses", "resting"):
            assert np.array_equal(getattr(other.contacts, name), getattr(pile.contacts, name)), name
    assert cached.provenance["recipe"] == calc_config_hash(recipe)
    assert cached.provenance["seed"] == 3
    assert set(cached.provenance["versions"]) == {"results", "drakerock", "drake", "numba", "numpy"}
    # A stored pile goes on as one that never was.
    shapes = load_rock_shapes(recipe.rocks)
    one, _ = settle(pile, shapes, recipe, 0.3)
    two, _ = settle(cached, shapes, recipe, 0.3)
    assert np.array_equal(one.p_WRs, two.p_WRs)


def test_refill_restores_the_level(pile, recipe):
    shapes = load_rock_shapes(recipe.rocks)
    emitter = make_emitter(recipe.site, recipe.pile)
    # The void's upper half is taken out, as if the pile had slid.
    removed = ~pile.fixed & (pile.p_WRs[:, 0] > 0) & (pile.p_WRs[:, 2] > 2.0)
    assert calc_level(pile.select(~removed), emitter) < 3.0
    after = refill(pile, removed, shapes, recipe, np.random.default_rng(1))
    assert calc_level(after, emitter) > recipe.pile.emission_height - 0.5
    assert len(after) == pytest.approx(len(pile), rel=0.15)
    static, before = after.p_WRs[after.fixed], pile.p_WRs[pile.fixed]
    assert np.array_equal(static[np.lexsort(static.T)], before[np.lexsort(before.T)])
    assert np.all(after.V_WRs == 0)
    assert after.p_WRs[:, 2].min() > 0
    moved = calc_creep(after, shapes, recipe, 2.0)
    assert moved.mean() < 0.005
    assert np.percentile(moved, 99) < 0.030


def test_refill_of_a_full_void_adds_hardly_any(pile, recipe):
    shapes = load_rock_shapes(recipe.rocks)
    after = refill(pile, np.zeros(len(pile), bool), shapes, recipe, np.random.default_rng(1))
    assert len(after) - len(pile) < 0.1 * len(pile)


def test_refill_of_a_counted_pile_keeps_its_rocks():
    recipe = make_small_recipe(pile={"rocks": 40}, site={"rear_layer": 0.0})
    pile = make_pile(recipe)
    shapes = load_rock_shapes(recipe.rocks)
    after = refill(pile, np.arange(len(pile)) % 4 == 0, shapes, recipe, np.random.default_rng(1))
    assert np.array_equal(np.sort(after.size), np.sort(pile.size))
    assert np.array_equal(np.bincount(after.shape), np.bincount(pile.shape))
    assert np.all(after.V_WRs == 0)


def test_rocks_without_room_wait_for_the_next_refill_and_hold_up_no_other():
    """Large rocks that the emitter is too narrow for: the small ones behind them are emitted all the same."""
    # High enough that the wider emitter before the brow is under the roof.
    site = {"void_depth": 0.6, "rear_layer": 0.0, "drift_height": 6.0}
    recipe = make_small_recipe(
        site=site, rocks={"gradation": [{"size_m": 0.3, "mass_fraction": 1.0}]}, pile={"rocks": 30}
    )
    shapes = load_rock_shapes(recipe.rocks)
    small = make_pile(recipe)
    large = sample_rocks(6, recipe.rocks, shapes, np.random.default_rng(0))
    large = replace(large, size=np.full(6, 0.8), p_WRs=large.p_WRs - [20.0, 0.0, 0.0])
    pile = large.join(small)
    removed = np.arange(len(pile)) < 12
    after = refill(replace(pile, contacts=None), removed, shapes, recipe, np.random.default_rng(1))
    assert np.array_equal(np.sort(after.size), np.sort(small.size))
    assert after.provenance[WAITING]["size"] == [0.8] * 6
    wider = make_small_recipe(site=site, pile={"rocks": 30, "emission_reach": 2.0, "emission_height": 1.5})
    again = refill(after, np.zeros(len(after), bool), shapes, wider, np.random.default_rng(2))
    assert np.array_equal(np.sort(again.size), np.sort(pile.size))
    assert WAITING not in again.provenance


def test_tapered_void_by_configuration_alone():
    recipe = make_small_recipe(site={"void_taper_deg": 4.0, "rear_layer": 0.0}, pile={"rocks": 60})
    pile = make_pile(recipe)
    foot = np.tan(np.deg2rad(4.0))
    in_void = pile.p_WRs[:, 0] > 0.5
    room = 1.5 - foot * (8.0 - pile.p_WRs[in_void, 2])
    assert in_void.sum() > 20
    assert np.all(np.abs(pile.p_WRs[in_void, 1]) < room)


def test_rocks_that_never_find_room_are_a_clear_error():
    recipe = make_small_recipe(
        site={"void_depth": 0.6, "rear_layer": 0.0},
        rocks={"gradation": [{"size_m": 0.9, "mass_fraction": 1.0}]},
        pile={"rocks": 3},
    )
    with pytest.raises(InputError, match="emission_height"):
        make_pile(recipe)


def test_fast_rocks_stay_inside(recipe):
    """Rocks at 20 m/s, faster than any fall from the emitter, in all directions at walls, floor and roof."""
    rng = np.random.default_rng(2)
    shapes = load_rock_shapes(recipe.rocks)
    n = 80
    direction = rng.normal(size=(n, 3))
    direction *= 20.0 / np.linalg.norm(direction, axis=1)[:, None]
    rocks = replace(
        sample_rocks(n, recipe.rocks, shapes, rng),
        # Apart, along the drift and in the void.
        p_WRs=np.column_stack([np.linspace(-30.0, 1.6, n), np.zeros(n), np.full(n, 1.2)]),
        V_WRs=np.hstack([rng.normal(size=(n, 3)), direction]),
    )
    after = rocks
    for _ in range(6):
        after, _ = settle(after, shapes, recipe, 0.25)
        assert np.abs(after.p_WRs[:, 1]).max() < 1.5
        assert after.p_WRs[:, 2].min() > 0
        assert after.p_WRs[:, 0].max() < recipe.site.void_depth
        in_drift = after.p_WRs[:, 0] < -0.5
        assert after.p_WRs[in_drift, 2].max() < recipe.site.drift_height


def test_piles_of_another_site_or_gradation_are_refused(pile, recipe, tmp_path):
    path = tmp_path / "pile.npz"
    save_pile(pile, path)
    for changes, words in (
        ({"site": {"drift_width": 2.0}}, "site.drift_width"),
        ({"site": {"void_depth": 1.4}}, "site.void_depth"),
        ({"rocks": {"gradation": [{"size_m": 0.3, "mass_fraction": 1.0}]}}, "gradation"),
        ({"rocks": {"shapes": recipe.rocks.shapes[:2]}}, r"rocks\.shapes"),
    ):
        other = make_small_recipe(**{**changes, "pile": {"source": str(path)}})
        with pytest.raises(InputError, match=words):
            fetch_pile(other)
