from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drakerock.rocks.config import PileConfig, RocksConfig, SiteConfig
from drakerock.rocks.geometry import make_pile_mesh
from drakerock.rocks.making.emission import (
    START_SPEED,
    Emitter,
    calc_level,
    calc_mean_volume,
    make_emitter,
    make_rear_emitter,
    place_rocks,
    sample_rocks,
)
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.state import make_empty_pile


def test_mass_shares_meet_the_gradation_within_sampling_error(shapes):
    rocks = RocksConfig()
    pile = sample_rocks(60_000, rocks, shapes, np.random.default_rng(2))
    mass = pile.calc_masses(np.array([shape.volume for shape in shapes]), rocks.density)
    for item in rocks.gradation:
        chosen = pile.size == item.size_m
        share = mass[chosen].sum() / mass.sum()
        # Three standard errors of a sum of independent masses.
        error = 3 * np.sqrt(np.sum(mass[chosen] ** 2)) / mass.sum()
        assert abs(share - item.mass_fraction) < error
    assert mass.mean() / rocks.density == pytest.approx(calc_mean_volume(rocks, shapes), rel=0.03)


@given(seed=st.integers(0, 2**31))
def test_placed_rocks_are_apart_inside_and_falling(seed):
    rocks = RocksConfig()
    shapes = load_rock_shapes(rocks)
    rng = np.random.default_rng(seed)
    emitter = Emitter(np.array([-2.0, -1.5, 2.0]), np.array([1.0, 1.5, 6.0]), 0.5)
    there, _ = place_rocks(sample_rocks(4, rocks, shapes, rng), make_empty_pile(), shapes, emitter, rng)
    waiting = sample_rocks(40, rocks, shapes, rng)
    placed, left = place_rocks(waiting, there, shapes, emitter, rng)
    assert len(placed) + len(left) == 40
    assert np.all(placed.V_WRs[:, 5] == -START_SPEED)
    corners = np.asarray(make_pile_mesh(placed, shapes).vertices)
    assert np.all(corners >= emitter.low - 1e-9)
    assert np.all(corners <= emitter.high + 1e-9)
    both = there.join(placed)
    radius = np.array([shape.radius for shape in shapes])[both.shape] * both.size
    gaps = np.linalg.norm(both.p_WRs[:, None] - both.p_WRs[None], axis=2) - radius[:, None] - radius[None]
    np.fill_diagonal(gaps, 1.0)
    assert gaps.min() >= 0


def test_rocks_that_find_no_room_wait_in_their_order(shapes):
    rng = np.random.default_rng(0)
    waiting = sample_rocks(60, RocksConfig(), shapes, rng)
    waiting = replace(waiting, p_WRs=np.tile(np.arange(60.0)[:, None], 3))
    emitter = Emitter(np.zeros(3), np.full(3, 1.5), 0.5)
    placed, left = place_rocks(waiting, make_empty_pile(), shapes, emitter, rng)
    assert 0 < len(placed) < 60
    assert np.all(np.diff(left.p_WRs[:, 0]) > 0)
    placed, left = place_rocks(
        waiting, make_empty_pile(), shapes, Emitter(np.zeros(3), np.full(3, 0.1), 0.5), rng
    )
    assert len(placed) == 0
    assert len(left) == 60


def test_emitter_empties_by_free_fall_between_batches():
    site, config = SiteConfig(), PileConfig()
    emitter = make_emitter(site, config)
    t = emitter.interval
    assert emitter.high[2] - emitter.low[2] == pytest.approx(START_SPEED * t + 0.5 * 9.81 * t**2)
    # The emitters share the void: one before the static rocks, one above them.
    rear = make_rear_emitter(site, config)
    assert emitter.high[0] == rear.low[0] == site.void_depth - site.rear_layer
    assert rear.high[0] == site.void_depth
    assert emitter.low[2] == rear.low[2] == config.emission_height == 8.0


def test_level_is_that_of_still_rocks(heap):
    emitter = Emitter(np.array([-1.7, -0.7, 3.0]), np.array([-0.95, 0.7, 4.0]), 0.5)
    assert calc_level(heap, emitter) == pytest.approx(0.75 + 0.15)
    falling = replace(heap, V_WRs=np.tile([0, 0, 0, 0, 0, -3.0], (12, 1)))
    assert calc_level(falling, emitter) == 0.0
    assert calc_level(make_empty_pile(), emitter) == 0.0
