from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drakerock.errors import InputError
from drakerock.lhd.placement import set_machine_pose
from drakerock.loading.control import FeedforwardController
from drakerock.loading.cycle import run_cycle
from drakerock.loading.plan_file import save_plan
from drakerock.loading.recording import load_recording, save_recording
from drakerock.loading.segments import Mode
from drakerock.loading.signals import calc_signals
from drakerock.loading.station import MAX_BACK, make_station
from drakerock.rocks.drake.interface import find_start_inside
from drakerock.rocks.drake.plant_engine import PlantRocks
from drakerock.study.jobs import get_pile


@pytest.fixture(scope="module")
def pile(small_scenario):
    return get_pile(small_scenario)


@pytest.fixture(scope="module")
def result(small_scenario, pile):
    return run_cycle(small_scenario, pile)


@pytest.fixture(scope="module")
def nonsmooth_result(small_scenario, pile):
    return run_cycle(use_engine(small_scenario, "nonsmooth"), pile)


def use_engine(scenario, engine):
    """Return the scenario with that rock engine."""
    return scenario.replace(**{"dynamics.rocks": engine})


def test_modes_run_in_order_and_the_load_is_weighed(result):
    modes = result.signals["mode"]
    assert np.all(np.diff(modes) >= 0)
    assert {int(mode) for mode in modes} >= {Mode.APPROACH, Mode.S0, Mode.S1, Mode.S2, Mode.S3, Mode.DONE}
    outcome = result.outcome
    performance = result.scenario.loading.performance
    # A rock that leans on the bucket from outside is weighed, in part, and not counted.
    tolerance = performance.weighing_tolerance
    assert outcome.weighed_mass_kg == pytest.approx(outcome.counted_when_weighed_kg, abs=tolerance)
    late = performance.weighing_delay + performance.weighing_time
    assert outcome.sim_time_s >= outcome.waypoint_times_s[4] + late - 1e-9
    changed = [item["mass_kg"] for item in outcome.events if item["event"] == "load changed after s4"]
    assert outcome.counted_when_weighed_kg == pytest.approx(outcome.bucket_mass_kg + sum(changed))


def test_bucket_forces_lift_the_load(result):
    """Impulse balance of the rocks' force on the bucket at rest: it carries the load's weight."""
    standing = result.signals["time"] > result.outcome.waypoint_times_s[4] + 1.0
    if result.outcome.bucket_mass_kg == 0 or not np.any(standing):
        pytest.skip("nothing in the bucket")
    force = -np.mean(result.signals["bucket_force_z"][standing]) / 9.81
    assert force == pytest.approx(result.outcome.bucket_mass_kg, abs=150)


def test_load_is_counted_when_s4_is_passed(small_scenario, pile, nonsmooth_result):
    """The simulation stops in the step in which the controller passes s4, not at the next frame."""
    config = use_engine(small_scenario, "nonsmooth").replace(**{"recording.frame_rate": 2.0})
    coarse = run_cycle(config, pile).outcome
    assert coarse.bucket_mass_kg == nonsmooth_result.outcome.bucket_mass_kg
    assert coarse.waypoint_times_s == nonsmooth_result.outcome.waypoint_times_s


# When the bucket is in the pile [s].
START = 2.4


@pytest.mark.parametrize("engine", ["plant", "nonsmooth"])
def test_rows_hold_the_step_that_begins(small_scenario, pile, engine):
    station = make_station(use_engine(small_scenario, engine), pile)
    simulator = Simulator(station.diagram)
    root = simulator.get_mutable_context()
    station.initialize(root)
    context = station.plant.GetMyMutableContextFromRoot(root)
    simulator.AdvanceTo(START)
    # What the coming step will do, asked for before it is taken.
    found = station.rocks.GetOutputPort("contacts").Eval(station.rocks.GetMyContextFromRoot(root))
    bucket = int(station.plant.GetBodyByName("bucket").index())
    force_on_bucket = found.f_WCs[found.body == bucket].sum(axis=0)
    contacts = len(found)
    moment = station.plant.get_reaction_forces_output_port().Eval(context)
    joint = station.plant.GetJointByName("bucket_joint", station.machine.instance)
    simulator.AdvanceTo(START + 0.05)
    signals, _ = calc_signals(station, root)
    row = round(START / 0.01)
    assert signals["time"][row] == pytest.approx(START)
    force = [signals[f"bucket_force_{axis}"][row] for axis in "xyz"]
    assert np.abs(force).max() > 10.0
    assert force == pytest.approx(force_on_bucket.tolist())
    if engine == "plant":
        assert signals["n_contacts"][row] == contacts
    hinge = moment[int(joint.index())].rotational()
    assert signals["hinge_moment"][row] == pytest.approx(np.hypot(hinge[0], hinge[2]))


def test_recording_round_trip(result, tmp_path):
    save_recording(result.recording, tmp_path / "r.npz")
    back = load_recording(tmp_path / "r.npz")
    assert np.array_equal(back.X_WBs, result.recording.X_WBs)
    assert np.array_equal(back.move_pose, result.recording.move_pose)
    assert back.notes == result.recording.notes
    assert len(back.visuals) == len(result.recording.visuals)


def with_loading(scenario, **parts):
    """The scenario with some keys of its loading's parts changed."""
    changes = {f"loading.{name}.{key}": value for name, keys in parts.items() for key, value in keys.items()}
    return use_engine(scenario.replace(**changes), "nonsmooth")


def test_reaching_s4_is_a_reason(result):
    assert result.outcome.reason == "s4 reached"
    assert result.outcome.status == "done"


def test_time_outs_are_events_and_the_last_one_a_reason(small_scenario, pile):
    """A machine whose wheels hardly turn times out everywhere, and still counts with its real time."""
    hurried = with_loading(
        small_scenario, control={"timeout": 0.3, "approach_time": 1.0}, performance={"settle_time": 0.5}
    )
    outcome = run_cycle(hurried.replace(**{"machine.wheel.effort": 10.0}), pile).outcome
    assert outcome.reason == "s4 timed out"
    assert outcome.status == "done"
    times = {item["waypoint"]: item["time_s"] for item in outcome.events if item["event"] == "timeout"}
    assert {"s0", "s1", "s4"} <= set(times)
    assert times["s0"] == pytest.approx(1.0, abs=0.03)
    assert times["s4"] == outcome.waypoint_times_s[4]
    assert outcome.loading_time_s == pytest.approx(times["s4"] - times["s0"])
    assert outcome.phi1 == pytest.approx(-outcome.bucket_mass_kg / outcome.loading_time_s)
    assert any(item["event"] == "stall" for item in outcome.events)


def test_wheels_without_grip_slip_as_an_event(small_scenario, pile):
    scenario = with_loading(small_scenario, control={"timeout": 0.3, "approach_time": 1.0})
    outcome = run_cycle(scenario.replace(**{"site.friction": 0.02}), pile).outcome
    slips = [item for item in outcome.events if item["event"] == "slip"]
    assert slips
    assert slips[0]["time_s"] < 0.5
    assert slips[0]["duration_s"] > 0.2


def test_drift_too_narrow_for_the_machine_is_refused(small_scenario, pile):
    wide = with_loading(small_scenario, planning={"wall_clearance": 0.6})
    with pytest.raises(InputError, match=r"site.drift_width: 3.9 m is too narrow .*at least 4.30 m"):
        run_cycle(wide, pile)


def test_scanner_sees_enough_to_dig(small_scenario, pile):
    scenario = with_loading(small_scenario, sensing={"kind": "scanner"})
    fields = []
    for config in (scenario, scenario, with_loading(small_scenario), scenario.replace(seed=6)):
        station = make_station(config, pile)
        root = station.diagram.CreateDefaultContext()
        context = station.plant.GetMyMutableContextFromRoot(root)
        set_machine_pose(station.plant, context, station.machine, x_tip=-8.0, z_tip=0.03)
        fields.append(station.diagram.GetOutputPort("height_field").Eval(root).h)
    scanned, again, ideal, reseeded = fields
    assert np.array_equal(scanned, again)
    assert not np.array_equal(scanned, reseeded)
    assert np.abs(scanned - ideal).mean() < 0.1
    outcome = run_cycle(scenario, pile).outcome
    assert outcome.status == "done"
    assert outcome.bucket_mass_kg > 0


def test_stored_plan_is_driven_again(small_scenario, pile, result, nonsmooth_result, tmp_path):
    save_plan(result.plan, result.field, tmp_path / "plan.json")
    source = {"planning": {"source": str(tmp_path / "plan.json")}, "strategy": {"alpha": 1.9}}
    again = run_cycle(with_loading(small_scenario, **source), pile)
    assert again.plan.to_dict() == result.plan.to_dict()
    assert again.outcome.phi1 == nonsmooth_result.outcome.phi1
    assert again.outcome.waypoint_times_s == nonsmooth_result.outcome.waypoint_times_s


def test_solver_failure_is_a_recorded_outcome(small_scenario, pile):
    calls = []

    def fail_at_one_second(mode, time):
        calls.append(time)
        if time > 1.0:
            raise RuntimeError("the solver failed to converge")

    result = run_cycle(use_engine(small_scenario, "nonsmooth"), pile, fail_at_one_second)
    assert result.outcome.status == "failed"
    assert "solver failed to converge" in result.outcome.reason
    assert result.outcome.phi1 is None
    assert len(result.signals["time"]) > 90
    assert result.recording is not None


@pytest.mark.parametrize("engine", ["plant", "nonsmooth"])
@pytest.mark.parametrize("speed", [1e20, 1e160])
def test_rocks_that_explode_are_a_failure_not_a_crash(small_scenario, pile, engine, speed):
    """Nothing computes with such a state: Drake's proximity engine has crashed on it."""
    wild = replace(pile, V_WRs=pile.V_WRs + np.array([0, 0, 0, 0, 0, speed]), contacts=None)
    scenario = use_engine(small_scenario, engine)
    outcome = run_cycle(scenario, wild).outcome
    assert outcome.status == "failed"
    assert outcome.steps <= 1
    assert "not finite" in outcome.reason


@pytest.mark.parametrize("engine", ["plant", "nonsmooth"])
def test_motor_speeds_that_are_no_numbers_are_a_failure(small_scenario, pile, monkeypatch, engine):
    def break_in_time(self: FeedforwardController, context, output):
        calc(self, context, output)
        if context.get_time() > 0.3:
            output.SetFromVector(np.full(output.size(), np.nan))

    calc = FeedforwardController._calc_motor_speeds
    monkeypatch.setattr(FeedforwardController, "_calc_motor_speeds", break_in_time)
    scenario = use_engine(small_scenario, engine)
    outcome = run_cycle(scenario, replace(pile, contacts=None)).outcome
    assert outcome.status == "failed"
    assert outcome.sim_time_s == pytest.approx(0.3, abs=0.05)


def test_rocks_that_are_nowhere_after_a_failure_are_left_where_they_were(small_scenario, pile, monkeypatch):
    """No pile can hold such a state; the failure is recorded all the same."""

    def lose(self, root):
        if root.get_time() > 0.3:
            raise ValueError("p_WRs: not finite")
        return get_pile_of(self, root)

    def fail(_mode, time):
        if time > 0.3:
            raise RuntimeError("the solver failed to converge")

    get_pile_of = PlantRocks.get_pile
    monkeypatch.setattr(PlantRocks, "get_pile", lose)
    result = run_cycle(small_scenario, pile, fail)
    assert result.outcome.status == "failed"
    assert "failed to converge" in result.outcome.reason
    assert np.array_equal(result.pile_after.p_WRs, pile.p_WRs)


def test_station_may_be_a_part_of_a_larger_diagram(small_scenario, pile):
    station = make_station(small_scenario, pile)

    def initialize(diagram):
        root = diagram.CreateDefaultContext()
        station.initialize(root)
        return station.plant.GetPositions(station.plant.GetMyContextFromRoot(root)).copy()

    alone = initialize(station.diagram)
    builder = DiagramBuilder()
    builder.AddSystem(station.diagram)
    assert np.array_equal(initialize(builder.Build()), alone)


@pytest.mark.parametrize("engine", ["plant", "nonsmooth"])
def test_machine_starts_behind_a_loose_rock_that_lies_in_its_place(small_scenario, pile, engine):
    scenario = use_engine(small_scenario, engine)

    def start(pile):
        station = make_station(scenario, pile)
        simulator = Simulator(station.diagram)
        root = simulator.get_mutable_context()
        station.initialize(root)
        simulator.Initialize()
        plant = station.plant
        X_WB = plant.EvalBodyPoseInWorld(
            plant.GetMyContextFromRoot(root), plant.GetBodyByName("bucket", station.machine.instance)
        )
        contacts = station.rocks.GetOutputPort("contacts").Eval(station.rocks.GetMyContextFromRoot(root))
        plan = station.diagram.GetOutputPort("plan").Eval(root)
        return X_WB.translation(), plan.waypoint_x[0] - scenario.loading.planning.run_up, contacts

    p_WB, tip_x, _ = start(pile)
    smallest = pile.select(np.array([int(np.argmin(pile.size))]))
    lying = replace(smallest, p_WRs=np.array([[tip_x, p_WB[1], 0.5 * smallest.size[0]]]), contacts=None)
    blocked = pile.join(lying)
    p_WB_blocked, _, contacts = start(blocked)
    assert p_WB_blocked[1] == p_WB[1]
    assert p_WB[0] - MAX_BACK < p_WB_blocked[0] < p_WB[0]
    assert find_start_inside(contacts, blocked.size) is None


def test_context_can_be_saved_and_repeated(small_scenario, pile):
    station = make_station(small_scenario, pile)
    simulator = Simulator(station.diagram)
    root = simulator.get_mutable_context()
    station.initialize(root)
    simulator.AdvanceTo(START)
    saved = simulator.get_context().Clone()
    simulator.AdvanceTo(START + 0.2)
    first = station.rocks.get_pile(simulator.get_context())
    again = Simulator(station.diagram, saved)
    # The plan is part of the context: a Simulator's initialisation keeps it.
    again.Initialize()
    again.AdvanceTo(START + 0.2)
    second = station.rocks.get_pile(again.get_context())
    assert np.array_equal(first.p_WRs, second.p_WRs)
    assert np.array_equal(first.V_WRs, second.V_WRs)
