"""Pure kinematics of boom, bucket and wheels in the machine's vertical plane (section 2 of the method).

Angles phi_l (boom) and phi_b (bucket, relative to the boom) count from the upward vertical, a rotation about
+y: x = r sin(phi), z = r cos(phi). The pitch psi of the bucket is 0 when its floor is level and positive
nose-up. The machine stands level on undeflected tyres, straight, heading along +x; heights count from the
floor. Arguments that are ArrayLike broadcast.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.plant import MultibodyPlant
from scipy.optimize import brentq

from drakerock.errors import InputError
from drakerock.lhd.model import Machine
from drakerock.lhd.tracing import find_range

Array = np.ndarray


@dataclass(frozen=True)
class Kinematics:
    """Lengths, angles and limits of a machine.

    Attributes:
        wheel_radius: r_w [m].
        boom_length: r_lb, boom hinge to bucket hinge [m].
        bucket_length: r_bt, bucket hinge to tip [m].
        p_FA: (2,) x and z of the boom hinge in the front unit's frame F [m].
        phi_level: phi_l + phi_b at psi = 0 [rad].
        phi_l_range: (2,) highest (smallest phi_l) and lowest boom angle [rad].
        phi_l_grid: (k,) boom angles [rad], increasing, at which the bucket's range is tabulated.
        phi_b_min, phi_b_max: (k,) full tilt and full dump of the bucket [rad] at those boom angles.
        wheel_speed, boom_speed, bucket_speed: the motors' velocity limits [rad/s].
    """

    wheel_radius: float
    boom_length: float
    bucket_length: float
    p_FA: Array
    phi_level: float
    phi_l_range: Array
    phi_l_grid: Array
    phi_b_min: Array
    phi_b_max: Array
    wheel_speed: float
    boom_speed: float
    bucket_speed: float


def make_kinematics(plant: MultibodyPlant, machine: Machine) -> Kinematics:
    """Read the machine's kinematics off the finalized plant; the linkage's stops give the ranges.

    Raises:
        InputError: the linkage isn't closed in the reference pose, or boom or bucket have no stops (`find_range`).
    """
    context = plant.CreateDefaultContext()
    instance = machine.instance
    front = plant.GetFrameByName("front_unit", instance)

    def locate(name: str, base: str) -> Array:
        frame = plant.GetFrameByName(name, instance)
        return frame.CalcPose(context, plant.GetFrameByName(base, instance)).translation()

    p_BT = locate("tip", "bucket")
    boom = plant.GetJointByName("boom_joint", instance)
    bucket = plant.GetJointByName("bucket_joint", instance)
    p_FA = boom.frame_on_parent().CalcPose(context, front).translation()
    p_LB = bucket.frame_on_parent().CalcPose(context, plant.GetFrameByName("boom", instance)).translation()
    none = np.zeros(0)
    kin = Kinematics(
        wheel_radius=float(-locate("floor", "front_unit")[2]),
        boom_length=float(np.linalg.norm(p_LB)),
        bucket_length=float(np.linalg.norm(p_BT[[0, 2]])),
        p_FA=p_FA[[0, 2]],
        phi_level=float(np.arctan2(p_BT[0], p_BT[2])),
        phi_l_range=none,
        phi_l_grid=none,
        phi_b_min=none,
        phi_b_max=none,
        wheel_speed=machine.wheel.velocity,
        boom_speed=machine.boom.velocity,
        bucket_speed=machine.bucket.velocity,
    )
    phi_l, phi_b = (float(angle) for angle in calc_joint_angles(kin, 0.0, 0.0))
    table = find_range(plant, machine, phi_l, phi_b)
    return replace(
        kin,
        phi_l_range=table[[0, -1], 0],
        phi_l_grid=table[:, 0],
        phi_b_min=table[:, 1],
        phi_b_max=table[:, 2],
    )


def calc_pitch(kin: Kinematics, phi_l: ArrayLike, phi_b: ArrayLike) -> Array:
    """Return the bucket's pitch psi [rad], nose-up positive."""
    return kin.phi_level - np.asarray(phi_l) - np.asarray(phi_b)


def calc_bucket_pose(kin: Kinematics, x_f: ArrayLike, phi_l: ArrayLike, phi_b: ArrayLike) -> Array:
    """Return (..., 3): the bucket hinge's x and z [m], psi [rad]; `x_f` is the front axle's x [m]."""
    x = np.asarray(x_f) + kin.p_FA[0] + kin.boom_length * np.sin(phi_l)
    z = kin.wheel_radius + kin.p_FA[1] + kin.boom_length * np.cos(phi_l)
    return np.stack(np.broadcast_arrays(x, z, calc_pitch(kin, phi_l, phi_b)), axis=-1)


def calc_tip(kin: Kinematics, x_f: ArrayLike, phi_l: ArrayLike, phi_b: ArrayLike) -> Array:
    """Return (..., 2): x and z of the bucket tip in the world [m]; `x_f` is the front axle's x."""
    pose = calc_bucket_pose(kin, x_f, phi_l, phi_b)
    phi = np.asarray(phi_l) + np.asarray(phi_b)
    return pose[..., :2] + kin.bucket_length * np.stack(
        np.broadcast_arrays(np.sin(phi), np.cos(phi)), axis=-1
    )


def calc_jacobian(kin: Kinematics, phi_l: float, phi_b: float) -> Array:
    """Return the (3, 3) matrix from the rates (wheel, boom, bucket) to (v_x, v_z, omega_b), section 2."""
    a, b, phi = kin.boom_length, kin.bucket_length, phi_l + phi_b
    return np.array(
        [
            [kin.wheel_radius, b * np.cos(phi) + a * np.cos(phi_l), b * np.cos(phi)],
            [0.0, -b * np.sin(phi) - a * np.sin(phi_l), -b * np.sin(phi)],
            [0.0, -1.0, -1.0],
        ]
    )


def calc_joint_rates(
    kin: Kinematics, phi_l: float, phi_b: float, v_x: float, v_z: float, omega_b: float
) -> Array:
    """Return the rates (wheel, boom, bucket) [rad/s] that give the tip's velocity (section 2).

    The boom only raises: where the wanted velocity asks it to lower, its rate is 0 and v_z is not met.

    Args:
        kin: the machine.
        phi_l, phi_b: boom and bucket angle [rad].
        v_x, v_z: tip velocity [m/s].
        omega_b: curl rate [rad/s], nose-up positive.
    """
    a, b, phi = kin.boom_length, kin.bucket_length, phi_l + phi_b
    boom = min((b * np.sin(phi) * omega_b - v_z) / (a * np.sin(phi_l)), 0.0)
    bucket = -boom - omega_b
    wheel = (v_x - (b * np.cos(phi) + a * np.cos(phi_l)) * boom - b * np.cos(phi) * bucket) / kin.wheel_radius
    return np.array([wheel, boom, bucket])


def calc_bucket_range(kin: Kinematics, phi_l: ArrayLike) -> tuple[Array, Array]:
    """Return phi_b at full tilt (smallest) and at full dump (largest) [rad] for a boom angle."""
    angle = np.asarray(phi_l, dtype=float)
    low = np.interp(angle, kin.phi_l_grid, kin.phi_b_min)
    high = np.interp(angle, kin.phi_l_grid, kin.phi_b_max)
    return low, high


def calc_full_tilt(kin: Kinematics, phi_l: ArrayLike) -> Array:
    """Return psi_m [rad], the pitch at the full-tilt stop for a boom angle."""
    return calc_pitch(kin, phi_l, calc_bucket_range(kin, phi_l)[0])


def calc_joint_angles(kin: Kinematics, z_tip: ArrayLike, psi: ArrayLike) -> tuple[Array, Array]:
    """Return (phi_l, phi_b) [rad] that put the tip at height `z_tip` [m] with the pitch `psi` [rad].

    Nothing is clamped: compare with `phi_l_range` and `calc_bucket_range`. Heights out of reach give NaN.
    """
    phi = kin.phi_level - np.asarray(psi)
    cosine = (
        np.asarray(z_tip) - kin.bucket_length * np.cos(phi) - kin.wheel_radius - kin.p_FA[1]
    ) / kin.boom_length
    phi_l = np.arccos(np.where(np.abs(cosine) <= 1, cosine, np.nan))
    return phi_l, phi - phi_l


def calc_reach(kin: Kinematics, slope: float) -> float:
    """Return r_ft [m]: how far up a plane slope [rad] the tip of the level bucket gets.

    The front wheels touch the slope's front; measured along the slope from its toe (section 5).

    Raises:
        InputError: the tip does not meet the slope at any boom angle.
    """
    # Wheel on the floor and against the slope: the toe lies this far ahead of the axle.
    x_toe = kin.wheel_radius * np.tan(slope / 2)

    def calc_height_above_slope(phi_l: float) -> float:
        x, z = calc_tip(kin, 0.0, phi_l, kin.phi_level - phi_l)
        return float(z - (x - x_toe) * np.tan(slope))

    ends = [calc_height_above_slope(float(phi_l)) for phi_l in kin.phi_l_range]
    if np.prod(ends) > 0:
        raise InputError(f"the tip of the level bucket does not meet a slope of {np.degrees(slope):.3g} deg")
    phi_l = brentq(calc_height_above_slope, *kin.phi_l_range)
    return float((calc_tip(kin, 0.0, phi_l, kin.phi_level - phi_l)[0] - x_toe) / np.cos(slope))
