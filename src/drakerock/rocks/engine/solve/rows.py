"""Contact rows: what the solve knows of each contact point, made ready before the iterations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.compiling import Array, Record, allocating_kernel, kernel
from drakerock.rocks.engine.contact_law import (
    ContactLaw,
    calc_normal_law,
    clip_friction,
    get_impulse,
    is_impact,
    update_impulse,
)
from drakerock.rocks.engine.memory_access import AHEAD
from drakerock.rocks.engine.records import BODY, CONTACT_ROW, as_matrix
from drakerock.rocks.engine.solve.bodies import (
    add_mobility,
    calc_mobility_along,
    calc_relative_velocity,
    prefetch_bodies,
    push,
)
from drakerock.rocks.engine.solve.machine_rows import (
    MachineArrays,
    add_machine_mobility,
    calc_body_velocities,
    push_machine,
    set_spatial_impulse,
)
from drakerock.rocks.engine.vectors import dot, get_vector

# A pair's key is first * KEY_STEP + second; bodies are below it.
KEY_STEP = 1 << 20


class ContactRows(NamedTuple):
    """Room for contact rows (capacity n). Rows of a pair are in line, those of the machine's pairs last.

    Attributes:
        values: (n,) records `CONTACT_ROW`.
        matrix: (n, columns) the same memory.
        body_a, body_b: (n,) the bodies of the solve that each row is between: rocks are their own, the one after the
            last rock is all that stands still, those beyond are the machine's.
        key: (n,) its pair's key, see `KEY_STEP`.
    """

    values: Array
    matrix: NDArray[np.float64]
    body_a: NDArray[np.int64]
    body_b: NDArray[np.int64]
    key: NDArray[np.int64]


def make_contact_rows(capacity: int) -> ContactRows:
    """Return room for so many rows."""
    numbers = [np.zeros(capacity, np.int64) for _ in range(3)]
    values = np.zeros(capacity, CONTACT_ROW)
    return ContactRows(values, as_matrix(values), *numbers)


@kernel
def make_key(a: int, b: int) -> int:
    """Return the key of a pair of bodies, see `KEY_STEP`."""
    return a * KEY_STEP + b


@kernel
def split_key(key: int) -> tuple[int, int]:
    """Return the two bodies of a pair's key."""
    return key // KEY_STEP, key % KEY_STEP


@allocating_kernel
def prepare_rows(
    n_rows: int,
    bodies: Array,
    body_compliance: Array,
    machine: MachineArrays,
    velocity: Array,
    law: ContactLaw,
    rows: ContactRows,
) -> int:
    """Set the masses, biases and compliances of the contact rows, and clip their friction.

    Reads:
        n_rows: number of rows.
        bodies: (n + 1,) records `BODY`: rocks and, last, all that stands still; velocities before the step.
        body_compliance: (bodies of the solve,) what each contributes to a pair's, see `contact_law`; 0: rigid.
        machine, velocity: the machine, and its generalised velocities before the step.
        law: the contact law's constants.
    Writes:
        rows: with bodies, geometry and the impulses of the last step.

    Returns:
        the number of impacts of pairs with restitution, for `solve_impacts`.
    """
    n_impacts = 0
    n_bodies = len(bodies)
    mobility = np.zeros(6)
    machine_bodies = np.zeros(len(machine.jacobian), BODY)
    calc_body_velocities(machine, velocity, machine_bodies)
    for k in range(n_rows):
        prefetch_bodies(rows.body_a, rows.body_b, min(k + AHEAD, n_rows - 1), bodies)
        row = rows.values[k]
        a, b = rows.body_a[k], rows.body_b[k]
        mobility[:] = 0.0
        add_mobility(bodies[a], get_vector(row.arm_a), mobility)
        if b >= n_bodies:
            add_machine_mobility(machine.mobility[b - n_bodies], get_vector(row.arm_b), mobility)
            d = calc_relative_velocity(row, bodies[a], machine_bodies[b - n_bodies])
        else:
            add_mobility(bodies[b], get_vector(row.arm_b), mobility)
            d = calc_relative_velocity(row, bodies[a], bodies[b])
        approach = dot(get_vector(row.normal), d)
        if row.restitution > 0.0 and is_impact(row.gap, approach, law):
            n_impacts += 1
        row.bias, row.compliance = calc_normal_law(
            row.gap, approach, row.impulse[0], body_compliance[a] + body_compliance[b], law
        )
        _set_masses(mobility, row)
        clip_friction(row)
    return n_impacts


@kernel
def _set_masses(mobility: Array, row: Record) -> None:
    """Set a row's masses and couplings from the mobility of its points and its compliance."""
    normal, one, two = get_vector(row.normal), get_vector(row.tangent_1), get_vector(row.tangent_2)
    m11 = calc_mobility_along(mobility, one, one)
    m12 = calc_mobility_along(mobility, one, two)
    m22 = calc_mobility_along(mobility, two, two)
    diagonal = calc_mobility_along(mobility, normal, normal) + row.compliance
    determinant = m11 * m22 - m12 * m12
    # Two bodies that cannot move have no rows to solve.
    row.normal_mass = 1.0 / diagonal if diagonal > 0.0 else 0.0
    inverse = 1.0 / determinant if determinant > 0.0 else 0.0
    row.coupling[0] = calc_mobility_along(mobility, normal, one)
    row.coupling[1] = calc_mobility_along(mobility, normal, two)
    row.tangent_mass[0] = m22 * inverse
    row.tangent_mass[1] = -m12 * inverse
    row.tangent_mass[2] = m11 * inverse
    row.tangent_step = 2.0 / (m11 + m22) if determinant > 0.0 else 0.0


@allocating_kernel
def apply_impulses(
    n_rows: int, rows: ContactRows, machine: MachineArrays, bodies: Array, velocity: Array
) -> None:
    """Change all velocities by the impulses that the rows hold (the warm start).

    Reads:
        n_rows, rows: contact rows.
        machine: the machine.
    Writes:
        bodies, velocity: of the rocks and the machine, see `prepare_rows`.
    """
    spatial = np.zeros(6)
    n_bodies = len(bodies)
    for k in range(n_rows):
        row = rows.values[k]
        if row.impulse[0] == 0.0:
            continue
        impulse = get_impulse(row)
        push(get_vector(row.arm_a), impulse, -1.0, bodies[rows.body_a[k]])
        b = rows.body_b[k]
        if b >= n_bodies:
            set_spatial_impulse(get_vector(row.arm_b), impulse, spatial)
            push_machine(machine, b - n_bodies, spatial, velocity)
        else:
            push(get_vector(row.arm_b), impulse, 1.0, bodies[b])


@kernel
def solve_contact(row: Record, body_a: Record, body_b: Record) -> float:
    """Update the impulses of one contact and its two rocks' velocities; return the change of the normal one.

    Writes:
        row, body_a, body_b: the contact and its rocks.
    """
    impulse, change = update_impulse(calc_relative_velocity(row, body_a, body_b), row)
    if impulse[0] != 0.0 or impulse[1] != 0.0 or impulse[2] != 0.0:
        push(get_vector(row.arm_a), impulse, -1.0, body_a)
        push(get_vector(row.arm_b), impulse, 1.0, body_b)
    return change


@kernel
def clear_marks(n_rows: int, rows: ContactRows, marks: Array) -> None:
    """Set the marks (bodies of the solve,) of all bodies that rows are between to zero."""
    for k in range(n_rows):
        marks[rows.body_a[k]], marks[rows.body_b[k]] = 0, 0


@kernel
def sum_normal_impulses(n_rows: int, rows: ContactRows) -> float:
    """Return the sum of the normal impulses [N s]."""
    total = 0.0
    for k in range(n_rows):
        total += rows.values[k].impulse[0]
    return total


@kernel
def find_deepest(n_rows: int, rows: ContactRows) -> float:
    """Return the deepest overlap of all points, 0 if there is none [m]."""
    deepest = 0.0
    for k in range(n_rows):
        deepest = max(deepest, -rows.values[k].gap)
    return deepest


@kernel
def find_depths(n_rows: int, rows: ContactRows, depths: Array) -> int:
    """Find the overlaps of the points that carry load; return how many there are.

    Reads:
        n_rows, rows: contact rows after the solve.
    Writes:
        depths: (n_rows,) at least [m].
    """
    n_loaded = 0
    for k in range(n_rows):
        if rows.values[k].impulse[0] > 0.0:
            depths[n_loaded] = -rows.values[k].gap
            n_loaded += 1
    return n_loaded


@allocating_kernel
def sum_machine_impulses(
    n_rows: int, rows: ContactRows, n_rocks: int, n_bodies: int, impacts: Array, with_impacts: bool
) -> Array:
    """Return (n_bodies, 6): the rocks' spatial impulse on each machine body at its origin, in W.

    Reads:
        n_rows, rows: contact rows after the solve.
        n_rocks: number of rocks.
        n_bodies: number of the machine's bodies that touch rocks.
        impacts, with_impacts: (n_rows, 3) impulses of the impact stage, if there was one.
    """
    sums = np.zeros((n_bodies, 6))
    spatial = np.zeros(6)
    for k in range(n_rows):
        number = rows.body_b[k] - n_rocks - 1
        if number < 0:
            continue
        row = rows.values[k]
        x, y, z = get_impulse(row)
        if with_impacts:
            x, y, z = x + impacts[k, 0], y + impacts[k, 1], z + impacts[k, 2]
        set_spatial_impulse(get_vector(row.arm_b), (x, y, z), spatial)
        for d in range(6):
            sums[number, d] += spatial[d]
    return sums
