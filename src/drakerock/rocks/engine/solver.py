"""The contact solve by projected Gauss-Seidel on velocities: rows, their updates one by one, the impact stage.

SPOOK stepper (docs/validation/nonsmooth.md): per contact one normal row with compliance and stabilisation,
and a tangential 2 x 2 block projected on the friction cone. The machine enters with its own inertia, in its
generalised velocities, together with the rows of its motors, stops and tyres, so that rocks and machine are
solved as one system. The resting stage, where the time goes, is in `resting`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.compiling import Array, Vector, allocating_kernel, kernel
from drakerock.rocks.engine.contacts import (
    ARM_A,
    ARM_B,
    BIAS,
    COMPLIANCE,
    COUPLING_1,
    COUPLING_2,
    FRICTION,
    GAP,
    IMPULSE,
    NORMAL,
    NORMAL_MASS,
    RESTITUTION,
    TANGENT_1,
    TANGENT_2,
    TANGENT_MASS,
    TANGENT_STEP,
)
from drakerock.rocks.engine.prefetching import AHEAD, prefetch

# Columns of a body of the solve.
ANGULAR = 0  # 0..2 angular velocity in W
LINEAR = 3  # 3..5 velocity of the centre of mass
INVERSE_MASS = 6
INVERSE_INERTIA = 7  # 7..12 xx xy xz yy yz zz in W's axes
BODY_WIDTH = 16

# Columns of a machine row.
TARGET = 0
ROW_COMPLIANCE = 1
LOWER = 2
UPPER = 3
ROW_MASS = 4
ROW_IMPULSE = 5
NORMAL_ROW = 6
MACHINE_ROW_WIDTH = 7

# Below this overlap the contact stiffness is constant [m].
MIN_OVERLAP = 1e-5


class MachineArrays(NamedTuple):
    """The machine as the solve sees it (v generalised velocities, b bodies that touch rocks, m rows).

    Attributes:
        jacobian: (b, 6, v) spatial velocity of each body at its origin in W: angular, translational.
        response: (b, v, 6) change of the generalised velocities by an impulse on each body at its origin.
        mobility: (b, 6, 6) change of each body's spatial velocity by an impulse on itself at its origin.
        rows: (m, v) what each row measures.
        row_response: (m, v) change of the generalised velocities by a unit of each row's impulse.
        row_values: (m, MACHINE_ROW_WIDTH): velocity aimed at, compliance, least and greatest impulse,
            1 / (diagonal + compliance), impulse, and for friction rows, which come in pairs, the row of the normal
            impulse that multiplies the limits (else -1).
    """

    jacobian: NDArray[np.float64]
    response: NDArray[np.float64]
    mobility: NDArray[np.float64]
    rows: NDArray[np.float64]
    row_response: NDArray[np.float64]
    row_values: NDArray[np.float64]


@kernel
def _apply_inertia(body: Array, x: float, y: float, z: float) -> Vector:
    return (
        body[INVERSE_INERTIA] * x + body[INVERSE_INERTIA + 1] * y + body[INVERSE_INERTIA + 2] * z,
        body[INVERSE_INERTIA + 1] * x + body[INVERSE_INERTIA + 3] * y + body[INVERSE_INERTIA + 4] * z,
        body[INVERSE_INERTIA + 2] * x + body[INVERSE_INERTIA + 4] * y + body[INVERSE_INERTIA + 5] * z,
    )


@kernel
def _push(body: Array, rx: float, ry: float, rz: float, px: float, py: float, pz: float, sign: float) -> None:
    """Change a body's velocities by an impulse p at arm r."""
    ux, uy, uz = _apply_inertia(body, ry * pz - rz * py, rz * px - rx * pz, rx * py - ry * px)
    factor = sign * body[INVERSE_MASS]
    body[0] += sign * ux
    body[1] += sign * uy
    body[2] += sign * uz
    body[3] += factor * px
    body[4] += factor * py
    body[5] += factor * pz


@kernel
def _push_machine(machine: MachineArrays, velocity: Array, b: int, impulse: Array) -> None:
    """Change the machine's velocities by a spatial impulse (6,) on its body b at its origin."""
    response = machine.response[b]
    for k in range(len(velocity)):
        for d in range(6):
            velocity[k] += response[k, d] * impulse[d]


@kernel
def _calc_body_velocity(machine: MachineArrays, velocity: Array, b: int, spatial: Array) -> None:
    """Set the spatial velocity (6,) of the machine's body b at its origin."""
    jacobian = machine.jacobian[b]
    for d in range(6):
        total = 0.0
        for k in range(len(velocity)):
            total += jacobian[d, k] * velocity[k]
        spatial[d] = total


@kernel
def _add_mobility(body: Array, rx: float, ry: float, rz: float, mobility: Array) -> None:
    """Add a rock's point mobility (velocity of the point per impulse at it; xx xy xz yy yz zz)."""
    # - [r]x I^-1 [r]x, column by column
    _, c0y, c0z = _apply_inertia(body, 0.0, rz, -ry)
    c1x, c1y, c1z = _apply_inertia(body, -rz, 0.0, rx)
    c2x, c2y, c2z = _apply_inertia(body, ry, -rx, 0.0)
    inverse_mass = body[INVERSE_MASS]
    mobility[0] += inverse_mass + c0y * rz - c0z * ry
    mobility[1] += c1y * rz - c1z * ry
    mobility[2] += c2y * rz - c2z * ry
    mobility[3] += inverse_mass + c1z * rx - c1x * rz
    mobility[4] += c2z * rx - c2x * rz
    mobility[5] += inverse_mass + c2x * ry - c2y * rx


@kernel
def _add_machine_mobility(m: Array, rx: float, ry: float, rz: float, mobility: Array) -> None:
    """Add the mobility at arm r of a machine body with the spatial mobility m (6, 6)."""
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
def _quadratic(m: Array, ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    """Return a^T M b of a symmetric M (xx xy xz yy yz zz)."""
    return (
        ax * (m[0] * bx + m[1] * by + m[2] * bz)
        + ay * (m[1] * bx + m[3] * by + m[4] * bz)
        + az * (m[2] * bx + m[4] * by + m[5] * bz)
    )


@kernel
def _relative_velocity(row: Array, body_a: Array, body_b: Array) -> Vector:
    """Return the velocity of B's point against A's."""
    ax, ay, az = row[ARM_A], row[ARM_A + 1], row[ARM_A + 2]
    bx, by, bz = row[ARM_B], row[ARM_B + 1], row[ARM_B + 2]
    return (
        (body_b[3] - body_a[3]) + (body_b[1] * bz - body_b[2] * by) + (body_a[2] * ay - body_a[1] * az),
        (body_b[4] - body_a[4]) + (body_b[2] * bx - body_b[0] * bz) + (body_a[0] * az - body_a[2] * ax),
        (body_b[5] - body_a[5]) + (body_b[0] * by - body_b[1] * bx) + (body_a[1] * ax - body_a[0] * ay),
    )


@kernel
def calc_normal_velocity(row: Array, body_a: Array, body_b: Array) -> float:
    """Return how fast a row's points part along its normal [m/s]."""
    dx, dy, dz = _relative_velocity(row, body_a, body_b)
    return float(row[NORMAL] * dx + row[NORMAL + 1] * dy + row[NORMAL + 2] * dz)


@kernel
def _relative_velocity_machine(row: Array, body_a: Array, spatial: Array) -> Vector:
    """Return the velocity of a point of a machine body, of spatial velocity (6,), against A's."""
    bx, by, bz = row[ARM_B], row[ARM_B + 1], row[ARM_B + 2]
    ax, ay, az = row[ARM_A], row[ARM_A + 1], row[ARM_A + 2]
    return (
        spatial[3] - body_a[3] + (spatial[1] * bz - spatial[2] * by) + (body_a[2] * ay - body_a[1] * az),
        spatial[4] - body_a[4] + (spatial[2] * bx - spatial[0] * bz) + (body_a[0] * az - body_a[2] * ax),
        spatial[5] - body_a[5] + (spatial[0] * by - spatial[1] * bx) + (body_a[1] * ax - body_a[0] * ay),
    )


@kernel
def _prefetch_bodies(body_a: Array, body_b: Array, row: int, bodies: Array, n_rocks: int) -> None:
    prefetch(bodies, body_a[row])
    prefetch(bodies, min(body_b[row], n_rocks))


@allocating_kernel
def prepare_rows(
    rows: Array,
    n_rows: int,
    body_a: Array,
    body_b: Array,
    bodies: Array,
    n_rocks: int,
    machine: MachineArrays,
    velocity: Array,
    softness: Array,
    hertz: float,
    linear: bool,
    time_step: float,
    upsilon: float,
    max_recovery_speed: float,
    impact_threshold: float,
) -> int:
    """Set the solver's columns of the contact rows.

    Args:
        rows, n_rows, body_a, body_b: contact rows and the bodies of each.
        bodies: (n_rocks + 1, BODY_WIDTH) rocks and, last, all that stands still; velocities before the step.
        n_rocks: B beyond it is body ``b - n_rocks - 1`` of the machine.
        machine, velocity: the machine and its generalised velocities before the step.
        softness: (bodies of the solve,) by Hertz's law 1 / radius of a rock [1/m], 0 for all else; by the linear law
            1 / stiffness of each body's spring [m/N]. A pair has the sum.
        hertz: 4/3 E*, E* the pair's effective modulus [Pa]: force = hertz overlap^(3/2) / sqrt(softness).
        linear: force = overlap / softness instead.
        time_step: [s]; upsilon: 1 / (1 + 4 tau / dt).
        max_recovery_speed: at which overlaps push apart what carries no load, at most [m/s].
        impact_threshold: what approaches faster is an impact [m/s].

    Returns:
        the number of impacts of pairs with restitution, for `solve_impacts`.
    """
    n_impacts = 0
    mobility = np.zeros(6)
    spatial = np.zeros((len(machine.jacobian), 6))
    for b in range(len(spatial)):
        _calc_body_velocity(machine, velocity, b, spatial[b])
    for k in range(n_rows):
        _prefetch_bodies(body_a, body_b, min(k + AHEAD, n_rows - 1), bodies, n_rocks)
        row = rows[k]
        a, b = body_a[k], body_b[k]
        mobility[:] = 0.0
        _add_mobility(bodies[a], row[ARM_A], row[ARM_A + 1], row[ARM_A + 2], mobility)
        if b > n_rocks:
            number = b - n_rocks - 1
            _add_machine_mobility(
                machine.mobility[number], row[ARM_B], row[ARM_B + 1], row[ARM_B + 2], mobility
            )
            dx, dy, dz = _relative_velocity_machine(row, bodies[a], spatial[number])
        else:
            _add_mobility(bodies[b], row[ARM_B], row[ARM_B + 1], row[ARM_B + 2], mobility)
            dx, dy, dz = _relative_velocity(row, bodies[a], bodies[b])
        nx, ny, nz = row[NORMAL], row[NORMAL + 1], row[NORMAL + 2]
        tx, ty, tz = row[TANGENT_1], row[TANGENT_1 + 1], row[TANGENT_1 + 2]
        ux, uy, uz = row[TANGENT_2], row[TANGENT_2 + 1], row[TANGENT_2 + 2]
        m11 = _quadratic(mobility, tx, ty, tz, tx, ty, tz)
        m12 = _quadratic(mobility, tx, ty, tz, ux, uy, uz)
        m22 = _quadratic(mobility, ux, uy, uz, ux, uy, uz)
        gap = row[GAP]
        approach = nx * dx + ny * dy + nz * dz
        compliance = 0.0
        if row[RESTITUTION] > 0.0 and _is_impact(gap, approach, time_step, impact_threshold):
            n_impacts += 1
        # An impact without restitution is rigid, and none of its speed is kept.
        rigid = approach < -impact_threshold
        if gap > 0.0:
            # Apart: they may approach until they touch at the end of the step; by a linear law, overlap then.
            bias = -gap / time_step
            if linear and not rigid:
                compliance = (softness[a] + softness[b]) / (time_step * time_step)
        else:
            stiffness, power = _calc_stiffness(gap, softness[a] + softness[b], hertz, linear)
            bias = -4.0 * upsilon * (1.0 / power) * gap / time_step
            if rigid:
                bias = min(bias, max_recovery_speed)
            else:
                compliance = 4.0 * upsilon / (stiffness * time_step * time_step)
                # What is bounded is the speed that an overlap gives, not its force: the load of the last step, and
                # what the approach adds to it, are carried.
                closing = min(approach, 0.0)
                carried = compliance * row[IMPULSE] - 4.0 * upsilon * closing
                bias = min(bias, max_recovery_speed + carried) + upsilon * closing
        diagonal = _quadratic(mobility, nx, ny, nz, nx, ny, nz) + compliance
        determinant = m11 * m22 - m12 * m12
        # Two bodies that cannot move have no rows to solve.
        row[NORMAL_MASS] = 1.0 / diagonal if diagonal > 0.0 else 0.0
        inverse = 1.0 / determinant if determinant > 0.0 else 0.0
        row[COUPLING_1] = _quadratic(mobility, nx, ny, nz, tx, ty, tz)
        row[COUPLING_2] = _quadratic(mobility, nx, ny, nz, ux, uy, uz)
        row[TANGENT_MASS] = m22 * inverse
        row[TANGENT_MASS + 1] = -m12 * inverse
        row[TANGENT_MASS + 2] = m11 * inverse
        row[TANGENT_STEP] = 2.0 / (m11 + m22) if determinant > 0.0 else 0.0
        row[BIAS] = bias
        row[COMPLIANCE] = compliance
        limit = row[FRICTION] * row[IMPULSE]
        slip = math.sqrt(row[IMPULSE + 1] ** 2 + row[IMPULSE + 2] ** 2)
        if slip > limit:
            row[IMPULSE + 1] *= limit / slip
            row[IMPULSE + 2] *= limit / slip
    return n_impacts


@kernel
def _calc_stiffness(gap: float, softness: float, hertz: float, linear: bool) -> tuple[float, float]:
    """Return a contact's stiffness dF/dd [N/m], and the power of the overlap that its force grows with.

    About an overlap the force is that of a spring of this stiffness, stretched by 1 / power of the overlap.
    """
    if linear:
        return 1.0 / softness, 1.0
    return 1.5 * hertz * math.sqrt(max(-gap, MIN_OVERLAP) / softness), 1.5


@kernel
def _is_impact(gap: float, approach: float, time_step: float, threshold: float) -> bool:
    return bool(approach < -threshold and gap + time_step * approach < 0.0)


@kernel
def damp_spin(
    rows: Array, n_rows: int, body_a: Array, body_b: Array, bodies: Array, n_rocks: int, share: float
) -> None:
    """Take a small share from the relative spin of rocks at each of their contacts that carried load.

    It lets rocks that swing on two points come to rest. It is measured by the rocks' own inertia, so that it is
    nothing beside the moments of contacts under load. Contacts of the machine are left out.

    Args:
        rows, n_rows, body_a, body_b, bodies, n_rocks: see `prepare_rows`; angular velocities are changed.
        share: of the relative spin.
    """
    for k in range(n_rows):
        row = rows[k]
        a, b = body_a[k], body_b[k]
        if row[IMPULSE] <= 0.0 or b > n_rocks:
            continue
        x, y, z = bodies[b, 0] - bodies[a, 0], bodies[b, 1] - bodies[a, 1], bodies[b, 2] - bodies[a, 2]
        ax, ay, az = _apply_inertia(bodies[a], x, y, z)
        bx, by, bz = _apply_inertia(bodies[b], x, y, z)
        mobility = x * (ax + bx) + y * (ay + by) + z * (az + bz)
        if mobility <= 0.0:
            continue
        # The impulse along the spin that would stop it is spin^2 / mobility, times the share.
        factor = share * (x * x + y * y + z * z) / mobility
        bodies[a, 0] += factor * ax
        bodies[a, 1] += factor * ay
        bodies[a, 2] += factor * az
        bodies[b, 0] -= factor * bx
        bodies[b, 1] -= factor * by
        bodies[b, 2] -= factor * bz


@kernel
def solve_row(row: Array, dx: float, dy: float, dz: float) -> tuple[float, float, float, float]:
    """Update a row's impulses for the relative velocity d; return the impulse's change in W and its normal part."""
    nx, ny, nz = row[NORMAL], row[NORMAL + 1], row[NORMAL + 2]
    old = row[IMPULSE]
    new = old - (nx * dx + ny * dy + nz * dz + row[COMPLIANCE] * old - row[BIAS]) * row[NORMAL_MASS]
    if new <= 0.0:
        if old == 0.0:
            return 0.0, 0.0, 0.0, 0.0
        new = 0.0
    change = new - old
    tx, ty, tz = row[TANGENT_1], row[TANGENT_1 + 1], row[TANGENT_1 + 2]
    ux, uy, uz = row[TANGENT_2], row[TANGENT_2 + 1], row[TANGENT_2 + 2]
    slip_1 = tx * dx + ty * dy + tz * dz + row[COUPLING_1] * change
    slip_2 = ux * dx + uy * dy + uz * dz + row[COUPLING_2] * change
    old_1, old_2 = row[IMPULSE + 1], row[IMPULSE + 2]
    new_1 = old_1 - (row[TANGENT_MASS] * slip_1 + row[TANGENT_MASS + 1] * slip_2)
    new_2 = old_2 - (row[TANGENT_MASS + 1] * slip_1 + row[TANGENT_MASS + 2] * slip_2)
    limit = row[FRICTION] * new
    size2 = new_1 * new_1 + new_2 * new_2
    if size2 > limit * limit:
        # It slides: against the slip. A step with the matrix would turn the force away from that direction.
        new_1 = old_1 - row[TANGENT_STEP] * slip_1
        new_2 = old_2 - row[TANGENT_STEP] * slip_2
        size2 = new_1 * new_1 + new_2 * new_2
        if size2 > limit * limit:
            factor = limit / math.sqrt(size2)
            new_1 *= factor
            new_2 *= factor
    row[IMPULSE], row[IMPULSE + 1], row[IMPULSE + 2] = new, new_1, new_2
    new_1 -= old_1
    new_2 -= old_2
    return (
        nx * change + tx * new_1 + ux * new_2,
        ny * change + ty * new_1 + uy * new_2,
        nz * change + tz * new_1 + uz * new_2,
        change,
    )


@kernel
def solve_contact(row: Array, body_a: Array, body_b: Array) -> float:
    """Update one contact and its two rocks' velocities; return the change of its normal impulse."""
    dx, dy, dz = _relative_velocity(row, body_a, body_b)
    px, py, pz, change = solve_row(row, dx, dy, dz)
    if px != 0.0 or py != 0.0 or pz != 0.0:
        _push(body_a, row[ARM_A], row[ARM_A + 1], row[ARM_A + 2], px, py, pz, -1.0)
        _push(body_b, row[ARM_B], row[ARM_B + 1], row[ARM_B + 2], px, py, pz, 1.0)
    return change


@kernel
def solve_machine_contacts(
    rows: Array,
    order: Array,
    body_a: Array,
    body_b: Array,
    bodies: Array,
    n_rocks: int,
    machine: MachineArrays,
    velocity: Array,
    scratch: Array,
) -> float:
    """Update the machine's contacts in `order`; return the sum of the changes of their normal impulses.

    Contacts of one body in line share its spatial velocity; the whole machine is told when the body changes.
    `scratch` is (3, 6).
    """
    spatial, impulse, point = scratch[0], scratch[1], scratch[2]
    current = -1
    changed = 0.0
    for c in range(len(order)):
        k = order[c]
        row = rows[k]
        number = body_b[k] - n_rocks - 1
        if number != current:
            if current >= 0:
                _push_machine(machine, velocity, current, impulse)
            impulse[:] = 0.0
            current = number
            _calc_body_velocity(machine, velocity, current, spatial)
        one = bodies[body_a[k]]
        dx, dy, dz = _relative_velocity_machine(row, one, spatial)
        px, py, pz, change = solve_row(row, dx, dy, dz)
        changed += abs(change)
        if px != 0.0 or py != 0.0 or pz != 0.0:
            _push(one, row[ARM_A], row[ARM_A + 1], row[ARM_A + 2], px, py, pz, -1.0)
            rx, ry, rz = row[ARM_B], row[ARM_B + 1], row[ARM_B + 2]
            point[0], point[1], point[2] = ry * pz - rz * py, rz * px - rx * pz, rx * py - ry * px
            point[3], point[4], point[5] = px, py, pz
            mobility = machine.mobility[current]
            for d in range(6):
                impulse[d] += point[d]
                for e in range(6):
                    spatial[d] += mobility[d, e] * point[e]
    if current >= 0:
        _push_machine(machine, velocity, current, impulse)
    return changed


@kernel
def _calc_row_impulse(machine: MachineArrays, velocity: Array, k: int) -> float:
    """Return what the impulse of the machine's row k has to be, limits left aside."""
    values = machine.row_values
    measured = 0.0
    for d in range(len(velocity)):
        measured += machine.rows[k, d] * velocity[d]
    old = values[k, ROW_IMPULSE]
    return old + (values[k, TARGET] - measured - values[k, ROW_COMPLIANCE] * old) * values[k, ROW_MASS]


@kernel
def _set_row_impulse(machine: MachineArrays, velocity: Array, k: int, impulse: float) -> None:
    """Set the impulse of the machine's row k, and the velocities accordingly."""
    change = impulse - machine.row_values[k, ROW_IMPULSE]
    if change != 0.0:
        machine.row_values[k, ROW_IMPULSE] = impulse
        for d in range(len(velocity)):
            velocity[d] += machine.row_response[k, d] * change


@kernel
def solve_machine_rows(machine: MachineArrays, velocity: Array) -> None:
    """Sweep over the machine's own rows: motors, stops, tyres. A normal row is followed by its two of friction."""
    values = machine.row_values
    k = 0
    while k < len(values):
        normal = int(values[k, NORMAL_ROW])
        if normal < 0:
            impulse = _calc_row_impulse(machine, velocity, k)
            _set_row_impulse(machine, velocity, k, min(max(impulse, values[k, LOWER]), values[k, UPPER]))
            k += 1
        else:
            one = _calc_row_impulse(machine, velocity, k)
            two = _calc_row_impulse(machine, velocity, k + 1)
            limit = values[k, UPPER] * values[normal, ROW_IMPULSE]
            size = math.sqrt(one * one + two * two)
            if size > limit:
                one *= limit / size
                two *= limit / size
            _set_row_impulse(machine, velocity, k, one)
            _set_row_impulse(machine, velocity, k + 1, two)
            k += 2


@allocating_kernel
def apply_impulses(
    rows: Array,
    n_rows: int,
    body_a: Array,
    body_b: Array,
    bodies: Array,
    n_rocks: int,
    machine: MachineArrays,
    velocity: Array,
) -> None:
    """Apply the impulses that the rows hold (the warm start) to all bodies."""
    point = np.zeros(6)
    for k in range(n_rows):
        row = rows[k]
        if row[IMPULSE] == 0.0:
            continue
        px, py, pz = _calc_impulse(row)
        _push(bodies[body_a[k]], row[ARM_A], row[ARM_A + 1], row[ARM_A + 2], px, py, pz, -1.0)
        rx, ry, rz = row[ARM_B], row[ARM_B + 1], row[ARM_B + 2]
        if body_b[k] > n_rocks:
            point[0], point[1], point[2] = ry * pz - rz * py, rz * px - rx * pz, rx * py - ry * px
            point[3], point[4], point[5] = px, py, pz
            _push_machine(machine, velocity, body_b[k] - n_rocks - 1, point)
        else:
            _push(bodies[body_b[k]], rx, ry, rz, px, py, pz, 1.0)


@kernel
def _calc_impulse(row: Array) -> Vector:
    """Return a row's impulse in W."""
    normal, one, two = row[IMPULSE], row[IMPULSE + 1], row[IMPULSE + 2]
    return (
        normal * row[NORMAL] + one * row[TANGENT_1] + two * row[TANGENT_2],
        normal * row[NORMAL + 1] + one * row[TANGENT_1 + 1] + two * row[TANGENT_2 + 1],
        normal * row[NORMAL + 2] + one * row[TANGENT_1 + 2] + two * row[TANGENT_2 + 2],
    )


@allocating_kernel
def sum_machine_impulses(
    rows: Array,
    n_rows: int,
    body_b: Array,
    n_rocks: int,
    n_bodies: int,
    impact_impulses: Array,
    with_impacts: bool,
) -> Array:
    """Return (n_bodies, 6): the rocks' spatial impulse on each machine body at its origin, in W.

    Args:
        rows, n_rows, body_b, n_rocks: after the solve, see `prepare_rows`.
        n_bodies: of the machine that touch rocks.
        impact_impulses, with_impacts: (rows, 3) of the impact stage, if there was one.
    """
    sums = np.zeros((n_bodies, 6))
    for k in range(n_rows):
        number = body_b[k] - n_rocks - 1
        if number < 0:
            continue
        row = rows[k]
        px, py, pz = _calc_impulse(row)
        if with_impacts:
            px, py, pz = px + impact_impulses[k, 0], py + impact_impulses[k, 1], pz + impact_impulses[k, 2]
        rx, ry, rz = row[ARM_B], row[ARM_B + 1], row[ARM_B + 2]
        sums[number, 0] += ry * pz - rz * py
        sums[number, 1] += rz * px - rx * pz
        sums[number, 2] += rx * py - ry * px
        sums[number, 3] += px
        sums[number, 4] += py
        sums[number, 5] += pz
    return sums


@kernel
def _calc_approach(row: Array, a: int, b: int, bodies: Array, n_rocks: int, spatial: Array) -> float:
    """Return how fast a row's points part; `spatial` holds the velocities of the machine's bodies [m/s]."""
    if b <= n_rocks:
        return calc_normal_velocity(row, bodies[a], bodies[b])
    dx, dy, dz = _relative_velocity_machine(row, bodies[a], spatial[b - n_rocks - 1])
    return float(row[NORMAL] * dx + row[NORMAL + 1] * dy + row[NORMAL + 2] * dz)


@allocating_kernel
def solve_impacts(
    rows: Array,
    n_rows: int,
    body_a: Array,
    body_b: Array,
    bodies: Array,
    n_rocks: int,
    machine: MachineArrays,
    velocity: Array,
    time_step: float,
    threshold: float,
    iterations: int,
    marks: Array,
    impact_impulses: Array,
) -> None:
    """The impact stage: Newton's law for pairs with restitution that meet faster than `threshold`.

    It covers all touching contacts of the bodies that take part. Pairs without restitution need no stage of
    their own, the resting stage stops them.

    Args:
        rows, n_rows, body_a, body_b: prepared; biases and impulses are left as they were.
        bodies, machine, velocity: at the velocities before the step; changed by the impacts.
        n_rocks: see `prepare_rows`.
        time_step: [s].
        threshold: [m/s].
        iterations: number of sweeps.
        marks: (bodies of the solve,) scratch.
        impact_impulses: (rows, 3) set: the impacts' impulses in W [N s].
    """
    spatial = np.zeros((len(machine.jacobian), 6))
    for b in range(len(spatial)):
        _calc_body_velocity(machine, velocity, b, spatial[b])
    marks[:] = 0
    for k in range(n_rows):
        row = rows[k]
        if row[RESTITUTION] <= 0.0:
            continue
        a, b = body_a[k], body_b[k]
        approach = _calc_approach(row, a, b, bodies, n_rocks, spatial)
        if _is_impact(row[GAP], approach, time_step, threshold):
            marks[a] = 1
            if b != n_rocks:
                marks[b] = 1
    chosen = np.empty(n_rows, np.int64)
    saved = np.empty((n_rows, 6))
    n_chosen = 0
    for k in range(n_rows):
        row = rows[k]
        for d in range(3):
            impact_impulses[k, d] = 0.0
        a, b = body_a[k], body_b[k]
        if marks[a] == 0 and marks[b] == 0:
            continue
        approach = _calc_approach(row, a, b, bodies, n_rocks, spatial)
        # Not reached within the step; or without restitution and still apart: left to the resting stage.
        if row[GAP] > 0.0 and (row[GAP] + time_step * approach >= 0.0 or row[RESTITUTION] <= 0.0):
            continue
        for d in range(3):
            saved[n_chosen, d] = row[IMPULSE + d]
            row[IMPULSE + d] = 0.0
        saved[n_chosen, 3], saved[n_chosen, 4] = row[BIAS], row[COMPLIANCE]
        saved[n_chosen, 5] = row[NORMAL_MASS]
        row[BIAS] = -row[RESTITUTION] * approach if approach < -threshold else 0.0
        # rigid
        if row[NORMAL_MASS] > 0.0:
            row[NORMAL_MASS] = 1.0 / (1.0 / row[NORMAL_MASS] - row[COMPLIANCE])
        row[COMPLIANCE] = 0.0
        chosen[n_chosen] = k
        n_chosen += 1
    n_free, scratch = 0, np.empty((3, 6))
    while n_free < n_chosen and body_b[chosen[n_free]] <= n_rocks:
        n_free += 1
    for _ in range(iterations):
        for c in range(n_free):
            k = chosen[c]
            solve_contact(rows[k], bodies[body_a[k]], bodies[body_b[k]])
        solve_machine_contacts(
            rows, chosen[n_free:n_chosen], body_a, body_b, bodies, n_rocks, machine, velocity, scratch
        )
    for c in range(n_chosen):
        k = chosen[c]
        row = rows[k]
        impact_impulses[k, 0], impact_impulses[k, 1], impact_impulses[k, 2] = _calc_impulse(row)
        for d in range(3):
            row[IMPULSE + d] = saved[c, d]
        row[BIAS], row[COMPLIANCE], row[NORMAL_MASS] = saved[c, 3], saved[c, 4], saved[c, 5]
