"""Vectors, rotations and symmetric matrices inside kernels, where arrays of three would cost more than they hold.

A vector is three numbers, a rotation nine by rows, a symmetric matrix six: xx xy xz yy yz zz. Sums are taken from left
to right, so that results keep their bits wherever they are written so.
"""

from __future__ import annotations

import math

from drakerock.rocks.engine.compiling import Array, Quaternion, Rotation, Symmetric, Vector, kernel

# Of a unit vector one component is 1 / sqrt(3) = 0.577 at least: tangents are made of a part that is long enough.
LEAST_COMPONENT = 0.57
# Below these angles series are exact to rounding, and their quotients 0 / 0 in the end [rad].
SMALL_ANGLE = 1e-4
SMALL_HALF_ANGLE = 1e-6


@kernel
def get_vector(values: Array) -> Vector:
    """Return the first three numbers of an array."""
    return values[0], values[1], values[2]


@kernel
def set_vector(vector: Vector, values: Array) -> None:
    """Set the first three numbers of an array."""
    values[0], values[1], values[2] = vector


@kernel
def dot(a: Vector, b: Vector) -> float:
    """Return a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def add(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@kernel
def subtract(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@kernel
def scale(factor: float, a: Vector) -> Vector:
    """Return factor a."""
    return factor * a[0], factor * a[1], factor * a[2]


@kernel
def negate(a: Vector) -> Vector:
    """Return -a."""
    return -a[0], -a[1], -a[2]


@kernel
def multiply_symmetric(m: Symmetric, v: Vector) -> Vector:
    """Return M v of a symmetric M (an array or a tuple of six)."""
    return (
        m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
        m[1] * v[0] + m[3] * v[1] + m[4] * v[2],
        m[2] * v[0] + m[4] * v[1] + m[5] * v[2],
    )


@kernel
def solve_symmetric(m: Symmetric, v: Vector) -> Vector:
    """Return M^-1 v of a symmetric M (an array or a tuple of six)."""
    a, b, c, d, e, f = m[0], m[1], m[2], m[3], m[4], m[5]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    factor = 1.0 / (a * c00 + b * c01 + c * c02)
    c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
    return (
        factor * (c00 * v[0] + c01 * v[1] + c02 * v[2]),
        factor * (c01 * v[0] + c11 * v[1] + c12 * v[2]),
        factor * (c02 * v[0] + c12 * v[1] + c22 * v[2]),
    )


@kernel
def rotate_symmetric(r: Rotation, m: Symmetric) -> Symmetric:
    """Return R M R^T of a symmetric M (an array or a tuple of six)."""
    xx, xy, xz, yy, yz, zz = m[0], m[1], m[2], m[3], m[4], m[5]
    m00, m01, m02 = r[0] * xx + r[1] * xy + r[2] * xz, r[0] * xy + r[1] * yy + r[2] * yz, r[0] * xz + r[1] * yz + r[2] * zz  # noqa: E501  # fmt: skip
    m10, m11, m12 = r[3] * xx + r[4] * xy + r[5] * xz, r[3] * xy + r[4] * yy + r[5] * yz, r[3] * xz + r[4] * yz + r[5] * zz  # noqa: E501  # fmt: skip
    m20, m21, m22 = r[6] * xx + r[7] * xy + r[8] * xz, r[6] * xy + r[7] * yy + r[8] * yz, r[6] * xz + r[7] * yz + r[8] * zz  # noqa: E501  # fmt: skip
    return (
        m00 * r[0] + m01 * r[1] + m02 * r[2],
        m00 * r[3] + m01 * r[4] + m02 * r[5],
        m00 * r[6] + m01 * r[7] + m02 * r[8],
        m10 * r[3] + m11 * r[4] + m12 * r[5],
        m10 * r[6] + m11 * r[7] + m12 * r[8],
        m20 * r[6] + m21 * r[7] + m22 * r[8],
    )


@kernel
def make_tangents(n: Vector) -> tuple[Vector, Vector]:
    """Return two unit vectors that complete a unit vector to a right-handed frame."""
    nx, ny, nz = n
    if abs(nx) > LEAST_COMPONENT:
        factor = 1.0 / math.sqrt(nx * nx + ny * ny)
        tx, ty, tz = -ny * factor, nx * factor, 0.0
    else:
        factor = 1.0 / math.sqrt(ny * ny + nz * nz)
        tx, ty, tz = 0.0, -nz * factor, ny * factor
    return (tx, ty, tz), (ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx)


@kernel
def get_rotation(rotations: Array, k: int) -> Rotation:
    """Return rotation `k` of (n, 3, 3)."""
    r = rotations[k]
    return r[0, 0], r[0, 1], r[0, 2], r[1, 0], r[1, 1], r[1, 2], r[2, 0], r[2, 1], r[2, 2]


@kernel
def rotate(r: Rotation, v: Vector) -> Vector:
    """Return R v."""
    return (
        r[0] * v[0] + r[1] * v[1] + r[2] * v[2],
        r[3] * v[0] + r[4] * v[1] + r[5] * v[2],
        r[6] * v[0] + r[7] * v[1] + r[8] * v[2],
    )


@kernel
def rotate_back(r: Rotation, v: Vector) -> Vector:
    """Return R^T v."""
    return (
        r[0] * v[0] + r[3] * v[1] + r[6] * v[2],
        r[1] * v[0] + r[4] * v[1] + r[7] * v[2],
        r[2] * v[0] + r[5] * v[1] + r[8] * v[2],
    )


@kernel
def make_rotation(q: Quaternion) -> Rotation:
    """Return the rotation of a unit quaternion w x y z."""
    w, x, y, z = q
    return (
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@kernel
def rotate_quaternion(q: Quaternion, a: Vector) -> Quaternion:
    """Return a unit quaternion q rotated further by the rotation vector a (in W): exp(a) q."""
    w, x, y, z = q
    angle2 = dot(a, a)
    half = 0.5 * math.sqrt(angle2)
    # sin(h) / (2 h), by its series where h is small
    factor = math.sin(half) / (2.0 * half) if half > SMALL_HALF_ANGLE else 0.5 - angle2 / 48.0
    c, u, v, s = math.cos(half), factor * a[0], factor * a[1], factor * a[2]
    nw = c * w - u * x - v * y - s * z
    nx = c * x + u * w + v * z - s * y
    ny = c * y + v * w + s * x - u * z
    nz = c * z + s * w + u * y - v * x
    inverse = 1.0 / math.sqrt(nw * nw + nx * nx + ny * ny + nz * nz)
    return nw * inverse, nx * inverse, ny * inverse, nz * inverse


@kernel
def rotate_rotation(r: Rotation, a: Vector) -> Rotation:
    """Return a rotation R rotated further by the rotation vector a (in W): exp(a) R."""
    x, y, z = a
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    # sin(t) / t and (1 - cos(t)) / t^2, by their series where t is small
    s = math.sin(angle) / angle if angle > SMALL_ANGLE else 1.0 - angle2 / 6.0
    c = (1.0 - math.cos(angle)) / angle2 if angle > SMALL_ANGLE else 0.5 - angle2 / 24.0
    t = 1.0 - c * angle2
    m0, m1, m2 = t + c * x * x, c * x * y - s * z, c * x * z + s * y
    m3, m4, m5 = c * x * y + s * z, t + c * y * y, c * y * z - s * x
    m6, m7, m8 = c * x * z - s * y, c * y * z + s * x, t + c * z * z
    return (
        m0 * r[0] + m1 * r[3] + m2 * r[6], m0 * r[1] + m1 * r[4] + m2 * r[7], m0 * r[2] + m1 * r[5] + m2 * r[8],
        m3 * r[0] + m4 * r[3] + m5 * r[6], m3 * r[1] + m4 * r[4] + m5 * r[7], m3 * r[2] + m4 * r[5] + m5 * r[8],
        m6 * r[0] + m7 * r[3] + m8 * r[6], m6 * r[1] + m7 * r[4] + m8 * r[7], m6 * r[2] + m7 * r[5] + m8 * r[8],
    )  # fmt: skip
