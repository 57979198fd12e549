"""The contact solve: symmetric Gauss-Seidel iterations over all contacts, with Nesterov acceleration.

An iteration updates contact by contact (`contact_law`), forwards and backwards in turn, each with the velocities that
the one before left behind. Each is followed by further ones over the machine's own rows, its contacts and their
neighbourhood: a light rock that the machine presses on others passes on little of the machine's momentum per
iteration. After every second one all are extrapolated (`acceleration`), but for the last tenth, in which what goes to
and fro with acceleration comes to an end. Points that carry no load, and are about to carry none, are left out of
most iterations.

Iterations over rocks run in single precision, in coloured batches (`batches`); the velocities are then made anew from
the impulses in double precision, so that momentum is kept to rounding.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drakerock.rocks.engine.compiling import Array, Record, allocating_kernel, kernel
from drakerock.rocks.engine.records import BODY
from drakerock.rocks.engine.solve.acceleration import calc_factor, extrapolate, extrapolate_in_lanes
from drakerock.rocks.engine.solve.batches import (
    FIELDS,
    IMPULSE,
    BatchArrays,
    SingleBodies,
    make_batches,
    pack,
    solve_batch,
    unpack_impulses,
)
from drakerock.rocks.engine.solve.bodies import calc_normal_velocity, copy_body, copy_velocity
from drakerock.rocks.engine.solve.lanes import LANES, WIDTH
from drakerock.rocks.engine.solve.machine_rows import (
    MachineArrays,
    solve_machine_contacts,
    solve_machine_rows,
)
from drakerock.rocks.engine.solve.rows import (
    ContactRows,
    apply_impulses,
    clear_marks,
    sum_normal_impulses,
)

# Contacts of rocks that are at most this many rocks away from one that touches the machine are its neighbourhood.
NEIGHBOURHOOD = 2
# The last of the iterations are not accelerated: one in so many, and at least so many.
PLAIN_SHARE = 10
LEAST_PLAIN = 10
# Points without load away from the machine are inactive if it takes this speed to close them within a step [m/s], and
# as bodies move now they will not touch within so many steps. They are looked at in one pair of iterations of so many,
# and take part with the others from the first impulse on.
INACTIVE_SPEED = 0.05
INACTIVE_STEPS = 4.0
INACTIVE_PERIOD = 5

# Groups of the rocks' contacts, each in batches of its own.
NEAR_MACHINE, LOADED, INACTIVE = 0, 1, 2


class IterationSettings(NamedTuple):
    """How the solve iterates.

    Attributes:
        iterations: number of iterations over all contacts.
        machine_iterations: further ones about the machine after each.
        acceleration: greatest share of Nesterov's extrapolation; 0: none.
    """

    iterations: int
    machine_iterations: int
    acceleration: float


class _Last(NamedTuple):
    """What all iterates were when they were extrapolated last, see `acceleration`."""

    impulses: Array
    velocities: Array
    machine_impulses: Array
    row_impulses: Array
    velocity: Array


@kernel
def _find_machine_rows(n_rows: int, rows: ContactRows, n_bodies: int) -> int:
    """Return the first of the machine's contacts; they are the last rows."""
    first = n_rows
    while first > 0 and rows.body_b[first - 1] >= n_bodies:
        first -= 1
    return first


@kernel
def _mark_neighbourhood(n_free: int, n_rows: int, rows: ContactRows, still: int, marks: Array) -> None:
    """Mark the rocks in the machine's neighbourhood with 1 and more.

    Reads:
        n_free, n_rows, rows: the rocks' rows are the first, the machine's the others.
        still: number of the body that stands still.
    Writes:
        marks: (bodies of the solve,); zero before.
    """
    for k in range(n_free, n_rows):
        marks[rows.body_a[k]] = 1
    for distance in range(1, NEIGHBOURHOOD + 1):
        for k in range(n_free):
            a, b = rows.body_a[k], rows.body_b[k]
            if b == still:
                continue
            if marks[a] == distance and marks[b] == 0:
                marks[b] = distance + 1
            elif marks[b] == distance and marks[a] == 0:
                marks[a] = distance + 1


@kernel
def _is_inactive(row: Record, body_a: Record, body_b: Record) -> bool:
    """Return whether a point carries no load and will not touch within `INACTIVE_STEPS`."""
    if row.impulse[0] > 0.0 or row.bias > -INACTIVE_SPEED:
        return False
    # Apart, the bias is the speed at which they meet within the step.
    return calc_normal_velocity(row, body_a, body_b) * INACTIVE_STEPS > row.bias


@allocating_kernel
def _make_all_batches(
    n_free: int, n_rows: int, rows: ContactRows, bodies: Array, members: Array, marks: Array
) -> tuple[int, int, int]:
    """Put the rocks' rows into batches: the machine's neighbourhood, others under load, inactive ones.

    Returns:
        how many the neighbourhood has, how many these two have, how many there are.
    """
    still = len(bodies) - 1
    _mark_neighbourhood(n_free, n_rows, rows, still, marks)
    chosen, group = np.empty(n_free, np.int64), np.empty(n_free, np.int64)
    for k in range(n_free):
        a, b = rows.body_a[k], rows.body_b[k]
        if marks[a] > 0 or marks[b] > 0:
            group[k] = NEAR_MACHINE
        elif _is_inactive(rows.values[k], bodies[a], bodies[b]):
            group[k] = INACTIVE
        else:
            group[k] = LOADED
    clear_marks(n_rows, rows, marks)
    n_batches, ends = 0, np.empty(3, np.int64)
    for number in range(3):
        n_chosen = 0
        for k in range(n_free):
            if group[k] == number:
                chosen[n_chosen] = k
                n_chosen += 1
        n_batches = make_batches(
            chosen[:n_chosen], rows.body_a, rows.body_b, still, n_batches, members, marks
        )
        ends[number] = n_batches
    return ends[0], ends[1], ends[2]


@kernel
def _choose_inactive(batches: BatchArrays, first: int, last: int, every: bool, chosen: Array) -> int:
    """Choose the inactive batches that take part: every one, or those that carry load by now; return how many."""
    n_chosen = 0
    for k in range(first, last):
        loaded = every
        for lane in range(LANES):
            # It may have been extrapolated below zero, which the next iteration mends.
            loaded |= batches.fields[k, IMPULSE, lane] != 0.0
        if loaded:
            chosen[n_chosen] = k
            n_chosen += 1
    return n_chosen


@kernel
def _iterate(
    n_batches: int,
    extra: Array,
    order: Array,
    forwards: bool,
    machine: MachineArrays,
    rows: ContactRows,
    batches: BatchArrays,
    single: SingleBodies,
    velocity: Array,
    scratch: Array,
    scratch_body: Array,
) -> float:
    """One iteration over the machine's rows, batches and the machine's contacts; return the change of their normals.

    Reads:
        n_batches, extra: the first so many batches, and others.
        order: (c,) rows of the machine's contacts.
        forwards: the direction.
    Writes:
        machine: impulses of its own rows.
        rows: impulses of the machine's contacts.
        batches: impulses of the others.
        single, velocity: velocities of rocks and machine.
        scratch, scratch_body: see `solve_machine_contacts`.
    """
    if len(machine.row_values) > 0:
        solve_machine_rows(machine, velocity)
    if forwards:
        for k in range(n_batches):
            solve_batch(k, batches, single.matrix)
        for k in range(len(extra)):
            solve_batch(extra[k], batches, single.matrix)
    change = solve_machine_contacts(
        order, rows.body_a, rows.body_b, machine, rows.values, single.values, velocity, scratch, scratch_body
    )
    if not forwards:
        for k in range(len(extra) - 1, -1, -1):
            solve_batch(extra[k], batches, single.matrix)
        for k in range(n_batches - 1, -1, -1):
            solve_batch(k, batches, single.matrix)
    return change


@allocating_kernel
def _accelerate(
    factor: float,
    n_batches: int,
    order: Array,
    awake: Array,
    machine: MachineArrays,
    rows: ContactRows,
    batches: BatchArrays,
    single: SingleBodies,
    velocity: Array,
    last: _Last,
) -> None:
    """Extrapolate all that the iterations change."""
    every = np.arange(n_batches)
    fields = batches.fields.reshape(len(batches.fields), FIELDS * LANES)
    extrapolate_in_lanes(every, IMPULSE * LANES, factor, fields, last.impulses)
    extrapolate_in_lanes(awake, 0, factor, single.matrix, last.velocities)
    for c in range(len(order)):
        extrapolate(factor, rows.values[order[c]].impulse, last.machine_impulses[c])
    for k in range(len(machine.row_values)):
        now = machine.row_values[k].impulse
        machine.row_values[k].impulse = now + factor * (now - last.row_impulses[k])
        last.row_impulses[k] = now
    extrapolate(factor, velocity, last.velocity)


@allocating_kernel
def solve_contacts(
    n_rows: int,
    awake: Array,
    settings: IterationSettings,
    weight: float,
    rows: ContactRows,
    bodies: Array,
    machine: MachineArrays,
    velocity: Array,
    batches: BatchArrays,
    single: SingleBodies,
    marks: Array,
) -> float:
    """Solve all contacts and the machine's rows.

    Reads:
        n_rows: number of contact rows.
        awake: (m,) rocks that can move.
        settings: how to iterate.
        weight: of the awake rocks over the step [N s].
    Writes:
        rows: prepared, with the warm start's impulses; impulses are changed.
        bodies: (n + 1,) records `BODY` with gravity, without the warm start; velocities are changed.
        machine: the impulses of its rows.
        velocity: (v,) its free velocities, without the warm start; changed.
        batches: room for as many rows.
        single: (n + 1) zero, and left so.
        marks: (bodies of the solve,) zero, and left so.

    Returns:
        the residual, which is the last whole iteration's change of the normal impulses over their sum, or over the
        weight if that is more: what hardly touches may be off by much of little.
    """
    free = np.empty(len(awake), BODY)
    for s in range(len(awake)):
        copy_velocity(bodies[awake[s]], free[s])
    apply_impulses(n_rows, rows, machine, bodies, velocity)
    for s in range(len(awake)):
        copy_body(bodies[awake[s]], single.values[awake[s]])
    n_free = _find_machine_rows(n_rows, rows, len(bodies))
    forwards = np.arange(n_free, n_rows)
    backwards = forwards[::-1].copy()
    scratch, scratch_body = np.empty((2, 6)), np.empty(1, BODY)
    n_near, n_loaded, n_batches = _make_all_batches(n_free, n_rows, rows, bodies, batches.members, marks)
    pack(rows, len(bodies) - 1, n_batches, batches)
    last = _Last(
        np.zeros((n_batches, 3 * LANES), np.float32),
        # With two columns that do not change, so that a rock is one vector.
        np.zeros((len(awake), WIDTH), np.float32),
        np.zeros((n_rows - n_free, 3)),
        np.zeros(len(machine.row_values)),
        np.zeros(len(velocity)),
    )
    iterations = settings.iterations
    first_plain = iterations - min(max(iterations // PLAIN_SHARE, LEAST_PLAIN), iterations // 2)
    changed = 0.0
    chosen = np.empty(n_batches - n_loaded, np.int64)
    n_chosen = 0
    for iteration in range(iterations):
        if iteration % 2 == 0:
            every = (iteration // 2) % INACTIVE_PERIOD == 0
            n_chosen = _choose_inactive(batches, n_loaded, n_batches, every, chosen)
        for further in range(1 + settings.machine_iterations):
            ahead = (iteration + further) % 2 == 0
            n, extra = (n_near, chosen[:0]) if further > 0 else (n_loaded, chosen[:n_chosen])
            batches.changes[:] = 0.0
            change = _iterate(
                n, extra, forwards if ahead else backwards, ahead, machine, rows, batches, single, velocity,
                scratch, scratch_body,
            )  # fmt: skip
            if further == 0:
                changed = change + float(batches.changes.sum())
        done = iteration + 1
        if settings.acceleration > 0.0 and done % 2 == 0 and done < iterations:
            factor = 0.0 if done >= first_plain else calc_factor(done // 2 - 1, settings.acceleration)
            _accelerate(factor, n_batches, forwards, awake, machine, rows, batches, single, velocity, last)
    unpack_impulses(batches, n_batches, rows)
    for s in range(len(awake)):
        copy_velocity(free[s], bodies[awake[s]])
        # What is not awake stays zero: at rest, and immovable.
        single.matrix[awake[s]] = 0.0
    apply_impulses(n_rows, rows, machine, bodies, np.zeros(len(velocity)))
    total = max(sum_normal_impulses(n_rows, rows), weight)
    return changed / total if total > 0.0 else 0.0
