"""Where a loading is on its plan: segments, waypoints, time-outs (method section 5, control)."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drakerock.lhd.kinematics import Kinematics, calc_bucket_range
from drakerock.lhd.measurement import MEASUREMENT
from drakerock.loading.config import ControlConfig
from drakerock.loading.plan import DigPlan, NoPlan


class Mode(IntEnum):
    """What the machine is doing; `S0` to `S3` are the segments that begin at that waypoint."""

    APPROACH = 0
    S0 = 1
    S1 = 2
    S2 = 3
    S3 = 4
    DONE = 5
    ABORTED = 6


# Layout of the tracker's discrete state.
MODE, ENTERED = 0, 1
WAYPOINT_TIMES = slice(2, 7)  # t0 to t4, nan until passed
TIMEOUTS = slice(7, 12)  # 1 where a mode (APPROACH to S3) ended by its time-out
N_STATE = 12

FULL_TILT_TOLERANCE = 0.005  # the joint limit gives this much under load [rad]


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

    s3 is also passed at the full-tilt stop: a boom that yields to its load, or a chassis that pitches, can
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


class SegmentTracker(LeafSystem):
    """Follows the tip along the plan: which segment is driven, when waypoints were passed, what timed out.

    Input ports:
        ``plan``: abstract, a `DigPlan` or `NoPlan`.
        ``measurement``: the machine's measurement vector (`drakerock.lhd.measurement.MEASUREMENT`), in W.

    Output ports:
        ``mode``: (1,) the `Mode`.
        ``progress``: (12,) mode, time it was entered [s], waypoint times t0 to t4 [s, nan until passed], and 1
            for each mode (APPROACH to S3) that ended by its time-out.
    """

    def __init__(self, kinematics: Kinematics, config: ControlConfig, time_step: float) -> None:
        """Make the tracker; modes advance every `time_step` [s]."""
        super().__init__()
        self.set_name("segment_tracker")
        self._kinematics = kinematics
        self._config = config
        self._indices = [list(MEASUREMENT).index(name) for name in ("x_T", "z_T", "psi", "phi_l", "phi_b")]
        self._plan = self.DeclareAbstractInputPort("plan", AbstractValue.Make(NoPlan("")))
        self._measurement = self.DeclareVectorInputPort("measurement", len(MEASUREMENT))
        initial = np.zeros(N_STATE)
        initial[WAYPOINT_TIMES] = np.nan
        state = self.DeclareDiscreteState(initial)
        self.DeclarePeriodicDiscreteUpdateEvent(time_step, 0.0, self._update)
        self.DeclareVectorOutputPort("mode", 1, self._calc_mode, {self.discrete_state_ticket(state)})
        self.DeclareStateOutputPort("progress", state)

    def _update(self, context: Context, values: DiscreteValues) -> None:
        progress = np.array(context.get_discrete_state_vector().value())
        plan = self._plan.Eval(context)
        mode, time = Mode(int(progress[MODE])), context.get_time()
        if isinstance(plan, NoPlan):
            if mode != Mode.ABORTED:
                progress[MODE], progress[ENTERED] = Mode.ABORTED, time
        elif mode < Mode.DONE:
            measured = self._measurement.Eval(context)
            late = time - progress[ENTERED] > calc_allowed_time(plan, mode, self._config)
            passed = calc_passed(plan, mode, self._kinematics, *(float(measured[k]) for k in self._indices))
            if passed or late:
                progress[TIMEOUTS][mode] = float(not passed)
                progress[WAYPOINT_TIMES][mode] = time
                progress[MODE], progress[ENTERED] = mode + 1, time
        values.set_value(progress)

    def _calc_mode(self, context: Context, output: BasicVector) -> None:
        output[0] = context.get_discrete_state_vector()[MODE]
