"""Articulation steering: holds the plan's line across the drift.

Along the path, driving forward or in reverse, the front axle's offset e from the line and its heading theta obey
de/du = theta', dtheta'/du = kappa', where u is the way driven and theta' the angle between the line and the way the
axle moves. The curvature kappa' = -(e / L^2 + 2 theta' / L) brings both to zero without overshoot over the preview
distance L. A machine that is bent by gamma at its articulation turns with kappa = sin(gamma) / (l_f cos(gamma) + l_r),
l_f and l_r from the articulation to the axles: that is solved for gamma. (Kinematics of articulated vehicles:
P. Corke, P. Ridley, Steering kinematics for a center-articulated mobile robot, IEEE T-RA 17 (2001).)
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


def calc_steering_angle(
    offset: float,
    heading: float,
    backwards: bool,
    preview: float,
    l_front: float,
    l_rear: float,
    limit: float,
) -> float:
    """Return the articulation's joint angle [rad] that brings the front axle back to the line; negative turns left.

    Args:
        offset: of the front axle's middle to the left of the line [m].
        heading: of the front unit, positive to the left [rad].
        backwards: whether it drives in reverse.
        preview: L, the way over which offset and heading decay [m].
        l_front, l_rear: articulation to front and rear axle [m].
        limit: largest angle [rad].
    """
    sign = -1.0 if backwards else 1.0
    curvature = -(offset / preview**2 + sign * 2.0 * heading / preview)
    # sin(gamma) - kappa l_f cos(gamma) = kappa l_r: a sine of gamma, shifted.
    share = curvature * l_rear / math.hypot(1.0, curvature * l_front)
    angle = math.asin(min(max(share, -1.0), 1.0)) + math.atan(curvature * l_front)
    # The joint's angle is the rear unit's: it turns to the other side.
    return -min(max(angle, -limit), limit)


class LineSteering(LeafSystem):
    """Steers the articulation so that the machine drives along the plan's line y = const.

    The angle turns no faster than `rate`, and not at all while the machine stands: there is nothing to steer then, and
    tyres would scrub.

    Input ports:
        ``plan``: abstract, a `DigPlan` or `NoPlan`.
        ``measurement``: the machine's measurement vector (`drakerock.lhd.measurement.MEASUREMENT`), in W.
        ``motor_speeds``: (3,) the motors' target speeds; the wheels' says which way it drives.

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
        self._indices = [list(MEASUREMENT).index(name) for name in ("y_F", "yaw_F", "v_F")]
        self._plan = self.DeclareAbstractInputPort("plan", AbstractValue.Make(NoPlan("")))
        self._measurement = self.DeclareVectorInputPort("measurement", len(MEASUREMENT))
        self._speeds = self.DeclareVectorInputPort("motor_speeds", 3)
        state = self.DeclareDiscreteState([self._start])
        self.DeclarePeriodicDiscreteUpdateEvent(self._step, 0.0, self._update)
        self.DeclareVectorOutputPort(
            "steering_angle", 1, self._calc_angle, {self.discrete_state_ticket(state)}
        )

    def _update(self, context: Context, values: DiscreteValues) -> None:
        angle = float(context.get_discrete_state_vector()[0])
        plan = self._plan.Eval(context)
        if isinstance(plan, DigPlan):
            measured = self._measurement.Eval(context)
            y, yaw, speed = (float(measured[k]) for k in self._indices)
            backwards = bool(self._speeds.Eval(context)[0] < 0.0)
            wanted = calc_steering_angle(
                y - plan.y, yaw, backwards, self._config.preview, *self._lengths, self._limit
            )
            if abs(speed) > self._config.least_speed:
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
