"""Sleeping: rocks at rest are taken out of the solve, and woken when their load changes.

A rock falls asleep when it has moved less than a distance in a time, and is slow. It stays in the force network: the
impulses of its contacts are kept, contacts with awake neighbours are solved against it as against solid ground. It
wakes when the sum S of its contact impulses differs from the sum S0 at which it fell asleep,

    |S - S0| > load m   and   |S - S0| > share 1/2 sum |p|,

or when it meets a sensor, the box in front of the bucket. A rock under pressure from all sides holds what a loose one
on the slope would not, and its neighbours' forces are never still: hence the second bound, or else most of those
woken do not move.

Rocks that lean on one that moves (a mover) are a case of their own. Single rocks that sleep in a slope that slides
slowly are posts that brake it, and what a mover does to its neighbours goes on in one direction, while changes
elsewhere are the force network's unrest. So they do not fall asleep, and a smaller change wakes them.

Many changes, each too small to wake a rock, may add up to a slope that would slide. So from time to time all that have
moved are woken together.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drakerock.rocks.engine.compiling import Array, allocating_kernel, kernel
from drakerock.rocks.engine.contact_cache import ContactCache, add_impulse, is_loaded
from drakerock.rocks.engine.records import AWAKE, LOST, NEW, SLEEPING


class WakeThresholds(NamedTuple):
    """What wakes a rock.

    Attributes:
        load: change of the impulses' sum per mass [m/s].
        share: ... and its share of half the sum of their sizes, the pressure.
        near_movers: both are multiplied by this for rocks that lean on a mover.
        steps: for how many steps on end.
    """

    load: float
    share: float
    near_movers: float
    steps: int


class SleepLimits(NamedTuple):
    """What lets a rock fall asleep.

    Attributes:
        displacement: it moved less than this [m] ...
        time: ... within this time [s] ...
        speed: ... and is slower than this [m/s, rad/s].
    """

    displacement: float
    time: float
    speed: float


@kernel
def is_sensed(position: Array, radius: float, sensors: Array) -> bool:
    """Return whether a sphere meets one of the boxes (k,), records `SENSOR`."""
    for s in range(len(sensors)):
        box = sensors[s]
        r, origin = box.rotation, box.position
        dx, dy, dz = position[0] - origin[0], position[1] - origin[1], position[2] - origin[2]
        d = 0
        while d < 3:
            local = r[d] * dx + r[3 + d] * dy + r[6 + d] * dz
            if local < box.lower[d] - radius or local > box.upper[d] + radius:
                break
            d += 1
        if d == 3:
            return True
    return False


@kernel
def mark_by_movers(
    sleep: Array,
    velocities: Array,
    cache: ContactCache,
    n_sleeping: int,
    mover_speed: float,
    movers: Array,
    by_movers: Array,
) -> None:
    """Mark the rocks that share a loaded contact with a mover.

    Reads:
        sleep: (n,) records `SLEEP`.
        velocities: (n, 6).
        cache, n_sleeping: contact points; the first so many are of sleeping rocks.
        mover_speed: awake rocks that are faster are movers [m/s].
    Writes:
        movers: (n,) bool.
        by_movers: (n,) bool: the rocks that lean on one.
    """
    n = len(sleep)
    by_movers[:] = False
    for i in range(n):
        movers[i] = _moves(sleep, velocities, i, mover_speed)
    for row in range(n_sleeping, len(cache.pairs)):
        a, b = cache.pairs[row, 0], cache.pairs[row, 1]
        if b < n and (movers[a] or movers[b]) and is_loaded(cache.points[row]):
            by_movers[a] |= movers[b]
            by_movers[b] |= movers[a]


@kernel
def _moves(sleep: Array, velocities: Array, i: int, speed: float) -> bool:
    if sleep[i].status != AWAKE:
        return False
    x, y, z = velocities[i, 3], velocities[i, 4], velocities[i, 5]
    return bool(x * x + y * y + z * z > speed * speed)


@allocating_kernel
def wake(
    positions: Array,
    radius: Array,
    mass: Array,
    cache: ContactCache,
    n_sleeping: int,
    sensors: Array,
    by_movers: Array,
    thresholds: WakeThresholds,
    sleep: Array,
) -> int:
    """Wake sleeping rocks.

    Reads:
        positions: (n, 3) [m].
        radius: (n,) bounding spheres [m].
        mass: (n,) [kg].
        cache, n_sleeping: see `mark_by_movers`.
        sensors: (k,) see `is_sensed`.
        by_movers: (n,) see `mark_by_movers`.
        thresholds: what wakes.
    Writes:
        sleep: (n,) records `SLEEP`.

    Returns:
        number of rocks woken.
    """
    n = len(sleep)
    sums, touched = np.zeros((n, 3)), np.zeros(n, np.bool_)
    _sum_where_touched(sleep, cache, n_sleeping, touched, sums)
    changed, pressures, change2 = np.zeros(n, np.bool_), np.empty(n), np.empty(n)
    _find_changed(touched, sums, mass, by_movers, thresholds, sleep, change2, changed)
    if changed.any():
        _sum_pressures(cache, changed, pressures)
    n_woken = 0
    for i in range(n):
        if sleep[i].status != SLEEPING:
            continue
        limit = thresholds.share * pressures[i] * (thresholds.near_movers if by_movers[i] else 1.0)
        if changed[i] and change2[i] > limit * limit:
            sleep[i].changed_steps += 1.0
        else:
            sleep[i].changed_steps = 0.0
        if sleep[i].changed_steps >= thresholds.steps or is_sensed(positions[i], radius[i], sensors):
            wake_rock(i, positions, sleep)
            n_woken += 1
    return n_woken


@kernel
def _sum_where_touched(
    sleep: Array, cache: ContactCache, n_sleeping: int, touched: Array, sums: Array
) -> None:
    """Sum the contact impulses of the rocks that were solved, or touched one that was; others' have not changed.

    Reads:
        sleep, cache, n_sleeping: see `wake`.
    Writes:
        touched: (n,) bool, False before.
        sums: (n, 3) zero before; added to for the rocks that are touched [N s].
    """
    n = len(sleep)
    for row in range(n_sleeping, len(cache.pairs)):
        a, b = cache.pairs[row, 0], cache.pairs[row, 1]
        touched[a] = True
        if b < n:
            touched[b] = True
    for row in range(len(cache.pairs)):
        a, b = cache.pairs[row, 0], cache.pairs[row, 1]
        if a < 0 or (not touched[a] and (b >= n or not touched[b])):
            continue
        # What has left the site carries no more.
        if sleep[a].status == LOST or (b < n and sleep[b].status == LOST):
            continue
        add_impulse(cache, row, n, sums)


@kernel
def _find_changed(
    touched: Array,
    sums: Array,
    mass: Array,
    by_movers: Array,
    thresholds: WakeThresholds,
    sleep: Array,
    change2: Array,
    changed: Array,
) -> None:
    """Find the sleeping rocks whose load has changed by the bound on its mass.

    Reads:
        touched, sums, mass, by_movers, thresholds: see `wake` and `_sum_where_touched`.
    Writes:
        sleep: references of rocks that have just fallen asleep.
        change2: (n,) squares of the changes [N^2 s^2].
        changed: (n,) bool, False before.
    """
    for i in range(len(sleep)):
        if sleep[i].status != SLEEPING:
            continue
        reference = sleep[i].reference
        if sleep[i].changed_steps == NEW:
            sleep[i].changed_steps = 0.0
            for d in range(3):
                reference[d] = sums[i, d]
        change2[i] = 0.0
        if not touched[i]:
            continue
        for d in range(3):
            change2[i] += (sums[i, d] - reference[d]) ** 2
        limit = thresholds.load * mass[i] * (thresholds.near_movers if by_movers[i] else 1.0)
        changed[i] = change2[i] > limit * limit


@kernel
def _sum_pressures(cache: ContactCache, chosen: Array, pressures: Array) -> None:
    """Set the pressures (n,) of chosen rocks (n,) to half the sum of the sizes of their contact impulses [N s]."""
    n_rocks = len(chosen)
    pressures[:] = 0.0
    for row in range(len(cache.pairs)):
        a, b = cache.pairs[row, 0], cache.pairs[row, 1]
        if a >= 0 and (chosen[a] or (b < n_rocks and chosen[b])):
            size2 = 0.0
            for d in range(3):
                size2 += cache.points[row].impulse[d] ** 2
            half = 0.5 * math.sqrt(size2)
            pressures[a] += half
            if b < n_rocks:
                pressures[b] += half


@kernel
def wake_rock(i: int, positions: Array, sleep: Array) -> None:
    """Make one rock awake.

    Reads:
        i, positions: which, and (n, 3) [m].
    Writes:
        sleep: (n,) records `SLEEP`.
    """
    sleep[i].status = AWAKE
    sleep[i].still_time = 0.0
    sleep[i].way = np.inf
    for d in range(3):
        sleep[i].anchor[d] = positions[i, d]


@kernel
def wake_all(positions: Array, only_moved: bool, sleep: Array) -> int:
    """Wake all sleeping rocks, or those of them that have moved since the start; return their number.

    Reads:
        positions, only_moved: (n, 3) [m], and which.
    Writes:
        sleep: (n,) records `SLEEP`.
    """
    n_woken = 0
    for i in range(len(sleep)):
        if sleep[i].status == SLEEPING and (sleep[i].moved == 1.0 or not only_moved):
            wake_rock(i, positions, sleep)
            n_woken += 1
    return n_woken


@kernel
def take_out_lost(lower: Array, upper: Array, positions: Array, sleep: Array, velocities: Array) -> int:
    """Take awake rocks out that have left the site.

    Reads:
        lower, upper: (3,) the site's box; a rock outside is lost [m].
        positions: (n, 3) [m].
    Writes:
        sleep: (n,) records `SLEEP`.
        velocities: (n, 6) zero for rocks that are lost.

    Returns:
        their number.
    """
    n_lost = 0
    for i in range(len(sleep)):
        if sleep[i].status != AWAKE:
            continue
        outside = False
        for d in range(3):
            outside |= positions[i, d] < lower[d] or positions[i, d] > upper[d]
        if outside:
            sleep[i].status = LOST
            velocities[i] = 0.0
            n_lost += 1
    return n_lost


@kernel
def fall_asleep(
    positions: Array,
    radius: Array,
    sensors: Array,
    by_movers: Array,
    time_step: float,
    limits: SleepLimits,
    sleep: Array,
    velocities: Array,
) -> int:
    """Let awake rocks fall asleep.

    Reads:
        positions, radius, sensors, by_movers: as for `wake`.
        time_step: [s].
        limits: what lets a rock fall asleep.
    Writes:
        sleep: (n,) records `SLEEP`; references are set by the next `wake`.
        velocities: (n, 6) zero for rocks that fall asleep.

    Returns:
        their number.
    """
    n_asleep = 0
    for i in range(len(sleep)):
        if sleep[i].status != AWAKE:
            continue
        moved2, fastest, anchor = 0.0, 0.0, sleep[i].anchor
        for d in range(3):
            moved2 += (positions[i, d] - anchor[d]) ** 2
            fastest = max(fastest, max(abs(velocities[i, d]), abs(velocities[i, 3 + d])))
        if moved2 > limits.displacement * limits.displacement:
            sleep[i].still_time = 0.0
            sleep[i].moved = 1.0
            for d in range(3):
                anchor[d] = positions[i, d]
        else:
            sleep[i].still_time += time_step
        if (
            sleep[i].still_time >= limits.time
            and fastest < limits.speed
            and not by_movers[i]
            and not is_sensed(positions[i], radius[i], sensors)
        ):
            sleep[i].status = SLEEPING
            sleep[i].changed_steps = NEW
            velocities[i] = 0.0
            n_asleep += 1
    return n_asleep
