"""Filling a measured surface: rocks placed apart, shares kept, a small heap that comes out at rest and as wanted."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drakerock.randomness import make_generator
from drakerock.rocks.config import RocksConfig, SiteConfig
from drakerock.rocks.making.make import make_pile as make_scenario_pile
from drakerock.rocks.making.placing import Placer, ShareKeeper
from drakerock.rocks.making.recipe import PileRecipe
from drakerock.rocks.making.settle import calc_creep
from drakerock.rocks.site import make_site
from drakerock.rocks.surveying.surface import calc_rms, view_pile
from drakerock.rocks.surveying.survey import survey_scan
from rock_helpers import make_pile

SITE = SiteConfig(drift_width=4.0, void_depth=1.0, rear_layer=0.0, drift_length=10.0)


def test_placed_rocks_touch_nothing(shapes):
    there = make_pile([[-2.0, 0.0, 0.4], [-2.0, 1.0, 0.4]], size=np.array([0.6, 0.6]))
    placer = Placer(there, shapes, make_site(SITE), make_generator(0))
    for place in np.random.default_rng(0).uniform([-4, -2], [1, 2], (200, 2)):
        placer.place(place, 0.4)
    rocks = placer.make_rocks()
    assert len(rocks) == placer.count > 10
    every = there.join(rocks)
    radii = np.array([shape.radius for shape in shapes])[every.shape] * every.size
    apart = np.linalg.norm(every.p_WRs[:, None] - every.p_WRs[None], axis=2)
    assert (apart + 1e-9 >= radii[:, None] + radii[None])[np.triu_indices(len(every), 1)].all()
    for rock in range(len(rocks)):
        turn = Rotation.from_quat(rocks.q_WRs[rock], scalar_first=True)
        corners = rocks.p_WRs[rock] + turn.apply(rocks.size[rock] * shapes[rocks.shape[rock]].vertices)
        assert np.abs(corners[:, 1]).max() < 2.0
        assert corners[:, 0].max() < 1.0
    # On what lies below, not in the air: over bare floor at the floor.
    assert rocks.p_WRs[:, 2].min() == pytest.approx(radii[2 + rocks.p_WRs[:, 2].argmin()] + 0.01)


def test_shares_follow_the_gradation():
    keeper = ShareKeeper(make_pile(np.zeros((0, 3))), RocksConfig())
    sizes = np.array([0.3, 0.4, 0.6, 0.8])
    masses = dict.fromkeys(sizes.tolist(), 0.0)
    for _ in range(600):
        size = keeper.choose(sizes)
        keeper.add(size)
        masses[size] += size**3
    shares = np.array(list(masses.values())) / sum(masses.values())
    np.testing.assert_allclose(shares, [0.2, 0.3, 0.3, 0.2], atol=0.01)
    assert keeper.choose(sizes[:0]) is None


def test_a_small_heap_is_filled_and_rests(tmp_path):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-4, 0.9, 6000), rng.uniform(-1.9, 1.9, 6000)
    z = np.maximum(0.8 - 0.6 * np.hypot(x + 1.6, y), 0.0)
    np.savetxt(tmp_path / "heap.xyz", np.column_stack([x, y, z]), fmt="%.3f")
    recipe = PileRecipe.model_validate({
        "seed": 1, "site": SITE.model_dump(), "dynamics": {},
        "rocks": {"gradation": [{"size_m": 0.3, "mass_fraction": 0.6}, {"size_m": 0.4, "mass_fraction": 0.4}]},
        "pile": {"scan": {"file": str(tmp_path / "heap.xyz")}, "settle_speed": 0.05, "balance_time": 0.3},
    })  # fmt: skip
    pile = make_scenario_pile(recipe)
    from drakerock.rocks.shapes import load_rock_shapes

    shapes = load_rock_shapes(recipe.rocks)
    scan = recipe.pile.scan
    assert scan is not None
    survey = survey_scan(scan, recipe.site, recipe.pile, recipe.rocks)
    rms, _ = calc_rms(view_pile(pile, shapes, survey.surface).h, survey.surface)
    assert pile.provenance["scan"]["rms_m"] == pytest.approx(rms, abs=1e-4)
    assert rms <= 0.15
    assert np.percentile(calc_creep(pile, shapes, recipe, 0.5), 90) < 0.01
