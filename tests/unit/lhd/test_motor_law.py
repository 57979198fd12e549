"""The motors' law on one joint, against closed forms: what a valve holds and yields to, stall, no load, no chatter.

The joint is stepped here by the law as `motor_law` states it, piece by piece, without Drake.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drakerock.lhd.motor_law import DEADBAND, Motor, MotorState

STEP = 0.01
INERTIA = 1e5  # of a loaded boom about its hinge [kg m^2]
FUNCTION = Motor(2e6, 1.0, 1e8, holds=True, check_valve=True, relief=2.2e6)
COMPLIANT = Motor(2e6, 1.0, 1e8)
WHEEL = 950.0  # a wheel alone about its axle [kg m^2]
LINEAR = Motor(190e3, 1.3, 1e8, curve=((0.0, 190e3), (1.56, 0.0)), inertia=WHEEL)
KNEE = Motor(190e3, 1.3, 1e8, curve=((0.0, 190e3), (0.5, 190e3), (1.0, 95e3), (1.5, 0.0)), inertia=WHEEL)


def step(motor, command, load, inertia, rate):
    """Return rate and torque at the end of a step, the law's three pieces tried in turn."""
    offset = command.bias + load
    for fixed, slope in (
        (motor.damping * command.rate + command.feedforward, motor.damping),
        (motor.half_window, 0.0),
        (-motor.half_window, 0.0),
    ):
        end = (inertia * rate + STEP * (fixed + offset)) / (inertia + STEP * slope)
        acting = motor.damping * (command.rate - end) + command.feedforward
        if (
            abs(np.clip(acting, -motor.half_window, motor.half_window) - (fixed - slope * end))
            <= 1e-6 * motor.peak
        ):
            return end, fixed - slope * end + command.bias
    raise AssertionError("no piece of the law fits")


def run(motor, wanted, load, duration, inertia=INERTIA, rate=0.0):
    """Step a joint under a load [N m]; wanted and load are functions of time. Return rates, torques, angles."""
    rows, angle, before = [], 0.0, MotorState(0.0, rate)
    for k in range(round(duration / STEP)):
        command = motor.calc_command(wanted(k * STEP), rate, before)
        start = rate
        rate, torque = step(motor, command, load(k * STEP), inertia, start)
        before = MotorState(torque, start)
        angle += STEP * rate
        rows.append((rate, torque, angle))
    return np.array(rows).T


@pytest.mark.parametrize("load", [1.5e6, -1.5e6])
def test_closed_valve_holds_below_its_relief(load):
    """10 s under load: a spring of stiffness D / h, and no drift beyond it; at 3.9 m it is less than a millimetre."""
    rates, torques, angles = run(FUNCTION, lambda _: 0.0, lambda _: load, 10.0)
    assert np.abs(angles).max() * 3.9 < 1e-3
    assert angles[-1] == pytest.approx(load / (FUNCTION.damping / STEP), rel=1e-6)
    assert angles[-1] == pytest.approx(angles[50], rel=1e-9)
    assert np.abs(rates[50:]).max() < 1e-12
    assert torques[-1] == pytest.approx(-load)


@pytest.mark.parametrize("relief", [1.5e6, 2.2e6])
def test_closed_valve_yields_at_its_relief(relief):
    """A load above it falls with what is left, and where the load ends the joint holds again, without a rebound."""
    motor = Motor(2e6, 1.0, 1e8, holds=True, check_valve=True, relief=relief)
    excess = 1e5
    rates, torques, angles = run(motor, lambda _: 0.0, lambda t: relief + excess if t < 1.0 else 0.3e6, 2.0)
    assert torques[10:100] == pytest.approx(-relief)
    assert np.diff(rates[10:100]) == pytest.approx(excess / INERTIA * STEP, rel=1e-6)
    assert rates[-1] == pytest.approx(0.0, abs=1e-9)
    assert torques[-1] == pytest.approx(-0.3e6)
    assert angles[-1] == pytest.approx(angles[150], abs=1e-9)


def test_the_methods_compliance_lets_a_load_sag():
    _, _, angles = run(COMPLIANT, lambda _: 0.0, lambda _: 1e6, 1.0)
    assert angles[-1] == pytest.approx(1e6 / 1e8, rel=0.01)


@given(
    wanted=st.floats(-1, 1).filter(lambda w: abs(w) > 10 * DEADBAND),
    load=st.floats(-1.9e6, 1.9e6),
    motor=st.sampled_from([FUNCTION, COMPLIANT]),
)
def test_moving_function_is_a_velocity_source(wanted, load, motor):
    """With the method's compliance; a load that compliance would let push it back stops a function that holds."""
    rates, _, _ = run(motor, lambda _: wanted, lambda _: load, 2.5)
    expected = wanted + load / motor.damping
    if motor.holds and expected * wanted < 0:
        expected = 0.0
    assert rates[-1] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("side", [-1, 1])
def test_check_valve(side):
    """Beyond the effort a load does not push a moving function back, and it goes on where the load falls below."""
    motor = Motor(2e6, 1.0, 1e8, holds=True, check_valve=True, relief=2.5e6)
    without = Motor(2e6, 1.0, 1e8, holds=True, relief=2.5e6)

    def load(t):
        return -side * (2.3e6 if 0.5 <= t < 1.5 else 1.8e6)

    rates, torques, angles = run(motor, lambda _: side * 0.3, load, 2.0)
    assert side * rates[40] == pytest.approx(0.3 - 0.018)
    stopped = slice(70, 150)
    assert np.abs(rates[stopped]).max() < 1e-6
    assert side * torques[stopped] == pytest.approx(2.3e6)
    assert np.ptp(angles[stopped]) < 1e-6
    assert side * rates[-1] == pytest.approx(0.3 - 0.018)
    # Without it the pump alone carries 2.0 of the 2.3.
    rates, _, _ = run(without, lambda _: side * 0.3, load, 1.5)
    assert side * rates[-1] < -2.0


def test_no_chatter_between_holding_and_moving():
    """A load about the effort, a command about zero: torque follows the load, nothing swings from step to step."""
    rng = np.random.default_rng(3)
    loads = np.clip(np.cumsum(rng.normal(0.0, 2e4, 400)) + 1.95e6, 1.7e6, 2.15e6)

    def at(t):
        return -float(loads[round(t / STEP)])

    rates, torques, _ = run(FUNCTION, lambda t: 0.05 if t % 0.5 < 0.25 else 0.0, at, 4.0)
    free = np.abs(torques) < FUNCTION.relief * 0.999
    # Where it neither yields nor is accelerated or halted, the torque is the load.
    still = free & (np.abs(np.diff(rates, prepend=0.0)) < 1e-3)
    assert still.mean() > 0.6
    assert np.abs(torques - loads)[still].max() < 1.5e-3 * INERTIA / STEP
    # A load above the effort pushes back for the step in which it closes the check valve.
    assert rates.min() > -(2.15e6 - FUNCTION.effort) / INERTIA * STEP
    assert np.abs(np.diff(torques)).max() < 0.06 * INERTIA / STEP + 1e5


def test_stall_and_no_load():
    """A blocked wheel has the stall torque, a free one runs up to what was commanded, at most to no load."""
    _, torques, _ = run(LINEAR, lambda _: 1.3, lambda _: 0.0, 0.5, inertia=1e15)
    assert torques[-1] == pytest.approx(190e3)
    rates, torques, _ = run(LINEAR, lambda _: 1.3, lambda _: 0.0, 2.0, inertia=1e3)
    assert rates[-1] == pytest.approx(1.3)
    assert torques[-1] == pytest.approx(0.0, abs=1.0)
    fast = replace(LINEAR, velocity=3.0)
    rates, torques, _ = run(fast, lambda _: 3.0, lambda _: 0.0, 5.0, inertia=1e3)
    assert rates[-1] == pytest.approx(1.56, rel=1e-6)
    assert torques[-1] == pytest.approx(0.0, abs=1.0)


@pytest.mark.parametrize("motor", [LINEAR, KNEE])
@pytest.mark.parametrize("load", [-150e3, -60e3])
@pytest.mark.parametrize("inertia", [WHEEL, 2.5e3, 5e4])
def test_loaded_wheel_settles_on_its_curve(motor, load, inertia):
    """Light wheels, which an explicit curve would make swing, and heavy ones."""
    fast = replace(motor, velocity=3.0)
    rates, torques, _ = run(fast, lambda _: 3.0, lambda _: load, 6.0, inertia=inertia)
    assert rates[-1] == pytest.approx(motor.find_rate(-load), rel=1e-3)
    assert motor.calc_limit(motor.find_rate(-load)) == pytest.approx(-load)
    assert rates.max() < motor.find_rate(-load) + 0.06, "it does not swing about its curve"
    assert np.ptp(torques[-100:]) < 1.0
    assert torques.max() <= 190e3 * (1.0 + 1e-9)


@given(
    loads=st.lists(st.floats(-2e5, 1e5), min_size=10, max_size=20),
    inertia=st.floats(WHEEL, 5e4),
    motor=st.sampled_from([LINEAR, KNEE]),
)
def test_no_blow_drives_a_wheel_above_its_stall_torque(loads, inertia, motor):
    _, torques, _ = run(
        motor, lambda _: 1.3, lambda t: loads[round(t / STEP)], STEP * len(loads), inertia=inertia
    )
    assert torques.max() <= 190e3 * (1.0 + 1e-9)


def test_run_up_follows_the_exponential_of_a_linear_curve():
    """A heavy wheel, whose load the first steps do not know: its torque comes up with a lag of two steps."""
    rates, _, _ = run(LINEAR, lambda _: 1.3, lambda _: 0.0, 0.6, inertia=5e4)
    time = STEP * np.arange(1, 61)
    expected = 1.56 * (1.0 - np.exp(-time * 190e3 / 1.56 / 5e4))
    below = expected < 1.25
    assert rates[below] == pytest.approx(expected[below], abs=2 * STEP * 190e3 / 5e4)


def test_wheel_brakes_with_its_whole_torque():
    rates, torques, _ = run(LINEAR, lambda _: 0.0, lambda _: 0.0, 0.3, inertia=5e4, rate=1.3)
    assert torques[:20] == pytest.approx(-190e3)
    assert np.diff(rates[:20]) == pytest.approx(-190e3 / 5e4 * STEP)


def test_a_curve_that_no_load_reaches():
    assert LINEAR.find_rate(2e5) == 0.0
    assert COMPLIANT.find_rate(2.1e6) == 0.0
    assert COMPLIANT.find_rate(1e6) == np.inf
