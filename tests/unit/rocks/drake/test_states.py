"""The rocks' states in a context: like arrays that are copied in every step, and never written to."""

import copy

import pytest

from drakerock.rocks.drake.states import RockStates, SolvedState
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.engine import make_machineless_step
from rock_helpers import make_box, make_engine, make_pile, make_plane_site

STILL = make_machineless_step()


@pytest.fixture(scope="module")
def engine():
    """Rocks that come to rest on the floor, and two that fall on them later."""
    positions = [[0.8 * k, 0.0, 0.21] for k in range(5)] + [[0.5, 0.0, 3.0], [2.1, 0.1, 5.0]]
    pile = make_pile(positions)
    config = NonsmoothConfig(reduction="rest")
    return make_engine(pile, [make_box(0.7, 0.5, 0.4)], make_plane_site(), config=config), pile


@pytest.fixture
def states(engine):
    return RockStates(engine[0], SolvedState(engine[0].make_arrays(engine[1])))


def read(arrays):
    """Return the bits of a state; a gap in the cache has no point."""
    pairs, points = arrays.cache
    motion = (arrays.positions, arrays.quaternions, arrays.velocities, arrays.sleep)
    return [part.tobytes() for part in (*motion, pairs, points[pairs[:, 0] >= 0])]


def step(states, first, last):
    for number in range(first, last):
        states.solve_next(number, STILL)
    return read(states.get(last).arrays)


def test_states_are_those_of_copied_arrays(engine, states):
    arrays = engine[0].make_arrays(engine[1])
    awake = set()
    for number in range(130):
        arrays, report = engine[0].advance(arrays)
        states.solve_next(number, STILL)
        assert read(states.get(number + 1).arrays) == read(arrays)
        awake.add(report.n_awake)
    assert len(awake) > 2


def test_solving_writes_to_no_state_and_can_be_repeated(states):
    before = step(states, 0, 60)
    first = read(states.solve_next(60, STILL).arrays)
    assert read(states.get(60).arrays) == before
    assert read(states.solve_next(60, STILL).arrays) == first
    assert read(states.get(60).arrays) == before


def test_copies_go_on_apart_from_a_shared_state(states):
    step(states, 0, 50)
    saved = copy.deepcopy(states)
    again = copy.deepcopy(saved)
    kept = read(saved.get(50).arrays)
    end = step(states, 50, 80)
    assert read(saved.get(50).arrays) == kept
    assert step(again, 50, 80) == end
    assert step(saved, 50, 80) == end


def test_number_without_its_state_is_told(states):
    step(states, 0, 5)
    with pytest.raises(RuntimeError, match="SetTimeStateAndParametersFrom"):
        states.get(3)


def test_failed_step_leaves_its_state(engine, states, monkeypatch):
    end = step(states, 0, 40)
    solve = engine[0].step

    def fail(arrays, machine, room):
        solve(arrays, machine, room)
        raise RuntimeError("on purpose")

    with monkeypatch.context() as patch:
        patch.setattr(engine[0], "step", fail)
        with pytest.raises(RuntimeError, match="on purpose"):
            states.solve_next(40, STILL)
    assert read(states.get(40).arrays) == end
    following = step(states, 40, 41)
    fresh = RockStates(engine[0], SolvedState(engine[0].make_arrays(engine[1])))
    assert step(fresh, 0, 41) == following
