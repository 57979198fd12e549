"""Rocks that run out of a slot: the law of Beverloo, in its form for a slot, W ~ (D - k d)^(3/2)."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drakerock.rocks.config import RocksConfig, SiteConfig
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.engine import NonsmoothEngine
from drakerock.rocks.site import ConvexPiece, Plane, Site, make_surroundings
from drakerock.rocks.state import PileState

D = 0.1  # sieve width of the rocks [m]
HALF_LENGTH, HALF_WIDTH = 0.9, 0.3  # of the bin [m]
LIFT = 0.6  # of the bin's floor above that of the site [m]
DT = 0.01


def make_bin(opening: float) -> Site:
    """A bin with a slot of a width [m] across the middle of its floor; what falls through leaves the site."""
    half_slot = 0.5 * opening
    planes = tuple(
        Plane(name, np.array(normal, float), offset)
        for name, normal, offset in (
            ("left", (0, -1, 0), -HALF_WIDTH), ("right", (0, 1, 0), -HALF_WIDTH),
            ("front", (1, 0, 0), -HALF_LENGTH), ("rear", (-1, 0, 0), -HALF_LENGTH),
        )
    )  # fmt: skip
    pieces = tuple(
        ConvexPiece(name, np.array([[x, y, z] for x in xs for y in (-1.0, 1.0) for z in (LIFT - 0.3, LIFT)]))
        for name, xs in (("floor_front", (-1.2, -half_slot)), ("floor_rear", (half_slot, 1.2)))
        if opening < 2 * HALF_LENGTH
    )
    return Site(SiteConfig(), planes, pieces)


def calc_discharge(shapes, opening: float, seed: int) -> float:
    """Return the rocks' rate through the slot, while it is steady [1/s]."""
    n, rng = 1600, np.random.default_rng(seed)
    per_layer = np.array([(x, y) for x in np.arange(-0.81, 0.85, 0.135) for y in (-0.2, 0.0, 0.2)])
    p_WRs = np.array(
        [(*per_layer[k % len(per_layer)], LIFT + 0.1 + 0.14 * (k // len(per_layer))) for k in range(n)]
    )
    pile = PileState(
        p_WRs, Rotation.random(n, rng=rng).as_quat(scalar_first=True), np.zeros((n, 6)),
        rng.integers(len(shapes), size=n), np.full(n, D), np.zeros(n, bool),
    )  # fmt: skip
    arrays = None
    # Filled with the slot shut, then opened.
    for site, duration in ((make_bin(0.0), 1.2), (make_bin(opening), 2.5)):
        engine = NonsmoothEngine(
            RocksConfig(),
            shapes,
            make_surroundings(site),
            NonsmoothConfig(reduction="none"),
            DT,
            pile.shape,
            pile.size,
            pile.fixed,
        )
        arrays = engine.make_arrays(pile)
        below = []
        for _ in range(round(duration / DT)):
            arrays, _ = engine.advance(arrays)
            below.append(int((arrays.positions[:, 2] < LIFT - 0.3).sum()))
        pile = engine.make_pile(arrays)
    count = np.array(below)
    # Neither the start nor the end, when little is left above the slot.
    first, last = 0.1 * n, 0.45 * n
    steady = (count > first) & (count < last)
    time = DT * np.arange(len(count))
    return float(np.polyfit(time[steady], count[steady], 1)[0])


@pytest.mark.slow
def test_discharge_goes_with_the_slots_width_to_the_power_three_halves(shapes):
    openings = D * np.array([4.5, 5.5, 6.5, 8.0])
    # A single bin's rate scatters by a tenth, and with it the exponent by 0.3.
    rates = np.array(
        [np.mean([calc_discharge(shapes, opening, seed) for seed in range(5)]) for opening in openings]
    )
    print("openings [m]", openings, "rates [1/s]", rates)
    exponent = np.polyfit(np.log(openings - 1.4 * D), np.log(rates), 1)[0]
    print("exponent", exponent)
    assert exponent == pytest.approx(1.5, abs=0.25)
