"""Overlaps that a step is about to make: seen beforehand where they are, and mostly not made."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drakerock.rocks.config import RocksConfig
from drakerock.rocks.engine import engine as engine_module
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.vectors import rotate_rotation
from drakerock.rocks.shapes import load_rock_shapes
from rock_helpers import draw_quaternion, make_box, make_engine, make_pile

SHAPES = load_rock_shapes(RocksConfig())
VECTORS = st.tuples(*[st.floats(-4.0, 4.0)] * 3)


@given(start=VECTORS, turn=VECTORS)
def test_a_rotation_is_turned_by_the_exponential_map(start, turn):
    r = Rotation.from_rotvec(start)
    turned = rotate_rotation(tuple(r.as_matrix().reshape(-1)), turn)
    expected = (Rotation.from_rotvec(turn) * r).as_matrix()
    np.testing.assert_allclose(np.reshape(turned, (3, 3)), expected, atol=1e-9)


@pytest.mark.parametrize("below", ["rock", "plane"])
@pytest.mark.parametrize("angle", [0.04, 0.1])
def test_the_overlap_of_a_turning_box_is_seen_beforehand(below, angle):
    """A box of 1 x 1 x 0.5 m turns by an angle on what it stands on: its edge is as deep as that says."""
    z = 2.0 if below == "rock" else 0.0
    pile = make_pile(
        [[0, 0, 1.0], [0.0 if below == "rock" else 5.0, 0, z + 0.25]], shape=[0, 1], fixed=[True, False]
    )
    config = NonsmoothConfig(reduction="none", rounding=1e-6)
    engine = make_engine(pile, [make_box(2, 2, 2), make_box(1, 1, 0.5)], config=config)
    _, report = engine.advance(engine.make_arrays(pile))
    assert report.n_loaded > 0

    detection = engine.detection

    def look_ahead(depth):
        detection.extra_speeds[:] = 0.0
        n_found = detection.find_deep_overlaps(report.n_contacts, detection.rows, velocities, depth)
        return n_found, detection.extra_speeds.copy()

    velocities = np.zeros((3, 6))
    velocities[1, 1] = angle / engine.time_step
    depth = 0.5 * np.sin(angle) + 0.25 * np.cos(angle) - 0.25
    assert look_ahead(depth + 1e-3)[0] == 0
    n_found, speeds = look_ahead(depth - 1e-3)
    assert n_found == 1
    # Speed of the farthest corner, of both bodies.
    hit = [0, 1] if below == "rock" else [1, engine.first_plane]
    np.testing.assert_allclose(speeds[hit], np.linalg.norm([0.5, 0.5, 0.25]) * velocities[1, 1], rtol=1e-4)
    assert np.count_nonzero(speeds) == 2
    # What carries no load is not looked at.
    detection.rows.values["impulse"] = 0.0
    assert look_ahead(depth - 1e-3)[0] == 0


def make_fall(seed):
    """A rock of 9 to 13 t that falls on two to five of 21 to 82 kg, which lie on nine that are fixed."""
    rng = np.random.default_rng(seed)
    n_small = rng.integers(2, 6)
    places = [[x, y] for x in (-0.6, 0.0, 0.6) for y in (-0.6, 0.0, 0.6)] + rng.uniform(-0.1, 0.1, (9, 2))
    positions, sizes = [[*place, 0.3] for place in places], [0.7] * 9
    for _ in range(n_small):
        positions.append([*rng.uniform(-0.5, 0.5, 2), 1.1])
        sizes.append(rng.choice([0.25, 0.3, 0.35]))
    for k in range(9, len(positions)):
        for below in positions[9:k]:
            if np.linalg.norm(np.subtract(positions[k], below)) < 0.4:
                positions[k][2] = below[2] + 0.42
    positions.append([*rng.uniform(-0.2, 0.2, 2), max(z for _, _, z in positions) + 1.6])
    n = len(positions)
    velocities = np.zeros((n, 6))
    velocities[-1, 5] = -rng.uniform(0.0, 2.0)
    pile = make_pile(
        positions,
        shape=rng.integers(0, 6, n),
        size=[*sizes, 1.9],
        quaternions=[draw_quaternion(rng) for _ in range(n)],
        fixed=np.arange(n) < 9,
    )
    return replace(pile, V_WRs=velocities)


def calc_deepest(seed):
    pile = make_fall(seed)
    engine = make_engine(pile, SHAPES, config=NonsmoothConfig(reduction="none", max_residual=1e9))
    arrays, depths, n_redone = engine.make_arrays(pile), [], 0
    for _ in range(100):
        arrays, report = engine.advance(arrays)
        depths.append(report.max_penetration)
        assert report.n_deep == 0 or report.redone
        assert report.redone <= report.flagged
        n_redone += report.redone
    return max(depths), n_redone


def test_rocks_that_are_spun_by_what_falls_on_them_do_not_end_up_in_each_other(monkeypatch):
    """Of the first 400 falls 34 go deeper than 40 mm without looking ahead, 7 with it; these are some of the former."""
    seeds = (1, 28, 35, 45, 58, 63, 73, 80, 104, 134, 142, 149)
    with_them = [calc_deepest(seed) for seed in seeds]
    monkeypatch.setattr(engine_module, "DEEPENED_SHARE", np.inf)
    without = [calc_deepest(seed) for seed in seeds]
    assert all(n_redone == 0 for _, n_redone in without)
    assert all(n_redone > 0 for _, n_redone in with_them)
    # Falls are chaotic: single ones differ from machine to machine.
    bound = NonsmoothConfig().max_penetration
    n_deep, n_deep_without = (sum(depth > bound for depth, _ in runs) for runs in (with_them, without))
    assert n_deep_without >= 8
    assert n_deep <= n_deep_without // 3
