"""Motors: hydraulic functions whose closed valves hold, wheels with a torque curve, as a plant's own actuators.

In a step of length h a motor's torque on its joint, whose rate is v before the step and v' after it, is

    clamp(D (w - v') + u, -P, P) + b,

an actuator with velocity gain D and largest torque P, which the solvers of plant and rocks treat implicitly, a
feed-forward u and a bias b that shifts the window of what it can give. D and P stay; w, u and b are chosen in each
step, from the command, the rate v, and torque and rate of the step before:

- A function that moves is a velocity source: w is the commanded rate, limited by `effort`.
- So is a wheel, limited by its curve. At v alone, a light wheel that spins would swing about its curve; so the limit
  is the curve at the rate that the wheel would have after the step, by its own inertia, at this torque and the load
  of the step before. Where that rate is v, the limit is the curve's; it never is above the stall torque.
- A function that is commanded to zero is a closed valve, and the trapped oil keeps its pressure but for what motion
  changes: w = 0 and the torque t of the step before is added, t' = t - D v', a spring of stiffness D / h that holds
  its place, up to `relief`. Beyond, it yields, and forgets where it was: t' stays at the relief.
- A function that a load would push back against its command has a check valve, which is closed as long as the load's
  pressure is above the pump's.

All meet without a jump of torque. u takes back what b does to a motor within its limits.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# A command below this is none: the valve is closed [rad/s].
DEADBAND = 1e-4


class MotorState(NamedTuple):
    """A motor in a step: its torque [N m], and its joint's rate at the step's beginning [rad/s]."""

    torque: float = 0.0
    rate: float = 0.0


class MotorCommand(NamedTuple):
    """What a motor is told for a step: rate [rad/s], feed-forward and bias [N m]."""

    rate: float
    feedforward: float
    bias: float


@dataclass(frozen=True)
class Motor:
    """A motor's law.

    Attributes:
        effort: largest torque while it moves; of a motor with a curve, at rest [N m].
        velocity: largest commanded rate [rad/s].
        damping: velocity gain D [N m s/rad].
        holds: whether it holds like a closed valve where it is commanded to zero.
        check_valve: whether nothing pushes it back against its command.
        relief: torque at which a closed valve yields [N m].
        curve: (k, 2) rate [rad/s] and largest torque [N m] from rest to no load; none: `effort` at every rate.
        inertia: of what a motor with a curve turns alone, a wheel [kg m^2].
        time_step: h [s].
    """

    effort: float
    velocity: float
    damping: float
    holds: bool = False
    check_valve: bool = False
    relief: float = 0.0
    curve: tuple[tuple[float, float], ...] = ()
    inertia: float = 0.0
    time_step: float = 0.01

    @cached_property
    def _columns(self) -> NDArray[np.float64]:
        """(2, k) the curve's rates and torques."""
        return np.array(self.curve).T

    @property
    def peak(self) -> float:
        """The largest torque of all [N m]."""
        return max(self.effort, self.relief) if self.holds else self.effort

    @property
    def half_window(self) -> float:
        """Half of what the actuator spans [N m]: P.

        The lower one of a function's two limits, so that neither side of a shifted window lies beyond its limit; at
        least half of the higher one, so that it has both signs.
        """
        return max(min(self.effort, self.relief), 0.5 * self.peak) if self.holds else self.effort

    def calc_limit(self, rate: float) -> float:
        """Return the largest torque [N m] of a moving motor at a rate [rad/s] in the torque's direction."""
        if not self.curve:
            return self.effort
        rates, torques = self._columns
        return float(np.interp(rate, rates, torques))

    def find_step_limit(self, side: float, rate: float, before: MotorState) -> float:
        """Return the largest torque [N m] on a side, 1 or -1, over a step that begins at a rate [rad/s]."""
        if not self.curve or side * rate < 0.0:
            return self.effort
        rates, torques = self._columns
        slope = self.inertia / self.time_step
        load = before.torque - slope * (rate - before.rate)
        # At the end's rate r the curve gives load + slope (r - rate): one rate, since the one falls, the other rises.
        end = np.interp(side * (slope * rate - load), slope * rates - torques, rates)
        return self.calc_limit(float(end))

    def find_rate(self, torque: float) -> float:
        """Return the largest rate [rad/s] at which a moving motor can give a torque [N m]; 0: at none."""
        if not self.curve:
            return float("inf") if torque <= self.effort else 0.0
        rates, torques = self._columns
        return float(np.interp(-torque, -torques, rates, left=0.0))

    def is_closed(self, wanted: float, rate: float, before: MotorState) -> bool:
        """Return whether the valve is closed.

        Args:
            wanted: commanded rate [rad/s].
            rate: the joint's [rad/s].
            before: the step before.
        """
        if not self.holds:
            return False
        if abs(wanted) <= DEADBAND:
            return True
        side = np.sign(wanted)
        trapped = min(side * before.torque - self.damping * side * rate, self.relief)
        pumped = min(self.damping * side * (wanted - rate), self.effort)
        return bool(self.check_valve and trapped >= pumped)

    def calc_command(self, wanted: float, rate: float, before: MotorState) -> MotorCommand:
        """Return what the motor is told for the coming step; arguments as of `is_closed`."""
        wanted = min(max(wanted, -self.velocity), self.velocity)
        if self.is_closed(wanted, rate, before):
            target, carried, side, limit = 0.0, before.torque, np.sign(before.torque), self.relief
        else:
            target, carried, side = wanted, 0.0, np.sign(wanted - rate)
            # Brakes have their whole torque on either side.
            limit = self.effort if abs(wanted) <= DEADBAND else self.find_step_limit(side, rate, before)
        bias = float(side * (limit - self.half_window))
        return MotorCommand(target, carried - bias, bias)
