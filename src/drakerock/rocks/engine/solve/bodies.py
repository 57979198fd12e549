"""Rocks in the solve: how they answer to impulses, and how the points of a contact move against each other.

An impulse p at an arm r from a body's centre of mass changes its velocities by  dv = p / m,  dw = I^-1 (r x p).  The
velocity of the point is v + w x r, so its mobility, velocity per impulse at the point, is  1 / m - [r]x I^-1 [r]x.
"""

from __future__ import annotations

from drakerock.rocks.engine.compiling import Array, Record, Symmetric, Vector, kernel
from drakerock.rocks.engine.memory_access import prefetch
from drakerock.rocks.engine.vectors import add, cross, dot, get_vector, multiply_symmetric, subtract


@kernel
def push(arm: Vector, impulse: Vector, sign: float, body: Record) -> None:
    """Change a rock's velocities by an impulse at an arm, times a sign."""
    turning = multiply_symmetric(body.inverse_inertia, cross(arm, impulse))
    factor = sign * body.inverse_mass
    angular, linear = body.angular, body.linear
    for d in range(3):
        angular[d] += sign * turning[d]
        linear[d] += factor * impulse[d]


@kernel
def copy_velocity(source: Record, target: Record) -> None:
    """Copy a body's velocities."""
    for d in range(3):
        target.angular[d] = source.angular[d]
        target.linear[d] = source.linear[d]


@kernel
def copy_body(source: Record, target: Record) -> None:
    """Copy a body's velocities and inertia, between precisions, too."""
    copy_velocity(source, target)
    target.inverse_mass = source.inverse_mass
    for d in range(6):
        target.inverse_inertia[d] = source.inverse_inertia[d]


@kernel
def add_mobility(body: Record, arm: Vector, mobility: Array) -> None:
    """Add the mobility of a rock's point at an arm (xx xy xz yy yz zz)."""
    rx, ry, rz = arm
    inertia, inverse_mass = body.inverse_inertia, body.inverse_mass
    # - [r]x I^-1 [r]x, column by column
    _, c0y, c0z = multiply_symmetric(inertia, (0.0, rz, -ry))
    c1x, c1y, c1z = multiply_symmetric(inertia, (-rz, 0.0, rx))
    c2x, c2y, c2z = multiply_symmetric(inertia, (ry, -rx, 0.0))
    mobility[0] += inverse_mass + c0y * rz - c0z * ry
    mobility[1] += c1y * rz - c1z * ry
    mobility[2] += c2y * rz - c2z * ry
    mobility[3] += inverse_mass + c1z * rx - c1x * rz
    mobility[4] += c2z * rx - c2x * rz
    mobility[5] += inverse_mass + c2x * ry - c2y * rx


@kernel
def calc_mobility_along(mobility: Symmetric, a: Vector, b: Vector) -> float:
    """Return a^T M b: the velocity along a by a unit impulse along b."""
    return dot(a, multiply_symmetric(mobility, b))


@kernel
def calc_relative_velocity(row: Record, body_a: Record, body_b: Record) -> Vector:
    """Return the velocity of B's point against A's in W [m/s]; a machine body counts about its own origin."""
    spin_b = cross(get_vector(body_b.angular), get_vector(row.arm_b))
    spin_a = cross(get_vector(row.arm_a), get_vector(body_a.angular))
    return add(add(subtract(get_vector(body_b.linear), get_vector(body_a.linear)), spin_b), spin_a)


@kernel
def calc_normal_velocity(row: Record, body_a: Record, body_b: Record) -> float:
    """Return how fast a row's points part along its normal [m/s]."""
    return float(dot(get_vector(row.normal), calc_relative_velocity(row, body_a, body_b)))


@kernel
def prefetch_bodies(body_a: Array, body_b: Array, row: int, bodies: Array) -> None:
    """Ask for the two bodies of a row, see `memory_access`."""
    prefetch(bodies, body_a[row])
    prefetch(bodies, min(body_b[row], len(bodies) - 1))
