"""Articulation steering: holds the plan's line across the drift, driving forward and in reverse.

The machine is two units on a hinge; seen in the direction of travel one leads, front or rear, and its axle is brought
to the line. With u the way driven, a the leading and b the trailing axle, l_a and l_b from the hinge to them and
L = l_a + l_b, e the leading axle's offset from the line, and gamma = theta_a - theta_b the bend, axles that do not
slide sideways obey

    de/du = sin theta_a,    dtheta_a/du = (sin gamma + l_b dgamma/du) / (l_a cos gamma + l_b).

The second term is the hinge's own: bending turns the leading unit by l_b / L of the bend, even at standstill. In terms
of the mean heading phi = (l_a theta_a + l_b theta_b) / L it is gone. For small angles

    de/du = phi + (l_b / L) gamma,    dphi/du = gamma / L,

and gamma = -L (k_1 e + k_2 phi) gives a closed loop with trace -(k_2 + l_b k_1) and determinant k_1: it is stable
if and only if k_1 > 0 and k_2 > -l_b k_1. The choice k_1 = 1 / P^2, k_2 = 2 / P - l_b / P^2 puts both poles at -1 / P,
for each preview distance P and each direction. From a parallel start at e_0, and P >= l_b, there is no overshoot:

    e = e_0 (1 + (1 - l_b / P) u / P) exp(-u / P).

Two things have to be so. The fed-back heading is phi, not that of one unit: with theta_a in its place the bend feeds
back on itself, and with the front unit's while driving in reverse the loop gain 1 - 2 l_r / P turns negative for
P < 2 l_r, which bends the machine to its limit and back. And the axle that leads is the one that is held: the other one
swings out before it follows (a zero in the right half-plane). (Kinematics: P. Corke, P. Ridley, Steering kinematics for
a center-articulated mobile robot, IEEE T-RA 17 (2001).)
"""

from __future__ import annotations

import math

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drakerock.lhd import names
from drakerock.lhd.measurement import MEASUREMENT
from drakerock.lhd.model import Machine
from drakerock.loading.config import SteeringConfig
from drakerock.loading.plan import DigPlan, NoPlan
from drakerock.loading.segments import Mode


def calc_steering_angle(
    offset: float,
    heading: float,
    angle: float,
    backwards: bool,
    preview: float,
    l_front: float,
    l_rear: float,
    limit: float,
) -> float:
    """Return the articulation's joint angle [rad] that brings the leading axle back to the line; see the module.

    Args:
        offset: of the front axle's middle from the line, along W's y [m].
        heading: of the front unit, positive to the left [rad].
        angle: of the articulation now: the rear unit's heading less the front unit's [rad].
        backwards: whether it drives in reverse, the rear unit leading.
        preview: P, the way over which offset and heading decay [m].
        l_front, l_rear: articulation to front and rear axle [m].
        limit: largest angle [rad].
    """
    length = l_front + l_rear
    rear_heading = heading + angle
    mean_heading = (l_front * heading + l_rear * rear_heading) / length
    if backwards:
        # Seen in the direction of travel left is where -y is; headings stay what they are.
        rear_offset = offset - l_front * math.sin(heading) - l_rear * math.sin(rear_heading)
        leading_offset, trailing = -rear_offset, l_front
    else:
        leading_offset, trailing = offset, l_rear
    k_1 = 1.0 / preview**2
    k_2 = 2.0 / preview - trailing / preview**2
    bend = -length * (k_1 * leading_offset + k_2 * mean_heading)
    bend = min(max(bend, -limit), limit)
    # The joint's angle is the rear unit's.
    return bend if backwards else -bend


STEERED = (Mode.APPROACH, Mode.S3)
"""The modes in which it steers."""


class LineSteering(LeafSystem):
    """Steers the articulation so that the machine drives along the plan's line y = const.

    It steers on the way to the pile and out of it, no faster than `rate_deg`. While the bucket digs, from s0 to s3,
    and while the machine stands, the angle is held: there the rocks turn the machine, its tyres slide, and the
    kinematics above do not hold.

    Input ports:
        ``plan``: abstract, a `DigPlan` or `NoPlan`.
        ``measurement``: the machine's measurement vector (`drakerock.lhd.measurement.MEASUREMENT`), in W.
        ``mode``: (1,) the `Mode`, from a `SegmentTracker`.

    Output port ``steering_angle``: (1,) target of the articulation's joint angle [rad].
    """

    def __init__(self, plant: MultibodyPlant, machine: Machine, config: SteeringConfig) -> None:
        """Make it for `machine` in the finalized `plant`; it acts every step."""
        super().__init__()
        self.set_name("line_steering")
        self._config = config
        self._start = machine.steering_angle
        self._lengths = measure_axles(plant, machine)
        joint = plant.GetJointByName("articulation", machine.instance)
        stops = joint.position_upper_limit(), -joint.position_lower_limit()
        self._limit = min(math.radians(config.limit_deg), *stops)
        self._step = plant.time_step()
        self._indices = [list(MEASUREMENT).index(name) for name in ("y_F", "yaw_F", "articulation", "v_F")]
        self._plan = self.DeclareAbstractInputPort("plan", AbstractValue.Make(NoPlan("")))
        self._measurement = self.DeclareVectorInputPort("measurement", len(MEASUREMENT))
        self._mode = self.DeclareVectorInputPort("mode", 1)
        state = self.DeclareDiscreteState([self._start])
        self.DeclarePeriodicDiscreteUpdateEvent(self._step, 0.0, self._update)
        self.DeclareVectorOutputPort(
            "steering_angle", 1, self._calc_angle, {self.discrete_state_ticket(state)}
        )

    def _update(self, context: Context, values: DiscreteValues) -> None:
        angle = float(context.get_discrete_state_vector()[0])
        plan = self._plan.Eval(context)
        if isinstance(plan, DigPlan) and Mode(int(self._mode.Eval(context)[0])) in STEERED:
            measured = self._measurement.Eval(context)
            y, yaw, bend, speed = (float(measured[k]) for k in self._indices)
            if abs(speed) > self._config.least_speed:
                wanted = calc_steering_angle(
                    y - plan.y, yaw, bend, speed < 0.0, self._config.preview, *self._lengths, self._limit
                )
                turn = math.radians(self._config.rate_deg) * self._step
                angle += float(np.clip(wanted - angle, -turn, turn))
        values.set_value([angle])

    def _calc_angle(self, context: Context, output: BasicVector) -> None:
        output[0] = context.get_discrete_state_vector()[0]


def measure_axles(plant: MultibodyPlant, machine: Machine) -> tuple[float, float]:
    """Return the distances from the articulation to the front and to the rear axle [m]."""
    context = plant.CreateDefaultContext()
    hinge = plant.GetJointByName("articulation", machine.instance).frame_on_parent()
    p_WJ = hinge.CalcPoseInWorld(context).translation()
    wheels = [
        plant.GetBodyByName(name, machine.instance).EvalPoseInWorld(context).translation()
        for name in names.WHEELS
    ]
    front, rear = (np.mean(pair, axis=0) - p_WJ for pair in (wheels[:2], wheels[2:]))
    return float(np.linalg.norm(front[:2])), float(np.linalg.norm(rear[:2]))
