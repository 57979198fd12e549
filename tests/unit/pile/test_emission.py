import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drakerock.pile.config import RocksConfig
from drakerock.pile.emission import place_rocks, sample_rocks
from drakerock.pile.shapes import load_rock_shapes
from drakerock.pile.state import make_empty_pile


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


@given(seed=st.integers(0, 2**31))
def test_placed_rocks_are_apart_and_inside(seed):
    rocks = RocksConfig()
    shapes = load_rock_shapes(rocks.shapes)
    rng = np.random.default_rng(seed)
    waiting = sample_rocks(40, rocks, shapes, rng)
    low, high = np.array([-2.0, -1.5, 0.0]), np.array([1.0, 1.5, 4.0])
    placed, left = place_rocks(waiting, make_empty_pile(), shapes, low, high, rng)
    assert len(placed) + len(left) == 40
    radius = np.array([shape.radius for shape in shapes])[placed.shape] * placed.size
    assert np.all(placed.p_WRs - radius[:, None] >= low - 1e-12)
    assert np.all(placed.p_WRs + radius[:, None] <= high + 1e-12)
    gaps = np.linalg.norm(placed.p_WRs[:, None] - placed.p_WRs[None], axis=2) - radius[:, None] - radius[None]
    np.fill_diagonal(gaps, 1.0)
    assert gaps.min() >= 0


def test_a_rock_too_large_for_the_box_waits(shapes):
    rng = np.random.default_rng(0)
    waiting = sample_rocks(5, RocksConfig(), shapes, rng)
    placed, left = place_rocks(waiting, make_empty_pile(), shapes, np.zeros(3), np.full(3, 0.1), rng)
    assert len(placed) == 0
    assert len(left) == 5
