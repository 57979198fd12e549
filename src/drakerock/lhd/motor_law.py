"""Motors: hydraulic functions whose closed valves hold, wheels with a torque curve, as a plant's own actuators.

In a step of length h a motor's torque on its joint, whose rate is v before the step and v' after it, is

    clamp(D (w - v') + u, -P, P) + b - c v',

an actuator with velocity gain D and peak torque P, which the solvers of plant and rocks treat implicitly, a
feed-forward u, a bias b that shifts the window of what it can give, and a drag c (joint damping, implicit, too).
D, P and c stay; w, u and b are chosen in each step, from the command, the rate v and the torque t of the step before:

- A function that moves is a velocity source: w is the commanded rate, limited by `effort`. So is a wheel, limited by
  its curve at v, which the drag goes on along within the step: explicit, a spinning wheel would swing about its curve.
- A function that is commanded to zero is a closed valve, and the trapped oil keeps its pressure but for what motion
  changes: w = 0 and t is added, t' = t - D v', a spring of stiffness D / h that holds its place, up to `relief`.
  Beyond, it yields, and forgets where it was: t' stays at the relief.
- A function that a load would push back against its command has a check valve, which is closed as long as the load's
  pressure is above the pump's.

All three meet without a jump of torque. u takes back what b and c do to a motor within its limits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

# A command below this is none: the valve is closed [rad/s].
DEADBAND = 1e-4


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
    """

    effort: float
    velocity: float
    damping: float
    holds: bool = False
    check_valve: bool = False
    relief: float = 0.0
    curve: tuple[tuple[float, float], ...] = ()

    @property
    def peak(self) -> float:
        """The largest torque of all [N m]."""
        return max(self.effort, self.relief) if self.holds else self.effort

    @property
    def drag(self) -> float:
        """The damping that goes along the curve within a step [N m s/rad]: its mean slope, or half the steepest one.

        Less than half of a curve's slope would be unstable on a light wheel.
        """
        if not self.curve:
            return 0.0
        rates, torques = np.array(self.curve).T
        return float(max(torques[0] / rates[-1], 0.5 * np.max(-np.diff(torques) / np.diff(rates))))

    def calc_limit(self, rate: float) -> float:
        """Return the largest torque [N m] of a moving motor at a rate [rad/s] in the torque's direction."""
        if not self.curve:
            return self.effort
        rates, torques = np.array(self.curve).T
        return float(np.interp(rate, rates, torques))

    def find_rate(self, torque: float) -> float:
        """Return the largest rate [rad/s] at which a moving motor can give a torque [N m]; 0: at none."""
        if not self.curve:
            return float("inf") if torque <= self.effort else 0.0
        rates, torques = np.array(self.curve).T
        return float(np.interp(-torque, -torques, rates, left=0.0))

    def is_closed(self, wanted: float, rate: float, torque: float) -> bool:
        """Return whether the valve is closed.

        Args:
            wanted: commanded rate [rad/s].
            rate: the joint's [rad/s].
            torque: the motor's in the step before [N m].
        """
        if not self.holds:
            return False
        if abs(wanted) <= DEADBAND:
            return True
        side = np.sign(wanted)
        trapped = min(side * torque - self.damping * side * rate, self.relief)
        pumped = min(self.damping * side * (wanted - rate), self.effort)
        return bool(self.check_valve and trapped >= pumped)

    def calc_command(self, wanted: float, rate: float, torque: float) -> MotorCommand:
        """Return what the motor is told for the coming step; arguments as of `is_closed`."""
        wanted = float(np.clip(wanted, -self.velocity, self.velocity))
        if self.is_closed(wanted, rate, torque):
            target, carried, side, limit = 0.0, torque, np.sign(torque), self.relief
        else:
            side = np.sign(wanted - rate)
            target, carried, limit = wanted, 0.0, self.calc_limit(side * rate)
        bias = float(side * (limit - self.peak) + self.drag * rate)
        return MotorCommand(target, carried - bias + self.drag * target, bias)
