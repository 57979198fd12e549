"""The impact stage: Newton's law for pairs with restitution that meet faster than a threshold.

A pair that approaches with u0 < 0 parts with -e u0, rigidly. The stage covers all touching contacts of the bodies that
take part, the others with u >= 0, so that an impact passes through a body into what it leans on. Pairs without
restitution need no stage of their own, the Gauss-Seidel iterations after it stop them.
"""

from __future__ import annotations

import numpy as np

from drakerock.rocks.engine.compiling import Array, allocating_kernel, kernel
from drakerock.rocks.engine.contact_law import ContactLaw, get_impulse, is_impact
from drakerock.rocks.engine.records import BODY
from drakerock.rocks.engine.solve.bodies import calc_normal_velocity
from drakerock.rocks.engine.solve.machine_rows import (
    MachineArrays,
    calc_body_velocities,
    solve_machine_contacts,
)
from drakerock.rocks.engine.solve.rows import ContactRows, clear_marks, solve_contact


@kernel
def _calc_approach(rows: ContactRows, k: int, bodies: Array, machine_bodies: Array) -> float:
    """Return how fast a row's points part [m/s]."""
    row, one, b = rows.values[k], bodies[rows.body_a[k]], rows.body_b[k]
    if b < len(bodies):
        return calc_normal_velocity(row, one, bodies[b])
    return calc_normal_velocity(row, one, machine_bodies[b - len(bodies)])


@kernel
def _mark_impacts(
    n_rows: int, rows: ContactRows, bodies: Array, machine_bodies: Array, law: ContactLaw, marks: Array
) -> None:
    """Mark the bodies of pairs that have an impact with 1; what stands still takes no part."""
    for k in range(n_rows):
        row = rows.values[k]
        if row.restitution <= 0.0:
            continue
        if is_impact(row.gap, _calc_approach(rows, k, bodies, machine_bodies), law):
            marks[rows.body_a[k]] = 1
            if rows.body_b[k] != len(bodies) - 1:
                marks[rows.body_b[k]] = 1


@kernel
def _make_rigid(
    n_rows: int,
    bodies: Array,
    machine_bodies: Array,
    law: ContactLaw,
    marks: Array,
    rows: ContactRows,
    chosen: Array,
    saved: Array,
) -> int:
    """Give the rows that take part the law of impacts; return how many they are.

    Reads:
        n_rows, bodies, machine_bodies, law: before the impacts.
        marks: 1 for bodies that have one.
    Writes:
        rows: without impulses.
        chosen: (n_rows,) the rows.
        saved: (n_rows, 6) what they were: impulse, bias, compliance, mass.
    """
    n_chosen = 0
    for k in range(n_rows):
        if marks[rows.body_a[k]] == 0 and marks[rows.body_b[k]] == 0:
            continue
        row = rows.values[k]
        approach = _calc_approach(rows, k, bodies, machine_bodies)
        # Not reached within the step; or without restitution and still apart: left to the iterations.
        if row.gap > 0.0 and (row.gap + law.time_step * approach >= 0.0 or row.restitution <= 0.0):
            continue
        for d in range(3):
            saved[n_chosen, d] = row.impulse[d]
            row.impulse[d] = 0.0
        saved[n_chosen, 3], saved[n_chosen, 4], saved[n_chosen, 5] = row.bias, row.compliance, row.normal_mass
        row.bias = -row.restitution * approach if approach < -law.impact_threshold else 0.0
        if row.normal_mass > 0.0:
            row.normal_mass = 1.0 / (1.0 / row.normal_mass - row.compliance)
        row.compliance = 0.0
        chosen[n_chosen] = k
        n_chosen += 1
    return n_chosen


@allocating_kernel
def solve_impacts(
    n_rows: int,
    law: ContactLaw,
    iterations: int,
    machine: MachineArrays,
    rows: ContactRows,
    bodies: Array,
    velocity: Array,
    impacts: Array,
    marks: Array,
) -> None:
    """Change the velocities by the impacts.

    Reads:
        n_rows: number of rows.
        law: the contact law's constants.
        iterations: of Gauss-Seidel.
        machine: the machine.
    Writes:
        rows: prepared; they are left as they were.
        bodies, velocity: before the step; changed.
        impacts: (n_rows, 3) the impacts' impulses in W [N s].
        marks: (bodies of the solve,) zero, and left so.
    """
    machine_bodies = np.zeros(len(machine.jacobian), BODY)
    calc_body_velocities(machine, velocity, machine_bodies)
    _mark_impacts(n_rows, rows, bodies, machine_bodies, law, marks)
    chosen, saved = np.empty(n_rows, np.int64), np.empty((n_rows, 6))
    n_chosen = _make_rigid(n_rows, bodies, machine_bodies, law, marks, rows, chosen, saved)
    clear_marks(n_rows, rows, marks)
    impacts[:n_rows] = 0.0
    n_free, scratch, scratch_body = 0, np.empty((2, 6)), np.empty(1, BODY)
    while n_free < n_chosen and rows.body_b[chosen[n_free]] < len(bodies):
        n_free += 1
    for _ in range(iterations):
        for c in range(n_free):
            k = chosen[c]
            solve_contact(rows.values[k], bodies[rows.body_a[k]], bodies[rows.body_b[k]])
        solve_machine_contacts(
            chosen[n_free:n_chosen], rows.body_a, rows.body_b, machine, rows.values, bodies, velocity, scratch,
            scratch_body,
        )  # fmt: skip
    for c in range(n_chosen):
        k = chosen[c]
        row = rows.values[k]
        impacts[k, 0], impacts[k, 1], impacts[k, 2] = get_impulse(row)
        for d in range(3):
            row.impulse[d] = saved[c, d]
        row.bias, row.compliance, row.normal_mass = saved[c, 3], saved[c, 4], saved[c, 5]
