"""Broad phase, contact cache, solve, sleeping and failures of the nonsmooth engine, each alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.solvers import ClarabelSolver, MathematicalProgram
from pydrake.systems.analysis import Simulator
from scipy.spatial.transform import Rotation

from drakerock.errors import InputError, SimulationFailure
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.drake.interface import ROCK_SUMMARY
from drakerock.rocks.engine import contact_cache, sleeping
from drakerock.rocks.engine import engine as engine_module
from drakerock.rocks.engine.collision import gjk
from drakerock.rocks.engine.collision.blocks import make_blocks, update_blocks
from drakerock.rocks.engine.config import NonsmoothConfig, RestConfig
from drakerock.rocks.engine.engine import DEEP_SHARE, MachinePiece, MachineStep, make_machineless_step
from drakerock.rocks.engine.records import (
    AWAKE,
    BODY,
    LOST,
    NEW,
    SEARCHED,
    SENSOR,
    SLEEP,
    SLEEPING,
    as_records,
)
from drakerock.rocks.engine.solve.rows import KEY_STEP, make_contact_rows
from drakerock.rocks.engine.solve.spin_damping import damp_spin
from drakerock.rocks.engine.vectors import rotate_quaternion
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.state import load_pile, save_pile
from rock_helpers import (
    draw_quaternion,
    make_ball,
    make_box,
    make_engine,
    make_machine_step,
    make_pile,
    make_plane_site,
    make_rock_diagram,
    make_shape,
    run,
)

SHAPES = load_rock_shapes(RocksConfig())


def draw_pile(seed, n, box=2.0, sizes=(0.3, 0.4, 0.6, 0.8)):
    rng = np.random.default_rng(seed)
    return make_pile(
        rng.uniform([-box, -box, 0.3], [box, box, box], (n, 3)),
        shape=rng.integers(0, 6, n),
        size=rng.choice(sizes, n),
        quaternions=[draw_quaternion(rng) for _ in range(n)],
        velocities=rng.normal(size=(n, 6)),
    )


@pytest.mark.parametrize("seed", range(5))
def test_broad_phase_finds_every_pair_of_boxes_that_meet(seed):
    pile = draw_pile(seed, 120)
    engine = make_engine(pile, SHAPES, make_plane_site(planes=5))
    arrays = engine.make_arrays(pile)
    rng = np.random.default_rng(seed)
    status = np.where(rng.random(len(pile)) < 0.4, SLEEPING, AWAKE)
    state, detection = (arrays.quaternions, arrays.positions), engine.detection
    detection.modes[: len(pile)] = SEARCHED
    stale, machine = detection.find_stale(np.arange(len(pile)), *state), make_machineless_step()
    awake = np.flatnonzero(status == AWAKE)
    detection.update_poses(stale, awake, *state, arrays.velocities, machine.X_WBs, np.zeros((0, 6)), 0.005)
    n_pairs = detection.find_pairs(awake, arrays.sleep)
    found = [(int(a), int(b)) for a, b in np.transpose(detection.pairs)[:n_pairs]]
    assert len(found) == len(set(found))
    lower, upper = detection.boxes
    expected = {
        (i, j)
        for i in range(len(pile))
        for j in range(i + 1, len(pile))
        if (lower[i] < upper[j]).all() and (upper[i] > lower[j]).all() and (status[i] == 0 or status[j] == 0)
    }
    assert {pair for pair in found if pair[1] < len(pile)} == expected
    # the boxes hold the rocks
    for i in range(len(pile)):
        r = Rotation.from_quat(arrays.quaternions[i], scalar_first=True)
        corners = r.apply(SHAPES[pile.shape[i]].vertices * pile.size[i]) + pile.p_WRs[i]
        assert (corners > lower[i] - 0.01 * pile.size[i]).all()
        assert (corners < upper[i] + 0.01 * pile.size[i]).all()


def test_frictionless_contacts_agree_with_a_quadratic_program():
    """Normal impulses of a cluster of balls between walls: least kinetic energy under the gaps' constraints."""
    rng = np.random.default_rng(0)
    n = 12
    pile = make_pile(
        rng.uniform([-0.6, -0.6, 0.5], [0.6, 0.6, 1.6], (n, 3)) * 1.0,
        size=rng.uniform(0.4, 0.6, n),
        velocities=np.hstack([np.zeros((n, 3)), rng.normal(size=(n, 3))]),
    )
    # stiff, undamped by design: iterations to convergence
    engine = make_engine(
        pile, [make_ball()], make_plane_site(1e-9), RocksConfig(friction=1e-9),
        NonsmoothConfig(reduction="none", iterations=2000, max_residual=1e9, impact_threshold=1e-9),
    )  # fmt: skip
    arrays = engine.make_arrays(pile)
    new, report = engine.step(arrays, make_machineless_step())
    assert report.n_loaded >= 4
    rows = engine.detection.rows.values[: report.n_contacts]
    # v minimises 1/2 (v - v_free)^T M (v - v_free) with G v >= bias, translations and rotations
    program = MathematicalProgram()
    v = program.NewContinuousVariables(6 * n)
    mass = np.zeros((6 * n, 6 * n))
    free = pile.V_WRs.copy()
    free[:, 5] -= 9.81 * engine.time_step
    for i in range(n):
        inverse = engine.detection.inverse_inertia[i]
        inertia = np.linalg.inv(
            [
                [inverse[0], inverse[1], inverse[2]],
                [inverse[1], inverse[3], inverse[4]],
                [inverse[2], inverse[4], inverse[5]],
            ]
        )
        mass[6 * i : 6 * i + 3, 6 * i : 6 * i + 3] = inertia
        mass[6 * i + 3 : 6 * i + 6, 6 * i + 3 : 6 * i + 6] = engine.mass[i] * np.eye(3)
    program.AddQuadraticCost(mass, -mass @ free.reshape(-1), v, is_convex=True)
    for k in range(len(rows)):
        g = np.zeros(6 * n)
        a, b, row = engine.detection.rows.body_a[k], engine.detection.rows.body_b[k], rows[k]
        g[6 * a : 6 * a + 6] = -np.concatenate([np.cross(row["arm_a"], row["normal"]), row["normal"]])
        if b < n:
            g[6 * b : 6 * b + 6] += np.concatenate([np.cross(row["arm_b"], row["normal"]), row["normal"]])
        program.AddLinearConstraint(g[None], [row["bias"]], [np.inf], v)
        assert row["gap"] > 0 or row["compliance"] < 1e-3
    expected = ClarabelSolver().Solve(program).GetSolution(v).reshape(n, 6)
    np.testing.assert_allclose(new.velocities[:, 3:], expected[:, 3:], atol=5e-3)


def test_cached_contacts_are_found_again():
    """A box at rest: the second step starts from the first one's impulses."""
    pile = make_pile([[0, 0, 0.25]])
    # Acceleration rings on in single precision: 3e-5 of the weight across it.
    engine = make_engine(
        pile, [make_box(0.8, 0.6, 0.5)], config=NonsmoothConfig(reduction="none", momentum=0.0)
    )
    arrays, _ = run(engine, engine.make_arrays(pile), 0.5)
    assert len(arrays.cache.pairs) == 4
    sums = np.zeros((1, 3))
    contact_cache.sum_impulses(arrays.cache, 1, sums)
    np.testing.assert_allclose(sums[0], [0, 0, engine.mass[0] * 9.81 * 0.01], rtol=1e-6, atol=1e-6)
    table = np.zeros(128, np.int64)
    stirs, active = np.ones(1, np.bool_), np.zeros(8, np.int64)
    assert contact_cache.index_cache(arrays.cache, 0, 1, stirs, active, table) == (64, 4)
    table = table[:64]
    key = contact_cache.read_key(arrays.cache, 0)
    assert contact_cache.find_in_cache(key, arrays.cache, table) == 0
    assert contact_cache.count_points(key, arrays.cache, 0) == 4
    assert contact_cache.find_in_cache(key + 1, arrays.cache, table) == -1
    # pairs without an awake rock are not searched
    assert contact_cache.index_cache(arrays.cache, 0, 1, ~stirs, active, table) == (64, 0)
    assert contact_cache.find_in_cache(key, arrays.cache, table) == -1


def settle(n=25, seed=0):
    rng = np.random.default_rng(seed)
    pile = make_pile(
        rng.uniform([-0.5, -0.5, 0.3], [0.5, 0.5, 4.0], (n, 3)),
        shape=rng.integers(0, 6, n),
        size=rng.choice([0.3, 0.4], n),
        quaternions=[draw_quaternion(rng) for _ in range(n)],
    )
    engine = make_engine(pile, SHAPES, config=NonsmoothConfig(), site=make_plane_site(planes=5))
    # Half a second after all that have moved were woken together.
    arrays, _ = run(engine, engine.make_arrays(pile), 4.5)
    return engine, arrays


def test_a_stored_pile_starts_warm(tmp_path):
    engine, arrays = settle(seed=1)
    pile = engine.make_pile(arrays)
    save_pile(pile, tmp_path / "pile.npz")
    loaded = load_pile(tmp_path / "pile.npz")
    again = engine.make_arrays(loaded)
    for name in ("positions", "quaternions", "velocities"):
        assert np.array_equal(getattr(arrays, name), getattr(again, name))
    loaded_points = arrays.cache.points["impulse"].any(axis=1)
    assert len(again.cache.pairs) == loaded_points.sum()
    # A pile keeps contact points and impulses in single precision, in memory as in the file: what was stored goes on
    # like what was not, bit for bit.
    kept = engine.make_arrays(pile)
    for one, other in zip(again.cache, kept.cache, strict=True):
        assert np.array_equal(one, other)
    # Where searches ended is not stored.
    stored = arrays.cache.select(loaded_points)
    assert np.array_equal(again.cache.pairs, stored.pairs)
    for name in ("point", "impulse"):
        assert np.allclose(again.cache.points[name], stored.points[name], rtol=1e-6, atol=1e-6)
    # all awake, it stays where it is; without the contacts it sinks and jumps more
    moved = {}
    for name, start in (("warm", loaded), ("cold", replace(loaded, contacts=None))):
        config = NonsmoothConfig(reduction="none", iterations=3, max_residual=1e9)
        awake = make_engine(start, SHAPES, make_plane_site(planes=5), config=config)
        one, _ = awake.advance(awake.make_arrays(start))
        moved[name] = np.abs(one.velocities[:, 3:]).max()
    assert moved["warm"] < 0.5 * moved["cold"]


def test_contacts_follow_the_rocks_they_belong_to():
    engine, arrays = settle()
    pile = engine.make_pile(arrays)
    order = np.arange(5, len(pile))
    part = pile.select(order)
    kept = (pile.contacts.pairs[:, 0] >= 5) & (
        (pile.contacts.pairs[:, 1] >= 5) | (pile.contacts.pairs[:, 1] < 0)
    )
    assert len(part.contacts.pairs) == kept.sum()
    both = part.join(pile.select(np.arange(5)))
    assert len(both) == len(pile)
    assert both.contacts.pairs.max() < len(pile)
    np.testing.assert_allclose(both.contacts.impulses[: kept.sum()], pile.contacts.impulses[kept])
    with pytest.raises(ValueError, match="not in the pile"):
        replace(pile, contacts=replace(pile.contacts, pairs=pile.contacts.pairs + len(pile)))


def test_rocks_rest_keep_their_forces_and_wake_when_their_load_changes():
    engine, arrays = settle()
    status = arrays.status
    assert (status == SLEEPING).mean() > 0.8
    before = _list_points(arrays.cache)
    after, _ = run(engine, arrays, 0.2)
    both_rest = [row for row in before if _rests(row, status, engine.n_rocks)]
    kept = set(_list_points(after.cache))
    assert both_rest
    assert kept.issuperset(both_rest)
    # a heavy rock dropped on the heap wakes what it lands on
    top = int(np.argmax(after.positions[:, 2]))
    heavy = engine.place(
        after, np.array([top]), after.positions[[top]] + [[0, 0, 1.0]], np.array([[0, 0, 0, 0, 0, -6.0]])
    )
    woken = 0
    for _ in range(60):
        heavy, report = engine.advance(heavy)
        woken += report.n_woken
    assert woken >= 2


def _list_points(cache):
    return [(*pair, point.tobytes()) for pair, point in zip(*cache, strict=True)]


def _rests(row, status, n):
    a, b = row[:2]
    return status[a] == SLEEPING and (b >= n or status[b] == SLEEPING)


def test_contacts_of_slow_rocks_follow_their_motion():
    """A heap nudged to millimetres a second: what steps without a search make of the gaps is what a search finds."""
    engine, arrays = settle(n=60, seed=2)
    rng = np.random.default_rng(0)
    arrays.sleep["status"] = AWAKE
    arrays.velocities[:, 3:] += rng.uniform(-4e-3, 4e-3, (engine.n_rocks, 3))
    arrays.sleep["way"] = np.inf
    engine.config = NonsmoothConfig(reduction="none")
    searched = []
    for _ in range(4):
        arrays, report = engine.advance(arrays)
        searched.append(report.n_distances)
    assert searched[0] > 20
    assert searched[1:] == [0, 0, 0]
    engine.config = NonsmoothConfig(reduction="none", search_period=1)
    _, report = engine.advance(arrays)
    rows, cache = engine.detection.rows, arrays.cache
    keys, gaps = rows.key[: report.n_contacts], rows.values["gap"][: report.n_contacts]
    cached_keys = np.array([contact_cache.read_key(cache, row) for row in range(len(cache.pairs))])
    pairs = np.intersect1d(keys, cached_keys)
    assert len(pairs) > 60
    found = [gaps[keys == key].min() for key in pairs]
    followed = [cache.points["gap"][cached_keys == key].min() for key in pairs]
    np.testing.assert_allclose(followed, found, atol=2e-5)


@pytest.mark.parametrize(
    ("speed", "searches"),
    [(0.001, 1), (0.01, 11), (0.019, 20), (0.05, 17)],
    ids=["slow: every millimetre", "ten times as fast", "every fifth step", "fast: every sixth step"],
)
def test_how_often_rocks_that_move_together_are_searched(speed, searches):
    pile = make_pile([[0, 0, 2.0], [0.5005, 0, 2.0]], velocities=[[0, 0, 0, speed, 0, 0]] * 2)
    engine = make_engine(
        pile, [make_box(0.5, 0.5, 0.5)], config=NonsmoothConfig(reduction="none"), gravity=np.zeros(3)
    )
    arrays, n_searches = engine.make_arrays(pile), 0
    for _ in range(100):
        arrays, report = engine.advance(arrays)
        n_searches += report.n_distances > 0
        assert report.n_contacts == 4
    assert n_searches == pytest.approx(searches, abs=1)


def test_a_rock_that_strikes_is_searched_at_once():
    """Between two searches of the slow ones, a fast rock finds what it hits, and sinks in no deeper than ever."""
    depths = {}
    for period in (1, 20):
        pile = make_pile([[0, 0, 0.25], [0, 0, 1.2]], velocities=[[0] * 6, [0, 0, 0, 0, 0, -5.0]])
        config = NonsmoothConfig(reduction="none", search_period=period)
        engine = make_engine(pile, [make_box(0.5, 0.5, 0.5)], config=config)
        arrays, depth = engine.make_arrays(pile), 0.0
        for _ in range(60):
            arrays, report = engine.advance(arrays)
            depth = max(depth, report.max_penetration)
        depths[period] = depth
        assert arrays.positions[1, 2] == pytest.approx(0.75, abs=5e-3)
    assert depths[20] < max(1.1 * depths[1], 2e-3)


def test_a_step_into_given_room_is_the_same_step():
    engine, arrays = settle()
    arrays.velocities[:, 5] += 0.2
    arrays.sleep["status"] = np.where(np.arange(engine.n_rocks) % 3 > 0, AWAKE, SLEEPING)
    arrays.velocities[::3] = 0.0
    groups = {name: value for name, value in vars(arrays).items() if isinstance(value, np.ndarray)}
    before = replace(arrays, **{name: value.copy() for name, value in groups.items()})
    room = engine.make_room()
    for name in groups:
        getattr(room, name).view(float)[:] = np.nan
    expected, _ = engine.advance(arrays)
    result, report = engine.step(arrays, make_machineless_step(), room)
    still = np.setdiff1d(np.arange(engine.n_rocks), report.awake)
    assert len(still) > 0
    assert result.steps == expected.steps == arrays.steps + 1
    for name in groups:
        value, whole = getattr(result, name), getattr(expected, name)
        if name in ("quaternions", "positions", "velocities"):
            # What did not move is not written.
            assert np.array_equal(value[report.awake], whole[report.awake])
            assert np.isnan(value[still]).all()
            assert np.array_equal(getattr(arrays, name)[still], whole[still])
        else:
            assert np.array_equal(value[report.stirred], whole[report.stirred]), name
            others = np.setdiff1d(still, report.stirred)
            assert np.array_equal(getattr(arrays, name)[others], whole[others])
        assert np.shares_memory(value, getattr(room, name))
        assert np.array_equal(getattr(arrays, name), getattr(before, name))


def wake_by_and_by(engine, arrays, woken):
    """Yield the states of steps that begin with each of the rocks `woken` shoved in turn, and the reports."""
    for rock in woken:
        sleeping.wake_rock(rock, arrays.positions, arrays.sleep)
        arrays.velocities[rock, 5] = 0.02
        arrays, report = engine.advance(arrays)
        yield arrays, report


def is_gap(arrays):
    return arrays.cache.pairs[:, 0] < 0


def settle_at_rest():
    """Return 200 rocks that have fallen asleep, their contacts in the cache, and their engine."""
    engine, arrays = settle(200)
    arrays.sleep["status"], arrays.sleep["changed_steps"] = SLEEPING, NEW
    arrays.velocities[:] = 0.0
    arrays, _ = engine.advance(arrays)
    assert arrays.n_sleeping == len(arrays.cache.pairs) > 200
    return engine, arrays


def test_contacts_of_sleeping_rocks_stay_in_their_place_and_gaps_change_nothing():
    engine, arrays = settle_at_rest()
    n_gaps = [0]
    for new, report in wake_by_and_by(engine, arrays, range(0, 200, 5)):
        gaps = is_gap(arrays)
        closed = replace(
            arrays, cache=arrays.cache.select(~gaps), n_sleeping=int((~gaps[: arrays.n_sleeping]).sum())
        )
        expected, _ = engine.advance(closed)
        for name in ("positions", "quaternions", "velocities", "sleep"):
            assert np.array_equal(getattr(new, name), getattr(expected, name)), name
        for found, whole in zip(new.cache.select(~is_gap(new)), expected.cache, strict=True):
            assert np.array_equal(found, whole[expected.cache.pairs[:, 0] >= 0])
        assert np.array_equal(
            engine.make_pile(new).contacts.impulses, engine.make_pile(expected).contacts.impulses
        )
        kept = np.setdiff1d(np.arange(report.n_kept), report.freed)
        assert np.array_equal(new.cache.pairs[kept], arrays.cache.pairs[kept])
        assert is_gap(new)[report.freed].all()
        assert not is_gap(new)[new.n_sleeping :].any()
        n_gaps.append(int(is_gap(new).sum()))
        assert n_gaps[-1] <= new.n_sleeping / contact_cache.MAX_GAPS
        arrays = new
    # They become more, are closed, and become more again.
    assert max(n_gaps) > 5
    assert (np.diff(n_gaps) < -5).any()


def test_a_refreshed_room_is_as_good_as_a_copy_of_the_whole_state():
    engine, arrays = settle_at_rest()
    woken = np.arange(0, 200, 20)
    sleeping.wake_rocks(woken, arrays.positions, arrays.sleep)
    arrays.velocities[woken, 5] = 0.02
    still, rooms = make_machineless_step(), [engine.make_room(), engine.make_room()]
    for room in rooms:
        engine.copy_to(arrays, room)
    new, report = engine.step(arrays, still, rooms[0])
    n_stopped = 0
    for _ in range(120):
        n_stopped += report.n_asleep
        whole = engine.make_room()
        engine.copy_to(new, whole)
        expected, _ = engine.step(new, still, whole)
        # The room of the state before.
        engine.refresh_room(new, report, rooms[1])
        new, report = engine.step(new, still, rooms[1])
        assert_same_state(new, expected)
        rooms.reverse()
    assert n_stopped > 5


def make_rooms(engine, arrays):
    """Return two rooms for the steps after a state, by turns, as the rocks' system keeps them."""
    rooms = [engine.make_room(), engine.make_room()]
    for room in rooms:
        engine.copy_to(arrays, room)
    return rooms


def step_in_rooms(engine, rooms, state, machine):
    """Step into the room that is ready, its index known, and make the other one ready; return state and report."""
    new, report = engine.step(state, machine, rooms[0])
    engine.refresh_room(new, report, rooms[1])
    rooms.reverse()
    return new, report


def assert_same_state(one, other):
    for name in ("positions", "quaternions", "velocities", "sleep"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    full = ~is_gap(other)
    assert np.array_equal(is_gap(one), ~full)
    for found, whole in zip(one.cache, other.cache, strict=True):
        assert np.array_equal(found[full], whole[full])


def test_what_is_known_of_a_state_changes_nothing():
    """A sleeping heap that rocks fall on, one of which leaves the site, and a sensor that comes near.

    Two states by turns in one engine, each stepped in its rooms with its index, and by another engine that looks at all
    rocks in every step.
    """
    engine, arrays = settle_at_rest()
    pile = engine.make_pile(arrays)
    other = make_engine(pile, SHAPES, make_plane_site(planes=5), config=engine.config)
    top = np.argsort(pile.p_WRs[:, 2])[-6:]
    V_WRs = np.zeros((6, 6))
    V_WRs[:, 3:] = [0.0, 0.0, -4.0]
    V_WRs[-1, 3:] = [0.0, 0.0, 4000.0]  # the topmost, which meets none on its way
    thrown = engine.place(arrays, top, pile.p_WRs[top] + [0.0, 0.0, 1.0], V_WRs)
    machine = make_machineless_step()
    states = [(make_rooms(engine, state), state) for state in (thrown, arrays)]
    expected = [thrown, arrays]
    seen = np.zeros(4)
    for k in range(60):
        box = np.concatenate([np.eye(3).reshape(-1), [2.5 - 0.05 * k, 0.0, 0.0], [-0.3] * 3, [0.3] * 3])
        machine = replace(machine, sensors=box[None]) if k >= 20 else machine
        for number in range(2) if k % 3 < 2 else (0,):
            rooms, state = states[number]
            state, report = step_in_rooms(engine, rooms, state, machine)
            states[number] = rooms, state
            expected[number], whole = other.step(expected[number], machine)
            assert_same_state(state, expected[number])
            for name in ("n_woken", "n_asleep", "n_lost", "n_contacts", "residual"):
                assert getattr(report, name) == getattr(whole, name), name
            seen += [report.n_woken, report.n_asleep, report.n_lost, len(report.freed)]
    assert (seen > [20, 20, 0, 20]).all()


def test_two_contexts_keep_their_solutions_apart():
    """The solution of a context is not lost when that of its clone is found."""
    pile = draw_pile(3, 20)
    diagram, system = make_rock_diagram(pile, SHAPES, make_plane_site(planes=5))
    one = diagram.CreateDefaultContext()
    first = system.get_report(one)
    other = one.Clone()
    shifted = replace(pile, p_WRs=pile.p_WRs + [0.0, 0.0, 1.0])
    system.set_pile(other, shifted)
    assert system.get_report(other) != first
    simulator = Simulator(diagram, one)
    simulator.AdvanceTo(0.01)
    expected, _ = run(system.engine, system.engine.make_arrays(pile), 0.01)
    assert np.array_equal(system.get_pile(simulator.get_context()).p_WRs, expected.positions)


def test_the_cache_keeps_keys_and_simplices_whole():
    """A simplex takes two numbers of single precision; the largest ones have to come back."""
    cache, rows = contact_cache.make_contact_cache(1), make_contact_rows(1)
    corners = np.array([[127, 126], [125, 127], [127, 127]])
    rows.values["impulse"][0, 0], rows.values["simplex"] = 1.0, gjk.encode_simplex(corners, 3)
    rock = KEY_STEP - 2
    rows.key[0] = key = rock * KEY_STEP + KEY_STEP - 1
    rotations = np.zeros((KEY_STEP, 3, 3))
    rotations[rock] = np.eye(3)
    empty = np.zeros(0, np.int64)
    index, old = contact_cache.CacheIndex(empty, empty, 0, 0), contact_cache.make_contact_cache(0)
    velocities = np.zeros((KEY_STEP, 6))
    written = contact_cache.write_cache(0, old, 0, index, 1, rows, rotations, velocities, 0.01, 0.0, cache)
    assert written == (1, 0, 0, 0)
    assert contact_cache.read_key(cache, 0) == key
    found = np.zeros((3, 2), np.int64)
    assert gjk.decode_simplex(contact_cache.read_simplex(cache.points[0]), found) == 3
    assert np.array_equal(found, corners)


def test_without_reduction_nothing_rests():
    engine, arrays = settle()
    assert (arrays.status == SLEEPING).any()
    engine.config = NonsmoothConfig(reduction="none")
    after, report = engine.advance(arrays)
    assert report.n_awake == engine.n_rocks
    assert not after.status.any()


def wake(positions, mass, cache, n_sleeping, by_movers, thresholds, sleep):
    """Wake rocks by their loads; return their number."""
    n = len(sleep)
    places, touched, woken = (np.zeros(n, np.int64) for _ in range(3))
    unsettled = np.flatnonzero((sleep["status"] == SLEEPING) & (sleep["changed_steps"] != 0.0))
    n_touched, n_all = sleeping.find_touched(cache, n_sleeping, unsettled, sleep, places, touched)
    n_woken = sleeping.find_woken(
        n_touched, touched[:n_all], mass, cache, by_movers, thresholds, places, sleep, woken
    )
    assert not places.any()
    sleeping.wake_rocks(woken[:n_woken], positions, sleep)
    return n_woken


def make_thresholds(load, share, near_movers, steps=1):
    return sleeping.WakeThresholds(load, share, near_movers, steps)


NOWHERE = np.zeros(0, SENSOR)


def test_the_sensor_wakes_what_is_in_its_box():
    engine, arrays = settle()
    sleep = arrays.sleep.copy()
    sleep["status"] = SLEEPING
    sums = np.zeros((len(sleep), 3))
    contact_cache.sum_impulses(arrays.cache, len(sleep), sums)
    sleep["reference"] = sums
    box = np.concatenate([np.eye(3).reshape(-1), np.zeros(3), [-10, -10, -1], [0.0, 10, 10]])
    inside = arrays.positions[:, 0] < engine.radius
    assert 0 < inside.sum() < len(inside)
    found, blocks = np.zeros(len(sleep), np.int64), make_blocks(len(sleep))
    update_blocks(np.arange(len(sleep)), arrays.positions, blocks)
    n = sleeping.find_sensed(
        arrays.positions,
        engine.radius,
        engine.radius.max(),
        as_records(box[None], SENSOR),
        blocks,
        sleep,
        found,
    )
    np.testing.assert_array_equal(found[:n], np.flatnonzero(inside))


@pytest.mark.parametrize(("size", "speed"), [(1.0, 2.0), (0.5, 2.0), (1.3, 0.7)])
def test_a_sleeping_rock_takes_a_blow_as_an_awake_one_does(size, speed):
    """A box slides on ice into another one that sleeps: both go on with the speed of a plastic impact."""
    pile = make_pile([[-2.0, 0, 0.25 * size], [0, 0, 0.25]], size=[size, 1.0])
    rocks = RocksConfig(friction=1e-9)
    box = [make_box(0.5, 0.5, 0.5)]
    engine = make_engine(pile, box, make_plane_site(1e-9), rocks, NonsmoothConfig())
    arrays, _ = run(engine, engine.make_arrays(pile), 0.5)
    assert (arrays.status == SLEEPING).all()
    velocities = np.array([[0, 0, 0, speed, 0, 0]])
    arrays = engine.place(arrays, np.array([0]), np.array([[-0.3 - 0.25 * size, 0, 0.25 * size]]), velocities)
    momentum = engine.mass[0] * speed
    n_woken = 0
    for _ in range(20):
        arrays, report = engine.advance(arrays)
        n_woken += report.n_woken
        assert engine.mass @ arrays.velocities[:, 3] == pytest.approx(momentum, rel=1e-4)
    assert n_woken == 1
    np.testing.assert_allclose(arrays.velocities[:, 3], momentum / engine.mass.sum(), rtol=0.02)


def test_rocks_that_leave_the_site_are_counted_and_taken_out():
    pile = make_pile([[0, 0, 0.25], [30.0, 0, 1.0]], velocities=[[0] * 6, [0, 0, 0, 2500.0, 0, 0]])
    engine = make_engine(pile, [make_box(0.5, 0.5, 0.5)])
    arrays, report = engine.advance(engine.make_arrays(pile))
    assert report.n_lost == 1
    assert arrays.status[1] == LOST
    assert not arrays.velocities[1].any()
    _, report = engine.advance(arrays)
    assert report.n_lost == 0
    assert report.n_awake == 1


@pytest.mark.parametrize("status", [AWAKE, SLEEPING])
def test_values_that_are_not_finite_do_not_leave_a_step(status):
    pile = make_pile([[0, 0, 0.25], [2.0, 0, 0.25]])
    engine = make_engine(pile, [make_box(0.5, 0.5, 0.5)])
    arrays = engine.make_arrays(pile)
    arrays.sleep["status"][0] = status
    arrays, _ = engine.advance(arrays)
    # The velocities of resting rocks are nowhere read.
    for group in (arrays.positions, arrays.quaternions, *[arrays.velocities] * (status == AWAKE)):
        before = group[0, 0]
        group[0, 0] = np.nan
        with pytest.raises(SimulationFailure, match="not finite"):
            engine.advance(arrays)
        group[0, 0] = before


@pytest.mark.parametrize("fails", [True, False])
def test_a_step_that_does_not_converge_is_redone_then_fails(fails):
    pile = make_pile([[0, 0, 0.25 + 0.5 * k] for k in range(20)])
    shapes = [make_box(0.8, 0.8, 0.5)]
    config = NonsmoothConfig(reduction="none", iterations=4, max_residual=1e9)
    residuals = []
    for iterations, momentum in ((4, config.momentum), (16, 0.0)):
        update = {"iterations": iterations, "momentum": momentum}
        engine = make_engine(pile, shapes, config=config.replace(**update))
        residuals.append(engine.advance(engine.make_arrays(pile))[1].residual)
    assert residuals[0] > 2 * residuals[1] > 0
    bound = 0.9 * residuals[1] if fails else 1.1 * residuals[1]
    engine = make_engine(pile, shapes, config=config.replace(max_residual=bound))
    if fails:
        with pytest.raises(SimulationFailure, match=r"did not converge: residual .* after 16 iterations"):
            engine.advance(engine.make_arrays(pile))
    else:
        _, report = engine.advance(engine.make_arrays(pile))
        assert report.redone
        assert report.flagged
        assert report.residual == residuals[1]


def test_acceleration_does_not_leave_a_sliding_rock_in_a_cycle():
    """A rock slides along another and the floor: accelerated to the last, impulses go to and fro for ever (0.4)."""
    pile = make_pile(
        [[-2.17279, -1.23646, 0.21966], [-2.51947, -0.66742, 0.2912]],
        shape=[2, 0],
        size=[0.6, 0.6],
        quaternions=[[-0.0506, 0.1475, -0.19773, -0.96778], [-0.11812, 0.28799, 0.40947, 0.85758]],
        fixed=[True, False],
    )
    velocities = np.zeros((2, 6))
    velocities[1] = [0.85403, 0.40902, -0.00076, 0.11915, -0.24943, -0.07278]
    pile = replace(pile, V_WRs=velocities)
    ends = {}
    for momentum in (0.8, 0.0):
        engine = make_engine(pile, SHAPES, config=NonsmoothConfig(reduction="none", momentum=momentum))
        arrays, report = engine.advance(engine.make_arrays(pile))
        assert report.residual < 0.05
        assert not report.redone
        ends[momentum] = arrays.velocities[1]
    np.testing.assert_allclose(ends[0.8], ends[0.0], atol=0.01)


def test_a_light_rock_between_a_heavy_one_and_the_floor_is_not_squeezed(monkeypatch):
    """A block of 18 t comes down at 1 m/s on one of 42 kg: few iterations pass on too little momentum."""
    velocities = np.zeros((2, 6))
    velocities[0, 5] = -1.0
    pile = make_pile([[0, 0, 1.25], [0, 0, 0.125]], size=[1.9, 0.25], velocities=velocities)
    shapes = [make_box(1.0, 1.0, 1.0)]
    deepest = {}
    for share, momentum in ((DEEP_SHARE, 0.0), (np.inf, 0.0), (np.inf, 0.8)):
        monkeypatch.setattr(engine_module, "DEEP_SHARE", share)
        config = NonsmoothConfig(reduction="none", iterations=50, momentum=momentum)
        engine = make_engine(pile, shapes, config=config)
        arrays = engine.make_arrays(pile)
        deepest[share, momentum] = 0.0
        for _ in range(60):
            arrays, report = engine.advance(arrays)
            deepest[share, momentum] = max(deepest[share, momentum], report.max_penetration)
    assert deepest[DEEP_SHARE, 0.0] < engine.config.max_penetration < deepest[np.inf, 0.0]
    assert deepest[np.inf, 0.8] < 0.6 * deepest[np.inf, 0.0]


def make_ram(mass: float, speed: float) -> tuple[MachinePiece, MachineStep]:
    """A plate that moves along x only."""
    plate = np.array([[x, y, z] for x in (-1.0, 0.0) for y in (-1, 1) for z in (0.0, 1.0)])
    jacobian = np.zeros((1, 6, 1))
    jacobian[0, 3, 0] = 1.0
    response = np.ascontiguousarray(jacobian.transpose(0, 2, 1) / mass)
    step = make_machine_step(np.eye(4)[None], np.array([speed]), jacobian, response)
    return MachinePiece(0, plate, 0.5), step


def push_light_rocks(speed, **settings):
    """A step in which 40 t push three rocks of 21 kg against one that is fixed."""
    piece, ram = make_ram(40e3, speed)
    width = 0.2
    x = width * (0.5 + np.arange(4))
    pile = make_pile(
        np.column_stack([x, np.zeros(4), np.full(4, 0.5 * width + 0.1)]),
        size=np.full(4, width),
        fixed=[False, False, False, True],
    )
    config = NonsmoothConfig(reduction="none", max_residual=1e9, rounding=1e-6, **settings)
    engine = make_engine(
        pile, [make_box(1, 1, 1)], config=config, gravity=np.zeros(3), pieces=[piece], n_machine_bodies=1
    )
    return engine, engine.step(engine.make_arrays(pile), ram)[1]


def test_iterations_about_the_machine_bring_its_momentum_through_light_rocks():
    left = {}
    for sweeps, iterations in ((0, 50), (3, 50), (0, 200), (0, 2000)):
        engine, report = push_light_rocks(0.3, machine_sweeps=sweeps, iterations=iterations, momentum=0.0)
        left[sweeps, iterations] = report.machine_velocity[0]
        # what the rocks got is what the machine lost, however many sweeps there were
        assert -report.F_Bs_W[0, 3] * engine.time_step == pytest.approx(
            40e3 * (0.3 - report.machine_velocity[0]), rel=1e-4
        )
    brought = {key: 0.3 - value for key, value in left.items()}
    assert brought[0, 2000] > 5.0 * brought[0, 50]
    assert brought[3, 50] > 3.0 * brought[0, 50]
    assert brought[3, 50] == pytest.approx(brought[0, 200], rel=0.15)


def test_acceleration_is_worth_many_iterations():
    def calc_brought(iterations, momentum, machine_sweeps=0):
        settings = {"iterations": iterations, "momentum": momentum, "machine_sweeps": machine_sweeps}
        _, report = push_light_rocks(0.3, **settings)
        return 0.3 - report.machine_velocity[0]

    assert calc_brought(100, 0.8) > 2.5 * calc_brought(100, 0.0)
    assert calc_brought(200, 0.8) > 2.0 * calc_brought(300, 0.0)
    # It ends where plain sweeps do.
    assert calc_brought(2000, 0.8) == pytest.approx(calc_brought(2000, 0.0, machine_sweeps=7), rel=1e-3)


def test_deep_overlap_recovers_slowly():
    pile = make_pile([[0, 0, 5.0], [0.1, 0.05, 5.2]])
    engine = make_engine(pile, [make_box(0.5, 0.5, 0.5)], gravity=np.zeros(3))
    arrays = engine.make_arrays(pile)
    fastest = 0.0
    arrays, report = engine.advance(arrays)
    assert report.flagged
    for _ in range(200):
        arrays, report = engine.advance(arrays)
        fastest = max(fastest, np.abs(arrays.velocities[:, 3:]).max())
    assert fastest <= engine.config.max_recovery_speed
    assert report.max_penetration < 1e-3
    assert not report.flagged


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3), st.integers(0, 1000))
def test_turning_is_the_exponential_map(vector, seed):
    start = Rotation.random(random_state=seed)
    q = start.as_quat(scalar_first=True)
    turned = Rotation.from_quat(rotate_quaternion(tuple(q), tuple(vector)), scalar_first=True)
    expected = Rotation.from_rotvec(vector) * start
    assert (turned * expected.inv()).magnitude() < 1e-9


def test_another_piles_rocks_are_refused():
    pile = make_pile([[0, 0, 0.25]])
    engine = make_engine(pile, [make_box(0.5, 0.5, 0.5)])
    with pytest.raises(ValueError, match="not those"):
        engine.make_arrays(make_pile([[0, 0, 0.25]], size=[0.9]))


def test_settings_are_checked():
    with pytest.raises(ValueError, match="manifold_gap"):
        NonsmoothConfig(manifold_gap=0.05)
    with pytest.raises(ValueError, match="wake_load"):
        RestConfig(wake_load=0.0)


def test_the_schema_marks_all_but_a_users_settings_as_advanced():
    schema = NonsmoothConfig.model_json_schema()
    groups = [schema["properties"], schema["$defs"]["RestConfig"]["properties"]]
    plain = [name for group in groups for name, item in group.items() if not item.get("advanced")]
    assert plain == [
        "iterations", "stiffness_factor", "linear_overlap", "rounding", "reduction", "rest", "max_penetration"
    ]  # fmt: skip


def test_a_damaged_pile_file_is_refused(tmp_path):
    engine, arrays = settle(5)
    path = tmp_path / "pile.npz"
    save_pile(engine.make_pile(arrays), path)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))
    with pytest.raises(InputError):
        load_pile(path)


def test_a_site_without_rocks_steps():
    pile = make_pile(np.zeros((0, 3)), quaternions=np.zeros((0, 4)), velocities=np.zeros((0, 6)))
    engine = make_engine(pile, SHAPES)
    _, report = engine.advance(engine.make_arrays(pile))
    assert report.n_awake == report.n_contacts == 0


def test_the_system_runs_without_a_machine_and_steps_as_the_engine_does():
    pile = draw_pile(0, 20)
    engine = make_engine(pile, SHAPES, make_plane_site(planes=5))
    diagram, system = make_rock_diagram(pile, SHAPES, make_plane_site(planes=5))
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.5)
    expected, _ = run(engine, engine.make_arrays(pile), 0.5)
    actual = system.get_pile(simulator.get_context())
    assert np.array_equal(actual.p_WRs, expected.positions)
    context = system.GetMyContextFromRoot(simulator.get_context())
    shown = system.GetOutputPort("pile").Eval(context)
    assert np.array_equal(shown.p_WRs, expected.positions)
    assert np.array_equal(shown.q_WRs, expected.quaternions)
    assert np.array_equal(shown.V_WRs, expected.velocities)
    summary = system.GetOutputPort("summary").Eval(context)
    assert summary[list(ROCK_SUMMARY).index("n_awake")] == len(pile)
    assert not any(
        force.get_coeffs().any() for force in system.GetOutputPort("body_spatial_forces").Eval(context)
    )
    assert not system.GetOutputPort("status").Eval(context).any()


@given(
    spins=st.lists(st.floats(-5, 5), min_size=6, max_size=6),
    share=st.floats(0.001, 0.5),
    fixed=st.booleans(),
)
def test_spin_damping_slows_and_keeps_angular_momentum(spins, share, fixed):
    """Two rocks with one contact, or a rock on the floor: the share of the spin goes, momentum stays."""
    bodies, rows = np.zeros(3, BODY), make_contact_rows(1)
    inertia = np.array([[2.0, 0.3, -0.1, 3.0, 0.2, 4.0], [1.0, 0.1, 0.2, 1.5, -0.1, 2.0]])
    bodies["inverse_inertia"][:2] = inertia
    bodies["angular"][:2] = np.reshape(spins, (2, 3))
    rows.body_b[0] = b = 2 if fixed else 1
    before = bodies.copy()
    damp_spin(1, rows, share, bodies)
    np.testing.assert_array_equal(bodies, before)  # no load, no damping
    rows.values["impulse"][0, 0] = 1.0
    damp_spin(1, rows, share, bodies)

    def unfold(m):
        return np.linalg.inv(np.array([[m[0], m[1], m[2]], [m[1], m[3], m[4]], [m[2], m[4], m[5]]]))

    start, end = before["angular"], bodies["angular"]
    old, new = start[b] - start[0], end[b] - end[0]
    np.testing.assert_allclose(new @ old, (1 - share) * (old @ old), atol=1e-9)
    twist = [unfold(inertia[k]) @ (end[k] - start[k]) for k in range(2)]
    if not fixed:
        np.testing.assert_allclose(twist[0], -twist[1], atol=1e-9)
    energies = [0.5 * v[k] @ unfold(inertia[k]) @ v[k] for v in (start, end) for k in range(2)]
    assert sum(energies[2:]) <= sum(energies[:2]) + 1e-9
    np.testing.assert_array_equal(end[2], 0.0)


def test_spin_damping_stops_a_rock_that_swings_on_two_points():
    """A spindle hangs by its tips between two posts: a pendulum, for ever if nothing resists."""
    tips = [[0, -0.7, 0.2], [0, 0.7, 0.2], [0, 0, -0.3], [-0.25, 0, 0.1], [0.25, 0, 0.1]]
    spindle = make_shape(trimesh.Trimesh(tips, trimesh.convex.convex_hull(np.array(tips)).faces))
    pile = make_pile(
        [[0, -0.8, 0.25], [0, 0.8, 0.25], [0, 0, 0.45]], shape=[0, 0, 1], fixed=[True, True, False]
    )
    swings = {}
    for damping in (0.0, 2.0):
        config = NonsmoothConfig(spin_damping=damping, reduction="none")
        engine = make_engine(pile, [make_box(0.5, 0.4, 0.5), spindle], config=config)
        arrays, _ = run(engine, engine.make_arrays(pile), 1.0)
        arrays.velocities[2, 1] = 0.3
        arrays, _ = run(engine, arrays, 4.0)
        spins = []
        for _ in range(150):
            arrays, _ = engine.advance(arrays)
            spins.append(abs(arrays.velocities[2, 1]))
        assert arrays.positions[2, 2] > 0.3
        swings[damping] = max(spins)
    assert swings[0.0] > 0.1
    assert swings[2.0] < 0.02


@pytest.mark.parametrize(("squeeze", "wakes"), [(0.0, True), (2.5, True), (2.8, False)])
def test_a_rock_under_pressure_wakes_by_a_share_of_it(squeeze, wakes):
    """A change of 0.31 times the weight: above 0.3 of it, and above a tenth of the pressure or not."""
    mass, weight = np.array([100.0]), 100.0 * 9.81 * 0.01
    sleep = np.zeros(1, SLEEP)
    sleep["status"] = SLEEPING
    sleep["reference"][0, 2] = weight
    # Squeezed between two walls, on a floor that carries 0.69 of its weight; half the sizes' sum is the pressure.
    cache = contact_cache.make_contact_cache(3)
    cache.pairs[:, 1] = [1, 2, 3]
    cache.points["impulse"][:, 0] = [0.0, squeeze * weight, -squeeze * weight]
    cache.points["impulse"][0, 2] = -0.69 * weight
    alone = np.zeros(1, np.bool_)
    thresholds = make_thresholds(0.3 * 9.81 * 0.01, 0.1, 0.1)
    n = wake(np.zeros((1, 3)), mass, cache, 0, alone, thresholds, sleep)
    assert n == wakes


@pytest.mark.parametrize("mover", [True, False])
def test_a_rock_that_leans_on_a_mover_wakes_sooner_and_does_not_fall_asleep(mover):
    """Rock 0 slides at 2 cm/s or 5 mm/s, movers from 1 cm/s; rock 1 leans on it, rock 2 on rock 1."""
    mass, weight = np.full(3, 100.0), 100.0 * 9.81 * 0.01
    cache = contact_cache.make_contact_cache(2)
    cache.pairs[:] = [[0, 1], [1, 2]]
    sleep = np.zeros(3, SLEEP)
    sleep["status"][1:] = SLEEPING
    velocities, movers, marks = np.zeros((3, 6)), np.zeros(3, np.bool_), np.zeros(3, np.bool_)
    velocities[0, 5] = 0.02 if mover else 0.005
    # The load of rock 1 has changed by 0.1 of the weight, that of rock 2 by 0.2: 0.3 wakes a rock otherwise.
    cache.points["impulse"][:, 2] = [0.1 * weight, 0.2 * weight]
    sleeping.mark_by_movers(np.arange(3), sleep, velocities, cache, 0, 0.01, movers, marks)
    assert not movers.any()
    np.testing.assert_array_equal(marks, [False, mover, False])
    # A speculative point is no contact yet.
    apart = cache._replace(points=np.zeros_like(cache.points))
    unmarked = np.ones(3, np.bool_)
    sleeping.mark_by_movers(np.arange(3), sleep, velocities, apart, 0, 0.01, movers, unmarked)
    assert not unmarked.any()
    rocks, thresholds = (np.zeros((3, 3)), np.ones(3)), make_thresholds(0.3 * 9.81 * 0.01, 0.0, 0.1)
    wake(rocks[0], mass, cache, 0, marks, thresholds, sleep)
    np.testing.assert_array_equal(sleep["status"], [AWAKE, AWAKE if mover else SLEEPING, SLEEPING])
    # Long still, they may fall asleep again, but not the one by the mover.
    sleep["status"], sleep["still_time"] = AWAKE, 1.0
    limits = sleeping.SleepLimits(1e-3, 0.1, 0.05)
    sleeping.fall_asleep(np.arange(3), *rocks, NOWHERE, marks, 0.01, limits, sleep, velocities)
    np.testing.assert_array_equal(sleep["status"], [SLEEPING, AWAKE if mover else SLEEPING, SLEEPING])


@pytest.mark.parametrize(
    ("other", "n_sleeping", "wakes"), [(LOST, 0, True), (SLEEPING, 0, False), (LOST, 1, False)]
)
def test_a_rock_wakes_when_what_carried_it_has_left_the_site(other, n_sleeping, wakes):
    """Rock 0 rests on rock 1. Contacts that were not solved in the last step cannot have changed, and are left out."""
    weight = 100.0 * 9.81 * 0.01
    cache = contact_cache.make_contact_cache(1)
    cache.pairs[0, 1], cache.points["impulse"][0, 2] = 1, -weight
    sleep = np.zeros(2, SLEEP)
    sleep["status"] = SLEEPING, other
    sleep["reference"][:, 2] = np.float32(weight), -np.float32(weight)
    alone, thresholds = np.zeros(2, np.bool_), make_thresholds(0.3 * 9.81 * 0.01, 0.3, 0.1)
    n = wake(np.zeros((2, 3)), np.full(2, 100.0), cache, n_sleeping, alone, thresholds, sleep)
    assert n == wakes


def test_all_that_have_moved_are_woken_together_from_time_to_time():
    """Two boxes at rest, one of which fell 5 mm: every 0.3 s it is awake, for 0.1 s; the other never."""
    pile = make_pile([[0, 0, 0.25], [3, 0, 0.255]])
    config = NonsmoothConfig(rest=RestConfig(recheck_period=0.3))
    engine = make_engine(pile, [make_box(0.8, 0.6, 0.5)], config=config)
    arrays = engine.make_arrays(pile)
    awake = []
    for _ in range(100):
        awake.append(arrays.status == AWAKE)
        arrays, _ = engine.advance(arrays)
    assert arrays.steps == 100
    first, second = np.transpose(awake)
    assert not first[25:].any()
    np.testing.assert_array_equal(np.flatnonzero(np.diff(second[25:].astype(int)) == 1) + 26, [30, 60, 90])
    np.testing.assert_array_equal(np.flatnonzero(np.diff(second[25:].astype(int)) == -1) + 26, [40, 70])
