"""The machine in the contact solve: its contacts with rocks, and its own rows of motors, stops and tyres.

The machine has generalised velocities v and inverse inertia A. Its body b moves with the spatial velocity V = J_b v,
so a spatial impulse P on it changes v by  A J_b^T P  (`response`) and V itself by  J_b A J_b^T P  (`mobility`). Each
row of its own, with direction g and impulse l, has the law  g v + s l = t  within limits on l, and changes v by  A
g^T l (`row_response`). Rocks and machine are so solved as one system. See `machine_step` for where the rows come
from.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.compiling import Array, Record, Vector, kernel
from drakerock.rocks.engine.contact_law import update_impulse
from drakerock.rocks.engine.solve.bodies import calc_relative_velocity, push
from drakerock.rocks.engine.vectors import cross, get_vector


class MachineArrays(NamedTuple):
    """The machine as the solve sees it (v generalised velocities, b bodies that touch rocks, m rows).

    Attributes:
        jacobian: (b, 6, v) spatial velocity of each body at its origin in W: angular, translational.
        response: (b, v, 6) change of the generalised velocities by an impulse on each body at its origin.
        mobility: (b, 6, 6) change of each body's spatial velocity by an impulse on itself at its origin.
        rows: (m, v) what each row measures.
        row_response: (m, v) change of the generalised velocities by a unit of each row's impulse.
        row_values: (m,) records `MACHINE_ROW`.
    """

    jacobian: NDArray[np.float64]
    response: NDArray[np.float64]
    mobility: NDArray[np.float64]
    rows: NDArray[np.float64]
    row_response: NDArray[np.float64]
    row_values: Array


@kernel
def push_machine(machine: MachineArrays, b: int, impulse: Array, velocity: Array) -> None:
    """Change the machine's velocities by a spatial impulse (6,) on its body b at its origin.

    Reads:
        machine, b, impulse: [N m s, N s].
    Writes:
        velocity: (v,).
    """
    response = machine.response[b]
    for k in range(len(velocity)):
        for d in range(6):
            velocity[k] += response[k, d] * impulse[d]


@kernel
def set_spatial_impulse(arm: Vector, impulse: Vector, spatial: Array) -> None:
    """Set the spatial impulse (6,) at a body's origin of an impulse at an arm."""
    torque = cross(arm, impulse)
    for d in range(3):
        spatial[d], spatial[3 + d] = torque[d], impulse[d]


@kernel
def _calc_body_velocity(machine: MachineArrays, b: int, velocity: Array, body: Record) -> None:
    """Set the velocities of the machine's body b at its origin."""
    jacobian = machine.jacobian[b]
    for d in range(3):
        angular, linear = 0.0, 0.0
        for k in range(len(velocity)):
            angular += jacobian[d, k] * velocity[k]
            linear += jacobian[3 + d, k] * velocity[k]
        body.angular[d], body.linear[d] = angular, linear


@kernel
def calc_body_velocities(machine: MachineArrays, velocity: Array, bodies: Array) -> None:
    """Set the velocities of all bodies of the machine at their origins.

    Reads:
        machine, velocity: (v,).
    Writes:
        bodies: (b,) records `BODY`; their inertia is left alone.
    """
    for b in range(len(bodies)):
        _calc_body_velocity(machine, b, velocity, bodies[b])


@kernel
def add_machine_mobility(m: Array, arm: Vector, mobility: Array) -> None:
    """Add the mobility of a point at an arm of a machine body.

    Reads:
        m: (6, 6) the body's spatial mobility.
        arm: from its origin [m].
    Writes:
        mobility: (6,) xx xy xz yy yz zz.
    """
    rx, ry, rz = arm
    # P m P^T with P = (-[r]x, 1), the map from a spatial velocity to the point's velocity
    p = ((0.0, rz, -ry), (-rz, 0.0, rx), (ry, -rx, 0.0))
    place = 0
    for i in range(3):
        for j in range(i, 3):
            total = m[3 + i, 3 + j]
            for k in range(3):
                total += p[i][k] * m[k, 3 + j] + m[3 + i, k] * p[j][k]
                for n in range(3):
                    total += p[i][k] * m[k, n] * p[j][n]
            mobility[place] += total
            place += 1


@kernel
def solve_machine_contacts(
    order: Array,
    body_a: Array,
    body_b: Array,
    machine: MachineArrays,
    rows: Array,
    bodies: Array,
    velocity: Array,
    scratch: Array,
    scratch_body: Array,
) -> float:
    """Update the machine's contacts in order; return the sum of the changes of their normal impulses.

    Contacts of one body in line share its velocity; the whole machine is told when the body changes.

    Reads:
        order: (c,) the contacts' rows.
        body_a, body_b: per row.
        machine: the machine.
    Writes:
        rows: records `CONTACT_ROW`; impulses are changed.
        bodies: (n + 1,) of the rocks, in single or double precision.
        velocity: (v,) of the machine.
        scratch, scratch_body: (2, 6), and (1,) record `BODY`.
    """
    impulse, point, current_body = scratch[0], scratch[1], scratch_body[0]
    current = -1
    changed = 0.0
    for c in range(len(order)):
        k = order[c]
        row = rows[k]
        number = body_b[k] - len(bodies)
        if number != current:
            if current >= 0:
                push_machine(machine, current, impulse, velocity)
            impulse[:] = 0.0
            current = number
            _calc_body_velocity(machine, current, velocity, current_body)
        rock = bodies[body_a[k]]
        p, change = update_impulse(calc_relative_velocity(row, rock, current_body), row)
        changed += abs(change)
        if p[0] != 0.0 or p[1] != 0.0 or p[2] != 0.0:
            push(get_vector(row.arm_a), p, -1.0, rock)
            set_spatial_impulse(get_vector(row.arm_b), p, point)
            mobility = machine.mobility[current]
            for d in range(6):
                impulse[d] += point[d]
            for d in range(3):
                for e in range(6):
                    current_body.angular[d] += mobility[d, e] * point[e]
                    current_body.linear[d] += mobility[3 + d, e] * point[e]
    if current >= 0:
        push_machine(machine, current, impulse, velocity)
    return changed


@kernel
def _calc_row_impulse(machine: MachineArrays, velocity: Array, k: int) -> float:
    """Return what the impulse of the machine's row k has to be, limits left aside."""
    row = machine.row_values[k]
    measured = 0.0
    for d in range(len(velocity)):
        measured += machine.rows[k, d] * velocity[d]
    old = row.impulse
    return old + (row.target - measured - row.compliance * old) * row.mass


@kernel
def _set_row_impulse(k: int, impulse: float, machine: MachineArrays, velocity: Array) -> None:
    """Set the impulse of the machine's row k, and the velocities accordingly."""
    change = impulse - machine.row_values[k].impulse
    if change != 0.0:
        machine.row_values[k].impulse = impulse
        for d in range(len(velocity)):
            velocity[d] += machine.row_response[k, d] * change


@kernel
def solve_machine_rows(machine: MachineArrays, velocity: Array) -> None:
    """One Gauss-Seidel iteration over the machine's own rows. A normal row is followed by its two of friction.

    Writes:
        machine: the rows' impulses.
        velocity: (v,).
    """
    k = 0
    while k < len(machine.row_values):
        row = machine.row_values[k]
        normal = int(row.normal_row)
        if normal < 0:
            impulse = _calc_row_impulse(machine, velocity, k)
            _set_row_impulse(k, min(max(impulse, row.lower), row.upper), machine, velocity)
            k += 1
        else:
            one = _calc_row_impulse(machine, velocity, k)
            two = _calc_row_impulse(machine, velocity, k + 1)
            limit = row.upper * machine.row_values[normal].impulse
            size = math.sqrt(one * one + two * two)
            if size > limit:
                one *= limit / size
                two *= limit / size
            _set_row_impulse(k, one, machine, velocity)
            _set_row_impulse(k + 1, two, machine, velocity)
            k += 2
