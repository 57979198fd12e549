from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.math import RigidTransform, RollPitchYaw

from drakerock.loading.config import PerformanceConfig
from drakerock.loading.performance import (
    Weighing,
    calc_damage,
    find_bucket_load,
    find_debris,
    find_events,
    find_lost,
    find_weighing_events,
)
from drakerock.rocks.config import SiteConfig

CONFIG = PerformanceConfig()
TAU_C = 145e3
PARTS = ("front_unit", "rear_unit", "bucket")


@given(moment=st.floats(0, 1e6), start=st.floats(0, 4), length=st.floats(0.5, 5))
def test_damage_of_a_constant_moment(moment, start, length):
    time = np.arange(0, 12, 0.01)
    start, end = round(start, 2), round(start + length, 2)
    expected = max(moment - TAU_C, 0) / TAU_C * (end - start) / CONFIG.t_char
    damage = calc_damage(time, np.full_like(time, moment), start, end, TAU_C, CONFIG.t_char)
    assert damage == pytest.approx(expected, rel=0.03, abs=1e-12)


def test_damage_counts_only_the_excess_inside_the_window():
    time = np.arange(0, 10, 0.01)
    moment = np.where((time > 3) & (time < 4), 3 * TAU_C, 0.9 * TAU_C)
    assert calc_damage(time, moment, 0, 10, TAU_C, CONFIG.t_char) == pytest.approx(2 * 0.99 / 12, rel=0.02)
    assert calc_damage(time, moment, 5, 10, TAU_C, CONFIG.t_char) == 0.0


def test_load_is_what_lies_in_the_bucket_at_any_pose(heap, digger):
    bucket = digger.bucket
    inside = np.array([0.9, 0.0, 0.1])
    outside = [[0.9, 2.0, 0.1], [-0.8, 0, 0], [0.9, 0, -0.9], [3.5, 0, 0]]
    p_BRs = np.array([inside, *outside])
    pile = replace(heap.select(np.arange(5)), p_WRs=p_BRs)
    for pose in (
        RigidTransform(),
        RigidTransform(RollPitchYaw(0.1, -0.9, 0.3), [-5.0, 1.0, 2.0]),
    ):
        placed = replace(pile, p_WRs=pose.multiply(np.asfortranarray(p_BRs.T)).T)
        assert list(find_bucket_load(placed, bucket, pose)) == [True, False, False, False, False]


def test_debris_is_what_touches_neither_pile_nor_bucket(heap, shapes):
    # A heap of touching rocks: every rock overlaps its neighbour, so the graph is one body.
    n = len(heap)
    row = replace(heap, p_WRs=np.column_stack([-0.25 * np.arange(n), np.zeros(n), np.full(n, 0.15)]))
    none = np.zeros(n, bool)
    assert not find_debris(row, shapes, none, 0.005).any()
    apart = row.p_WRs.copy()
    apart[-1, 0] -= 3.0
    scattered = replace(row, p_WRs=apart)
    assert list(np.flatnonzero(find_debris(scattered, shapes, none, 0.005))) == [n - 1]
    # In the bucket it is no debris; a rock that only the bucket's load connects to the pile is.
    load = none.copy()
    load[n - 1] = True
    assert not find_debris(scattered, shapes, load, 0.005).any()
    cut = none.copy()
    cut[n - 3] = True
    assert list(np.flatnonzero(find_debris(row, shapes, cut, 0.005))) == [n - 2, n - 1]


def test_a_body_with_a_fixed_rock_is_pile_however_small(heap, shapes):
    n = len(heap)
    p_WRs = np.column_stack([-0.25 * np.arange(n), np.zeros(n), np.full(n, 0.15)])
    p_WRs[-1, 0] -= 3.0
    fixed = np.zeros(n, bool)
    fixed[-1] = True
    pile = replace(heap, p_WRs=p_WRs, fixed=fixed)
    assert not find_debris(pile, shapes, np.zeros(n, bool), 0.005).any()


def test_rocks_out_of_the_site_are_lost(heap):
    p_WRs = heap.p_WRs.copy()
    p_WRs[0], p_WRs[1], p_WRs[2], p_WRs[3] = [-1, 4, 1], [-1, 0, -3], [9, 0, 1], [-50, 0, 1]
    assert list(np.flatnonzero(find_lost(replace(heap, p_WRs=p_WRs), SiteConfig()))) == [0, 1, 2, 3]


def test_events_have_times_and_do_not_count_turns():
    time = np.arange(0, 10, 0.01)
    told = np.where(time < 5, 1.3, -1.3)
    speed = np.where((time > 2) & (time < 3), 0.0, told)
    slip = np.where((time > 6) & (time < 6.5), 1.2, 0.0)
    signals = {
        "time": time,
        "mode": np.full_like(time, 1.0),
        "target_wheel_rate": told,
        "v_F": np.where(np.abs(time - 5) < 0.05, 0.0, speed),
        "wheel_slip": slip,
        "wall_force": np.zeros_like(time),
        "wall_part": np.full_like(time, -1.0),
    }
    events = find_events(
        signals, np.array([0, 0, 1.0, 0, 0]), np.array([0, 1, 4, 5, 6.0]), CONFIG, 1.3, PARTS
    )
    assert [item["event"] for item in events] == ["stall", "timeout", "slip"]
    assert events[0]["time_s"] == pytest.approx(2.01)
    assert events[0]["duration_s"] == pytest.approx(0.99, abs=0.02)
    assert events[1]["waypoint"] == "s2"


def test_wall_contacts_are_events_with_part_and_largest_force():
    time = np.arange(0, 10, 0.01)
    force, part = np.zeros_like(time), np.full_like(time, -1.0)
    # Rear unit twice with 0.2 s between, one event; the bucket two seconds later, another.
    for start, end, who, size in ((2.0, 3.0, 1, 4e4), (3.2, 3.5, 1, 9e4), (5.5, 5.6, 2, 1e4)):
        inside = (time > start - 0.005) & (time < end - 0.005)
        force[inside], part[inside] = size, who
    signals = {
        "time": time,
        "mode": np.full_like(time, 1.0),
        "target_wheel_rate": np.zeros_like(time),
        "v_F": np.ones_like(time),
        "wheel_slip": np.zeros_like(time),
        "wall_force": force,
        "wall_part": part,
    }
    events = find_events(signals, np.zeros(5), np.arange(5.0), CONFIG, 1.3, PARTS)
    assert [item["event"] for item in events] == ["wall contact", "wall contact"]
    assert [item["part"] for item in events] == ["rear_unit", "bucket"]
    assert [item["force_N"] for item in events] == [9e4, 1e4]
    assert [item["time_s"] for item in events] == pytest.approx([2.0, 5.5])
    assert [item["duration_s"] for item in events] == pytest.approx([1.5, 0.1])


@pytest.mark.parametrize(
    ("weight", "on_bucket", "cause"),
    [
        (5900, 5890, None),
        (3000, 3010, "the pile holds up part of the load"),
        (6400, 6390, "rocks that are not in the bucket bear on it"),
        (6400, 6005, "rocks bear on other parts of the machine than the bucket"),
    ],
)
def test_weight_that_differs_from_the_counted_load_is_an_event_with_its_cause(weight, on_bucket, cause):
    weighing = Weighing(time_s=20.0, weight_kg=weight, on_bucket_kg=on_bucket, counted_kg=6000.0)
    events = find_weighing_events(weighing, load=6000.0, tolerance=150.0)
    if cause is None:
        assert events == []
        return
    assert [item["event"] for item in events] == ["load and weight differ"]
    assert events[0]["cause"] == cause
    assert events[0]["difference_kg"] == 6000.0 - weight
    assert events[0]["time_s"] == 20.0


def test_a_rock_that_falls_off_after_s4_is_an_event():
    weighing = Weighing(time_s=20.0, weight_kg=5990.0, on_bucket_kg=5990.0, counted_kg=6000.0)
    (event,) = find_weighing_events(weighing, load=6122.0, tolerance=150.0)
    assert event["event"] == "load changed after s4"
    assert event["mass_kg"] == -122.0
