"""Coloured batches: sixteen contacts that share no rock, and a Gauss-Seidel update of a whole batch at once.

The contacts of a batch have no bearing on each other, so to update them together is to update them one after the
other. It is a greedy colouring of the graph whose nodes are rocks and whose edges are contacts. Rows are packed in
single precision, field by field, so that a field of a batch lies in line.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from drakerock.rocks.engine.compiling import Array, allocating_kernel, kernel
from drakerock.rocks.engine.memory_access import make_aligned_zeros
from drakerock.rocks.engine.records import CONTACT_ROW, SINGLE_BODY, as_matrix, count_columns, find_column
from drakerock.rocks.engine.solve.lanes import INTEGER, LANES, WIDTH, Lanes, gather, scatter
from drakerock.rocks.engine.solve.rows import ContactRows

# A vector each of the contacts of a batch: three numbers, in all lanes.
Vectors = tuple[Lanes, ...]

# Fields of a packed row: the first columns of a contact row, up to its impulses, then its tangential step.
NORMAL, TANGENT_1, TANGENT_2 = (
    find_column(CONTACT_ROW, name) for name in ("normal", "tangent_1", "tangent_2")
)
ARM_A, ARM_B = find_column(CONTACT_ROW, "arm_a"), find_column(CONTACT_ROW, "arm_b")
NORMAL_MASS, TANGENT_MASS = find_column(CONTACT_ROW, "normal_mass"), find_column(CONTACT_ROW, "tangent_mass")
COUPLING = find_column(CONTACT_ROW, "coupling")
BIAS, COMPLIANCE = find_column(CONTACT_ROW, "bias"), find_column(CONTACT_ROW, "compliance")
FRICTION, IMPULSE = find_column(CONTACT_ROW, "friction"), find_column(CONTACT_ROW, "impulse")
TANGENT_STEP = IMPULSE + 3
ROW_TANGENT_STEP = find_column(CONTACT_ROW, "tangent_step")
FIELDS = TANGENT_STEP + 1

# Numbers of a body.
BODY_WIDTH = count_columns(SINGLE_BODY)

# Batches that are being filled at a time: one bit each in a body's mark. More are fuller, and take longer to fill.
OPEN = 32
# An empty place in a batch.
NOBODY = -1


class BatchArrays(NamedTuple):
    """Room for batches (capacity n).

    Attributes:
        members: (n, LANES) int32 contact rows, NOBODY in places left over.
        fields: (n, FIELDS, LANES) float32.
        bodies: (n, 2, LANES) int32 bodies A and B.
        changes: (LANES,) float32 sum of the sizes of the changes of normal impulses.
    """

    members: NDArray[np.int32]
    fields: NDArray[np.float32]
    bodies: NDArray[np.int32]
    changes: NDArray[np.float32]


def make_batch_arrays(n_rows: int) -> BatchArrays:
    """Return room for as many rows, if need be each in a batch of its own; what is not used takes no memory."""
    return BatchArrays(
        make_aligned_zeros((n_rows, LANES), np.int32),
        make_aligned_zeros((n_rows, FIELDS, LANES), np.float32),
        make_aligned_zeros((n_rows, 2, LANES), np.int32),
        make_aligned_zeros((LANES,), np.float32),
    )


class SingleBodies(NamedTuple):
    """Rocks in single precision (n + 1), see `prepare_rows`; all zero between solves.

    Attributes:
        values: (n + 1,) records `SINGLE_BODY`.
        matrix: (n + 1, BODY_WIDTH) the same memory.
    """

    values: Array
    matrix: NDArray[np.float32]


def make_single_bodies(n_bodies: int) -> SingleBodies:
    """Return room for so many bodies."""
    values = make_aligned_zeros((n_bodies,), SINGLE_BODY)
    return SingleBodies(values, as_matrix(values))


@allocating_kernel
def make_batches(
    chosen: Array, body_a: Array, body_b: Array, still: int, n_batches: int, members: Array, marks: Array
) -> int:
    """Put rows into batches without a common body, each row into the first open batch that has none of its own.

    Reads:
        chosen: (m,) the rows.
        body_a, body_b: per row.
        still: number of the body that stands still, which any number of rows of a batch may touch.
        n_batches: number of batches before.
    Writes:
        members: (capacity, LANES) from `n_batches` on: rows, NOBODY in places left over.
        marks: (bodies of the solve,) scratch; has to be zero and is left so.

    Returns:
        number of batches.
    """
    place = np.zeros(OPEN, np.int64)
    size = np.zeros(OPEN, np.int64)
    n_open = 0
    for k in chosen:
        a, b = body_a[k], body_b[k]
        taken = marks[a] if b == still else marks[a] | marks[b]
        slot = 0
        while slot < n_open and (taken >> slot) & 1 == 1:
            slot += 1
        if slot == OPEN:
            # Each has a row of one of these bodies: the fullest makes room.
            slot = int(np.argmax(size))
            _close(body_a, body_b, place[slot], size[slot], slot, members, marks)
            size[slot] = 0
        elif slot == n_open:
            n_open += 1
        if size[slot] == 0:
            place[slot] = n_batches
            n_batches += 1
        members[place[slot], size[slot]] = k
        size[slot] += 1
        marks[a] |= 1 << slot
        if b != still:
            marks[b] |= 1 << slot
        if size[slot] == LANES:
            _close(body_a, body_b, place[slot], LANES, slot, members, marks)
            size[slot] = 0
    for slot in range(n_open):
        if size[slot] > 0:
            _close(body_a, body_b, place[slot], size[slot], slot, members, marks)
    return n_batches


@kernel
def _close(
    body_a: Array, body_b: Array, batch: int, size: int, slot: int, members: Array, marks: Array
) -> None:
    """Take the marks of an open batch from its bodies; places left over are nobody's."""
    for lane in range(size):
        row = members[batch, lane]
        marks[body_a[row]] &= ~(1 << slot)
        marks[body_b[row]] &= ~(1 << slot)
    for lane in range(size, LANES):
        members[batch, lane] = NOBODY


@kernel
def pack(rows: ContactRows, still: int, n_batches: int, batches: BatchArrays) -> None:
    """Copy rows to single precision, batch by batch.

    Reads:
        rows: contact rows.
        still: see `make_batches`; places left over are its own.
        n_batches: number of batches.
    Writes:
        batches: with members; fields and bodies are set.
    """
    members, bodies = batches.members, batches.bodies
    for n in range(n_batches):
        size = 0
        while size < LANES and members[n, size] != NOBODY:
            k = members[n, size]
            bodies[n, 0, size], bodies[n, 1, size] = rows.body_a[k], rows.body_b[k]
            size += 1
        for lane in range(size, LANES):
            bodies[n, 0, lane], bodies[n, 1, lane] = still, still
        _pack_fields(rows, n, size, members, batches.fields)


@kernel
def _pack_fields(rows: ContactRows, n: int, size: int, members: Array, fields: Array) -> None:
    """Copy the fields of a batch, one after the other, so that memory is written in line."""
    for d in range(FIELDS):
        column = d if d < TANGENT_STEP else ROW_TANGENT_STEP
        for lane in range(size):
            fields[n, d, lane] = rows.matrix[members[n, lane], column]
        for lane in range(size, LANES):
            fields[n, d, lane] = 0.0


@kernel
def unpack_impulses(batches: BatchArrays, n_batches: int, rows: ContactRows) -> None:
    """Copy the impulses back to their rows.

    Reads:
        batches, n_batches: after the iterations.
    Writes:
        rows: their impulses.
    """
    for n in range(n_batches):
        for lane in range(LANES):
            k = batches.members[n, lane]
            if k != NOBODY:
                for d in range(3):
                    rows.values[k].impulse[d] = batches.fields[n, IMPULSE + d, lane]


@intrinsic  # type: ignore[untyped-decorator]
def _update_batch(_context: Any, fields: Any, numbers: Any, changes: Any, bodies: Any, batch: Any) -> Any:
    return types.void(fields, numbers, changes, bodies, types.int64), _build_batch_update


@kernel
def solve_batch(batch: int, batches: BatchArrays, bodies: Array) -> None:
    """Update the contacts of a batch and the velocities of their rocks, as `update_impulse` does one by one.

    Reads:
        batch: which.
    Writes:
        batches: packed; the batch's impulses are changed, the sizes of the normal changes added to `changes`.
        bodies: (n, BODY_WIDTH) float32, C-contiguous; velocities are changed.
    """
    _update_batch(batches.fields, batches.bodies, batches.changes, bodies, batch)


def _dot(a: Vectors, b: Vectors, term: Lanes) -> Lanes:
    """Return ``a . b + term``."""
    return a[0].times_plus(b[0], a[1].times_plus(b[1], a[2].times_plus(b[2], term)))


def _cross(a: Vectors, b: Vectors) -> Vectors:
    return (
        a[1].times_plus(b[2], -(a[2] * b[1])),
        a[2].times_plus(b[0], -(a[0] * b[2])),
        a[0].times_plus(b[1], -(a[1] * b[0])),
    )


def _build_batch_update(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    def get_data(k: int) -> Any:
        return context.make_array(signature.args[k])(context, builder, arguments[k]).data

    def move(pointer: Any, steps: Any) -> Any:
        return builder.gep(pointer, [ir.Constant(INTEGER, steps) if isinstance(steps, int) else steps])

    def times(number: Any, factor: int) -> Any:
        return builder.mul(number, ir.Constant(INTEGER, factor))

    batch = arguments[4]
    fields = move(get_data(0), times(batch, FIELDS * LANES))
    numbers = move(get_data(1), times(batch, 2 * LANES))
    changes, all_bodies = get_data(2), get_data(3)

    def read(field: int) -> Lanes:
        return Lanes.load(builder, move(fields, field * LANES))

    def read_vector(field: int) -> Vectors:
        return read(field), read(field + 1), read(field + 2)

    def find_bodies(side: int) -> list[Any]:
        found = (builder.load(move(numbers, side * LANES + lane)) for lane in range(LANES))
        return [move(all_bodies, times(builder.sext(number, INTEGER), BODY_WIDTH)) for number in found]

    def read_bodies(pointers: list[Any]) -> list[Lanes]:
        """Return a body's columns."""
        return gather(builder, pointers) + gather(builder, [move(pointer, WIDTH) for pointer in pointers])

    def push(w: Vectors, inertia: Sequence[Lanes], torque: Vectors) -> Vectors:
        """Return ``w + I^-1 torque``."""
        xx, xy, xz, yy, yz, zz = inertia
        rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
        return tuple(_dot(row, torque, part) for row, part in zip(rows, w, strict=True))

    zero, one = Lanes.fill(builder, 0.0), Lanes.fill(builder, 1.0)
    pointers_a, pointers_b = find_bodies(0), find_bodies(1)
    # Angular and translational velocity, inverse mass, inverse inertia xx xy xz yy yz zz.
    columns_a, columns_b = read_bodies(pointers_a), read_bodies(pointers_b)
    w_a, v_a, mass_a, inertia_a = tuple(columns_a[:3]), columns_a[3:6], columns_a[6], columns_a[7:13]
    w_b, v_b, mass_b, inertia_b = tuple(columns_b[:3]), columns_b[3:6], columns_b[6], columns_b[7:13]
    normal, tangent_1, tangent_2 = read_vector(NORMAL), read_vector(TANGENT_1), read_vector(TANGENT_2)
    arm_a, arm_b = read_vector(ARM_A), read_vector(ARM_B)

    spins = zip(v_a, v_b, _cross(w_a, arm_a), _cross(w_b, arm_b), strict=True)
    d = tuple((vb - va) + (sb - sa) for va, vb, sa, sb in spins)
    old, old_1, old_2 = read_vector(IMPULSE)
    miss = _dot(normal, d, read(COMPLIANCE).times_plus(old, -read(BIAS)))
    new = (-miss).times_plus(read(NORMAL_MASS), old)
    new = new.where_above(zero, new, zero)
    change = new - old

    # Tangential: at once where it sticks, against the slip where it slides (`contact_law`).
    slip_1 = _dot(tangent_1, d, read(COUPLING) * change)
    slip_2 = _dot(tangent_2, d, read(COUPLING + 1) * change)
    mass_11, mass_12, mass_22 = read_vector(TANGENT_MASS)
    stuck_1 = old_1 - mass_11.times_plus(slip_1, mass_12 * slip_2)
    stuck_2 = old_2 - mass_12.times_plus(slip_1, mass_22 * slip_2)
    step = -read(TANGENT_STEP)
    slid_1, slid_2 = step.times_plus(slip_1, old_1), step.times_plus(slip_2, old_2)
    limit = read(FRICTION) * new
    limit2 = limit * limit
    size2 = slid_1.times_plus(slid_1, slid_2 * slid_2)
    factor = size2.where_above(limit2, limit / size2.calc_root(), one)
    stuck2 = stuck_1.times_plus(stuck_1, stuck_2 * stuck_2)
    new_1 = stuck2.where_above(limit2, slid_1 * factor, stuck_1)
    new_2 = stuck2.where_above(limit2, slid_2 * factor, stuck_2)
    for k, impulse in enumerate((new, new_1, new_2)):
        impulse.store(move(fields, (IMPULSE + k) * LANES))
    (Lanes.load(builder, changes) + change.calc_size()).store(changes)

    change_1, change_2 = new_1 - old_1, new_2 - old_2
    axes = zip(normal, tangent_1, tangent_2, strict=True)
    p = tuple(n.times_plus(change, t.times_plus(change_1, u * change_2)) for n, t, u in axes)
    w_a, w_b = push(w_a, inertia_a, _cross(p, arm_a)), push(w_b, inertia_b, _cross(arm_b, p))
    v_a = [(-mass_a).times_plus(part, v) for part, v in zip(p, v_a, strict=True)]
    v_b = [mass_b.times_plus(part, v) for part, v in zip(p, v_b, strict=True)]
    scatter(builder, pointers_a, [*w_a, *v_a, *columns_a[6:WIDTH]])
    scatter(builder, pointers_b, [*w_b, *v_b, *columns_b[6:WIDTH]])
    return context.get_dummy_value()
