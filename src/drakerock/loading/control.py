"""Feed-forward control of a dig plan (method section 5, control)."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drakerock.lhd.kinematics import Kinematics, calc_bucket_range
from drakerock.lhd.measurement import MEASUREMENT
from drakerock.loading.config import ControlConfig
from drakerock.loading.plan import DigPlan, NoPlan, calc_motor_rates, clamp_rates

Array = NDArray[np.float64]


class Mode(IntEnum):
    """What the controller is doing; `S0` to `S3` are the segments that begin at that waypoint."""

    APPROACH = 0
    S0 = 1
    S1 = 2
    S2 = 3
    S3 = 4
    DONE = 5
    ABORTED = 6


# Layout of the controller's discrete state.
MODE, ENTERED = 0, 1
WAYPOINT_TIMES = slice(2, 7)  # t0 to t4, nan until passed
TIMEOUTS = slice(7, 12)  # 1 where a mode (APPROACH to S3) ended by its time-out
N_STATE = 12

FULL_TILT_TOLERANCE = 0.005  # the joint limit gives this much under load [rad]


def project_on_path(plan: DigPlan, segment: int, x: float, z: float) -> int:
    """Return the index of the path point of `segment` nearest to the tip (x, z)."""
    points = np.flatnonzero(plan.segment == segment)
    if len(points) == 0:
        return int(np.searchsorted(plan.segment, segment))
    distance = (plan.x[points] - x) ** 2 + (plan.z[points] - z) ** 2
    return int(points[np.argmin(distance)])


def calc_motor_speeds(
    plan: DigPlan, mode: Mode, kinematics: Kinematics, x: float, z: float, psi: float
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
    """
    if mode in (Mode.APPROACH, Mode.S0):
        speeds = np.array([plan.drive_speed / kinematics.wheel_radius, 0.0, 0.0])
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


def calc_passed(
    plan: DigPlan,
    mode: Mode,
    kinematics: Kinematics,
    x: float,
    z: float,
    psi: float,
    phi_l: float,
    phi_b: float,
) -> bool:
    """Return whether the waypoint that ends `mode` is passed: s0, s1, s4 by x, s2 by x or z, s3 by psi.

    s3 is also passed at the full-tilt stop: a boom that sags under its load, or a chassis that pitches, can
    leave the bucket at its stop with psi short of the plan, and nothing is left to turn then.

    Args:
        plan: the plan.
        mode: the segment driven.
        kinematics: the machine's geometry.
        x, z: tip position in W [m].
        psi: bucket pitch [rad].
        phi_l, phi_b: joint angles [rad].
    """
    if mode == Mode.APPROACH:
        return x >= plan.waypoint_x[0]
    if mode == Mode.S0:
        return x >= plan.waypoint_x[1]
    if mode == Mode.S1:
        return x >= plan.waypoint_x[2] or z >= plan.waypoint_z[2]
    if mode == Mode.S2:
        at_stop = phi_b <= calc_bucket_range(kinematics, phi_l)[0] + FULL_TILT_TOLERANCE
        return bool(psi >= plan.waypoint_psi[3] or at_stop)
    if mode == Mode.S3:
        return x <= plan.waypoint_x[4]
    return False


def calc_allowed_time(plan: DigPlan, mode: Mode, config: ControlConfig) -> float:
    """Return how long `mode` may last: a segment its planned time plus the time-out [s]."""
    if mode == Mode.APPROACH:
        return config.approach_time
    planned = plan.waypoint_t[mode] - plan.waypoint_t[mode - 1]
    return float(planned) + config.timeout


class FeedforwardController(LeafSystem):
    """Drives the motors at the plan's joint rates; no feedback brings the tip back to the path.

    Input ports:
        ``plan``: abstract, a `DigPlan` or `NoPlan`.
        ``measurement``: the machine's measurement vector (`drakerock.lhd.MEASUREMENT`), in W.

    Output ports:
        ``motor_speeds``: (3,) targets of wheels, boom and bucket [rad/s].
        ``mode``: (1,) the `Mode`.
        ``progress``: (12,) mode, time it was entered [s], waypoint times t0 to t4 [s, nan until passed], and 1
            for each mode (APPROACH to S3) that ended by its time-out.
    """

    def __init__(self, kinematics: Kinematics, config: ControlConfig, time_step: float) -> None:
        """Make the controller; its modes advance every `time_step` [s]."""
        super().__init__()
        self.set_name("feedforward_controller")
        self._kinematics = kinematics
        self._config = config
        self._indices = [list(MEASUREMENT).index(name) for name in ("x_T", "z_T", "psi", "phi_l", "phi_b")]
        self._plan = self.DeclareAbstractInputPort("plan", AbstractValue.Make(NoPlan("")))
        self._measurement = self.DeclareVectorInputPort("measurement", len(MEASUREMENT))
        initial = np.zeros(N_STATE)
        initial[WAYPOINT_TIMES] = np.nan
        state = self.DeclareDiscreteState(initial)
        self.DeclarePeriodicDiscreteUpdateEvent(time_step, 0.0, self._update)
        # Not of time itself: what was solved for the log at a step's end then serves the next step's update.
        self.DeclareVectorOutputPort(
            "motor_speeds",
            3,
            self._calc_motor_speeds,
            {self._plan.ticket(), self._measurement.ticket(), self.xd_ticket()},
        )
        self.DeclareVectorOutputPort("mode", 1, self._calc_mode, {self.discrete_state_ticket(state)})
        self.DeclareStateOutputPort("progress", state)

    def _read(self, context: Context) -> list[float]:
        """Return x_T, z_T, psi, phi_l, phi_b."""
        measured = self._measurement.Eval(context)
        return [float(measured[k]) for k in self._indices]

    def _update(self, context: Context, values: DiscreteValues) -> None:
        progress = np.array(context.get_discrete_state_vector().value())
        plan = self._plan.Eval(context)
        mode, time = Mode(int(progress[MODE])), context.get_time()
        if isinstance(plan, NoPlan):
            if mode != Mode.ABORTED:
                progress[MODE], progress[ENTERED] = Mode.ABORTED, time
        elif mode < Mode.DONE:
            late = time - progress[ENTERED] > calc_allowed_time(plan, mode, self._config)
            passed = calc_passed(plan, mode, self._kinematics, *self._read(context))
            if passed or late:
                progress[TIMEOUTS][mode] = float(not passed)
                progress[WAYPOINT_TIMES][mode] = time
                progress[MODE], progress[ENTERED] = mode + 1, time
        values.set_value(progress)

    def _calc_motor_speeds(self, context: Context, output: BasicVector) -> None:
        plan = self._plan.Eval(context)
        if isinstance(plan, NoPlan):
            output.SetFromVector(np.zeros(3))
            return
        mode = Mode(int(context.get_discrete_state_vector()[MODE]))
        output.SetFromVector(calc_motor_speeds(plan, mode, self._kinematics, *self._read(context)[:3]))

    def _calc_mode(self, context: Context, output: BasicVector) -> None:
        output[0] = context.get_discrete_state_vector()[MODE]
