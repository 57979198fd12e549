"""The contact cache: what is kept of contact points from step to step, and how it is found again.

It holds the loaded points of the last step, and speculative ones, which are near but not in contact. It is what makes a
stored pile start warm, what a sleeping pile's force network is kept in, and where contacts come from that are not
searched in every step (`collision.persistence`). Points of sleeping pairs come first and stay in their places; a hash
table leads from a pair to the first of its points. A second cache holds the separating axes of pairs that are near but
apart: it skips searches and never changes a result.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.compiling import Array, Record, Rotation, Vector, kernel
from drakerock.rocks.engine.contact_law import get_impulse
from drakerock.rocks.engine.memory_access import make_aligned_zeros, prefetch
from drakerock.rocks.engine.records import CACHED_POINT
from drakerock.rocks.engine.solve.rows import ContactRows, make_key, split_key
from drakerock.rocks.engine.vectors import get_rotation, get_vector, rotate_back, set_vector

# Speculative points are kept up to this share of the cache's capacity, so that loaded ones find room.
SPECULATIVE_SHARE = 0.875
# Gaps in it are closed when they are one in this many of the points of sleeping rocks: closing them writes all anew.
MAX_GAPS = 16
# A simplex is kept in two numbers in single precision, exact up to this.
SIMPLEX_STEP = 1 << 22


class ContactCache(NamedTuple):
    """The cache of m contact points. Pairs are apart from the rest: they are looked at in passes over all points.

    Attributes:
        pairs: (m, 2) int32 the bodies of each; first a rock. -1 where there was a point of sleeping rocks, see
            `write_cache`.
        points: (m,) records `CACHED_POINT`.
    """

    pairs: NDArray[np.int32]
    points: Array

    def select(self, rows: slice | NDArray[np.bool_]) -> ContactCache:
        """Return some of the points, as numpy indexes them."""
        return ContactCache(self.pairs[rows], self.points[rows])


def make_contact_cache(n: int) -> ContactCache:
    """Return a cache of so many points, all zero."""
    return ContactCache(np.zeros((n, 2), np.int32), np.zeros(n, CACHED_POINT))


class CacheIndex(NamedTuple):
    """Which points of a cache are looked up in a step.

    Attributes:
        active: (n_active,) at least: their rows. Others are of pairs without an awake rock, and stay as they are.
        table: (2**k,) hash table from a pair's key to the first of its rows, -1 where empty.
        n_active: number of active rows.
        n_gaps: number of gaps.
    """

    active: NDArray[np.int64]
    table: NDArray[np.int64]
    n_active: int
    n_gaps: int


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
    records = make_aligned_zeros((places, 8), np.float32)
    cache = AxisCache(records.view(np.int64)[:, 0], records[:, 2:5])
    cache.keys[:] = -1
    return cache


def calc_places(n: int) -> int:
    """Return how many places a hash table for `n` has: the next power of two."""
    return 1 << int(np.ceil(np.log2(n)))


@kernel
def _hash(key: int, mask: int) -> int:
    return ((key * -7046029254386353131) >> 40) & mask


# What is read from the cache is as wide as elsewhere: kernels are compiled once for each type of number they are given.
@kernel
def read_pair(cache: ContactCache, row: int) -> tuple[int, int]:
    """Return the two bodies that a point of the cache belongs to."""
    return int(np.int64(cache.pairs[row, 0])), int(np.int64(cache.pairs[row, 1]))


@kernel
def read_key(cache: ContactCache, row: int) -> int:
    """Return the key of the pair that a point of the cache belongs to."""
    a, b = read_pair(cache, row)
    return make_key(a, b)


@kernel
def read_simplex(point: Record) -> int:
    """Return where the search of the point's pair ended, see `gjk.encode_simplex`."""
    return int(point.simplex[0]) + SIMPLEX_STEP * int(point.simplex[1])


@kernel
def widen(values: Array) -> Vector:
    """Return three numbers in double precision."""
    return np.float64(values[0]), np.float64(values[1]), np.float64(values[2])


@kernel
def is_loaded(point: Record) -> bool:
    """Return whether a point carried load; the others are speculative."""
    x, y, z = get_vector(point.impulse)
    return bool(x != 0.0 or y != 0.0 or z != 0.0)


@kernel
def count_gaps(cache: ContactCache) -> int:
    """Return the number of gaps in a cache."""
    n_gaps = 0
    for row in range(len(cache.pairs)):
        if cache.pairs[row, 0] < 0:
            n_gaps += 1
    return n_gaps


@kernel
def index_cache(
    cache: ContactCache, first: int, n_rocks: int, stirs: Array, active: Array, table: Array
) -> tuple[int, int]:
    """Set a hash table from a pair's key to the first of its points (those of a pair are in line).

    Reads:
        cache: of the last step (m points).
        first: the points before are of rocks that sleep.
        n_rocks: number of rocks.
        stirs: (n,) bool, the rocks that are awake, or have left the site in the last step. A pair of others, or of one
            and what stands still, is not searched, its points stay as they are, and it is left out.
    Writes:
        active: (m,) at least: the active rows, those of rocks that have left the site among them.
        table: (2**k,) at least twice as many places as points; as many of the first as needed are set, -1 where
            empty.

    Returns:
        how many places are in use: a power of two; look up in ``table[:places]``. And the number of active rows.
    """
    n_active = 0
    for row in range(first, len(cache.pairs)):
        a, b = cache.pairs[row, 0], cache.pairs[row, 1]
        if a >= 0 and (stirs[a] or (b < n_rocks and stirs[b])):
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
        key = read_key(cache, row)
        if key != last:
            place = _hash(key, mask)
            while table[place] >= 0:
                place = (place + 1) & mask
            table[place] = row
        last = key
    return places, n_active


@kernel
def find_in_cache(key: int, cache: ContactCache, table: Array) -> int:
    """Return the first point of a pair in the cache, or -1."""
    mask = len(table) - 1
    place = _hash(key, mask)
    while table[place] >= 0:
        if read_key(cache, table[place]) == key:
            return table[place]
        place = (place + 1) & mask
    return -1


@kernel
def count_points(key: int, cache: ContactCache, first: int) -> int:
    """Return how many points a pair has, the first of which is at `first`; none if that is -1."""
    if first < 0:
        return 0
    last = first
    while last < len(cache.pairs) and read_key(cache, last) == key:
        last += 1
    return last - first


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
def store_axis(key: int, axis: Vector, cache: AxisCache) -> None:
    """Write a pair's axis to the cache; of two other pairs in its places the earlier one goes.

    Reads:
        key, axis: any length.
    Writes:
        cache: of axes.
    """
    place, known = find_axis(key, cache)
    if not known:
        cache.keys[place + 1] = cache.keys[place]
        for d in range(3):
            cache.axes[place + 1, d] = cache.axes[place, d]
    cache.keys[place] = key
    set_vector(axis, cache.axes[place])


@kernel
def prefetch_places(key: int, table: Array, cache: AxisCache) -> None:
    """Ask for the places where a pair will be looked up."""
    prefetch(table, _hash(key, len(table) - 1))
    prefetch(cache.keys, _find_axis_places(key, cache))


@kernel
def prefetch_cached(key: int, cache: ContactCache, table: Array) -> None:
    """Ask for the point of the cache that is at a pair's place, if any; the place should be at hand by now."""
    prefetch(cache.pairs, max(table[_hash(key, len(table) - 1)], 0))


@kernel
def write_cache(
    n_rocks: int,
    old: ContactCache,
    n_sleeping: int,
    index: CacheIndex,
    n_rows: int,
    rows: ContactRows,
    rotations: Array,
    velocities: Array,
    time_step: float,
    speculative_gap: float,
    new: ContactCache,
) -> tuple[int, int, int, int]:
    """Write the cache of the coming step: the points just solved, and all loaded points between sleeping rocks.

    The latter come first and are not moved: what is solved again leaves a gap (pair -1), so that a step in which little
    is awake writes little. Gaps are closed when they are many.

    Reads:
        n_rocks: number of rocks.
        old: cache of the last step; n_sleeping of its points, the first, are of rocks that slept then.
        n_sleeping: see `old`.
        index: its rows that were looked up, and its gaps; the others are kept.
        n_rows, rows: contact rows after the solve.
        rotations: (n, 3, 3) of the rocks at the poses of the solve.
        velocities: (n, 6) of the rocks over the step [rad/s, m/s].
        time_step: [s].
        speculative_gap: points without load are kept up to this gap [m], while there is room.
    Writes:
        new: as many rows as there are points, but for those of `old` that stay in their places.

    Returns:
        the number of points, gaps included; beyond the capacity they are counted but lost. How many of them, the
        first, are of sleeping rocks. How many of these, the first, stay in their places or leave a gap there. And the
        number of gaps.
    """
    capacity = len(new.pairs)
    n_freed = 0
    while n_freed < index.n_active and index.active[n_freed] < n_sleeping:
        n_freed += 1
    n_kept, n_gaps = 0, 0
    if (index.n_gaps + n_freed) * MAX_GAPS < n_sleeping and len(old.pairs) + n_rows <= capacity:
        n_kept, n_gaps = n_sleeping, index.n_gaps + n_freed
        for k in range(n_freed):
            new.pairs[index.active[k], 0], new.pairs[index.active[k], 1] = -1, -1
    n_new = _copy_sleeping(old, index, n_kept, n_freed if n_kept > 0 else 0, new)
    n_sleeping = n_new
    room = SPECULATIVE_SHARE * capacity + n_gaps
    for k in range(n_rows):
        row = rows.values[k]
        if row.impulse[0] <= 0.0 and (row.gap >= speculative_gap or n_new >= room):
            continue
        if n_new < capacity:
            a, b = split_key(rows.key[k])
            new.pairs[n_new, 0], new.pairs[n_new, 1] = a, b
            approach = _calc_speed_along(velocities[a], row, row.arm_a)
            if b < n_rocks:
                approach -= _calc_speed_along(velocities[b], row, row.arm_b)
            _write_point(row, get_rotation(rotations, a), row.gap - time_step * approach, new.points[n_new])
        n_new += 1
    return n_new, min(n_sleeping, capacity), n_kept, n_gaps


@kernel
def _copy_sleeping(
    old: ContactCache, index: CacheIndex, n_kept: int, next_active: int, new: ContactCache
) -> int:
    """Copy loaded points that were not looked up, from `n_kept` on; return the number of points."""
    n_new = n_kept
    for row in range(n_kept, len(old.pairs)):
        if next_active < index.n_active and index.active[next_active] == row:
            next_active += 1
            continue
        a, b = old.pairs[row, 0], old.pairs[row, 1]
        if a < 0 or not is_loaded(old.points[row]):
            continue
        if n_new < len(new.pairs):
            new.pairs[n_new, 0], new.pairs[n_new, 1] = a, b
            new.points[n_new] = old.points[row]
        n_new += 1
    return n_new


@kernel
def _write_point(row: Record, r_a: Rotation, gap: float, point: Record) -> None:
    """Write a cached point: vectors in the first rock's frame, its gap after the step, the impulse in W."""
    point.gap = gap
    simplex = int(row.simplex)
    point.simplex[0], point.simplex[1] = simplex % SIMPLEX_STEP, simplex // SIMPLEX_STEP
    set_vector(rotate_back(r_a, get_vector(row.normal)), point.normal)
    set_vector(rotate_back(r_a, get_vector(row.arm_a)), point.point)
    set_vector(get_impulse(row), point.impulse)


@kernel
def _calc_speed_along(velocity: Array, row: Record, arm: Array) -> float:
    """Return how fast the point at an arm of a row goes along its normal with a rock's velocity (6,) [m/s]."""
    x, y, z = get_vector(arm)
    return float(
        row.normal[0] * (velocity[3] + velocity[1] * z - velocity[2] * y)
        + row.normal[1] * (velocity[4] + velocity[2] * x - velocity[0] * z)
        + row.normal[2] * (velocity[5] + velocity[0] * y - velocity[1] * x)
    )


@kernel
def add_impulse(cache: ContactCache, row: int, n_rocks: int, sums: Array) -> None:
    """Add a point's impulse to the sums of its rocks.

    Reads:
        cache, row, n_rocks: the point.
    Writes:
        sums: (n, 3) [N s].
    """
    a, b = cache.pairs[row, 0], cache.pairs[row, 1]
    impulse = cache.points[row].impulse
    for d in range(3):
        sums[a, d] -= impulse[d]
    if b < n_rocks:
        for d in range(3):
            sums[b, d] += impulse[d]


@kernel
def sum_impulses(cache: ContactCache, n_rocks: int, sums: Array) -> None:
    """Sum the contact impulses on each rock.

    Reads:
        cache, n_rocks: all points.
    Writes:
        sums: (n, 3) [N s].
    """
    sums[:] = 0.0
    for row in range(len(cache.pairs)):
        if cache.pairs[row, 0] >= 0:
            add_impulse(cache, row, n_rocks, sums)
