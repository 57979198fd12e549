"""Feed-forward control of a dig plan (method section 5, control)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drakerock.lhd.kinematics import Kinematics
from drakerock.lhd.measurement import MEASUREMENT
from drakerock.loading.config import WeightTransferConfig
from drakerock.loading.plan import DigPlan, NoPlan, calc_motor_rates, clamp_rates
from drakerock.loading.segments import Mode

Array = NDArray[np.float64]

# The last bit of the raise for weight transfer, in which its rate fades out [m].
RAISE_RAMP = 0.02


def project_on_path(plan: DigPlan, segment: int, x: float, z: float) -> int:
    """Return the index of the path point of `segment` nearest to the tip (x, z)."""
    points = np.flatnonzero(plan.segment == segment)
    if len(points) == 0:
        return int(np.searchsorted(plan.segment, segment))
    distance = (plan.x[points] - x) ** 2 + (plan.z[points] - z) ** 2
    return int(points[np.argmin(distance)])


def calc_raise(plan: DigPlan, z: float, config: WeightTransferConfig) -> float:
    """Return the boom's rate that transfers weight during the push [rad/s]; it fades out at the wanted height.

    Args:
        plan: the plan.
        z: the tip's height [m].
        config: how far and how fast.
    """
    if config.height == 0.0:
        return 0.0
    left = float(plan.waypoint_z[0]) + config.height - z
    return -config.rate * min(max(left / RAISE_RAMP, 0.0), 1.0)


def calc_motor_speeds(
    plan: DigPlan,
    mode: Mode,
    kinematics: Kinematics,
    x: float,
    z: float,
    psi: float,
    weight_transfer: WeightTransferConfig | None = None,
) -> Array:
    """Return the motors' target speeds [wheel, boom, bucket] [rad/s].

    On [s1, s2] each of v_x, v_z and omega is read at its own coordinate (x, z, psi), which are clamped to the
    segment so that a speed holds until its waypoint is passed; the joint angles are the plan's own at
    the projection of the tip on the path.

    Args:
        plan: the plan.
        mode: the segment driven.
        kinematics: the machine's geometry.
        x, z: tip position in W [m].
        psi: bucket pitch [rad].
        weight_transfer: of the push; None: none.
    """
    if mode in (Mode.APPROACH, Mode.S0):
        speeds = np.array([plan.drive_speed / kinematics.wheel_radius, 0.0, 0.0])
        if mode == Mode.S0 and weight_transfer:
            speeds[1] = calc_raise(plan, z, weight_transfer)
    elif mode == Mode.S1:
        at = project_on_path(plan, 1, x, z)
        v_z = plan.v_z.calc(z) if z < plan.v_z.at[-1] else 0.0
        omega = plan.omega.calc(psi) if psi < plan.omega.at[-1] else 0.0
        speeds = calc_motor_rates(
            kinematics, float(plan.phi_l[at]), float(plan.phi_b[at]), plan.v_x.calc(x), v_z, omega
        )
    elif mode == Mode.S2:
        speeds = np.array([0.0, 0.0, -plan.tilt_rate])
    elif mode == Mode.S3:
        speeds = np.array([-plan.drive_speed / kinematics.wheel_radius, 0.0, 0.0])
    else:
        speeds = np.zeros(3)
    return clamp_rates(kinematics, speeds)


class FeedforwardController(LeafSystem):
    """Drives the motors at the plan's joint rates; no feedback brings the tip back to the path.

    Input ports:
        ``plan``: abstract, a `DigPlan` or `NoPlan`.
        ``mode``: (1,) the `Mode`, from a `SegmentTracker`.
        ``measurement``: the machine's measurement vector (`drakerock.lhd.measurement.MEASUREMENT`), in W.

    Output port ``motor_speeds``: (3,) targets of wheels, boom and bucket [rad/s].
    """

    def __init__(self, kinematics: Kinematics, weight_transfer: WeightTransferConfig | None = None) -> None:
        """Make the controller of a machine."""
        super().__init__()
        self.set_name("feedforward_controller")
        self._weight_transfer = weight_transfer
        self._kinematics = kinematics
        self._indices = [list(MEASUREMENT).index(name) for name in ("x_T", "z_T", "psi")]
        self._plan = self.DeclareAbstractInputPort("plan", AbstractValue.Make(NoPlan("")))
        self._mode = self.DeclareVectorInputPort("mode", 1)
        self._measurement = self.DeclareVectorInputPort("measurement", len(MEASUREMENT))
        # Not of time itself: what was solved for the log at a step's end then serves the next step's update.
        self.DeclareVectorOutputPort(
            "motor_speeds", 3, self._calc_motor_speeds, {self.all_input_ports_ticket()}
        )

    def _calc_motor_speeds(self, context: Context, output: BasicVector) -> None:
        plan = self._plan.Eval(context)
        if isinstance(plan, NoPlan):
            output.SetFromVector(np.zeros(3))
            return
        measured = self._measurement.Eval(context)
        mode = Mode(int(self._mode.Eval(context)[0]))
        x, z, psi = (float(measured[k]) for k in self._indices)
        output.SetFromVector(
            calc_motor_speeds(plan, mode, self._kinematics, x, z, psi, self._weight_transfer)
        )
