"""Steering by the articulation: the closed form against the kinematics of the bent machine, integrated.

It has caught a law that fed the front unit's own heading back: in reverse it bent the machine to its limit and back.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.value import AbstractValue
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.systems.framework import Context, DiagramBuilder

from drakerock.lhd.config import MachineConfig
from drakerock.lhd.measurement import MEASUREMENT
from drakerock.lhd.model import Machine, add_machine
from drakerock.loading.config import SteeringConfig
from drakerock.loading.plan import DigPlan, NoPlan
from drakerock.loading.segments import Mode
from drakerock.loading.steering import LineSteering, calc_steering_angle, measure_axles

L_FRONT, L_REAR, LIMIT = 2.35, 2.1, math.radians(15)
STEP = 0.01
TURN = math.radians(8.0) * STEP / 1.3
"""Largest turn of the hinge over a step of the way: at 8 deg/s while the machine drives at 1.3 m/s [rad]."""


def drive(
    offset: float, heading: float, backwards: bool, preview: float, way: float, turn: float = TURN
) -> Iterator[tuple[float, float, float]]:
    """Yield the front axle's offset, its heading and the articulation's angle as an ideal machine is steered.

    Its axles do not slide sideways: that of the front unit moves along it, and the rear axle's velocity across
    the rear unit is zero, solved for the yaw rate with the hinge's own.
    """
    direction, angle = (-1.0 if backwards else 1.0), 0.0
    for _ in range(int(way / STEP)):
        wanted = calc_steering_angle(offset, heading, angle, backwards, preview, L_FRONT, L_REAR, LIMIT)
        bend = float(np.clip(wanted - angle, -turn, turn))
        # Across the rear unit: -d sin(angle) - yaw l_f cos(angle) - (yaw + bend) l_r = 0.
        yaw = -(direction * STEP * math.sin(angle) + bend * L_REAR) / (L_FRONT * math.cos(angle) + L_REAR)
        offset += direction * STEP * math.sin(heading + 0.5 * yaw)
        heading += yaw
        angle += bend
        yield offset, heading, angle


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("preview", [2.0, 4.0, 8.0])
@pytest.mark.parametrize(
    ("offset", "heading"), [(0.5, 0.0), (-0.5, 0.0), (0.0, 0.1), (0.0, -0.1), (0.3, 0.1), (0.3, -0.1)]
)
def test_machine_comes_back_to_the_line(offset, heading, backwards, preview):
    states = np.array(list(drive(offset, heading, backwards, preview, way=8.0 * preview + 4.0)))
    assert np.abs(states[:, 2]).max() <= LIMIT + 1e-12
    assert np.abs(states[-1]) == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize("preview", [2.0, 4.0, 8.0])
def test_front_axle_follows_the_solution(preview):
    """A small offset, a hinge without limit: e = e_0 (1 + (1 - l_b / P) u / P) exp(-u / P), after the first bend."""
    offset = 1e-3
    states = np.array(list(drive(offset, 0.0, False, preview, way=4.0 * preview, turn=1.0)))
    u = STEP * np.arange(1, len(states) + 1) / preview
    expected = offset * (1.0 + (1.0 - L_REAR / preview) * u) * np.exp(-u)
    np.testing.assert_allclose(states[:, 0], expected, atol=0.01 * offset)


@given(
    offset=st.floats(-1.0, 1.0),
    heading=st.floats(-0.2, 0.2),
    angle=st.floats(-0.2, 0.2),
    backwards=st.booleans(),
    preview=st.floats(1.0, 20.0),
)
def test_mirrored_machine_is_steered_mirrored(offset, heading, angle, backwards, preview):
    """Left and right are alike, and so are driving forward and, turned round, in reverse."""
    wanted = calc_steering_angle(offset, heading, angle, backwards, preview, L_FRONT, L_REAR, LIMIT)
    assert abs(wanted) <= LIMIT
    mirrored = calc_steering_angle(-offset, -heading, -angle, backwards, preview, L_FRONT, L_REAR, LIMIT)
    assert mirrored == pytest.approx(-wanted, abs=1e-12)
    # Turned by 180 deg about the line's middle, rear becomes front: the other unit's axle, on the other side.
    rear = heading + angle
    other = -(offset - L_FRONT * math.sin(heading) - L_REAR * math.sin(rear))
    turned = calc_steering_angle(other, rear, -angle, not backwards, preview, L_REAR, L_FRONT, LIMIT)
    assert turned == pytest.approx(-wanted, abs=1e-12)


def test_negative_angle_turns_left_as_the_machine_does():
    """To the right of the line it steers left, in reverse it bends the other way: the rear goes first there."""
    assert calc_steering_angle(-0.2, 0.0, 0.0, False, 4.0, L_FRONT, L_REAR, LIMIT) < 0.0
    assert calc_steering_angle(-0.2, 0.0, 0.0, True, 4.0, L_FRONT, L_REAR, LIMIT) < 0.0
    assert calc_steering_angle(0.0, 0.1, 0.0, False, 4.0, L_FRONT, L_REAR, LIMIT) > 0.0
    assert calc_steering_angle(0.0, 0.1, 0.0, True, 4.0, L_FRONT, L_REAR, LIMIT) < 0.0


@pytest.fixture(scope="module")
def shipped() -> tuple[MultibodyPlant, SceneGraph, Machine]:
    plant, scene_graph = AddMultibodyPlantSceneGraph(DiagramBuilder(), STEP)
    machine = add_machine(plant, MachineConfig())
    plant.Finalize()
    return plant, scene_graph, machine


def make_context(
    steering: LineSteering, plan: DigPlan | NoPlan, mode: Mode = Mode.APPROACH, **measured: float
) -> Context:
    context = steering.CreateDefaultContext()
    steering.GetInputPort("plan").FixValue(context, AbstractValue.Make(plan))
    steering.GetInputPort("mode").FixValue(context, [float(mode)])
    values = [measured.get(name, 0.0) for name in MEASUREMENT]
    steering.GetInputPort("measurement").FixValue(context, values)
    return context


def steer(steering: LineSteering, context: Context, steps: int) -> list[float]:
    angles = []
    for _ in range(steps):
        updated = steering.EvalUniquePeriodicDiscreteUpdate(context).value(0)
        context.SetDiscreteState(0, updated)
        angles.append(float(steering.GetOutputPort("steering_angle").Eval(context)[0]))
    return angles


def test_axles_are_those_of_the_machine(shipped):
    plant, _, machine = shipped
    assert measure_axles(plant, machine) == pytest.approx((2.35, 2.35), abs=1e-9)


@pytest.mark.parametrize("speed", [1.0, -1.0])
def test_turns_at_its_rate_to_its_limit(shipped, plan, speed):
    plant, _, machine = shipped
    config = SteeringConfig(rate_deg=10.0, limit_deg=5.0)
    steering = LineSteering(plant, machine, config)
    context = make_context(steering, plan, y_F=1.0, v_F=speed)
    angles = steer(steering, context, 100)
    assert abs(angles[0]) == pytest.approx(math.radians(0.1))
    assert np.abs(np.diff(angles)).max() <= math.radians(0.1) + 1e-12
    assert abs(angles[-1]) == pytest.approx(math.radians(5.0))


@pytest.mark.parametrize(
    ("mode", "speed", "planned"),
    [
        (Mode.APPROACH, 0.0, True),
        (Mode.APPROACH, 0.09, True),
        (Mode.S3, -0.09, True),
        (Mode.S0, 1.0, True),
        (Mode.S1, 0.5, True),
        (Mode.S2, 0.5, True),
        (Mode.DONE, -0.5, True),
        (Mode.APPROACH, 1.0, False),
    ],
)
def test_holds_its_angle_at_standstill_and_in_the_pile(shipped, plan, mode, speed, planned):
    plant, _, machine = shipped
    steering = LineSteering(plant, machine, SteeringConfig())
    where = plan if planned else NoPlan("nothing to dig")
    context = make_context(steering, where, mode, y_F=1.0, yaw_F=0.1, v_F=speed)
    assert steer(steering, context, 10) == [0.0] * 10
