from dataclasses import replace

import numpy as np
import pytest

from drakerock.rocks.config import RocksConfig, SiteConfig
from drakerock.rocks.making.emission import sample_rocks
from drakerock.rocks.shapes import RockShape, make_rock_shape
from drakerock.rocks.site import make_site
from drakerock.rocks.state import ContactMemory, PileState
from drakerock.rocks.summary import calc_gradation, calc_packing, calc_slope, calc_summary, calc_support


@pytest.fixture(scope="module")
def cube() -> tuple[RockShape, ...]:
    return (make_rock_shape("cube", np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T),)


def stack(centres, size: float) -> PileState:
    n = len(centres)
    return PileState(
        np.asarray(centres, float), np.tile([1.0, 0, 0, 0], (n, 1)), np.zeros((n, 6)), np.zeros(n, int),
        np.full(n, size), np.zeros(n, bool),
    )  # fmt: skip


@pytest.mark.parametrize("angle", [25.0, 38.0])
def test_slope_of_stairs_is_their_slope(cube, angle):
    size = 0.1
    rise = np.tan(np.deg2rad(angle))
    x = np.arange(-4.0, 0.0, size)
    centres = [(a, y, rise * (a + 4.0) - size) for a in x for y in np.arange(-3.2, 3.2, size)]
    # A little larger than their steps, so that no ray passes between two of them.
    slope = calc_slope(stack(centres, 1.05 * size), cube, SiteConfig(roof_sag=0.0))
    assert np.rad2deg(slope) == pytest.approx(angle, abs=0.5)


def test_no_slope_where_nothing_lies_in_the_drift(cube):
    assert np.isnan(calc_slope(stack([(2.0, 0.0, 0.5)], 1.0), cube, SiteConfig()))


@pytest.mark.parametrize("gap", [0.0, 0.1])
def test_packing_of_a_lattice_of_cubes(cube, gap):
    step = 0.2 + gap
    axis = np.arange(0.1, 6.5, step)
    grid = np.array(np.meshgrid(axis, axis - 3.25, axis)).reshape(3, -1).T
    packing = calc_packing(stack(grid, 0.2), cube, SiteConfig(void_depth=6.5, rear_layer=0.0))
    assert packing == pytest.approx((0.2 / step) ** 3, rel=0.05)


def test_support_is_split_among_floor_walls_and_static_rocks(cube):
    """Two moving cubes: one on the floor and a wall, one on a static cube; forces given by hand."""
    pile = replace(stack([(1, 0, 0.5), (2, 0, 1.5), (2, 0, 0.5)], 1.0), fixed=np.array([False, False, True]))
    site = make_site(SiteConfig())
    floor = -(len(site.pieces) + 1)
    weight, dt = 2500.0 * 9.81, 0.01
    down = np.array([0.75, 0.25, 1.0])[:, None] * [0.0, 0.0, -weight * dt]
    pairs = np.array([[0, floor], [0, floor - 1], [1, 2]])
    pile = replace(pile, contacts=ContactMemory(pairs, np.zeros((3, 3)), down, np.ones(3, bool)))
    support = calc_support(pile, cube, RocksConfig(), site, dt)
    assert support.weight == pytest.approx(2 * weight)
    assert support.floor == pytest.approx(0.75 * weight, rel=1e-6)
    assert support.walls == pytest.approx(0.25 * weight, rel=1e-6)
    assert support.static == pytest.approx(weight, rel=1e-6)
    assert support.contacts_per_rock == 0.0


def test_gradation_errors_are_standard_errors(shapes):
    rocks = RocksConfig()
    scores = []
    for seed in range(40):
        pile = sample_rocks(800, rocks, shapes, np.random.default_rng(seed))
        for item in calc_gradation(pile, shapes, rocks):
            scores.append((item["share"] - item["wanted"]) / item["standard_error"])
    assert np.std(scores) == pytest.approx(1.0, abs=0.2)


def test_summary_of_a_pile_too_small_for_most(heap, shapes):
    summary = calc_summary(heap, shapes, RocksConfig(), make_site(SiteConfig()), 0.01)
    assert summary["rocks"] == 12
    assert summary["static_rocks"] == 0
    assert summary["packing"] is None
    assert "carried_by_floor" not in summary
    none = calc_summary(heap.select(np.zeros(12, bool)), shapes, RocksConfig(), make_site(SiteConfig()), 0.01)
    assert none["rocks"] == 0
