"""Contract: what speaks against an entry is found where it is, and nothing on an even slope."""

import numpy as np
import pytest

from drakerock.autonomy.entry import PileGrid
from drakerock.autonomy.hazards import HazardLimits, calibrate_limits, find_hazards, find_pile
from drakerock.loading.field import HeightField, calc_pile_profile
from drakerock.loading.sensing import make_grid
from drakerock.rocks.config import SiteConfig

X, Y = make_grid(SiteConfig(), 0.26, 10.0)
GRID = PileGrid(X, Y, 0.26, 0.15, 1.55, 3.0)


def make_slope(toe=-4.0):
    return np.maximum(0.7 * (X - toe), 0.0)[:, None] * np.ones(len(Y))


def find(h):
    return find_hazards(GRID, h, 3.1, HazardLimits())


def put(h, x, y, height, half=0.2):
    h = h.copy()
    near = (np.abs(X[:, None] - x) <= half) & (np.abs(Y[None, :] - y) <= half)
    h[near] += height
    return h


def test_an_even_slope_has_none():
    assert find(make_slope()) == ()
    assert find(np.zeros((len(X), len(Y)))) == ()


def test_a_rough_slope_has_none():
    rough = make_slope() + np.random.default_rng(0).uniform(0, 0.25, (len(X), len(Y))) * (make_slope() > 0)
    assert find(rough) == ()


def test_debris_bars_the_entries_whose_way_it_is_in():
    found = find(put(make_slope(), -7.0, 1.3, 0.5))
    assert {hazard.kind for hazard in found} == {"debris in the way"}
    for hazard in found:
        assert abs(hazard.y - 1.3) <= 0.5 * 3.1 + 0.3
        assert hazard.x == pytest.approx(-7.0, abs=0.3)
        assert hazard.size == pytest.approx(0.5, abs=0.01)
    ways = {round(hazard.y, 2) for hazard in found}
    assert any(abs(y) <= 1.55 and y < -0.5 and round(y, 2) not in ways for y in Y)


def test_a_boulder_at_the_foot_is_found_and_one_high_up_is_not():
    assert {hazard.kind for hazard in find(put(make_slope(), -3.0, 0.0, 0.9))} == {"boulder at the entry"}
    assert find(put(make_slope(), -0.5, 0.0, 0.9)) == ()


def test_a_face_may_overhang():
    face = make_slope() + np.where(X > -2.5, 2.0, 0.0)[:, None]
    assert "overhang" in {hazard.kind for hazard in find(face)}
    assert "2." in next(str(hazard) for hazard in find(face) if hazard.kind == "overhang")


def test_rocks_of_the_usual_size_are_no_boulders():
    """Caught: on a pile of rocks of up to 0.8 m nearly every entry had a boulder."""
    rng = np.random.default_rng(1)

    def scatter(height):
        h = make_slope()
        for _ in range(60):
            h = put(h, rng.uniform(-4, 0), rng.uniform(-3, 3), height)
        return h

    piles = np.array([scatter(0.8) for _ in range(30)])
    limits = calibrate_limits(GRID, piles, 3.1)
    assert limits.boulder_height > 0.6
    usual = [any(z.kind == "boulder at the entry" for z in find_hazards(GRID, h, 3.1, limits)) for h in piles]
    assert np.mean(usual) <= 0.05
    boulder = put(make_slope(), -3.0, 0.0, limits.boulder_height + 0.3)
    assert {hazard.kind for hazard in find_hazards(GRID, boulder, 3.1, limits)} == {"boulder at the entry"}
    assert calibrate_limits(GRID, make_slope()[None], 3.1) == HazardLimits()


def test_what_is_pile_is_the_planner_s():
    h = put(make_slope(), -7.0, 1.3, 0.5)
    pile = find_pile(GRID, h)
    profile = calc_pile_profile(HeightField(X, Y, h, 0.26), 0.15)
    for j in range(len(Y)):
        assert X[np.flatnonzero(pile[:, j])[0]] == profile.x_front[j]
