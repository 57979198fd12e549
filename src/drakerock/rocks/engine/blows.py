"""Blows: sleeping rocks that a step is about to strike are woken before it; asleep they would take a blow like a wall.

A blow wakes as a change of the load does (`sleeping`): its momentum, of the rock that strikes along the normal, is
compared with the same two bounds.
"""

from __future__ import annotations

import numpy as np

from drakerock.rocks.engine.compiling import Array, allocating_kernel
from drakerock.rocks.engine.contact_cache import ContactCache
from drakerock.rocks.engine.records import SLEEPING
from drakerock.rocks.engine.sleeping import WakeThresholds, sum_pressures
from drakerock.rocks.engine.solve.bodies import calc_normal_velocity
from drakerock.rocks.engine.solve.rows import ContactRows


@allocating_kernel
def find_struck(
    n_rows: int,
    rows: ContactRows,
    bodies: Array,
    mass: Array,
    cache: ContactCache,
    sleep: Array,
    thresholds: WakeThresholds,
    least_speed: float,
    time_step: float,
    places: Array,
    struck: Array,
) -> int:
    """Find the sleeping rocks that other rocks are about to strike by more than what wakes them.

    Reads:
        n_rows, rows: contacts of the coming step.
        bodies: (n + 1,) records `BODY` before it: the awake rocks', all others immovable.
        mass: (n,) [kg].
        cache: contact points of the last step.
        sleep: (n,) records `SLEEP` before the step.
        thresholds: what wakes.
        least_speed: what is slower is no blow [m/s].
        time_step: [s]; what does not meet within it strikes later.
    Writes:
        places: (n,) zero, and left so.
        struck: (n,) at least, these rocks.

    Returns:
        their number.
    """
    n, n_hit = len(sleep), 0
    momenta = np.empty(n_rows)
    for k in range(n_rows):
        row, a, b = rows.values[k], rows.body_a[k], rows.body_b[k]
        if b >= n:
            continue
        hitter, hit = (b, a) if bodies[a].inverse_mass == 0.0 else (a, b)
        if bodies[hit].inverse_mass > 0.0 or sleep[hit].status != SLEEPING:
            continue
        speed = -calc_normal_velocity(row, bodies[a], bodies[b])
        momentum = mass[hitter] * speed
        if speed < least_speed or row.gap > time_step * speed or momentum < thresholds.load * mass[hit]:
            continue
        if places[hit] == 0:
            struck[n_hit], momenta[n_hit] = hit, 0.0
            n_hit += 1
            places[hit] = n_hit
        momenta[places[hit] - 1] = max(momenta[places[hit] - 1], momentum)
    if n_hit == 0:
        return 0
    pressures = np.zeros(n_hit)
    sum_pressures(cache, places, pressures)
    n_struck = 0
    for k in range(n_hit):
        hit = struck[k]
        places[hit] = 0
        if momenta[k] > thresholds.share * pressures[k]:
            struck[n_struck] = hit
            n_struck += 1
    return n_struck
