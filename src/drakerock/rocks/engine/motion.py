"""The rocks' motion over a step: positions, rotations by the exponential map, free spin.

Free spin keeps the angular momentum L = I w in W. Over a step of length h the rotation R is taken with the angular
velocity at its middle (explicit mid-point rule), and the new angular velocity follows from the momentum and the new
inertia:

    R_m = exp(h/2 w) R,      w_m = (R_m I0^-1 R_m^T) L
    R'  = exp(h w_m) R,      w'  = (R' I0^-1 R'^T) L            I0 in the rock's frame
"""

from __future__ import annotations

from drakerock.rocks.engine.compiling import Array, allocating_kernel, kernel
from drakerock.rocks.engine.vectors import (
    get_vector,
    make_rotation,
    multiply_symmetric,
    rotate_quaternion,
    rotate_symmetric,
    scale,
    set_vector,
    solve_symmetric,
)

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
def set_bodies(
    awake: Array,
    velocities: Array,
    inverse_mass: Array,
    inverse_inertia: Array,
    bodies: Array,
    body_velocities: Array,
) -> None:
    """Set the bodies of the solve: awake rocks with their inertia, all others immovable and at rest.

    Reads:
        awake: (m,) rocks.
        velocities: (n, 6) angular, translational, in W.
        inverse_mass: (n,) [1/kg].
        inverse_inertia: (n, 6) in W's axes.
    Writes:
        bodies: (n + 1,) records `BODY`; zero before.
        body_velocities: (n, 6); zero before.
    """
    for s in range(len(awake)):
        i = awake[s]
        body = bodies[i]
        for d in range(6):
            body_velocities[i, d] = velocities[i, d]
            body.inverse_inertia[d] = inverse_inertia[i, d]
        for d in range(3):
            body.angular[d], body.linear[d] = velocities[i, d], velocities[i, 3 + d]
        body.inverse_mass = inverse_mass[i]


@kernel
def add_gravity(awake: Array, change: Array, bodies: Array) -> None:
    """Add gravity's change of velocity over a step (3,) to the awake rocks.

    Reads:
        awake, change: (m,) rocks, (3,) [m/s].
    Writes:
        bodies: (n + 1,) records `BODY`.
    """
    for s in range(len(awake)):
        for d in range(3):
            bodies[awake[s]].linear[d] += change[d]


@kernel
def clear_bodies(chosen: Array, bodies: Array) -> None:
    """Set some bodies of the solve to zero again.

    Reads:
        chosen: (m,) which.
    Writes:
        bodies: (n + 1,) records `BODY`.
    """
    for s in range(len(chosen)):
        body = bodies[chosen[s]]
        for d in range(3):
            body.angular[d], body.linear[d] = 0.0, 0.0
        for d in range(6):
            body.inverse_inertia[d] = 0.0
        body.inverse_mass = 0.0


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

    Reads:
        awake: (m,) rocks.
        bodies: (n + 1,) records `BODY` after the solve.
        inverse_inertia_local: (n, 6) in the rocks' frames.
        time_step: [s].
        quaternions, positions: (n, 4), (n, 3) before the step.
    Writes:
        new_quaternions, new_positions, new_velocities: (n, 4), (n, 3), (n, 6) of the awake rocks.
        body_velocities: (n, 6) the new velocities for them, too.

    Returns:
        False if any of it is not finite.
    """
    sane = True
    for s in range(len(awake)):
        i = awake[s]
        body, local = bodies[i], inverse_inertia_local[i]
        spin, velocity = get_vector(body.angular), get_vector(body.linear)
        q = (quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3])
        momentum = solve_symmetric(body.inverse_inertia, spin)
        middle = make_rotation(rotate_quaternion(q, scale(0.5 * time_step, spin)))
        spin = multiply_symmetric(rotate_symmetric(middle, local), momentum)
        q = rotate_quaternion(q, scale(time_step, spin))
        spin = multiply_symmetric(rotate_symmetric(make_rotation(q), local), momentum)
        qw, qx, qy, qz = q
        new_quaternions[i, 0], new_quaternions[i, 1] = qw, qx
        new_quaternions[i, 2], new_quaternions[i, 3] = qy, qz
        set_vector(spin, new_velocities[i])
        set_vector(velocity, new_velocities[i, 3:])
        total = qw + qx + qy + qz
        for d in range(3):
            new_positions[i, d] = positions[i, d] + time_step * velocity[d]
            total += new_positions[i, d] + spin[d] + velocity[d]
        for d in range(6):
            body_velocities[i, d] = new_velocities[i, d]
        # Not math.isfinite: with sums reordered it is compiled to True.
        if not abs(total) < HUGE:
            sane = False
    return sane
