"""Narrow phase: from pairs of bodies to contact rows with positions, gaps and last step's impulses.

A pair gets contacts if it may close its gap within the step: its gap is below the margin plus h times the speed that
its bodies can have against each other, their turning included (speculative contacts). Those of a pair that moves
together follow it instead (`persistence`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.collision.broad_phase import Pairs
from drakerock.rocks.engine.collision.geometry import Core, calc_support_distance, get_corner, get_rounding
from drakerock.rocks.engine.collision.gjk import (
    OVERLAPPING,
    SEPARATED,
    GjkWorkspace,
    calc_core_distance,
    make_gjk_workspace,
)
from drakerock.rocks.engine.collision.manifold import (
    MAX_POINTS,
    SPREAD,
    ManifoldWorkspace,
    add_candidate,
    add_spread_points,
    find_first_point,
    make_manifold,
    make_manifold_workspace,
    set_point,
)
from drakerock.rocks.engine.collision.penetration import calc_core_penetration
from drakerock.rocks.engine.collision.persistence import calc_own_speed, follow_pair, write_row
from drakerock.rocks.engine.collision.poses import CollisionBodies, get_core, get_offset
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Vector, kernel
from drakerock.rocks.engine.contact_cache import (
    AxisCache,
    ContactCache,
    count_points,
    find_axis,
    find_in_cache,
    is_loaded,
    prefetch_cached,
    prefetch_places,
    read_simplex,
    store_axis,
    widen,
)
from drakerock.rocks.engine.memory_access import AHEAD, prefetch
from drakerock.rocks.engine.records import SEARCHED
from drakerock.rocks.engine.solve.rows import ContactRows, make_key
from drakerock.rocks.engine.vectors import (
    add,
    dot,
    get_vector,
    negate,
    rotate,
    rotate_back,
    scale,
    set_vector,
)

# A pair that overlaps deeply may turn its normal from the direction it was pushed in by at most 60 degrees.
MIN_COSINE_TO_HISTORY = 0.5
# How many pairs ahead what a look-up begins with is asked for, so that what it leads to can be, too.
FAR_AHEAD = 3 * AHEAD
# A way per step from which on all corners of a rock count against plates and other solid pieces [m].
FAST = 0.03
# A point is one of the last step if this near to it [radius of the first rock].
MATCH_DISTANCE = 0.3
# Origins of two bodies nearer than the root of this give no direction to begin a search with [m^2].
MIN_SQUARED_OFFSET = 1e-12


class CollisionGeometry(NamedTuple):
    """What does not change from step to step.

    Attributes:
        n_rocks, first_plane, first_piece: where static pieces, planes and machine pieces start among the bodies.
        planes: (p, 4) unit normal out of the solid and offset.
        shapes: all shapes.
        restitution: (2,) rock against rock or site, rock against machine.
    """

    n_rocks: int
    first_plane: int
    first_piece: int
    planes: NDArray[np.float64]
    shapes: ConvexShapes
    restitution: NDArray[np.float64]


class SearchSettings(NamedTuple):
    """How contacts are searched.

    Attributes:
        time_step: [s]; pairs that can meet within it get contacts beforehand.
        margin: contacts are found up to this gap [m].
        manifold_gap: further points of a pair up to this gap [m], or up to `margin` if the pair may close it in a step.
        face_cosine: see `make_manifold`.
        slow_speed: pairs of rocks that are not SEARCHED, slower than this against each other, follow [m/s].
    """

    time_step: float
    margin: float
    manifold_gap: float
    face_cosine: float
    slow_speed: float


class LookUp(NamedTuple):
    """Room for what is known of each pair (capacity n).

    Attributes:
        cached: (n,) its first point in the contact cache, or -1.
        axes: (n, 3) float32 its separating axis, all zero if it is not known.
    """

    cached: NDArray[np.int64]
    axes: NDArray[np.float32]


def make_look_up(capacity: int) -> LookUp:
    """Return room for so many pairs."""
    return LookUp(np.zeros(capacity, np.int64), np.zeros((capacity, 3), np.float32))


class NarrowWorkspace(NamedTuple):
    """Scratch memory of the narrow phase.

    Attributes:
        gjk, manifold: of distances and manifolds.
        points: (MAX_POINTS, 4) a pair's points, from A's origin, and gaps [m]; with fewer rows, a pair has fewer.
        known: (MAX_POINTS, 3) those that carried load in the last step, from A's origin [m].
    """

    gjk: GjkWorkspace
    manifold: ManifoldWorkspace
    points: NDArray[np.float64]
    known: NDArray[np.float64]


def make_narrow_workspace() -> NarrowWorkspace:
    """Return scratch memory for `find_contacts`."""
    return NarrowWorkspace(
        make_gjk_workspace(), make_manifold_workspace(), np.zeros((MAX_POINTS, 4)), np.zeros((MAX_POINTS, 3))
    )


@kernel
def calc_signed_core_distance(
    shapes: ConvexShapes,
    a: Core,
    b: Core,
    p: Vector,
    guess: Vector,
    history: Vector,
    simplex: int,
    max_distance: float,
    workspace: GjkWorkspace,
) -> tuple[int, float, Vector, Vector, int]:
    """Find how far two cores are apart, or how deep they are in each other.

    Reads:
        shapes, a, b, p, guess: as for `calc_core_distance`.
        history: as for `calc_core_penetration`.
        simplex, max_distance: as for `calc_core_distance`.
    Writes:
        workspace: as of `calc_core_distance`.

    Returns:
        ``(status, distance, normal, a, simplex)``: status and simplex as of `calc_core_distance`, the distance
        (negative: overlap), the unit normal from A to B, and A's point. SEPARATED: an axis that tells the cores
        apart, of any length; distance and point of no use.
    """
    status, v, on_a, simplex = calc_core_distance(shapes, a, b, p, guess, simplex, max_distance, workspace)
    if status == SEPARATED:
        return status, max_distance, v, on_a, simplex
    if status == OVERLAPPING:
        distance, normal, on_a = calc_core_penetration(shapes, a, b, p, history, MIN_COSINE_TO_HISTORY)
        return status, distance, normal, on_a, simplex
    distance = math.sqrt(dot(v, v))
    return status, distance, (v[0] / distance, v[1] / distance, v[2] / distance), on_a, simplex


@kernel
def _look_up_pairs(
    pairs: Pairs,
    n_pairs: int,
    cache: ContactCache,
    table: Array,
    axis_cache: AxisCache,
    look_up: LookUp,
) -> None:
    """Look all pairs up in both caches.

    Both are anywhere in large tables. Looked up for one pair after the other, with nothing else between, the processor
    fetches several at once.
    """
    for pair in range(n_pairs):
        ahead = min(pair + FAR_AHEAD, n_pairs - 1)
        prefetch_places(make_key(pairs.a[ahead], pairs.b[ahead]), table, axis_cache)
        ahead = min(pair + AHEAD, n_pairs - 1)
        prefetch_cached(make_key(pairs.a[ahead], pairs.b[ahead]), cache, table)
        key = make_key(pairs.a[pair], pairs.b[pair])
        look_up.cached[pair] = find_in_cache(key, cache, table)
        place, known = find_axis(key, axis_cache)
        for d in range(3):
            look_up.axes[pair, d] = axis_cache.axes[place, d] if known else 0.0


@kernel
def _prefetch_pair(
    pairs: Pairs, look_up: LookUp, pair: int, bodies: CollisionBodies, velocities: Array, cache: ContactCache
) -> None:
    """Ask for what a pair needs of its second body; its first is at hand, as the pairs of a body are in line."""
    b = pairs.b[pair]
    prefetch(bodies.positions, b)
    prefetch(bodies.rotations, b)
    prefetch(velocities, bodies.solver_body[b])
    prefetch(bodies.shape, b)
    prefetch(bodies.scale, b)
    prefetch(bodies.friction, b)
    if look_up.cached[pair] >= 0:
        prefetch(cache.points, look_up.cached[pair])


@kernel
def _calc_turning(shapes: ConvexShapes, core: Core, velocity: Array) -> float:
    """Return the speed that a body's turning gives its farthest corner [m/s]."""
    spin = math.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    return spin * core.scale * shapes.radius[core.shape]


@kernel
def _calc_speed(velocities: Array, body_1: int, body_2: int) -> float:
    """Return how fast two bodies of the solve move against each other, their turning left aside [m/s]."""
    speed2 = 0.0
    for d in range(3, 6):
        speed2 += (velocities[body_1, d] - velocities[body_2, d]) ** 2
    return math.sqrt(speed2)


@kernel
def _read_history(
    cache: ContactCache, first: int, n_cached: int, a: Core, known: Array
) -> tuple[Vector, int]:
    """Return the sum of a pair's impulses in the last step, and the number of points that carried load.

    Reads:
        cache, first, n_cached: the pair's points.
        a: its first body.
    Writes:
        known: (MAX_POINTS, 3) the points that carried load, from A's origin in W [m].
    """
    history = (0.0, 0.0, 0.0)
    n_known = 0
    for row in range(first, first + n_cached):
        point = cache.points[row]
        history = add(history, widen(point.impulse))
        if n_known < MAX_POINTS and is_loaded(point):
            set_vector(rotate(a.rotation, widen(point.point)), known[n_known])
            n_known += 1
    return history, n_known


@kernel
def _find_plane_points(
    shapes: ConvexShapes,
    core: Core,
    position: Vector,
    plane: Array,
    max_gap: float,
    n_known: int,
    workspace: NarrowWorkspace,
) -> int:
    """Set the manifold of a rock on a plane: its corners within `max_gap`, the deepest first, then spread."""
    candidates, points = workspace.manifold.candidates, workspace.points
    normal, rounding = get_vector(plane), get_rounding(shapes, core)
    height = dot(normal, position) - plane[3] - rounding
    local = rotate_back(core.rotation, normal)
    n_candidates = 0
    for k in range(shapes.vertex_start[core.shape], shapes.vertex_start[core.shape + 1]):
        gap = height + core.scale * dot(local, get_vector(shapes.vertices[k]))
        if gap < max_gap:
            corner = get_corner(shapes, k, core)
            shift = rounding + 0.5 * gap
            n_candidates = add_candidate(
                (corner[0] - shift * normal[0], corner[1] - shift * normal[1], corner[2] - shift * normal[2]),
                gap, n_candidates, candidates,
            )  # fmt: skip
    if n_candidates == 0:
        return 0
    radius = core.scale * shapes.radius[core.shape]
    first = find_first_point(n_candidates, workspace.known, n_known, radius, candidates)
    set_point(candidates[first], points[0])
    return add_spread_points(candidates, n_candidates, 1, SPREAD * radius, points)


@kernel
def _add_fast_points(
    shapes: ConvexShapes,
    core: Core,
    normal: Vector,
    offset: float,
    max_gap: float,
    n_points: int,
    workspace: NarrowWorkspace,
) -> int:
    """Add the corners of a fast rock that can reach the plane ``n p = offset`` of what it is about to hit.

    A rock that strikes with one corner would be spun through a thin plate within the step; with rows for its
    other corners it lands on them.
    """
    candidates = workspace.manifold.candidates
    rounding = get_rounding(shapes, core)
    n_candidates = 0
    for k in range(shapes.vertex_start[core.shape], shapes.vertex_start[core.shape + 1]):
        corner = get_corner(shapes, k, core)
        gap = offset - rounding - dot(normal, corner)
        if gap < max_gap:
            point = add(corner, scale(rounding + 0.5 * gap, normal))
            n_candidates = add_candidate(point, gap, n_candidates, candidates)
    spread = SPREAD * core.scale * shapes.radius[core.shape]
    return add_spread_points(candidates, n_candidates, n_points, spread, workspace.points)


@kernel
def _are_apart(shapes: ConvexShapes, a: Core, b: Core, p: Vector, axis: Vector, max_distance: float) -> bool:
    """Return whether two cores are farther apart on an axis than that; False for an axis of no length."""
    if axis[0] == 0.0 and axis[1] == 0.0 and axis[2] == 0.0:
        return False
    along = (
        dot(axis, p) - calc_support_distance(shapes, a, axis) - calc_support_distance(shapes, b, negate(axis))
    )
    return along > 0.0 and along * along > max_distance * max_distance * dot(axis, axis)


@kernel
def _choose_guess(history: Vector, p: Vector) -> tuple[Vector, Vector]:
    """Return the direction a search begins with, and that in which the pair was pushed, zero if it was not."""
    length = math.sqrt(dot(history, history))
    if length > 0.0:
        unit = (history[0] / length, history[1] / length, history[2] / length)
        return unit, unit
    if dot(p, p) < MIN_SQUARED_OFFSET:
        return (1.0, p[1], p[2]), history
    return p, history


@kernel
def _find_core_points(
    key: int,
    shapes: ConvexShapes,
    a: Core,
    b: Core,
    p: Vector,
    history: Vector,
    n_known: int,
    simplex: int,
    way: float,
    solid: bool,
    settings: SearchSettings,
    axis_cache: AxisCache,
    statistics: Array,
    workspace: NarrowWorkspace,
) -> tuple[int, Vector, int]:
    """Set the manifold of two cores.

    Reads:
        key: of the pair.
        shapes, a, b, p: as for `calc_core_distance`.
        history, n_known: see `_read_history`.
        simplex: with which the pair's last search ended, or 0.
        way: that the pair can go within the step [m].
        solid: B is no rock.
        settings: how to search.
    Writes:
        axis_cache: an axis, if they are apart.
        statistics: see `find_contacts`.
        workspace: the points, and scratch.

    Returns:
        their number, 0 if the cores are apart; the normal from A to B; where the search ended.
    """
    points = workspace.points
    max_gap = settings.margin + way
    rounding_a, rounding_b = get_rounding(shapes, a), get_rounding(shapes, b)
    roundings = rounding_a + rounding_b
    guess, history = _choose_guess(history, p)
    statistics[1] += 1
    status, distance, normal, on_a, simplex = calc_signed_core_distance(
        shapes, a, b, p, guess, history, simplex, roundings + max_gap, workspace.gjk
    )
    if status == SEPARATED:
        store_axis(key, normal, axis_cache)
        return 0, normal, simplex
    statistics[2] += status == OVERLAPPING
    gap = distance - roundings
    set_vector(add(on_a, scale(rounding_a + 0.5 * gap, normal)), points[0])
    points[0, 3] = gap
    # A face that is about to land, lands on all corners that it can reach within the step, or it would be spun.
    further = max_gap if way > settings.manifold_gap else max(settings.manifold_gap, gap)
    n_points = make_manifold(
        shapes, a, b, p, normal, further, settings.face_cosine, workspace.known, n_known, points, workspace.manifold
    )  # fmt: skip
    if solid and way > FAST:
        offset = dot(normal, on_a) + distance - rounding_b
        n_points = _add_fast_points(shapes, a, normal, offset, max_gap, n_points, workspace)
    return n_points, normal, simplex


@kernel
def _match_point(
    cache: ContactCache, first: int, n_cached: int, local: Vector, limit: float, used: int
) -> int:
    """Return which of a pair's cached points is nearest to a point in A's frame and not used yet (bits); or -1."""
    nearest = limit * limit
    found = -1
    for k in range(n_cached):
        x, y, z = widen(cache.points[first + k].point)
        distance2 = (x - local[0]) ** 2 + (y - local[1]) ** 2 + (z - local[2]) ** 2
        if distance2 < nearest and (used >> k) & 1 == 0:
            nearest = distance2
            found = k
    return found


@kernel
def _write_rows(
    a: int,
    b: int,
    core: Core,
    normal: Vector,
    n_points: int,
    points: Array,
    simplex: int,
    cache: ContactCache,
    first: int,
    n_cached: int,
    geometry: CollisionGeometry,
    bodies: CollisionBodies,
    n_rows: int,
    rows: ContactRows,
) -> int:
    """Add a pair's points to the rows, with the impulses that they had in the last step; return the number of rows."""
    match_limit = MATCH_DISTANCE * core.scale * geometry.shapes.radius[core.shape]
    on_machine = bodies.solver_body[b] > geometry.n_rocks
    restitution = geometry.restitution[1] if on_machine else geometry.restitution[0]
    used = 0
    for k in range(n_points):
        point, impulse = get_vector(points[k]), (0.0, 0.0, 0.0)
        if n_cached > 0:
            local = rotate_back(core.rotation, point)
            found = _match_point(cache, first, n_cached, local, match_limit, used)
            if found >= 0:
                used |= 1 << found
                impulse = widen(cache.points[first + found].impulse)
        n_rows = write_row(
            a, b, normal, point, points[k, 3], impulse, restitution, simplex, bodies, n_rows, rows
        )
    return n_rows


@kernel
def find_contacts(
    pairs: Pairs,
    n_pairs: int,
    geometry: CollisionGeometry,
    bodies: CollisionBodies,
    velocities: Array,
    settings: SearchSettings,
    modes: Array,
    extra_speeds: Array,
    cache: ContactCache,
    table: Array,
    n_rows: int,
    rows: ContactRows,
    axis_cache: AxisCache,
    look_up: LookUp,
    statistics: Array,
    workspace: NarrowWorkspace,
) -> int:
    """Find the contact points of all pairs.

    Reads:
        pairs, n_pairs: from the broad phase.
        geometry: shapes, planes, and which bodies are what.
        bodies: rocks, static pieces, planes, pieces of the machine, in this order.
        velocities: (bodies of the solve, 6) angular, translational, at the last step.
        settings: how to search.
        modes: per body, see `persistence`.
        extra_speeds: per body, by how much its pairs may be faster than before the step, see `speculative` [m/s].
        cache, table: contact points of the last step, see `contact_cache`.
        n_rows: number of rows before.
    Writes:
        rows: from `n_rows` on.
        axis_cache: skips pairs, never changes a result.
        look_up: scratch for as many pairs.
        statistics: (4,) pairs skipped, distances computed, overlapping cores, rows.
        workspace: scratch.

    Returns:
        number of rows; beyond the capacity they are counted but not stored.
    """
    shapes = geometry.shapes
    statistics[:] = 0
    _look_up_pairs(pairs, n_pairs, cache, table, axis_cache, look_up)
    for pair in range(n_pairs):
        _prefetch_pair(pairs, look_up, min(pair + AHEAD, n_pairs - 1), bodies, velocities, cache)
        a, b = pairs.a[pair], pairs.b[pair]
        key, first = make_key(a, b), look_up.cached[pair]
        if first >= 0 and _moves_together(a, b, geometry, bodies, velocities, settings, modes):
            n_rows = follow_pair(cache, first, key, bodies, geometry.restitution[0], n_rows, rows)
            continue
        n_cached = count_points(key, cache, first)
        core_a = get_core(bodies, a)
        body_1, body_2 = bodies.solver_body[a], bodies.solver_body[b]
        speed = _calc_speed(velocities, body_1, body_2) + _calc_turning(shapes, core_a, velocities[a])
        speed += max(extra_speeds[a], extra_speeds[b])
        # The direction in which the pair pushed last starts the search; where it did is preferred.
        history, n_known = _read_history(cache, first, n_cached, core_a, workspace.known)
        simplex = 0
        if geometry.first_plane <= b < geometry.first_piece:
            plane = geometry.planes[b - geometry.first_plane]
            normal, position = negate(get_vector(plane)), get_vector(bodies.positions[a])
            max_gap = settings.margin + settings.time_step * speed
            n_points = _find_plane_points(shapes, core_a, position, plane, max_gap, n_known, workspace)
        else:
            core_b, p = get_core(bodies, b), get_offset(bodies, a, b)
            speed += _calc_turning(shapes, core_b, velocities[body_2])
            way = settings.time_step * speed
            roundings = get_rounding(shapes, core_a) + get_rounding(shapes, core_b)
            axis, limit = widen(look_up.axes[pair]), roundings + (settings.margin + way)
            if _are_apart(shapes, core_a, core_b, p, axis, limit):
                statistics[0] += 1
                continue
            if n_cached > 0:
                simplex = read_simplex(cache.points[first])
            n_points, normal, simplex = _find_core_points(
                key, shapes, core_a, core_b, p, history, n_known, simplex, way, b >= geometry.n_rocks, settings,
                axis_cache, statistics, workspace,
            )  # fmt: skip
        n_rows = _write_rows(
            a, b, core_a, normal, n_points, workspace.points, simplex, cache, first, n_cached, geometry, bodies,
            n_rows, rows,
        )  # fmt: skip
    statistics[3] = n_rows
    return n_rows


@kernel
def _moves_together(
    a: int,
    b: int,
    geometry: CollisionGeometry,
    bodies: CollisionBodies,
    velocities: Array,
    settings: SearchSettings,
    modes: Array,
) -> bool:
    """Return whether two rocks that need no search are slow against each other."""
    if b >= geometry.n_rocks or modes[a] == SEARCHED or modes[b] == SEARCHED:
        return False
    radius = bodies.scale[b] * geometry.shapes.radius[bodies.shape[b]]
    return calc_own_speed(bodies, velocities, a, b, radius) < settings.slow_speed
