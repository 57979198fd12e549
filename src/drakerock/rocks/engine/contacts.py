"""Contact rows and the memory of contacts: what a contact point is, and how it is found again.

Memory holds the loaded points of the last step, and those about to touch: the pair's key, the point in the frame of
the pair's first rock, the impulse in W, where the search for the pair's nearest points ended, the contact's normal,
and its gap after the step. It is what makes a stored pile start warm, what a resting pile's force network is kept in,
and where contacts come from that are not searched in every step, those of calm rocks and of rocks that move together.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.collision.broad_phase import AWAKE, LOST
from drakerock.rocks.engine.compiling import Array, Vector, kernel
from drakerock.rocks.engine.lanes import make_zeros
from drakerock.rocks.engine.prefetching import prefetch

# Columns of a contact row. All vectors in W; impulses act on body B, and reversed on body A.
NORMAL = 0  # 0..2 unit normal from A to B
TANGENT_1 = 3  # 3..5
TANGENT_2 = 6  # 6..8
ARM_A = 9  # 9..11 from A's origin to the point
ARM_B = 12  # 12..14 from B's origin to the point
NORMAL_MASS = 15  # 1 / (normal row's diagonal + compliance)
COUPLING_1 = 16  # normal impulse -> velocity along tangent 1
COUPLING_2 = 17
TANGENT_MASS = 18  # 18..20 inverse of the tangential 2 x 2 block: 11 12 22
BIAS = 21  # normal velocity aimed at
COMPLIANCE = 22
FRICTION = 23
IMPULSE = 24  # 24..26 normal, tangent 1, tangent 2 [N s]
GAP = 27
RESTITUTION = 28
TANGENT_STEP = 29  # 2 / trace of the tangential block
SIMPLEX = 30  # where the search for the nearest points ended, see `gjk.encode_simplex`; or 0
ROW_WIDTH = 32

# Columns of the memory's values, in single precision: all of it is copied in every step, also of rocks that rest.
MEMORY_POINT = 0  # 0..2
MEMORY_IMPULSE = 3  # 3..5
MEMORY_SIMPLEX = 6  # 6..7, its lower and its upper bits
MEMORY_NORMAL = 8  # 8..10 in the frame of the pair's first rock
MEMORY_GAP = 11
MEMORY_WIDTH = 12  # even: two numbers take the room of one of the context's

# Points without load go into memory up to this share of its capacity, so that those with load find room.
NEAR_SHARE = 0.875
# Gaps in it are closed when they are one in this many of the points of rocks at rest.
MAX_GAPS = 16

# A pair's key is first * KEY_STEP + second; bodies are below it.
KEY_STEP = 1 << 20
SIMPLEX_STEP = 1 << 22


class ContactRows(NamedTuple):
    """Room for contact rows (capacity n).

    Attributes:
        values: (n, ROW_WIDTH).
        body_a, body_b: (n,) the bodies of the solve that each row is between.
        key: (n,) its pair's key, see `KEY_STEP`.
    """

    values: NDArray[np.float64]
    body_a: NDArray[np.int64]
    body_b: NDArray[np.int64]
    key: NDArray[np.int64]


class Memory(NamedTuple):
    """The memory of m contact points. Pairs are apart from the rest: they are looked at in passes over all points.

    Attributes:
        pairs: (m, 2) int32 the bodies of each; first a rock. -1 where there was a point of rocks at rest, see
            `write_memory`.
        values: (m, MEMORY_WIDTH) float32.
    """

    pairs: NDArray[np.int32]
    values: NDArray[np.float32]

    def select(self, rows: slice | NDArray[np.bool_]) -> Memory:
        """Return some of the points, as numpy indexes them."""
        return Memory(self.pairs[rows], self.values[rows])


def make_memory(n: int) -> Memory:
    """Return memory of so many points, all zero."""
    return Memory(np.zeros((n, 2), np.int32), np.zeros((n, MEMORY_WIDTH), np.float32))


class AxisCache(NamedTuple):
    """The separating axes of pairs that are near but apart: places for p of them, found by their key.

    A pair has a choice of two places, the later one beside the earlier: with a single place each, a tenth of the pairs
    pushed each other out in every step.

    Attributes:
        keys: (p,) key of the pair at each place, or -1.
        axes: (p, 3) float32 its axis, any length.
    """

    keys: NDArray[np.int64]
    axes: NDArray[np.float32]


def make_axis_cache(n: int) -> AxisCache:
    """Return an empty cache with room for at least so many pairs."""
    places = calc_places(max(n, 2))
    # Two places, with key and axis each, are a line of the processor's cache.
    records = make_zeros((places, 8), np.float32)
    cache = AxisCache(records.view(np.int64)[:, 0], records[:, 2:5])
    cache.keys[:] = -1
    return cache


def make_contact_rows(capacity: int) -> ContactRows:
    """Return room for so many rows."""
    numbers = [np.zeros(capacity, np.int64) for _ in range(3)]
    return ContactRows(np.zeros((capacity, ROW_WIDTH)), *numbers)


def calc_places(n: int) -> int:
    """Return how many places a hash table for `n` has: the next power of two."""
    return 1 << int(np.ceil(np.log2(n)))


@kernel
def _hash(key: int, mask: int) -> int:
    return ((key * -7046029254386353131) >> 40) & mask


@kernel
def make_key(a: int, b: int) -> int:
    """Return the key of a pair of bodies, see `KEY_STEP`."""
    return a * KEY_STEP + b


@kernel
def split_key(key: int) -> tuple[int, int]:
    """Return the two bodies of a pair's key."""
    return key // KEY_STEP, key % KEY_STEP


# What is read from memory is as wide as elsewhere: kernels are compiled once for each type of number they are given.
@kernel
def read_pair(memory: Memory, row: int) -> tuple[int, int]:
    """Return the two bodies that a row of the memory belongs to."""
    return int(np.int64(memory.pairs[row, 0])), int(np.int64(memory.pairs[row, 1]))


@kernel
def read_key(memory: Memory, row: int) -> int:
    """Return the key of the pair that a row of the memory belongs to."""
    a, b = read_pair(memory, row)
    return make_key(a, b)


@kernel
def read_simplex(memory: Memory, row: int) -> int:
    """Return where the search of the row's pair ended, see `gjk.encode_simplex`."""
    return int(memory.values[row, MEMORY_SIMPLEX]) + SIMPLEX_STEP * int(
        memory.values[row, MEMORY_SIMPLEX + 1]
    )


@kernel
def read_vector(memory: Memory, row: int, column: int) -> Vector:
    """Return the three numbers of a row of the memory that begin at a column."""
    values = memory.values
    return (
        np.float64(values[row, column]),
        np.float64(values[row, column + 1]),
        np.float64(values[row, column + 2]),
    )


@kernel
def is_loaded(memory: Memory, row: int) -> bool:
    """Return whether a row of the memory carried load; the others are about to touch."""
    x, y, z = read_vector(memory, row, MEMORY_IMPULSE)
    return bool(x != 0.0 or y != 0.0 or z != 0.0)


@kernel
def _is_active(status: int) -> bool:
    return status == AWAKE or status == LOST  # `in` would be a loop


@kernel
def index_memory(
    memory: Memory, n_rocks: int, status: Array, active: Array, table: Array
) -> tuple[int, int, int]:
    """Set a hash table from a pair's key to the first of its rows in memory (rows of a pair are in line).

    Args:
        memory: of the last step (m points).
        n_rocks: number of rocks.
        status: (n,) of each rock, see `broad_phase`. A pair of rocks at rest, or of one and what stands still, is idle:
            it is not searched, its points stay as they are, and it is left out.
        active: (m,) at least, set: the rows that are not idle, those of rocks that have left the site among them.
        table: (2**k,) at least twice as many places as rows; as many of the first as needed are set, -1 where
            empty.

    Returns:
        how many places are in use: a power of two; look up in ``table[:places]``. The number of active rows, and
        of gaps.
    """
    n_active, n_gaps = 0, 0
    for row in range(len(memory.pairs)):
        a, b = memory.pairs[row, 0], memory.pairs[row, 1]
        if a < 0:
            n_gaps += 1
        elif _is_active(status[a]) or (b < n_rocks and _is_active(status[b])):
            active[n_active] = row
            n_active += 1
    places = 64
    while places < 2 * n_active:
        places *= 2
    table[:places] = -1
    mask = places - 1
    last = -1
    for k in range(n_active):
        row = active[k]
        key = read_key(memory, row)
        if key != last:
            place = _hash(key, mask)
            while table[place] >= 0:
                place = (place + 1) & mask
            table[place] = row
        last = key
    return places, n_active, n_gaps


@kernel
def find_in_memory(key: int, memory: Memory, table: Array) -> int:
    """Return the first row of a pair in memory, or -1."""
    mask = len(table) - 1
    place = _hash(key, mask)
    while table[place] >= 0:
        if read_key(memory, table[place]) == key:
            return table[place]
        place = (place + 1) & mask
    return -1


@kernel
def _find_axis_places(key: int, cache: AxisCache) -> int:
    """Return the first of a pair's two places."""
    return 2 * _hash(key, len(cache.keys) // 2 - 1)


@kernel
def find_axis(key: int, cache: AxisCache) -> tuple[int, bool]:
    """Return the place of a pair in the cache of separating axes, and whether it is the pair's own."""
    place = _find_axis_places(key, cache)
    if cache.keys[place + 1] == key:
        place += 1
    return place, cache.keys[place] == key


@kernel
def prefetch_places(key: int, table: Array, cache: AxisCache) -> None:
    """Ask for the places where a pair will be looked up."""
    prefetch(table, _hash(key, len(table) - 1))
    prefetch(cache.keys, _find_axis_places(key, cache))


@kernel
def prefetch_remembered(key: int, memory: Memory, table: Array) -> None:
    """Ask for the row of the memory that is at a pair's place, if any; the place should be at hand by now."""
    prefetch(memory.pairs, max(table[_hash(key, len(table) - 1)], 0))


@kernel
def store_axis(key: int, x: float, y: float, z: float, cache: AxisCache) -> None:
    """Write a pair's axis to the cache; of two other pairs in its places the earlier one goes."""
    place, known = find_axis(key, cache)
    if not known:
        cache.keys[place + 1] = cache.keys[place]
        for d in range(3):
            cache.axes[place + 1, d] = cache.axes[place, d]
    cache.keys[place] = key
    cache.axes[place, 0], cache.axes[place, 1], cache.axes[place, 2] = x, y, z


@kernel
def write_memory(
    n_rocks: int,
    old: Memory,
    n_idle: int,
    active: Array,
    n_active: int,
    n_gaps: int,
    rows: ContactRows,
    n_rows: int,
    rotations: Array,
    velocities: Array,
    time_step: float,
    near_gap: float,
    new: Memory,
) -> tuple[int, int, int]:
    """Write the memory of the coming step: the points just solved, and all loaded points between rocks at rest.

    The latter come first and are not moved: what is solved again leaves a gap (pair -1), so that a step in which little
    is awake writes little. Gaps are closed when they are many.

    Args:
        n_rocks: number of rocks.
        old: memory of the last step; n_idle of its points, the first, are of rocks that were at rest then.
        active, n_active, n_gaps: its rows that were looked up, and its gaps, see `index_memory`; the others are kept.
        rows, n_rows: contact rows after the solve.
        rotations: (n, 3, 3) of the rocks at the poses of the solve.
        velocities: (n, 6) of the rocks over the step [rad/s, m/s].
        time_step: [s].
        near_gap: points without load are kept up to this gap [m], while there is room.
        new: set, as many rows as there are points, but for those of `old` that stay in their places.

    Returns:
        the number of points, gaps included; beyond the capacity they are counted but lost. How many of them, the
        first, are of rocks at rest. And how many of these, the first, stay in their places or leave a gap there.
    """
    capacity = len(new.pairs)
    n_freed = 0
    while n_freed < n_active and active[n_freed] < n_idle:
        n_freed += 1
    next_active = 0
    n_kept = 0
    if (n_gaps + n_freed) * MAX_GAPS < n_idle and len(old.pairs) + n_rows <= capacity:
        n_kept = n_idle
        n_gaps += n_freed
        next_active = n_freed
        for k in range(n_freed):
            new.pairs[active[k], 0], new.pairs[active[k], 1] = -1, -1
    else:
        n_gaps = 0
    n_new = n_kept
    for row in range(n_kept, len(old.pairs)):
        if next_active < n_active and active[next_active] == row:
            next_active += 1
            continue
        a, b = old.pairs[row, 0], old.pairs[row, 1]
        if a < 0 or not is_loaded(old, row):
            continue
        if n_new < capacity:
            new.pairs[n_new, 0], new.pairs[n_new, 1] = a, b
            for d in range(MEMORY_WIDTH):
                new.values[n_new, d] = old.values[row, d]
        n_new += 1
    n_idle = n_new
    room_for_near = NEAR_SHARE * capacity + n_gaps
    for k in range(n_rows):
        row = rows.values[k]
        normal, tangent_1, tangent_2 = row[IMPULSE], row[IMPULSE + 1], row[IMPULSE + 2]
        if normal <= 0.0 and (row[GAP] >= near_gap or n_new >= room_for_near):
            continue
        if n_new < capacity:
            values = new.values[n_new]
            a, b = split_key(rows.key[k])
            new.pairs[n_new, 0], new.pairs[n_new, 1] = a, b
            approach = _calc_approach(velocities[a], row, ARM_A)
            if b < n_rocks:
                approach -= _calc_approach(velocities[b], row, ARM_B)
            values[MEMORY_GAP] = row[GAP] - time_step * approach
            simplex = int(row[SIMPLEX])
            values[MEMORY_SIMPLEX] = simplex % SIMPLEX_STEP
            values[MEMORY_SIMPLEX + 1] = simplex // SIMPLEX_STEP
            for d in range(3):
                values[MEMORY_NORMAL + d] = (
                    rotations[a, 0, d] * row[NORMAL]
                    + rotations[a, 1, d] * row[NORMAL + 1]
                    + rotations[a, 2, d] * row[NORMAL + 2]
                )
                values[MEMORY_POINT + d] = (
                    rotations[a, 0, d] * row[ARM_A]
                    + rotations[a, 1, d] * row[ARM_A + 1]
                    + rotations[a, 2, d] * row[ARM_A + 2]
                )
                values[MEMORY_IMPULSE + d] = (
                    normal * row[NORMAL + d] + tangent_1 * row[TANGENT_1 + d] + tangent_2 * row[TANGENT_2 + d]
                )
        n_new += 1
    return n_new, min(n_idle, capacity), n_kept


@kernel
def find_deepest(rows: ContactRows, n_rows: int) -> float:
    """Return the deepest overlap of all points, 0 if there is none [m]."""
    deepest = 0.0
    for k in range(n_rows):
        deepest = max(deepest, -rows.values[k, GAP])
    return deepest


@kernel
def find_depths(rows: ContactRows, n_rows: int, depths: Array) -> int:
    """Set `depths` to the overlaps of the points that carry load [m]; return how many there are."""
    n_loaded = 0
    for k in range(n_rows):
        if rows.values[k, IMPULSE] > 0.0:
            depths[n_loaded] = -rows.values[k, GAP]
            n_loaded += 1
    return n_loaded


@kernel
def _calc_approach(velocity: Array, row: Array, arm: int) -> float:
    """Return how fast the point at an arm of a row goes along its normal with a rock's velocity (6,) [m/s]."""
    x, y, z = row[arm], row[arm + 1], row[arm + 2]
    return float(
        row[NORMAL] * (velocity[3] + velocity[1] * z - velocity[2] * y)
        + row[NORMAL + 1] * (velocity[4] + velocity[2] * x - velocity[0] * z)
        + row[NORMAL + 2] * (velocity[5] + velocity[0] * y - velocity[1] * x)
    )


@kernel
def sum_impulses(memory: Memory, n_rocks: int, sums: Array) -> None:
    """Set `sums` (n, 3) to the sum of the contact impulses on each rock [N s]."""
    sums[:] = 0.0
    for row in range(len(memory.pairs)):
        a, b = memory.pairs[row, 0], memory.pairs[row, 1]
        if a < 0:
            continue
        for d in range(3):
            sums[a, d] -= memory.values[row, MEMORY_IMPULSE + d]
        if b < n_rocks:
            for d in range(3):
                sums[b, d] += memory.values[row, MEMORY_IMPULSE + d]


@kernel
def sum_pressures(memory: Memory, n_rocks: int, chosen: Array, pressures: Array) -> None:
    """Set `pressures` (n,) of the rocks `chosen` (n,) to half the sum of the sizes of their contact impulses [N s]."""
    pressures[:] = 0.0
    for row in range(len(memory.pairs)):
        a, b = memory.pairs[row, 0], memory.pairs[row, 1]
        if a >= 0 and (chosen[a] or (b < n_rocks and chosen[b])):
            size2 = 0.0
            for d in range(3):
                size2 += memory.values[row, MEMORY_IMPULSE + d] ** 2
            half = 0.5 * math.sqrt(size2)
            pressures[a] += half
            if b < n_rocks:
                pressures[b] += half
