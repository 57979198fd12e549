"""Broad phase, contact memory, solver, reduction and failures of the nonsmooth engine, each alone."""

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
from drakerock.rocks.engine import contacts, motion, reduction, solver
from drakerock.rocks.engine import engine as engine_module
from drakerock.rocks.engine.collision import gjk
from drakerock.rocks.engine.collision.broad_phase import AWAKE, LOST, RESTING
from drakerock.rocks.engine.config import NonsmoothConfig, RestConfig
from drakerock.rocks.engine.engine import DEEP_SHARE, MachinePiece, MachineStep, make_machineless_step
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

SHAPES = load_rock_shapes(RocksConfig().shapes)


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
    arrays.book[rng.random(len(pile)) < 0.4, reduction.STATUS] = 1  # some at rest
    status = arrays.book[:, reduction.STATUS].astype(np.int64)
    engine._pose(arrays, make_machineless_step(), status)
    n_pairs = engine._find_pairs(status)
    found = [
        (int(a), int(b)) for a, b in zip(engine._pair_a[:n_pairs], engine._pair_b[:n_pairs], strict=True)
    ]
    assert len(found) == len(set(found))
    lower, upper = engine._lower, engine._upper
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
    rows = engine._rows.values[: report.n_contacts]
    normals, gaps = rows[:, contacts.NORMAL : contacts.NORMAL + 3], rows[:, contacts.GAP]
    # v minimises 1/2 (v - v_free)^T M (v - v_free) with G v >= bias, translations and rotations
    program = MathematicalProgram()
    v = program.NewContinuousVariables(6 * n)
    mass = np.zeros((6 * n, 6 * n))
    free = pile.V_WRs.copy()
    free[:, 5] -= 9.81 * engine.time_step
    for i in range(n):
        inverse = engine._inverse_inertia[i]
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
        a, b = engine._rows.body_a[k], engine._rows.body_b[k]
        g[6 * a : 6 * a + 6] = -np.concatenate([np.cross(rows[k, 9:12], normals[k]), normals[k]])
        if b < n:
            g[6 * b : 6 * b + 6] += np.concatenate([np.cross(rows[k, 12:15], normals[k]), normals[k]])
        program.AddLinearConstraint(g[None], [rows[k, contacts.BIAS]], [np.inf], v)
        assert gaps[k] > 0 or rows[k, contacts.COMPLIANCE] < 1e-3
    expected = ClarabelSolver().Solve(program).GetSolution(v).reshape(n, 6)
    np.testing.assert_allclose(new.velocities[:, 3:], expected[:, 3:], atol=5e-3)


def test_contact_memory_is_found_again():
    """A box at rest: the second step starts from the first one's impulses."""
    pile = make_pile([[0, 0, 0.25]])
    # Momentum rings on in single precision: 3e-5 of the weight across it.
    engine = make_engine(
        pile, [make_box(0.8, 0.6, 0.5)], config=NonsmoothConfig(reduction="none", momentum=0.0)
    )
    arrays, _ = run(engine, engine.make_arrays(pile), 0.5)
    assert len(arrays.memory.pairs) == 4
    sums, pressures = np.zeros((1, 3)), np.zeros(1)
    contacts.sum_impulses(arrays.memory, 1, sums)
    np.testing.assert_allclose(sums[0], [0, 0, engine.mass[0] * 9.81 * 0.01], rtol=1e-6, atol=1e-6)
    impulses = arrays.memory.values[:, contacts.MEMORY_IMPULSE : contacts.MEMORY_IMPULSE + 3]
    contacts.sum_pressures(arrays.memory, 1, np.ones(1, bool), pressures)
    assert pressures[0] == pytest.approx(0.5 * np.linalg.norm(impulses, axis=1).sum(), rel=1e-5)
    table = np.zeros(128, np.int64)
    status, active = np.zeros(1, np.int64), np.zeros(8, np.int64)
    assert contacts.index_memory(arrays.memory, 1, status, active, table) == (64, 4, 0)
    table = table[:64]
    key = contacts.read_key(arrays.memory, 0)
    assert contacts.find_in_memory(key, arrays.memory, table) == 0
    assert contacts.find_in_memory(key + 1, arrays.memory, table) == -1
    # pairs without an awake rock are not searched
    assert contacts.index_memory(arrays.memory, 1, status + 1, active, table) == (64, 0, 0)
    assert contacts.find_in_memory(key, arrays.memory, table) == -1


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
    loaded_rows = arrays.memory.values[:, contacts.MEMORY_IMPULSE : contacts.MEMORY_IMPULSE + 3].any(axis=1)
    assert len(again.memory.pairs) == loaded_rows.sum()
    # A pile keeps contact points and impulses in single precision, in memory as in the file: what was stored goes on
    # like what was not, bit for bit.
    kept = engine.make_arrays(pile)
    for one, other in zip(again.memory, kept.memory, strict=True):
        assert np.array_equal(one, other)
    # Where searches ended is not stored.
    stored, columns = arrays.memory.select(loaded_rows), slice(contacts.MEMORY_SIMPLEX)
    assert np.array_equal(again.memory.pairs, stored.pairs)
    assert np.allclose(again.memory.values[:, columns], stored.values[:, columns], rtol=1e-6, atol=1e-6)
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
    status = arrays.book[:, reduction.STATUS]
    assert (status == 1).mean() > 0.8
    before = [(*pair, *values) for pair, values in zip(*arrays.memory, strict=True)]
    after, _ = run(engine, arrays, 0.2)
    both_rest = [row for row in before if _rests(row, status, engine.n_rocks)]
    kept = {(*pair, *values) for pair, values in zip(*after.memory, strict=True)}
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


def _rests(row, status, n):
    a, b = row[:2]
    return status[a] == 1 and (b >= n or status[b] == 1)


def test_contacts_of_slow_rocks_follow_their_motion():
    """A heap nudged to millimetres a second: what steps without a search make of the gaps is what a search finds."""
    engine, arrays = settle(n=60, seed=2)
    rng = np.random.default_rng(0)
    arrays.book[:, reduction.STATUS] = AWAKE
    arrays.velocities[:, 3:] += rng.uniform(-4e-3, 4e-3, (engine.n_rocks, 3))
    arrays.book[:, reduction.WAY] = np.inf
    engine.config = NonsmoothConfig(reduction="none")
    searched = []
    for _ in range(4):
        arrays, _ = engine.advance(arrays)
        searched.append(engine._statistics[1])
    assert searched[0] > 20
    assert searched[1:] == [0, 0, 0]
    engine.config = NonsmoothConfig(reduction="none", search_period=1)
    _, report = engine.advance(arrays)
    keys, rows = engine._rows.key[: report.n_contacts], engine._rows.values[: report.n_contacts]
    memory_keys = np.array([contacts.read_key(arrays.memory, row) for row in range(len(arrays.memory.pairs))])
    pairs = np.intersect1d(keys, memory_keys)
    assert len(pairs) > 60
    found = [rows[keys == key, contacts.GAP].min() for key in pairs]
    followed = [arrays.memory.values[memory_keys == key, contacts.MEMORY_GAP].min() for key in pairs]
    np.testing.assert_allclose(followed, found, atol=2e-5)


@pytest.mark.parametrize(
    ("speed", "searches"),
    [(0.001, 1), (0.01, 11), (0.019, 20), (0.05, 17)],
    ids=["slow: every millimetre", "ten times as fast", "every fifth step", "fast: every sixth step"],
)
def test_how_often_rocks_that_move_together_are_searched(speed, searches):
    pile = make_pile([[0, 0, 2.0], [0.5005, 0, 2.0]], velocities=[[0, 0, 0, speed, 0, 0]] * 2)
    engine = make_engine(
        pile, [make_box(0.5, 0.5, 0.5)], config=NonsmoothConfig(reduction="none"), gravity=0.0
    )
    arrays, n_searches = engine.make_arrays(pile), 0
    for _ in range(100):
        arrays, report = engine.advance(arrays)
        n_searches += engine._statistics[1] > 0
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
    arrays.book[:, reduction.STATUS] = np.where(np.arange(engine.n_rocks) % 3 > 0, AWAKE, 1)
    arrays.velocities[::3] = 0.0
    groups = {name: value for name, value in vars(arrays).items() if isinstance(value, np.ndarray)}
    before = replace(arrays, **{name: value.copy() for name, value in groups.items()})
    room = engine.make_room()
    for name in groups:
        getattr(room, name)[:] = np.nan
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
            assert np.array_equal(value, whole), name
        assert np.shares_memory(value, getattr(room, name))
        assert np.array_equal(getattr(arrays, name), getattr(before, name))


def wake_by_and_by(engine, arrays, woken):
    """Yield the states of steps that begin with each of the rocks `woken` shoved in turn, and the reports."""
    for rock in woken:
        reduction.wake_rock(arrays.book, arrays.positions, rock)
        arrays.velocities[rock, 5] = 0.02
        arrays, report = engine.advance(arrays)
        yield arrays, report


def is_gap(arrays):
    return arrays.memory.pairs[:, 0] < 0


def settle_at_rest():
    """Return 200 rocks that have come to rest, memory of resting rocks written, and their engine."""
    engine, arrays = settle(200)
    arrays.book[:, reduction.STATUS], arrays.book[:, reduction.CHANGED_STEPS] = RESTING, reduction.NEW
    arrays.velocities[:] = 0.0
    arrays, _ = engine.advance(arrays)
    assert arrays.n_idle == len(arrays.memory.pairs) > 200
    return engine, arrays


def test_what_rocks_at_rest_remember_stays_in_its_place_and_gaps_change_nothing():
    engine, arrays = settle_at_rest()
    n_gaps = [0]
    for new, report in wake_by_and_by(engine, arrays, range(0, 200, 5)):
        gaps = is_gap(arrays)
        closed = replace(
            arrays, memory=arrays.memory.select(~gaps), n_idle=int((~gaps[: arrays.n_idle]).sum())
        )
        expected, _ = engine.advance(closed)
        for name in ("positions", "quaternions", "velocities", "book"):
            assert np.array_equal(getattr(new, name), getattr(expected, name)), name
        for found, whole in zip(new.memory.select(~is_gap(new)), expected.memory, strict=True):
            assert np.array_equal(found, whole[expected.memory.pairs[:, 0] >= 0])
        assert np.array_equal(
            engine.make_pile(new).contacts.impulses, engine.make_pile(expected).contacts.impulses
        )
        kept = np.setdiff1d(np.arange(report.n_kept), report.freed)
        assert np.array_equal(new.memory.pairs[kept], arrays.memory.pairs[kept])
        assert is_gap(new)[report.freed].all()
        assert not is_gap(new)[new.n_idle :].any()
        n_gaps.append(int(is_gap(new).sum()))
        assert n_gaps[-1] <= new.n_idle / contacts.MAX_GAPS
        arrays = new
    # They become more, are closed, and become more again.
    assert max(n_gaps) > 5
    assert (np.diff(n_gaps) < -5).any()


def test_changes_written_into_a_copy_are_the_whole_state():
    engine, arrays = settle_at_rest()
    capacity = len(engine.make_room().memory.pairs)
    for new, _ in wake_by_and_by(engine, arrays, range(0, 200, 20)):
        copy = replace(
            arrays,
            **{
                name: getattr(arrays, name).copy()
                for name in ("positions", "quaternions", "velocities", "book")
            },
            memory=contacts.make_memory(capacity),
        )
        for before, after in zip(copy.memory, arrays.memory, strict=True):
            before[: len(after)] = after
        room = engine.make_room()
        room.memory.pairs[:], room.memory.values[:] = 7, np.nan
        engine.write_changes(*engine.step(arrays, make_machineless_step(), room), copy)
        for name in ("positions", "quaternions", "velocities", "book"):
            assert np.array_equal(getattr(copy, name), getattr(new, name)), name
        # What stands in a gap counts for nothing.
        full = ~is_gap(new)
        for found, whole in zip(copy.memory.select(slice(len(full))), new.memory, strict=True):
            assert np.array_equal(found[full], whole[full])
        assert np.array_equal(copy.memory.pairs[: len(full), 0] < 0, ~full)
        arrays = new


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


def test_memory_keeps_keys_and_simplices_whole():
    """A simplex takes two columns of single precision; the largest numbers have to come back."""
    memory = contacts.make_memory(1)
    rows = contacts.make_contact_rows(1)
    corners = np.array([[127, 126], [125, 127], [127, 127]])
    rows.values[0, [contacts.IMPULSE, contacts.SIMPLEX]] = 1.0, gjk.encode_simplex(corners, 3)
    rock = contacts.KEY_STEP - 2
    rows.key[0] = key = rock * contacts.KEY_STEP + contacts.KEY_STEP - 1
    rotations = np.zeros((contacts.KEY_STEP, 3, 3))
    rotations[rock] = np.eye(3)
    empty = np.zeros(0, np.int64)
    n, n_idle, n_kept = contacts.write_memory(
        0,
        contacts.make_memory(0),
        0,
        empty,
        0,
        0,
        rows,
        1,
        rotations,
        np.zeros((contacts.KEY_STEP, 6)),
        0.01,
        0.0,
        memory,
    )
    assert (n, n_idle, n_kept) == (1, 0, 0)
    assert contacts.read_key(memory, 0) == key
    found = np.zeros((3, 2), np.int64)
    assert gjk.decode_simplex(contacts.read_simplex(memory, 0), found) == 3
    assert np.array_equal(found, corners)


def test_without_reduction_nothing_rests():
    engine, arrays = settle()
    assert (arrays.book[:, reduction.STATUS] == 1).any()
    engine.config = NonsmoothConfig(reduction="none")
    after, report = engine.advance(arrays)
    assert report.n_awake == engine.n_rocks
    assert not after.book[:, reduction.STATUS].any()


def test_the_sensor_wakes_what_is_in_its_box():
    engine, arrays = settle()
    book = arrays.book.copy()
    book[:, reduction.STATUS] = 1
    sums = np.zeros((len(book), 3))
    contacts.sum_impulses(arrays.memory, len(book), sums)
    book[:, reduction.REFERENCE : reduction.REFERENCE + 3] = sums
    box = np.concatenate([np.eye(3).reshape(-1), np.zeros(3), [-10, -10, -1], [0.0, 10, 10]])
    alone = np.zeros(len(book), np.bool_)
    n = reduction.wake(
        book,
        arrays.positions,
        engine.radius,
        engine.mass,
        arrays.memory,
        0,
        box[None],
        alone,
        0.1,
        0.1,
        0.1,
        3,
    )
    inside = arrays.positions[:, 0] < engine.radius
    assert n == inside.sum()
    assert ((book[:, reduction.STATUS] == 0) == inside).all()


def test_rocks_that_leave_the_site_are_counted_and_taken_out():
    pile = make_pile([[0, 0, 0.25], [30.0, 0, 1.0]], velocities=[[0] * 6, [0, 0, 0, 2500.0, 0, 0]])
    engine = make_engine(pile, [make_box(0.5, 0.5, 0.5)])
    arrays, report = engine.advance(engine.make_arrays(pile))
    assert report.n_lost == 1
    assert arrays.book[1, reduction.STATUS] == 3
    assert not arrays.velocities[1].any()
    _, report = engine.advance(arrays)
    assert report.n_lost == 0
    assert report.n_awake == 1


@pytest.mark.parametrize("status", [AWAKE, RESTING])
def test_values_that_are_not_finite_do_not_leave_a_step(status):
    pile = make_pile([[0, 0, 0.25], [2.0, 0, 0.25]])
    engine = make_engine(pile, [make_box(0.5, 0.5, 0.5)])
    arrays = engine.make_arrays(pile)
    arrays.book[0, reduction.STATUS] = status
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


def test_momentum_does_not_leave_a_sliding_rock_in_a_cycle():
    """A rock slides along another and the floor: with momentum to the last, impulses go to and fro for ever (0.4)."""
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
        pile, [make_box(1, 1, 1)], config=config, gravity=0.0, pieces=[piece], n_machine_bodies=1
    )
    return engine, engine.step(engine.make_arrays(pile), ram)[1]


def test_sweeps_around_the_machine_bring_its_momentum_through_light_rocks():
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


def test_momentum_is_worth_many_sweeps():
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
    engine = make_engine(pile, [make_box(0.5, 0.5, 0.5)], gravity=0.0)
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
    turned = Rotation.from_quat(motion.turn(*q, *vector), scalar_first=True)
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
    bodies = np.zeros((3, solver.BODY_WIDTH))
    inertia = np.array([[2.0, 0.3, -0.1, 3.0, 0.2, 4.0], [1.0, 0.1, 0.2, 1.5, -0.1, 2.0]])
    bodies[:2, solver.INVERSE_INERTIA : solver.INVERSE_INERTIA + 6] = inertia
    bodies[:2, :3] = np.reshape(spins, (2, 3))
    rows = np.zeros((1, contacts.ROW_WIDTH))
    a, b = np.array([0]), np.array([2 if fixed else 1])
    before = bodies.copy()
    solver.damp_spin(rows, 1, a, b, bodies, 2, share)
    np.testing.assert_array_equal(bodies, before)  # no load, no damping
    rows[0, contacts.IMPULSE] = 1.0
    solver.damp_spin(rows, 1, a, b, bodies, 2, share)

    def unfold(m):
        return np.linalg.inv(np.array([[m[0], m[1], m[2]], [m[1], m[3], m[4]], [m[2], m[4], m[5]]]))

    old, new = before[b[0], :3] - before[0, :3], bodies[b[0], :3] - bodies[0, :3]
    np.testing.assert_allclose(new @ old, (1 - share) * (old @ old), atol=1e-9)
    twist = [unfold(inertia[k]) @ (bodies[k, :3] - before[k, :3]) for k in range(2)]
    if not fixed:
        np.testing.assert_allclose(twist[0], -twist[1], atol=1e-9)
    energies = [0.5 * v[k, :3] @ unfold(inertia[k]) @ v[k, :3] for v in (before, bodies) for k in range(2)]
    assert sum(energies[2:]) <= sum(energies[:2]) + 1e-9
    np.testing.assert_array_equal(bodies[2], 0.0)


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
    book = np.zeros((1, reduction.BOOK_WIDTH))
    book[0, reduction.STATUS] = 1
    book[0, reduction.REFERENCE + 2] = weight
    # Squeezed between two walls, on a floor that carries 0.69 of its weight; half the sizes' sum is the pressure.
    memory = contacts.make_memory(3)
    memory.pairs[:, 1] = [1, 2, 3]
    memory.values[:, contacts.MEMORY_IMPULSE] = [0.0, squeeze * weight, -squeeze * weight]
    memory.values[0, contacts.MEMORY_IMPULSE + 2] = -0.69 * weight
    nowhere = np.zeros((0, 18))
    alone = np.zeros(1, np.bool_)
    n = reduction.wake(
        book, np.zeros((1, 3)), np.ones(1), mass, memory, 0, nowhere, alone, 0.3 * 9.81 * 0.01, 0.1, 0.1, 1
    )
    assert n == wakes


@pytest.mark.parametrize("mover", [True, False])
def test_a_rock_that_leans_on_a_mover_wakes_sooner_and_does_not_rest(mover):
    """Rock 0 slides at 2 cm/s or 5 mm/s, movers from 1 cm/s; rock 1 leans on it, rock 2 on rock 1."""
    mass, weight = np.full(3, 100.0), 100.0 * 9.81 * 0.01
    memory = contacts.make_memory(2)
    memory.pairs[:] = [[0, 1], [1, 2]]
    book = np.zeros((3, reduction.BOOK_WIDTH))
    book[1:, reduction.STATUS] = RESTING
    velocities, movers, marks = np.zeros((3, 6)), np.zeros(3, np.bool_), np.zeros(3, np.bool_)
    velocities[0, 5] = 0.02 if mover else 0.005
    # The load of rock 1 has changed by 0.1 of the weight, that of rock 2 by 0.2: 0.3 wakes a rock otherwise.
    memory.values[:, contacts.MEMORY_IMPULSE + 2] = [0.1 * weight, 0.2 * weight]
    reduction.mark_by_movers(book, velocities, memory, 0, 0.01, movers, marks)
    np.testing.assert_array_equal(movers, [mover, False, False])
    np.testing.assert_array_equal(marks, [False, mover, False])
    # A point about to touch is no contact yet.
    apart = contacts.Memory(memory.pairs, np.zeros_like(memory.values))
    unmarked = np.ones(3, np.bool_)
    reduction.mark_by_movers(book, velocities, apart, 0, 0.01, movers, unmarked)
    assert not unmarked.any()
    nowhere, limits = np.zeros((0, 18)), (0.3 * 9.81 * 0.01, 0.0, 0.1, 1)
    reduction.wake(book, np.zeros((3, 3)), np.ones(3), mass, memory, 0, nowhere, marks, *limits)
    np.testing.assert_array_equal(book[:, reduction.STATUS], [AWAKE, AWAKE if mover else RESTING, RESTING])
    # Long still, they may rest again, but not the one by the mover.
    book[:, reduction.STATUS], book[:, reduction.STILL_TIME] = AWAKE, 1.0
    far = np.full(3, 1e3)
    reduction.rest(
        book, np.zeros((3, 3)), velocities, np.ones(3), nowhere, marks, 0.01, 1e-3, 0.1, 0.05, -far, far, True
    )
    np.testing.assert_array_equal(book[:, reduction.STATUS], [RESTING, AWAKE if mover else RESTING, RESTING])


@pytest.mark.parametrize(
    ("other", "n_idle", "wakes"), [(LOST, 0, True), (RESTING, 0, False), (LOST, 1, False)]
)
def test_a_rock_wakes_when_what_carried_it_has_left_the_site(other, n_idle, wakes):
    """Rock 0 rests on rock 1. Contacts that were not solved in the last step cannot have changed, and are left out."""
    weight = 100.0 * 9.81 * 0.01
    memory = contacts.make_memory(1)
    memory.pairs[0, 1], memory.values[0, contacts.MEMORY_IMPULSE + 2] = 1, -weight
    book = np.zeros((2, reduction.BOOK_WIDTH))
    book[:, reduction.STATUS] = RESTING, other
    book[:, reduction.REFERENCE + 2] = np.float32(weight), -np.float32(weight)
    nowhere, alone, limits = np.zeros((0, 18)), np.zeros(2, np.bool_), (0.3 * 9.81 * 0.01, 0.3, 0.1, 1)
    n = reduction.wake(
        book, np.zeros((2, 3)), np.ones(2), np.full(2, 100.0), memory, n_idle, nowhere, alone, *limits
    )
    assert n == wakes


def test_all_that_have_moved_are_woken_together_from_time_to_time():
    """Two boxes at rest, one of which fell 5 mm: every 0.3 s it is awake, for 0.1 s; the other never."""
    pile = make_pile([[0, 0, 0.25], [3, 0, 0.255]])
    config = NonsmoothConfig(rest=RestConfig(recheck_period=0.3))
    engine = make_engine(pile, [make_box(0.8, 0.6, 0.5)], config=config)
    arrays = engine.make_arrays(pile)
    awake = []
    for _ in range(100):
        awake.append(arrays.book[:, reduction.STATUS] == AWAKE)
        arrays, _ = engine.advance(arrays)
    assert arrays.steps == 100
    first, second = np.transpose(awake)
    assert not first[25:].any()
    np.testing.assert_array_equal(np.flatnonzero(np.diff(second[25:].astype(int)) == 1) + 26, [30, 60, 90])
    np.testing.assert_array_equal(np.flatnonzero(np.diff(second[25:].astype(int)) == -1) + 26, [40, 70])
