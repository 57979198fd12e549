"""The rocks' motion over a step: positions, rotations by the exponential map, free spin."""

from __future__ import annotations

import math

import numpy as np

from drakerock.rocks.engine.collision.broad_phase import rotate_inertia
from drakerock.rocks.engine.compiling import Array, Rotation, Vector, allocating_kernel, kernel
from drakerock.rocks.engine.solver import INVERSE_INERTIA, INVERSE_MASS

# No sum of a rock's coordinates and velocities is larger; NaN is not smaller either.
HUGE = 1e9


@allocating_kernel
def are_finite(values: Array, chosen: Array) -> bool:
    """Return whether all values of the rows `chosen` of a matrix are finite, and none is absurdly large."""
    finite = True
    for k in range(len(chosen)):
        for d in range(values.shape[1]):
            # Not math.isfinite: with sums reordered it is compiled to True.
            finite &= abs(values[chosen[k], d]) < HUGE
    return finite


@kernel
def turn(
    w: float, x: float, y: float, z: float, ax: float, ay: float, az: float
) -> tuple[float, float, float, float]:
    """Return the unit quaternion q turned by the rotation vector a (in W): exp(a) q."""
    angle2 = ax * ax + ay * ay + az * az
    half = 0.5 * math.sqrt(angle2)
    # sin(h) / (2 h), by its series where h is small
    factor = math.sin(half) / (2.0 * half) if half > 1e-6 else 0.5 - angle2 / 48.0
    c, u, v, s = math.cos(half), factor * ax, factor * ay, factor * az
    nw = c * w - u * x - v * y - s * z
    nx = c * x + u * w + v * z - s * y
    ny = c * y + v * w + s * x - u * z
    nz = c * z + s * w + u * y - v * x
    scale = 1.0 / math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
    return nw * scale, nx * scale, ny * scale, nz * scale


@kernel
def _make_rotation(w: float, x: float, y: float, z: float) -> Rotation:
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@kernel
def _solve_symmetric(m: Array, i: int, x: float, y: float, z: float) -> Vector:
    """Return M^-1 (x, y, z) for row i of symmetric matrices (xx xy xz yy yz zz)."""
    a, b, c, d, e, f = m[i, 0], m[i, 1], m[i, 2], m[i, 3], m[i, 4], m[i, 5]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    scale = 1.0 / (a * c00 + b * c01 + c * c02)
    c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
    return (
        scale * (c00 * x + c01 * y + c02 * z),
        scale * (c01 * x + c11 * y + c12 * z),
        scale * (c02 * x + c12 * y + c22 * z),
    )


@kernel
def set_bodies(
    awake: Array,
    velocities: Array,
    inverse_mass: Array,
    inverse_inertia: Array,
    bodies: Array,
    body_velocities: Array,
) -> None:
    """Set the bodies of the solve: awake rocks with their inertia, all others immovable and at rest.

    Args:
        awake: (m,) rocks.
        velocities: (n, 6) angular, translational, in W.
        inverse_mass: (n,) [1/kg].
        inverse_inertia: (n, 6) in W's axes.
        bodies: (n + 1, BODY_WIDTH) set; zero before.
        body_velocities: (n, 6) set; zero before.
    """
    for s in range(len(awake)):
        i = awake[s]
        for d in range(6):
            bodies[i, d] = body_velocities[i, d] = velocities[i, d]
            bodies[i, INVERSE_INERTIA + d] = inverse_inertia[i, d]
        bodies[i, INVERSE_MASS] = inverse_mass[i]


@kernel
def add_gravity(awake: Array, bodies: Array, change: Array) -> None:
    """Add gravity's change of velocity over a step (3,) to the awake rocks."""
    for s in range(len(awake)):
        for d in range(3):
            bodies[awake[s], 3 + d] += change[d]


@allocating_kernel
def move(
    awake: Array,
    bodies: Array,
    inverse_inertia_local: Array,
    time_step: float,
    quaternions: Array,
    positions: Array,
    new_quaternions: Array,
    new_positions: Array,
    new_velocities: Array,
    body_velocities: Array,
) -> bool:
    """Set the awake rocks' poses after the step, and their velocities.

    Free spin keeps the angular momentum: the rotation is taken with the angular velocity at the middle of the
    step (explicit mid-point), and the new angular velocity follows from the momentum and the new inertia.

    Args:
        awake: (m,) rocks.
        bodies: (n + 1, BODY_WIDTH) after the solve; set to zero.
        inverse_inertia_local: (n, 6) in the rocks' frames.
        time_step: [s].
        quaternions, positions: (n, 4), (n, 3) before the step.
        new_quaternions, new_positions, new_velocities: (n, 4), (n, 3), (n, 6) set for the awake rocks.
        body_velocities: (n, 6) set to the new velocities for them, too.

    Returns:
        False if any of it is not finite.
    """
    scratch = np.zeros((1, 6))
    local = np.zeros((1, 6))
    sane = True
    for s in range(len(awake)):
        i = awake[s]
        wx, wy, wz = bodies[i, 0], bodies[i, 1], bodies[i, 2]
        for d in range(3):
            new_positions[i, d] = positions[i, d] + time_step * bodies[i, 3 + d]
            new_velocities[i, 3 + d] = bodies[i, 3 + d]
        for d in range(6):
            local[0, d] = inverse_inertia_local[i, d]
            scratch[0, d] = bodies[i, INVERSE_INERTIA + d]
        qw, qx, qy, qz = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        lx, ly, lz = _solve_symmetric(scratch, 0, wx, wy, wz)
        half = 0.5 * time_step
        mw, mx, my, mz = turn(qw, qx, qy, qz, half * wx, half * wy, half * wz)
        rotate_inertia(_make_rotation(mw, mx, my, mz), local, scratch, 0)
        m = scratch[0]
        wx = m[0] * lx + m[1] * ly + m[2] * lz
        wy = m[1] * lx + m[3] * ly + m[4] * lz
        wz = m[2] * lx + m[4] * ly + m[5] * lz
        qw, qx, qy, qz = turn(qw, qx, qy, qz, time_step * wx, time_step * wy, time_step * wz)
        rotate_inertia(_make_rotation(qw, qx, qy, qz), local, scratch, 0)
        new_velocities[i, 0] = m[0] * lx + m[1] * ly + m[2] * lz
        new_velocities[i, 1] = m[1] * lx + m[3] * ly + m[4] * lz
        new_velocities[i, 2] = m[2] * lx + m[4] * ly + m[5] * lz
        new_quaternions[i, 0], new_quaternions[i, 1] = qw, qx
        new_quaternions[i, 2], new_quaternions[i, 3] = qy, qz
        total = qw + qx + qy + qz
        for d in range(3):
            total += new_positions[i, d] + new_velocities[i, d] + new_velocities[i, 3 + d]
        for d in range(6):
            body_velocities[i, d] = new_velocities[i, d]
        bodies[i] = 0.0
        # Not math.isfinite: with sums reordered it is compiled to True.
        if not abs(total) < HUGE:
            sane = False
    return sane
