"""Contacts in batches of eight that share no rock, and a Gauss-Seidel update of a whole batch at once.

The contacts of a batch have no bearing on each other, so to update them together is to update them one after the
other. Rows are packed in single precision, field by field, so that a field of eight contacts is one vector.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from drakerock.dynamics.nonsmooth.compiling import Array, allocating_kernel, kernel
from drakerock.dynamics.nonsmooth.contacts import (
    ARM_A,
    ARM_B,
    BIAS,
    COMPLIANCE,
    COUPLING_1,
    COUPLING_2,
    FRICTION,
    IMPULSE,
    NORMAL,
    NORMAL_MASS,
    TANGENT_1,
    TANGENT_2,
    TANGENT_MASS,
    TANGENT_STEP,
)
from drakerock.dynamics.nonsmooth.lanes import INTEGER, LANES, Lanes, transpose
from drakerock.dynamics.nonsmooth.solver import BODY_WIDTH

# Fields of a packed row: the first columns as in `contacts`, up to the impulses, then the tangential step.
FIELD_TANGENT_STEP = IMPULSE + 3
FIELDS = FIELD_TANGENT_STEP + 1

# Batches that are being filled at a time: one bit each in a body's mark.
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
        np.zeros((n_rows, LANES), np.int32),
        np.zeros((n_rows, FIELDS, LANES), np.float32),
        np.zeros((n_rows, 2, LANES), np.int32),
        np.zeros(LANES, np.float32),
    )


@allocating_kernel
def make_batches(
    chosen: Array, body_a: Array, body_b: Array, still: int, marks: Array, members: Array, n_batches: int
) -> int:
    """Put rows into batches without a common body, each row into the first open batch that has none of its own.

    Args:
        chosen: (m,) the rows.
        body_a, body_b: per row.
        still: number of the body that stands still, which any number of rows of a batch may touch.
        marks: (bodies of the solve,) scratch; has to be zero and is left so.
        members: (capacity, LANES) set from `n_batches` on: rows, NOBODY in places left over.
        n_batches: number of batches before.

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
            _close(members, place[slot], size[slot], slot, body_a, body_b, marks)
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
            _close(members, place[slot], LANES, slot, body_a, body_b, marks)
            size[slot] = 0
    for slot in range(n_open):
        if size[slot] > 0:
            _close(members, place[slot], size[slot], slot, body_a, body_b, marks)
    return n_batches


@kernel
def _close(
    members: Array, batch: int, size: int, slot: int, body_a: Array, body_b: Array, marks: Array
) -> None:
    """Take the marks of an open batch from its bodies; places left over are nobody's."""
    for lane in range(size):
        row = members[batch, lane]
        marks[body_a[row]] &= ~(1 << slot)
        marks[body_b[row]] &= ~(1 << slot)
    for lane in range(size, LANES):
        members[batch, lane] = NOBODY


@kernel
def pack(rows: Array, body_a: Array, body_b: Array, still: int, batches: BatchArrays, n_batches: int) -> None:
    """Copy rows to single precision, batch by batch.

    Args:
        rows, body_a, body_b: contact rows and the bodies of each.
        still: see `make_batches`; places left over are its own.
        batches, n_batches: with members; fields and bodies are set.
    """
    members, fields, bodies = batches.members, batches.fields, batches.bodies
    for n in range(n_batches):
        for lane in range(LANES):
            k = members[n, lane]
            if k == NOBODY:
                bodies[n, 0, lane], bodies[n, 1, lane] = still, still
                for d in range(FIELDS):
                    fields[n, d, lane] = 0.0
                continue
            bodies[n, 0, lane], bodies[n, 1, lane] = body_a[k], body_b[k]
            for d in range(FIELD_TANGENT_STEP):
                fields[n, d, lane] = rows[k, d]
            fields[n, FIELD_TANGENT_STEP, lane] = rows[k, TANGENT_STEP]


@kernel
def unpack_impulses(batches: BatchArrays, n_batches: int, rows: Array) -> None:
    """Copy the impulses back to their rows."""
    for n in range(n_batches):
        for lane in range(LANES):
            k = batches.members[n, lane]
            if k != NOBODY:
                for d in range(3):
                    rows[k, IMPULSE + d] = batches.fields[n, IMPULSE + d, lane]


@intrinsic  # type: ignore[untyped-decorator]
def _update_batch(_context: Any, fields: Any, numbers: Any, changes: Any, bodies: Any, batch: Any) -> Any:
    return types.void(fields, numbers, changes, bodies, types.int64), _build_batch_update


@kernel
def solve_batch(batches: BatchArrays, batch: int, bodies: Array) -> None:
    """Update the contacts of a batch and the velocities of their rocks, see `solver.solve_row`.

    Args:
        batches: packed; the batch's impulses are changed, the sizes of the normal changes added to `changes`.
        batch: which.
        bodies: (n, BODY_WIDTH) float32, C-contiguous; velocities are changed.
    """
    _update_batch(batches.fields, batches.bodies, batches.changes, bodies, batch)


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

    def read_vector(field: int) -> tuple[Lanes, Lanes, Lanes]:
        return read(field), read(field + 1), read(field + 2)

    def find_bodies(side: int) -> list[Any]:
        found = (builder.load(move(numbers, side * LANES + lane)) for lane in range(LANES))
        return [move(all_bodies, times(builder.sext(number, INTEGER), BODY_WIDTH)) for number in found]

    def read_bodies(pointers: list[Any]) -> list[Lanes]:
        """Return a body's columns, eight bodies each."""
        lower = transpose([Lanes.load(builder, pointer) for pointer in pointers])
        return lower + transpose([Lanes.load(builder, move(pointer, LANES)) for pointer in pointers])

    def write_bodies(pointers: list[Any], columns: list[Lanes]) -> None:
        for pointer, body in zip(pointers, transpose(columns), strict=True):
            body.store(pointer)

    zero, one = Lanes.fill(builder, 0.0), Lanes.fill(builder, 1.0)
    pointers_a, pointers_b = find_bodies(0), find_bodies(1)
    columns_a, columns_b = read_bodies(pointers_a), read_bodies(pointers_b)
    nx, ny, nz = read_vector(NORMAL)
    tx, ty, tz = read_vector(TANGENT_1)
    ux, uy, uz = read_vector(TANGENT_2)
    ax, ay, az = read_vector(ARM_A)
    bx, by, bz = read_vector(ARM_B)
    # Angular and translational velocity, inverse mass, inverse inertia xx xy xz yy yz zz.
    wa0, wa1, wa2, va0, va1, va2, mass_a, a_xx, a_xy, a_xz, a_yy, a_yz, a_zz = columns_a[:13]
    wb0, wb1, wb2, vb0, vb1, vb2, mass_b, b_xx, b_xy, b_xz, b_yy, b_yz, b_zz = columns_b[:13]

    dx = (vb0 - va0) + (wb1 * bz - wb2 * by) + (wa2 * ay - wa1 * az)
    dy = (vb1 - va1) + (wb2 * bx - wb0 * bz) + (wa0 * az - wa2 * ax)
    dz = (vb2 - va2) + (wb0 * by - wb1 * bx) + (wa1 * ax - wa0 * ay)
    old = read(IMPULSE)
    new = old - (nx * dx + ny * dy + nz * dz + read(COMPLIANCE) * old - read(BIAS)) * read(NORMAL_MASS)
    new = new.where_above(zero, new, zero)
    change = new - old

    # Tangential: at once where it sticks, against the slip where it slides (`solver.solve_row`).
    slip_1 = tx * dx + ty * dy + tz * dz + read(COUPLING_1) * change
    slip_2 = ux * dx + uy * dy + uz * dz + read(COUPLING_2) * change
    old_1, old_2 = read(IMPULSE + 1), read(IMPULSE + 2)
    mass_11, mass_12, mass_22 = read_vector(TANGENT_MASS)
    stuck_1 = old_1 - (mass_11 * slip_1 + mass_12 * slip_2)
    stuck_2 = old_2 - (mass_12 * slip_1 + mass_22 * slip_2)
    step = read(FIELD_TANGENT_STEP)
    slid_1 = old_1 - step * slip_1
    slid_2 = old_2 - step * slip_2
    limit = read(FRICTION) * new
    limit2 = limit * limit
    size2 = slid_1 * slid_1 + slid_2 * slid_2
    factor = size2.where_above(limit2, limit / size2.calc_root(), one)
    stuck2 = stuck_1 * stuck_1 + stuck_2 * stuck_2
    new_1 = stuck2.where_above(limit2, slid_1 * factor, stuck_1)
    new_2 = stuck2.where_above(limit2, slid_2 * factor, stuck_2)
    for d, impulse in enumerate((new, new_1, new_2)):
        impulse.store(move(fields, (IMPULSE + d) * LANES))
    (Lanes.load(builder, changes) + change.calc_size()).store(changes)

    change_1, change_2 = new_1 - old_1, new_2 - old_2
    px = nx * change + tx * change_1 + ux * change_2
    py = ny * change + ty * change_1 + uy * change_2
    pz = nz * change + tz * change_1 + uz * change_2
    lx, ly, lz = ay * pz - az * py, az * px - ax * pz, ax * py - ay * px
    velocity_a = [
        wa0 - (a_xx * lx + a_xy * ly + a_xz * lz),
        wa1 - (a_xy * lx + a_yy * ly + a_yz * lz),
        wa2 - (a_xz * lx + a_yz * ly + a_zz * lz),
        va0 - mass_a * px,
        va1 - mass_a * py,
        va2 - mass_a * pz,
    ]
    lx, ly, lz = by * pz - bz * py, bz * px - bx * pz, bx * py - by * px
    velocity_b = [
        wb0 + (b_xx * lx + b_xy * ly + b_xz * lz),
        wb1 + (b_xy * lx + b_yy * ly + b_yz * lz),
        wb2 + (b_xz * lx + b_yz * ly + b_zz * lz),
        vb0 + mass_b * px,
        vb1 + mass_b * py,
        vb2 + mass_b * pz,
    ]
    write_bodies(pointers_a, velocity_a + columns_a[6:LANES])
    write_bodies(pointers_b, velocity_b + columns_b[6:LANES])
    return context.get_dummy_value()
