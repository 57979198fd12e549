"""The contact solve's resting stage: sweeps over all contacts with momentum, and further ones about the machine."""

from __future__ import annotations

import numpy as np

from drakerock.rocks.engine.batches import (
    FIELDS,
    BatchArrays,
    make_batches,
    pack,
    solve_batch,
    unpack_impulses,
)
from drakerock.rocks.engine.compiling import Array, allocating_kernel, kernel
from drakerock.rocks.engine.contacts import BIAS, IMPULSE
from drakerock.rocks.engine.lanes import LANES, WIDTH
from drakerock.rocks.engine.momentum import calc_share, go_on, go_on_in_lanes
from drakerock.rocks.engine.solver import (
    INVERSE_INERTIA,
    ROW_IMPULSE,
    MachineArrays,
    apply_impulses,
    calc_normal_velocity,
    solve_machine_contacts,
    solve_machine_rows,
)

# Contacts of rocks that are at most this many rocks away from one that touches the machine are its neighbourhood.
NEIGHBOURHOOD = 2
# The last of the iterations are without momentum: one in so many, and at least so many.
PLAIN_SHARE = 10
LEAST_PLAIN = 10
# Points without load away from the machine are idle if it takes this speed to close them within a step [m/s], and as
# bodies move now they will not touch within so many steps. They are looked at in one pair of sweeps of so many, and
# swept with the others from the first impulse on.
IDLE_SPEED = 0.05
IDLE_STEPS = 4.0
IDLE_PERIOD = 5


@kernel
def _find_machine_rows(n_rows: int, body_b: Array, n_rocks: int) -> int:
    """Return the first of the machine's contacts; they are the last rows."""
    first = n_rows
    while first > 0 and body_b[first - 1] > n_rocks:
        first -= 1
    return first


@kernel
def _mark_neighbourhood(
    n_free: int, n_rows: int, body_a: Array, body_b: Array, n_rocks: int, marks: Array
) -> None:
    """Mark the rocks in the machine's neighbourhood with 1 and more.

    Args:
        n_free, n_rows, body_a, body_b: the rocks' rows are the first, the machine's the others.
        n_rocks: see `prepare_rows`.
        marks: (bodies of the solve,) set.
    """
    marks[:] = 0
    for k in range(n_free, n_rows):
        marks[body_a[k]] = 1
    for distance in range(1, NEIGHBOURHOOD + 1):
        for k in range(n_free):
            a, b = body_a[k], body_b[k]
            if b == n_rocks:
                continue
            if marks[a] == distance and marks[b] == 0:
                marks[b] = distance + 1
            elif marks[b] == distance and marks[a] == 0:
                marks[a] = distance + 1


@allocating_kernel
def _make_all_batches(
    rows: Array,
    n_free: int,
    n_rows: int,
    body_a: Array,
    body_b: Array,
    bodies: Array,
    n_rocks: int,
    marks: Array,
    members: Array,
) -> tuple[int, int, int]:
    """Put the rocks' rows into batches: the machine's neighbourhood, others under load, those without.

    Returns:
        how many the neighbourhood has, how many these two have, how many there are.
    """
    _mark_neighbourhood(n_free, n_rows, body_a, body_b, n_rocks, marks)
    chosen, group = np.empty(n_free, np.int64), np.empty(n_free, np.int64)
    for k in range(n_free):
        if marks[body_a[k]] > 0 or marks[body_b[k]] > 0:
            group[k] = 0
        elif _is_idle(rows[k], bodies[body_a[k]], bodies[body_b[k]]):
            group[k] = 2
        else:
            group[k] = 1
    marks[:] = 0
    n_batches, ends = 0, np.empty(3, np.int64)
    for number in range(3):
        n_chosen = 0
        for k in range(n_free):
            if group[k] == number:
                chosen[n_chosen] = k
                n_chosen += 1
        n_batches = make_batches(chosen[:n_chosen], body_a, body_b, n_rocks, marks, members, n_batches)
        ends[number] = n_batches
    return ends[0], ends[1], ends[2]


@kernel
def _choose_idle(batches: BatchArrays, first: int, last: int, every: bool, swept: Array) -> int:
    """Choose the batches of idle points to be swept: every one, or those that carry load by now; return how many."""
    n_swept = 0
    for k in range(first, last):
        loaded = every
        for lane in range(LANES):
            # Momentum may have gone on below zero, which the next sweep mends.
            loaded |= batches.fields[k, IMPULSE, lane] != 0.0
        if loaded:
            swept[n_swept] = k
            n_swept += 1
    return n_swept


@kernel
def _is_idle(row: Array, body_a: Array, body_b: Array) -> bool:
    """Return whether a point carries no load and will not touch within `IDLE_STEPS`."""
    if row[IMPULSE] > 0.0 or row[BIAS] > -IDLE_SPEED:
        return False
    # Apart, the bias is the speed at which they meet within the step.
    return calc_normal_velocity(row, body_a, body_b) * IDLE_STEPS > row[BIAS]


@kernel
def sum_normal_impulses(rows: Array, first: int, last: int) -> float:
    """Return the sum of the normal impulses of a range of rows [N s]."""
    total = 0.0
    for k in range(first, last):
        total += rows[k, IMPULSE]
    return total


@allocating_kernel
def solve_resting(
    rows: Array,
    n_rows: int,
    body_a: Array,
    body_b: Array,
    awake: Array,
    bodies: Array,
    n_rocks: int,
    machine: MachineArrays,
    velocity: Array,
    iterations: int,
    machine_sweeps: int,
    momentum: float,
    batches: BatchArrays,
    bodies_32: Array,
    marks: Array,
    weight: float,
) -> float:
    """The resting stage: symmetric sweeps, forwards and backwards in turn.

    Each is followed by `machine_sweeps` over the machine's own rows, its contacts and their neighbourhood. A light rock
    that the machine presses on others passes on little of the machine's momentum per sweep. After every second one all
    are continued on their way, see `momentum`; but for the last tenth of `iterations`, in which what goes to and fro
    with momentum comes to an end. Points that carry no load, and are not about to, are left out of most sweeps.

    The sweeps over the rocks run in single precision; the velocities are then made anew from the impulses in
    double precision, so that momentum is kept to rounding.

    Args:
        rows, n_rows, body_a, body_b: prepared contact rows with the warm start's impulses; the machine's are the
            last. Impulses are set.
        awake: (m,) rocks that can move.
        bodies, machine, velocity: with gravity and free velocities, without the warm start; changed.
        n_rocks: see `prepare_rows`.
        iterations: number of sweeps over all contacts.
        machine_sweeps: further sweeps about the machine after each.
        momentum: at most this share of two sweeps' change is added to them, see `momentum`; 0: none.
        batches: room for as many rows.
        bodies_32: (n_rocks + 1, BODY_WIDTH) float32 scratch; has to be zero and is left so.
        marks: (bodies of the solve,) scratch.
        weight: of the awake rocks over the step [N s].

    Returns:
        the residual, which is the last whole sweep's change of the normal impulses over their sum, or over the weight
        if that is more: what hardly touches may be off by much of little.
    """
    free = np.empty((len(awake), 6))
    for s in range(len(awake)):
        for d in range(6):
            free[s, d] = bodies[awake[s], d]
    apply_impulses(rows, n_rows, body_a, body_b, bodies, n_rocks, machine, velocity)
    for s in range(len(awake)):
        for d in range(INVERSE_INERTIA + 6):
            bodies_32[awake[s], d] = bodies[awake[s], d]
    n_free = _find_machine_rows(n_rows, body_b, n_rocks)
    forwards = np.arange(n_free, n_rows)
    backwards = forwards[::-1].copy()
    scratch = np.empty((3, 6))
    n_near, n_loaded, n_batches = _make_all_batches(
        rows, n_free, n_rows, body_a, body_b, bodies, n_rocks, marks, batches.members
    )
    pack(rows, body_a, body_b, n_rocks, batches, n_batches)
    every_batch, every_motor = np.arange(n_batches), np.arange(len(machine.row_values))
    one_body, fields = np.zeros(1, np.int64), batches.fields.reshape(len(batches.fields), FIELDS * LANES)
    last_impulses = np.zeros((n_batches, 3 * LANES), np.float32)
    # With two columns that do not change, so that a rock is one vector.
    last_velocities = np.zeros((len(awake), WIDTH), np.float32)
    last_machine_impulses = np.zeros((n_rows - n_free, 3))
    last_motors, last_velocity = np.zeros((len(every_motor), 1)), np.zeros((1, len(velocity)))
    first_plain = iterations - min(max(iterations // PLAIN_SHARE, LEAST_PLAIN), iterations // 2)
    changed = 0.0
    swept = np.empty(n_batches - n_loaded, np.int64)
    n_swept = 0
    for iteration in range(iterations):
        if iteration % 2 == 0:
            n_swept = _choose_idle(batches, n_loaded, n_batches, (iteration // 2) % IDLE_PERIOD == 0, swept)
        for sweep in range(1 + machine_sweeps):
            n = n_near if sweep > 0 else n_loaded
            if len(machine.row_values) > 0:
                solve_machine_rows(machine, velocity)
            batches.changes[:] = 0.0
            if (iteration + sweep) % 2 == 0:
                for k in range(n):
                    solve_batch(batches, k, bodies_32)
                if sweep == 0:
                    for k in range(n_swept):
                        solve_batch(batches, swept[k], bodies_32)
                change = solve_machine_contacts(
                    rows, forwards, body_a, body_b, bodies_32, n_rocks, machine, velocity, scratch
                )
            else:
                change = solve_machine_contacts(
                    rows, backwards, body_a, body_b, bodies_32, n_rocks, machine, velocity, scratch
                )
                if sweep == 0:
                    for k in range(n_swept - 1, -1, -1):
                        solve_batch(batches, swept[k], bodies_32)
                for k in range(n - 1, -1, -1):
                    solve_batch(batches, k, bodies_32)
            if sweep == 0:
                changed = change + float(batches.changes.sum())
        done = iteration + 1
        if momentum > 0.0 and done % 2 == 0 and done < iterations:
            share = 0.0 if done >= first_plain else calc_share(done // 2 - 1, momentum)
            go_on_in_lanes(fields, every_batch, IMPULSE * LANES, last_impulses, share)
            go_on_in_lanes(bodies_32, awake, 0, last_velocities, share)
            go_on(rows, forwards, IMPULSE, last_machine_impulses, share)
            go_on(machine.row_values, every_motor, ROW_IMPULSE, last_motors, share)
            go_on(velocity.reshape(1, len(velocity)), one_body, 0, last_velocity, share)
    unpack_impulses(batches, n_batches, rows)
    for s in range(len(awake)):
        for d in range(6):
            bodies[awake[s], d] = free[s, d]
        # What is not awake stays zero: at rest, and immovable.
        bodies_32[awake[s]] = 0.0
    apply_impulses(rows, n_rows, body_a, body_b, bodies, n_rocks, machine, np.zeros(len(velocity)))
    total = max(sum_normal_impulses(rows, 0, n_rows), weight)
    return changed / total if total > 0.0 else 0.0
