"""Controllers that yield to the pile: admittance, and slip control as operators do it. Alternatives to feed-forward.

A scenario names them as ``loading.parts.controller``: ``drakerock.loading.yielding_control:make_admittance`` or
``...:make_slip_control``. Both take the plan's joint rates (wheels phi'_w, boom phi'_l, bucket phi'_b), as
`FeedforwardController` does, and change them:

    admittance     phi' / (1 + F / F_half) for all three, on [s0, s3]
    slip control   phi'_w (1 - e) for the wheels, phi'_l - lift e / ease for the boom, on [s0, s2]

with F the rocks' force on the bucket, filtered to the first order, and e in [0, ease] rising with the slip ratio
(r_w phi'_w - v_F) / (r_w phi'_w) beyond the one that is allowed. A raised boom puts the pile's weight on the front
wheels, which then grip.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from drakerock.errors import InputError
from drakerock.lhd.kinematics import Kinematics
from drakerock.lhd.measurement import MEASUREMENT
from drakerock.loading.config import WeightTransferConfig
from drakerock.loading.control import calc_motor_speeds
from drakerock.loading.parts import StationView
from drakerock.loading.plan import NoPlan, clamp_rates
from drakerock.loading.segments import Mode

Array = NDArray[np.float64]

# Slower wheels than this have no slip ratio worth acting on [m/s].
_LEAST_WHEEL_SPEED = 0.1


def calc_admittance(planned: Array, force: float, half: float) -> Array:
    """Return speeds (3,) that yield to a force: half of the planned ones at `half`.

    Args:
        planned: wheels, boom, bucket [rad/s].
        force: of the rocks on the bucket [N].
        half: force at which the speeds are halved [N].
    """
    return planned / (1.0 + force / half)


def calc_slip_ratio(wheel_rate: float, v: float, wheel_radius: float) -> float:
    """Return by what share the tyres are faster than the machine that drives forward, in [0, 1]; 0 while they are slow.

    Args:
        wheel_rate: the wheels' mean rate [rad/s].
        v: forward speed [m/s].
        wheel_radius: [m].
    """
    rim = wheel_rate * wheel_radius
    return 0.0 if rim < _LEAST_WHEEL_SPEED else float(np.clip((rim - v) / rim, 0.0, 1.0))


def calc_easing(slip: float, allowed: float, ease: float) -> float:
    """Return how far the drive is eased off, in [0, ease]: not at all up to the allowed slip ratio, fully at 1."""
    return ease * float(np.clip((slip - allowed) / (1.0 - allowed), 0.0, 1.0))


class _YieldingController(LeafSystem):
    """Feed-forward whose speeds a filtered quantity changes; the filter is the discrete state."""

    def __init__(
        self,
        kinematics: Kinematics,
        weight_transfer: WeightTransferConfig,
        time_step: float,
        time_constant: float,
    ) -> None:
        super().__init__()
        self._kinematics, self._weight_transfer = kinematics, weight_transfer
        self._share = 1.0 - float(np.exp(-time_step / time_constant)) if time_constant > 0.0 else 1.0
        self._indices = [list(MEASUREMENT).index(name) for name in ("x_T", "z_T", "psi")]
        self._plan = self.DeclareAbstractInputPort("plan", AbstractValue.Make(NoPlan("")))
        self._mode = self.DeclareVectorInputPort("mode", 1)
        self._measurement = self.DeclareVectorInputPort("measurement", len(MEASUREMENT))
        state = self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(time_step, 0.0, self._update)
        inputs = {port.ticket() for port in (self._plan, self._mode, self._measurement)}
        self.DeclareVectorOutputPort(
            "motor_speeds", 3, self._calc_motor_speeds, inputs | {self.discrete_state_ticket(state)}
        )

    def _update(self, context: Context, values: DiscreteValues) -> None:
        before = float(context.get_discrete_state_vector()[0])
        values.set_value([before + self._share * (self._calc_quantity(context) - before)])

    def _calc_quantity(self, context: Context) -> float:
        raise NotImplementedError

    def _change(self, mode: Mode, planned: Array, filtered: float) -> Array:
        raise NotImplementedError

    def _calc_motor_speeds(self, context: Context, output: BasicVector) -> None:
        plan = self._plan.Eval(context)
        if isinstance(plan, NoPlan):
            output.SetFromVector(np.zeros(3))
            return
        measured = self._measurement.Eval(context)
        mode = Mode(int(self._mode.Eval(context)[0]))
        x, z, psi = (float(measured[k]) for k in self._indices)
        planned = calc_motor_speeds(plan, mode, self._kinematics, x, z, psi, self._weight_transfer)
        changed = self._change(mode, planned, float(context.get_discrete_state_vector()[0]))
        output.SetFromVector(clamp_rates(self._kinematics, changed))


class AdmittanceController(_YieldingController):
    """Feed-forward that yields to the force on the bucket while it digs.

    Ports: those of `FeedforwardController`; and the input port ``bucket_force``: (6,) torque and force of the rocks on
    the bucket in W, of the step that ended [N m, N].
    """

    def __init__(
        self,
        kinematics: Kinematics,
        weight_transfer: WeightTransferConfig,
        time_step: float,
        half_force: float,
        time_constant: float,
    ) -> None:
        """Make it.

        Args:
            kinematics: the machine's.
            weight_transfer: of the push.
            time_step: of the filter [s].
            half_force: at which the speeds are halved [N].
            time_constant: of the filter [s].
        """
        super().__init__(kinematics, weight_transfer, time_step, time_constant)
        self.set_name("admittance_controller")
        self._force = self.DeclareVectorInputPort("bucket_force", 6)
        self._half = half_force

    def _calc_quantity(self, context: Context) -> float:
        return float(np.linalg.norm(self._force.Eval(context)[3:]))

    def _change(self, mode: Mode, planned: Array, filtered: float) -> Array:
        return calc_admittance(planned, filtered, self._half) if Mode.S0 <= mode <= Mode.S2 else planned


class SlipController(_YieldingController):
    """Feed-forward that eases off the wheels and lifts the boom where the wheels slip.

    Ports: those of `FeedforwardController`.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        weight_transfer: WeightTransferConfig,
        time_step: float,
        allowed_slip: float,
        ease: float,
        lift: float,
        time_constant: float,
    ) -> None:
        """Make it.

        Args:
            kinematics: the machine's.
            weight_transfer: of the push.
            time_step: of the filter [s].
            allowed_slip: slip ratio up to which nothing is done [1].
            ease: share of the wheels' speed that is taken away at a slip ratio of 1.
            lift: rate at which the boom is raised then [rad/s].
            time_constant: of the filter [s].
        """
        super().__init__(kinematics, weight_transfer, time_step, time_constant)
        self.set_name("slip_controller")
        self._allowed, self._ease, self._lift = allowed_slip, ease, lift
        self._of_slip = [list(MEASUREMENT).index(name) for name in ("wheel_rate", "v_F")]

    def _calc_quantity(self, context: Context) -> float:
        rate, v = (float(self._measurement.Eval(context)[k]) for k in self._of_slip)
        return calc_slip_ratio(rate, v, self._kinematics.wheel_radius)

    def _change(self, mode: Mode, planned: Array, filtered: float) -> Array:
        if mode not in (Mode.S0, Mode.S1):
            return planned
        easing = calc_easing(filtered, self._allowed, self._ease)
        speeds = planned.copy()
        speeds[0] *= 1.0 - easing
        # The boom only raises: its rate is negative.
        speeds[1] -= self._lift * easing / self._ease if self._ease > 0.0 else 0.0
        return speeds


def make_admittance(
    view: StationView, half_force: float = 4.0e5, time_constant: float = 0.1
) -> AdmittanceController:
    """Return the admittance controller of a station, for `loading.parts.controller`.

    Args:
        view: the station.
        half_force: force on the bucket at which the speeds are half the planned ones [N].
        time_constant: of the force's filter [s].

    Raises:
        InputError: half_force is not above 0, or time_constant is below 0.
    """
    _check("half_force", half_force, 1.0, 1e9)
    _check("time_constant", time_constant, 0.0, 10.0)
    loading = view.scenario.loading
    return AdmittanceController(
        view.digger.kinematics,
        loading.control.weight_transfer,
        view.plant.time_step(),
        half_force,
        time_constant,
    )


def make_slip_control(
    view: StationView,
    allowed_slip: float = 0.15,
    ease: float = 0.5,
    lift: float = 0.05,
    time_constant: float = 0.2,
) -> SlipController:
    """Return the slip controller of a station, for `loading.parts.controller`.

    Args:
        view: the station.
        allowed_slip: slip ratio up to which nothing is done [1].
        ease: share of the wheels' speed that is taken away where they spin freely.
        lift: the boom's rate then [rad/s].
        time_constant: of the slip's filter [s].

    Raises:
        InputError: a parameter outside its range.
    """
    _check("allowed_slip", allowed_slip, 0.0, 0.95)
    _check("ease", ease, 0.0, 1.0)
    _check("lift", lift, 0.0, 1.0)
    _check("time_constant", time_constant, 0.0, 10.0)
    loading = view.scenario.loading
    return SlipController(
        view.digger.kinematics, loading.control.weight_transfer, view.plant.time_step(), allowed_slip, ease, lift,
        time_constant,
    )  # fmt: skip


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise InputError(f"loading.parts.controller.parameters.{name}: {value:g}; from {low:g} to {high:g}")
