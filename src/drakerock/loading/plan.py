"""DigPlan: a bucket path with its speeds, as a value that can be drawn, stored and replayed."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drakerock.lhd.kinematics import Kinematics, calc_joint_rates

Array = NDArray[np.float64]


def calc_motor_rates(
    kin: Kinematics, phi_l: float, phi_b: float, v_x: float, v_z: float, omega: float
) -> Array:
    """Return the rates (wheel, boom, bucket) [rad/s] for a tip velocity, clamped to the motors' limits.

    The plan is integrated with the rates that the controller will ask for, limits included (section 5, speeds).

    Args:
        kin: the machine's geometry and limits.
        phi_l, phi_b: boom and bucket angle [rad].
        v_x, v_z: tip velocity [m/s].
        omega: curl rate, nose-up positive [rad/s].
    """
    return clamp_rates(kin, calc_joint_rates(kin, phi_l, phi_b, v_x, v_z, omega))


def clamp_rates(kin: Kinematics, rates: Array) -> Array:
    """Return the rates (wheel, boom, bucket) clamped to the motors' limits [rad/s]."""
    limits = np.array([kin.wheel_speed, kin.boom_speed, kin.bucket_speed])
    return np.clip(rates, -limits, limits)


@dataclass(frozen=True, eq=False)
class SpeedTable:
    """A speed as a function of the coordinate that drives it.

    Attributes:
        at: (k,) the coordinate, rising.
        speed: (k,) the speed there.
    """

    at: Array
    speed: Array

    def calc(self, value: float) -> float:
        """Return the speed at `value`; before the first and after the last point, theirs."""
        return float(np.interp(value, self.at, self.speed))


@dataclass(frozen=True, eq=False)
class DigPlan:
    """The plan of one loading (method section 5): waypoints s0 to s4, path, speeds.

    Attributes:
        y: the entry point's y_gamma, the machine's centreline [m].
        slope: the pile's slope averaged around the entry point, xi_gamma [rad].
        h_s2: the dig height beta h_p [m].
        psi_m: the pitch at the full-tilt stop for the boom angle at s2 [rad].
        volume: the undisturbed pile's volume that the plan sweeps [m^3].
        volume_wanted: alpha V_b [m^3].
        reached: whether the wanted volume can be swept; if not, the plan sweeps the nearest it can.
        waypoint_x, waypoint_z, waypoint_psi: (5,) tip position [m] and bucket pitch [rad] at s0 to s4.
        waypoint_t: (5,) planned times, 0 at s0 [s].
        x, z, psi: (k,) tip path from s0 to s4 [m, m, rad].
        phi_l, phi_b: (k,) the joint angles along it [rad].
        t: (k,) planned times [s].
        segment: (k,) 0 for [s0, s1] to 3 for [s3, s4].
        v_x: speed of the tip over x on [s1, s2] [m/s]; v_z: over the height z; omega: over the pitch [rad/s].
        drive_speed: forward speed before s1 and reverse speed after s3 [m/s].
        tilt_rate: the bucket's rate on [s2, s3] [rad/s].
        swept: (m, 2) outline of the swept section in the plane of x and z [m].
    """

    y: float
    slope: float
    h_s2: float
    psi_m: float
    volume: float
    volume_wanted: float
    reached: bool
    waypoint_x: Array
    waypoint_z: Array
    waypoint_psi: Array
    waypoint_t: Array
    x: Array
    z: Array
    psi: Array
    phi_l: Array
    phi_b: Array
    t: Array
    segment: NDArray[np.int64]
    v_x: SpeedTable
    v_z: SpeedTable
    omega: SpeedTable
    drive_speed: float
    tilt_rate: float
    swept: Array

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, for JSON."""
        return {key: _to_plain(value) for key, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> DigPlan:
        """Return the plan that `to_dict` wrote."""
        values: dict[str, Any] = {}
        for item in fields(cls):
            value = data[item.name]
            if isinstance(value, dict):
                value = SpeedTable(np.array(value["at"]), np.array(value["speed"]))
            elif isinstance(value, list):
                value = np.array(value)
            values[item.name] = value
        return cls(**values)


@dataclass(frozen=True)
class NoPlan:
    """There is nothing to dig or nowhere to enter; `reason` says why."""

    reason: str


def _to_plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _to_plain(item) for key, item in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value
