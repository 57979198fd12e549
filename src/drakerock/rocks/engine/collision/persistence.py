"""Persistent contacts: those of slow rocks, and of rocks that move together, need no search in every step.

Until a pair is searched again, its points follow the bodies: point and normal are carried by the pair's first rock, the
gap g of each grows by h u, u the normal velocity over a step of length h. Errors are of second order in the pair's own
motion, fractions of a millimetre.
"""

from __future__ import annotations

import math

import numpy as np

from drakerock.rocks.engine.collision.poses import CollisionBodies, get_offset
from drakerock.rocks.engine.compiling import Array, Vector, kernel
from drakerock.rocks.engine.contact_cache import (
    ContactCache,
    count_points,
    read_pair,
    read_simplex,
    widen,
)
from drakerock.rocks.engine.memory_access import AHEAD, prefetch
from drakerock.rocks.engine.records import COMOVING, FOLLOWED, SEARCHED
from drakerock.rocks.engine.sleeping import is_sensed
from drakerock.rocks.engine.solve.rows import ContactRows, make_key
from drakerock.rocks.engine.vectors import (
    add,
    cross,
    dot,
    get_rotation,
    get_vector,
    make_tangents,
    rotate,
    set_vector,
    subtract,
)


@kernel
def choose_search_modes(
    awake: Array,
    positions: Array,
    velocities: Array,
    radius: Array,
    sensors: Array,
    time_step: float,
    slow_speed: float,
    distance: float,
    search_fast: bool,
    sleep: Array,
    modes: Array,
) -> None:
    """Choose how the contacts of each rock are found in this step.

    SEARCHED: all contacts are searched, of rocks that are just woken, as what they touch may have moved meanwhile,
    and of those in the sensor, which the bucket may strike in the next step; else from time to time. FOLLOWED: those
    of slow rocks, and of such as don't move at all, follow their motion. COMOVING: those of fast rocks with others
    that move like them do.

    Reads:
        awake: (m,) the rocks to do; all others are FOLLOWED.
        positions, velocities, radius, sensors: see `sleeping`.
        time_step: [s].
        slow_speed: below it rocks are slow, their turning at their bounding spheres included [m/s].
        distance: slow rocks are searched when they will have moved this far since the last time [m]; below 0: always.
        search_fast: whether the others, which else are COMOVING, are searched too.
    Writes:
        sleep: (n,) records `SLEEP`: the way of each rock.
        modes: (n,) at least, of these.
    """
    for s in range(len(awake)):
        i = awake[s]
        rock, v = sleep[i], velocities[i]
        modes[i] = FOLLOWED
        spin = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
        speed = math.sqrt(v[3] * v[3] + v[4] * v[4] + v[5] * v[5]) + radius[i] * spin
        rock.way += time_step * speed
        slow = speed < slow_speed
        if (
            (search_fast and not slow)
            or (slow and rock.way + time_step * speed > distance)
            or rock.way == np.inf
            or is_sensed(positions[i], radius[i], sensors)
        ):
            modes[i] = SEARCHED
            rock.way = 0.0
        elif not slow:
            modes[i] = COMOVING


@kernel
def write_row(
    a: int,
    b: int,
    normal: Vector,
    point: Vector,
    gap: float,
    impulse: Vector,
    restitution: float,
    simplex: int,
    bodies: CollisionBodies,
    n_rows: int,
    rows: ContactRows,
) -> int:
    """Add a contact row; beyond the capacity it is counted but not stored.

    Reads:
        a, b: the pair's bodies.
        normal: from A to B, in W.
        point: from A's origin, in W [m].
        gap: [m].
        impulse: of the last step, in W [N s].
        restitution: coefficient.
        simplex: where the search ended.
        bodies: all bodies.
        n_rows: number of rows before.
    Writes:
        rows: one more.

    Returns:
        the number of rows.
    """
    if n_rows < len(rows.values):
        rows.body_a[n_rows], rows.body_b[n_rows] = bodies.solver_body[a], bodies.solver_body[b]
        rows.key[n_rows] = make_key(a, b)
        tangent_1, tangent_2 = make_tangents(normal)
        row = rows.values[n_rows]
        set_vector(normal, row.normal)
        set_vector(tangent_1, row.tangent_1)
        set_vector(tangent_2, row.tangent_2)
        set_vector(point, row.arm_a)
        position_a, position_b = get_vector(bodies.positions[a]), get_vector(bodies.positions[b])
        set_vector(subtract(add(point, position_a), position_b), row.arm_b)
        mu_a, mu_b = bodies.friction[a], bodies.friction[b]
        row.friction = 2.0 * mu_a * mu_b / (mu_a + mu_b)
        row.gap, row.simplex, row.restitution = gap, simplex, restitution
        row.impulse[0] = max(dot(impulse, normal), 0.0)
        row.impulse[1], row.impulse[2] = dot(impulse, tangent_1), dot(impulse, tangent_2)
    return n_rows + 1


@kernel
def _follow_point(
    cache: ContactCache,
    point: int,
    bodies: CollisionBodies,
    restitution: float,
    n_rows: int,
    rows: ContactRows,
) -> int:
    """Add a row from a point of the cache; return the number of rows."""
    a, b = read_pair(cache, point)
    cached = cache.points[point]
    r_a = get_rotation(bodies.rotations, a)
    return write_row(
        a, b, rotate(r_a, widen(cached.normal)), rotate(r_a, widen(cached.point)), np.float64(cached.gap),
        widen(cached.impulse), restitution, read_simplex(cached), bodies, n_rows, rows,
    )  # fmt: skip


@kernel
def follow_pair(
    cache: ContactCache, first: int, key: int, bodies: CollisionBodies, restitution: float, n_rows: int, rows:
    ContactRows
) -> int:  # fmt: skip
    """Add the rows of a pair from the cache; return the number of rows.

    Reads:
        cache, first, key: all points, the pair's first one, its key.
        bodies, restitution, n_rows: as for `write_row`.
    Writes:
        rows: more of them.
    """
    for point in range(first, first + count_points(key, cache, first)):
        n_rows = _follow_point(cache, point, bodies, restitution, n_rows, rows)
    return n_rows


@kernel
def follow_contacts(
    cache: ContactCache,
    active: Array,
    n_active: int,
    modes: Array,
    bodies: CollisionBodies,
    restitution: float,
    rows: ContactRows,
) -> int:
    """Set the rows of the pairs both of whose bodies are FOLLOWED.

    Reads:
        cache, active, n_active: contact points of the last step, see `contact_cache`.
        modes: per body, see `choose_search_modes`.
        bodies: all bodies.
        restitution: of rocks against rocks and site.
    Writes:
        rows: these.

    Returns:
        number of rows; beyond the capacity they are counted but not stored.
    """
    n_rows = 0
    for k in range(n_active):
        ahead = active[min(k + AHEAD, n_active - 1)]
        prefetch(bodies.rotations, int(cache.pairs[ahead, 0]))
        prefetch(bodies.positions, int(cache.pairs[ahead, 0]))
        prefetch(bodies.positions, int(cache.pairs[ahead, 1]))
        point = active[k]
        if modes[cache.pairs[point, 0]] == FOLLOWED and modes[cache.pairs[point, 1]] == FOLLOWED:
            n_rows = _follow_point(cache, point, bodies, restitution, n_rows, rows)
    return n_rows


@kernel
def calc_own_speed(bodies: CollisionBodies, velocities: Array, a: int, b: int, radius_b: float) -> float:
    """Return how fast rock b moves against rock a at most, seen from a, which turns [m/s]."""
    v, w = velocities[a], velocities[b]
    spin_a = get_vector(v)
    carried = cross(spin_a, get_offset(bodies, a, b))
    own = subtract(subtract(get_vector(w[3:]), get_vector(v[3:])), carried)
    spin2 = (w[0] - v[0]) ** 2 + (w[1] - v[1]) ** 2 + (w[2] - v[2]) ** 2
    return math.sqrt(dot(own, own)) + radius_b * math.sqrt(spin2)
