import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource

from drakerock.lhd.kinematics import calc_jacobian, calc_pitch, calc_tip
from drakerock.lhd.measurement import MEASUREMENT
from drakerock.loading.config import ControlConfig, WeightTransferConfig
from drakerock.loading.control import RAISE_RAMP, FeedforwardController, calc_motor_speeds
from drakerock.loading.plan import NoPlan
from drakerock.loading.segments import (
    TIMEOUTS,
    WAYPOINT_TIMES,
    Mode,
    SegmentTracker,
    calc_allowed_time,
    calc_passed,
)
from tests.unit.loading.test_planning import make_wedge, plan_for


@pytest.fixture(scope="module")
def plan(digger):
    return plan_for(digger, make_wedge(), beta=0.6, kappa=0.6)


def drive(plan, digger, config, blocked=()):
    """Let an ideal machine follow the controller's law; in a blocked mode nothing moves."""
    kin = digger.kinematics
    phi_l, phi_b, x = float(plan.phi_l[0]), float(plan.phi_b[0]), float(plan.waypoint_x[0]) - 1.0
    mode, entered, time, dt = Mode.APPROACH, 0.0, 0.0, 0.01
    times, timeouts, track = [], [], []
    while mode < Mode.DONE and time < 120:
        tip = calc_tip(kin, 0.0, phi_l, phi_b)
        psi = float(calc_pitch(kin, phi_l, phi_b))
        state = (x, float(tip[1]), psi)
        passed = calc_passed(plan, mode, kin, *state, phi_l, phi_b)
        if passed or time - entered > calc_allowed_time(plan, mode, config):
            times.append(time)
            timeouts.append(not passed)
            mode, entered = Mode(mode + 1), time
            continue
        rates = calc_motor_speeds(plan, mode, kin, *state)
        track.append((time, int(mode), *state))
        if mode not in blocked:
            velocity = calc_jacobian(kin, phi_l, phi_b) @ rates
            x += float(velocity[0]) * dt
            phi_l += float(rates[1]) * dt
            phi_b += float(rates[2]) * dt
        time += dt
    return np.array(times), timeouts, np.array(track)


def test_ideal_machine_follows_the_plan(plan, digger):
    times, timeouts, track = drive(plan, digger, ControlConfig())
    assert not any(timeouts)
    assert times - times[0] == pytest.approx(plan.waypoint_t, abs=0.12)
    lift = track[track[:, 1] == Mode.S1]
    # The driven path is the planned one to within a step's travel.
    for _, _, x, z, _ in lift[:: max(1, len(lift) // 20)]:
        distance = np.hypot(plan.x - x, plan.z - z).min()
        assert distance < 0.03
    assert track[-1, 4] == pytest.approx(plan.psi_m, abs=0.02)


@pytest.mark.parametrize("blocked", [Mode.S0, Mode.S1, Mode.S2])
def test_blocked_segment_ends_five_seconds_late_and_the_cycle_goes_on(plan, digger, blocked):
    times, timeouts, _ = drive(plan, digger, ControlConfig(), blocked=(blocked,))
    assert timeouts[blocked]
    planned = plan.waypoint_t[blocked] - plan.waypoint_t[blocked - 1]
    assert times[blocked] - times[blocked - 1] == pytest.approx(planned + 5.0, abs=0.03)
    assert len(times) == 5


def test_speeds_never_fall_to_zero_before_the_waypoint(plan, digger):
    for x in np.linspace(plan.waypoint_x[1], plan.waypoint_x[2], 50):
        assert plan.v_x.calc(x) >= 0.1 * plan.drive_speed - 1e-12
    kin = digger.kinematics
    stuck = calc_motor_speeds(plan, Mode.S1, kin, plan.waypoint_x[2] - 1e-6, plan.v_z.at[-1] - 1e-6, 9.0)
    assert stuck[0] > 0
    assert stuck[1] < 0


def test_only_the_bucket_moves_at_s2_and_only_the_wheels_at_s3(plan, digger):
    kin = digger.kinematics
    assert calc_motor_speeds(plan, Mode.S2, kin, 0, 0, 0) == pytest.approx([0, 0, -plan.tilt_rate])
    reverse = calc_motor_speeds(plan, Mode.S3, kin, 0, 0, 0)
    assert reverse == pytest.approx([-1.3, 0, 0])
    assert np.all(calc_motor_speeds(plan, Mode.DONE, kin, 0, 0, 0) == 0)


def test_full_tilt_stop_passes_s3_though_the_boom_sags(plan, digger):
    kin = digger.kinematics
    phi_l = float(plan.phi_l[-1])
    args = (plan, Mode.S2, kin, 0.0, 0.0, plan.psi_m - 0.2, phi_l)
    assert not calc_passed(*args, 0.0)
    assert calc_passed(*args, -2.0)


def run_alone(digger, plan, measured, duration):
    builder = DiagramBuilder()
    controller = builder.AddSystem(FeedforwardController(digger.kinematics))
    tracker = builder.AddSystem(SegmentTracker(digger.kinematics, ControlConfig(), 0.01))
    plan_source = builder.AddSystem(ConstantValueSource(AbstractValue.Make(plan)))
    sensor = builder.AddSystem(ConstantVectorSource(measured))
    for system in (controller, tracker):
        builder.Connect(plan_source.get_output_port(), system.GetInputPort("plan"))
        builder.Connect(sensor.get_output_port(), system.GetInputPort("measurement"))
    builder.Connect(tracker.GetOutputPort("mode"), controller.GetInputPort("mode"))
    builder.ExportOutput(tracker.GetOutputPort("progress"), "progress")
    builder.ExportOutput(controller.GetOutputPort("motor_speeds"), "motor_speeds")
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(duration)
    root = simulator.get_context()
    return [
        np.array(simulator.get_system().GetOutputPort(name).Eval(root))
        for name in ("progress", "motor_speeds")
    ]


def test_controller_alone_in_a_users_diagram(plan, digger):
    measured = np.zeros(len(MEASUREMENT))
    measured[list(MEASUREMENT).index("x_T")] = plan.waypoint_x[0] + 1e-6
    progress, speeds = run_alone(digger, plan, measured, 1.0)
    assert progress[0] == Mode.S0
    assert progress[WAYPOINT_TIMES][0] == pytest.approx(0.0, abs=0.02)
    assert np.isnan(progress[WAYPOINT_TIMES][1])
    assert progress[TIMEOUTS].sum() == 0
    assert speeds == pytest.approx([1.3, 0.0, 0.0])


def test_without_a_plan_it_aborts_and_stands_still(digger):
    progress, speeds = run_alone(digger, NoPlan("nothing there"), np.zeros(len(MEASUREMENT)), 0.1)
    assert progress[0] == Mode.ABORTED
    assert np.all(speeds == 0)


def test_weight_is_transferred_during_the_push_alone(plan, digger):
    """The boom is raised at its rate, fades out at the height, and never lowers; nothing else changes."""
    kin = digger.kinematics
    transfer = WeightTransferConfig(height=0.15, rate=0.03)
    x, floor = float(plan.waypoint_x[0]) + 0.1, float(plan.waypoint_z[0])
    for mode in Mode:
        plain = calc_motor_speeds(plan, mode, kin, x, floor, 0.0)
        assert (calc_motor_speeds(plan, mode, kin, x, floor, 0.0, WeightTransferConfig()) == plain).all()
        changed = calc_motor_speeds(plan, mode, kin, x, floor, 0.0, transfer) - plain
        assert changed.tolist() == ([0.0, -0.03, 0.0] if mode == Mode.S0 else [0.0, 0.0, 0.0])
    rates = [
        calc_motor_speeds(plan, Mode.S0, kin, x, floor + lift, 0.0, transfer)[1]
        for lift in (-0.05, 0.15 - RAISE_RAMP, 0.15 - RAISE_RAMP / 2, 0.15, 0.3)
    ]
    assert rates == pytest.approx([-0.03, -0.03, -0.015, 0.0, 0.0], abs=1e-12)
