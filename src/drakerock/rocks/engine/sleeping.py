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

from drakerock.rocks.engine.collision.blocks import BLOCK, Blocks, is_block_near
from drakerock.rocks.engine.compiling import Array, Record, allocating_kernel, kernel
from drakerock.rocks.engine.contact_cache import ContactCache, is_loaded
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


@allocating_kernel
def find_sensed(
    positions: Array, radius: Array, reach: float, sensors: Array, blocks: Blocks, sleep: Array, sensed: Array
) -> int:
    """Find the sleeping rocks that meet a sensor.

    Reads:
        positions, radius: see `is_sensed`, (n, 3), (n,).
        reach, sensors: largest radius [m], boxes.
        blocks: of all rocks.
        sleep: (n,) records `SLEEP`.
    Writes:
        sensed: (n,) at least, these rocks.

    Returns:
        their number.
    """
    n_sensed = 0
    low, high = np.empty((len(sensors), 3)), np.empty((len(sensors), 3))
    for s in range(len(sensors)):
        _find_corners(sensors[s], low[s], high[s])
    for block in range(len(blocks.lower)):
        near = False
        for s in range(len(sensors)):
            near |= is_block_near(block, low[s], high[s], reach, blocks)
        if not near:
            continue
        for i in range(BLOCK * block, min(BLOCK * (block + 1), len(sleep))):
            if sleep[i].status == SLEEPING and is_sensed(positions[i], radius[i], sensors):
                sensed[n_sensed] = i
                n_sensed += 1
    return n_sensed


@kernel
def _find_corners(box: Record, low: Array, high: Array) -> None:
    """Set the corners (3,) of the box in W's axes around a sensor."""
    for d in range(3):
        low[d], high[d] = box.position[d], box.position[d]
        for e in range(3):
            one = box.rotation[3 * d + e] * box.lower[e]
            other = box.rotation[3 * d + e] * box.upper[e]
            low[d] += min(one, other)
            high[d] += max(one, other)


@kernel
def mark_by_movers(
    chosen: Array,
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
        chosen: (m,) the awake rocks, and others whose marks are needed; those of their neighbours are set, too.
        sleep: (n,) records `SLEEP`.
        velocities: (n, 6).
        cache, n_sleeping: contact points; the first so many are of sleeping rocks.
        mover_speed: awake rocks that are faster are movers [m/s].
    Writes:
        movers: (n,) bool; False before and after.
        by_movers: (n,) bool: the rocks that lean on one.
    """
    n = len(sleep)
    for i in chosen:
        by_movers[i], movers[i] = False, _moves(sleep, velocities, i, mover_speed)
    for row in range(n_sleeping, len(cache.pairs)):
        a, b = cache.pairs[row, 0], cache.pairs[row, 1]
        by_movers[a] = False
        if b < n:
            by_movers[b] = False
    for row in range(n_sleeping, len(cache.pairs)):
        a, b = cache.pairs[row, 0], cache.pairs[row, 1]
        if b < n and (movers[a] or movers[b]) and is_loaded(cache.points[row]):
            by_movers[a] |= movers[b]
            by_movers[b] |= movers[a]
    for i in chosen:
        movers[i] = False


@kernel
def _moves(sleep: Array, velocities: Array, i: int, speed: float) -> bool:
    if sleep[i].status != AWAKE:
        return False
    x, y, z = velocities[i, 3], velocities[i, 4], velocities[i, 5]
    return bool(x * x + y * y + z * z > speed * speed)


@kernel
def find_touched(
    cache: ContactCache, n_sleeping: int, unsettled: Array, sleep: Array, places: Array, touched: Array
) -> tuple[int, int]:
    """Find the sleeping rocks whose load may have changed: those that touched a rock that was solved.

    Reads:
        cache, n_sleeping: see `mark_by_movers`.
        unsettled: (k,) sleeping rocks whose `changed_steps` is not 0.
        sleep: (n,) records `SLEEP`.
    Writes:
        places: (n,) zero before: of each one its place among them, counted from 1.
        touched: (n,) at least: these rocks, and then those of `unsettled` that are not among them.

    Returns:
        the number of the former, and of all.
    """
    n, n_touched = len(sleep), 0
    for row in range(n_sleeping, len(cache.pairs)):
        for side in range(2):
            i = cache.pairs[row, side]
            if i < n and places[i] == 0 and sleep[i].status == SLEEPING:
                touched[n_touched] = i
                n_touched += 1
                places[i] = n_touched
    n_all = n_touched
    for i in unsettled:
        if places[i] == 0:
            touched[n_all] = i
            n_all += 1
    return n_touched, n_all


@allocating_kernel
def find_woken(
    n_touched: int,
    touched: Array,
    mass: Array,
    cache: ContactCache,
    by_movers: Array,
    thresholds: WakeThresholds,
    places: Array,
    sleep: Array,
    woken: Array,
) -> int:
    """Find the sleeping rocks that a change of their load wakes.

    Reads:
        n_touched, touched: see `find_touched`; the load of those after `n_touched` has not changed.
        mass: (n,) [kg].
        cache: contact points.
        by_movers: (n,) see `mark_by_movers`.
        thresholds: what wakes.
    Writes:
        places: see `find_touched`; zero afterwards.
        sleep: (n,) records `SLEEP`: references and steps of these rocks.
        woken: (n,) at least, the rocks to wake.

    Returns:
        the number of rocks to wake.
    """
    for i in touched[n_touched:]:
        if sleep[i].changed_steps == NEW:
            for d in range(3):
                sleep[i].reference[d] = 0.0
        sleep[i].changed_steps = 0.0
    if n_touched == 0:
        return 0
    chosen = touched[:n_touched]
    sums, changes2 = np.zeros((n_touched, 3)), np.empty(n_touched)
    _sum_impulses(cache, places, sleep, sums)
    some = _find_changes(chosen, sums, mass, by_movers, thresholds, sleep, changes2)
    pressures = np.zeros(n_touched)
    if some:
        sum_pressures(cache, places, pressures)
    n_woken = 0
    for k in range(n_touched):
        i = chosen[k]
        places[i] = 0
        limit = thresholds.share * pressures[k] * (thresholds.near_movers if by_movers[i] else 1.0)
        if changes2[k] > limit * limit:
            sleep[i].changed_steps += 1.0
        else:
            sleep[i].changed_steps = 0.0
        if sleep[i].changed_steps >= thresholds.steps:
            woken[n_woken] = i
            n_woken += 1
    return n_woken


@kernel
def _get_place(body: int, places: Array) -> int:
    """Return the place of a rock among those chosen, counted from 0; -1: it is not, or is no rock."""
    return int(places[body]) - 1 if body < len(places) else -1


@kernel
def _sum_impulses(cache: ContactCache, places: Array, sleep: Array, sums: Array) -> None:
    """Sum the contact impulses (k, 3) of the rocks with a place [N s]."""
    n = len(sleep)
    for row in range(len(cache.pairs)):
        a, b = cache.pairs[row, 0], cache.pairs[row, 1]
        if a < 0:
            continue
        one, other = _get_place(a, places), _get_place(b, places)
        # What has left the site carries no more.
        if (one < 0 and other < 0) or sleep[a].status == LOST or (b < n and sleep[b].status == LOST):
            continue
        for d in range(3):
            if one >= 0:
                sums[one, d] -= cache.points[row].impulse[d]
            if other >= 0:
                sums[other, d] += cache.points[row].impulse[d]


@kernel
def _find_changes(
    chosen: Array,
    sums: Array,
    mass: Array,
    by_movers: Array,
    thresholds: WakeThresholds,
    sleep: Array,
    changes2: Array,
) -> bool:
    """Find by how much the load of rocks has changed.

    Reads:
        chosen, sums: (k,) the rocks, (k, 3) the sums of their impulses [N s].
        mass, by_movers, thresholds: see `find_woken`.
    Writes:
        sleep: references of rocks that have just fallen asleep.
        changes2: (k,) squares of the changes [N^2 s^2]; -1 below the bound on the mass.

    Returns:
        whether any is above it.
    """
    some = False
    for k in range(len(chosen)):
        i = chosen[k]
        reference = sleep[i].reference
        if sleep[i].changed_steps == NEW:
            sleep[i].changed_steps = 0.0
            for d in range(3):
                reference[d] = sums[k, d]
        changes2[k] = 0.0
        for d in range(3):
            changes2[k] += (sums[k, d] - reference[d]) ** 2
        limit = thresholds.load * mass[i] * (thresholds.near_movers if by_movers[i] else 1.0)
        if changes2[k] > limit * limit:
            some = True
        else:
            changes2[k] = -1.0
    return some


@kernel
def sum_pressures(cache: ContactCache, places: Array, pressures: Array) -> None:
    """Set the pressures (k,) of the rocks with a place to half the sum of the sizes of their contact impulses [N s]."""
    for row in range(len(cache.pairs)):
        a, b = cache.pairs[row, 0], cache.pairs[row, 1]
        if a < 0:
            continue
        one, other = _get_place(a, places), _get_place(b, places)
        if one >= 0 or other >= 0:
            size2 = 0.0
            for d in range(3):
                size2 += cache.points[row].impulse[d] ** 2
            half = 0.5 * math.sqrt(size2)
            if one >= 0:
                pressures[one] += half
            if other >= 0:
                pressures[other] += half


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
def wake_rocks(chosen: Array, positions: Array, sleep: Array) -> None:
    """Make rocks awake.

    Reads:
        chosen, positions: (m,) which, and (n, 3) [m].
    Writes:
        sleep: (n,) records `SLEEP`.
    """
    for i in chosen:
        wake_rock(i, positions, sleep)


@kernel
def take_out_lost(
    awake: Array, lower: Array, upper: Array, positions: Array, sleep: Array, velocities: Array
) -> int:
    """Take awake rocks out that have left the site.

    Reads:
        awake: (m,) these rocks.
        lower, upper: (3,) the site's box; a rock outside is lost [m].
        positions: (n, 3) [m].
    Writes:
        sleep: (n,) records `SLEEP`.
        velocities: (n, 6) zero for rocks that are lost.

    Returns:
        their number.
    """
    n_lost = 0
    for i in awake:
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
    awake: Array,
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
        awake: (m,) these rocks; what has left the site among them is left alone.
        positions, radius, sensors: see `is_sensed`, (n, 3) and (n,).
        by_movers: (n,) see `mark_by_movers`.
        time_step: [s].
        limits: what lets a rock fall asleep.
    Writes:
        sleep: (n,) records `SLEEP`; references are set by the next `find_woken`.
        velocities: (n, 6) zero for rocks that fall asleep.

    Returns:
        their number.
    """
    n_asleep = 0
    for i in awake:
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
