"""Narrow phase: from pairs of bodies to contact rows with positions, gaps and last step's impulses."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.collision.broad_phase import CALM, SEARCHED
from drakerock.rocks.engine.collision.geometry import (
    calc_support_distance,
    get_corner,
    get_rotation,
    make_tangents,
    rotate,
    rotate_back,
)
from drakerock.rocks.engine.collision.gjk import (
    OVERLAPPING,
    SEPARATED,
    calc_core_distance,
    make_gjk_workspace,
)
from drakerock.rocks.engine.collision.gjk import Workspace as GjkWorkspace
from drakerock.rocks.engine.collision.manifold import (
    KNOWN,
    MAX_POINTS,
    add_spread_points,
    find_first_point,
    make_manifold,
    make_manifold_workspace,
)
from drakerock.rocks.engine.collision.overlap import calc_core_penetration
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Rotation, kernel
from drakerock.rocks.engine.contacts import (
    ARM_A,
    ARM_B,
    FRICTION,
    GAP,
    IMPULSE,
    MEMORY_GAP,
    MEMORY_IMPULSE,
    MEMORY_NORMAL,
    MEMORY_POINT,
    NORMAL,
    RESTITUTION,
    SIMPLEX,
    TANGENT_1,
    TANGENT_2,
    AxisCache,
    ContactRows,
    Memory,
    find_axis,
    find_in_memory,
    is_loaded,
    make_key,
    prefetch_places,
    prefetch_remembered,
    read_key,
    read_pair,
    read_simplex,
    read_vector,
    store_axis,
)
from drakerock.rocks.engine.prefetching import AHEAD, prefetch

# A pair that overlaps deeply may turn its normal from the direction it was pushed in by at most 60 degrees.
MIN_COSINE_TO_HISTORY = 0.5
# How many pairs ahead what a look-up begins with is asked for, so that what it leads to can be, too.
FAR_AHEAD = 3 * AHEAD
# A way per step from which on all corners of a rock count against plates and other solid pieces [m].
FAST = 0.03

Workspace = tuple[GjkWorkspace, tuple[Array, Array, Array, Array], Array, Array]


class CollisionBodies(NamedTuple):
    """All bodies that touch: rocks, static pieces, planes, pieces of the machine (n bodies).

    Attributes:
        shape, scale: (n,) number and scale of each one's shape.
        positions, rotations: (n, 3) [m], (n, 3, 3).
        solver_body: (n,) body of the solve: rocks are their own, all that stands still is the one after the last rock,
            machine bodies are beyond.
        friction: (n,) each one's coefficient; a pair has 2 a b / (a + b).
    """

    shape: NDArray[np.int64]
    scale: NDArray[np.float64]
    positions: NDArray[np.float64]
    rotations: NDArray[np.float64]
    solver_body: NDArray[np.int64]
    friction: NDArray[np.float64]


def make_workspace() -> Workspace:
    """Return scratch memory of the narrow phase: distances, manifolds, a pair's points, those of the last step."""
    return (
        make_gjk_workspace(),
        make_manifold_workspace(),
        np.zeros((MAX_POINTS, 4)),
        np.zeros((MAX_POINTS, 3)),
    )


@kernel
def _find_plane_points(
    shapes: ConvexShapes,
    shape: int,
    scale: float,
    r: Rotation,
    x: float,
    y: float,
    z: float,
    plane: Array,
    max_gap: float,
    known: Array,
    n_known: int,
    points: Array,
    candidates: Array,
) -> int:
    """Set the manifold of a rock on a plane: its corners within `max_gap`, the deepest first, then spread."""
    rounding = scale * shapes.rounding[shape]
    height = plane[0] * x + plane[1] * y + plane[2] * z - plane[3] - rounding
    lx, ly, lz = rotate_back(r, plane[0], plane[1], plane[2])
    n_candidates = 0
    for k in range(shapes.vertex_start[shape], shapes.vertex_start[shape + 1]):
        along = lx * shapes.vertices[k, 0] + ly * shapes.vertices[k, 1] + lz * shapes.vertices[k, 2]
        gap = height + scale * along
        if gap < max_gap and n_candidates < len(candidates):
            cx, cy, cz = get_corner(shapes.vertices, k, scale, r)
            shift = rounding + 0.5 * gap
            candidates[n_candidates, 0] = cx - shift * plane[0]
            candidates[n_candidates, 1] = cy - shift * plane[1]
            candidates[n_candidates, 2] = cz - shift * plane[2]
            candidates[n_candidates, 3] = gap
            n_candidates += 1
    if n_candidates == 0:
        return 0
    radius = scale * shapes.radius[shape]
    first = find_first_point(candidates, n_candidates, known, n_known, radius)
    for d in range(4):
        points[0, d] = candidates[first, d]
    return add_spread_points(candidates, n_candidates, points, 1, 0.2 * radius)


@kernel
def _add_fast_points(
    shapes: ConvexShapes,
    shape: int,
    scale: float,
    r: Rotation,
    nx: float,
    ny: float,
    nz: float,
    offset: float,
    max_gap: float,
    points: Array,
    n_points: int,
    candidates: Array,
) -> int:
    """Add the corners of a fast rock that can reach the plane ``n p = offset`` of what it is about to hit.

    A rock that strikes with one corner would be spun through a thin plate within the step; with rows for its
    other corners it lands on them.
    """
    rounding = scale * shapes.rounding[shape]
    n_candidates = 0
    for k in range(shapes.vertex_start[shape], shapes.vertex_start[shape + 1]):
        cx, cy, cz = get_corner(shapes.vertices, k, scale, r)
        gap = offset - rounding - (nx * cx + ny * cy + nz * cz)
        if gap < max_gap and n_candidates < len(candidates):
            shift = rounding + 0.5 * gap
            candidates[n_candidates, 0] = cx + shift * nx
            candidates[n_candidates, 1] = cy + shift * ny
            candidates[n_candidates, 2] = cz + shift * nz
            candidates[n_candidates, 3] = gap
            candidates[n_candidates, KNOWN] = 0.0
            n_candidates += 1
    return add_spread_points(candidates, n_candidates, points, n_points, 0.2 * scale * shapes.radius[shape])


@kernel
def _write_row(
    rows: ContactRows,
    n_rows: int,
    bodies: CollisionBodies,
    a: int,
    b: int,
    n: tuple[float, float, float],
    point: tuple[float, float, float],
    gap: float,
    impulse: tuple[float, float, float],
    restitution: float,
    simplex: int,
) -> None:
    """Set a contact row: bodies, normal, point from A's origin, gap, impulse in W, restitution, simplex."""
    rows.body_a[n_rows], rows.body_b[n_rows] = bodies.solver_body[a], bodies.solver_body[b]
    rows.key[n_rows] = make_key(a, b)
    nx, ny, nz = n
    x, y, z = point
    ix, iy, iz = impulse
    tx, ty, tz, ux, uy, uz = make_tangents(nx, ny, nz)
    out = rows.values[n_rows]
    out[NORMAL], out[NORMAL + 1], out[NORMAL + 2] = nx, ny, nz
    out[TANGENT_1], out[TANGENT_1 + 1], out[TANGENT_1 + 2] = tx, ty, tz
    out[TANGENT_2], out[TANGENT_2 + 1], out[TANGENT_2 + 2] = ux, uy, uz
    out[ARM_A], out[ARM_A + 1], out[ARM_A + 2] = x, y, z
    out[ARM_B] = x + bodies.positions[a, 0] - bodies.positions[b, 0]
    out[ARM_B + 1] = y + bodies.positions[a, 1] - bodies.positions[b, 1]
    out[ARM_B + 2] = z + bodies.positions[a, 2] - bodies.positions[b, 2]
    mu_a, mu_b = bodies.friction[a], bodies.friction[b]
    out[FRICTION] = 2.0 * mu_a * mu_b / (mu_a + mu_b)
    out[GAP] = gap
    out[SIMPLEX] = simplex
    out[RESTITUTION] = restitution
    out[IMPULSE] = max(ix * nx + iy * ny + iz * nz, 0.0)
    out[IMPULSE + 1] = ix * tx + iy * ty + iz * tz
    out[IMPULSE + 2] = ix * ux + iy * uy + iz * uz


@kernel
def _follow_row(
    memory: Memory, row: int, bodies: CollisionBodies, restitution: Array, rows: ContactRows, n_rows: int
) -> int:
    """Set a contact row from the memory; return the number of rows.

    Point and normal are carried by the pair's first rock, the gap has followed the velocities: errors are of second
    order in the pair's own motion, fractions of a millimetre.
    """
    if n_rows < len(rows.values):
        a, b = read_pair(memory, row)
        r_a = get_rotation(bodies.rotations, a)
        x, y, z = read_vector(memory, row, MEMORY_POINT)
        nx, ny, nz = read_vector(memory, row, MEMORY_NORMAL)
        _write_row(
            rows, n_rows, bodies, a, b, rotate(r_a, nx, ny, nz), rotate(r_a, x, y, z),
            np.float64(memory.values[row, MEMORY_GAP]), read_vector(memory, row, MEMORY_IMPULSE), restitution[0],
            read_simplex(memory, row),
        )  # fmt: skip
    return n_rows + 1


@kernel
def follow_contacts(
    memory: Memory,
    active: Array,
    n_active: int,
    calm: Array,
    bodies: CollisionBodies,
    restitution: Array,
    rows: ContactRows,
) -> int:
    """Set the rows of pairs of calm bodies from the memory: they follow the bodies' motion since the last search.

    Args:
        memory, active, n_active: loaded points of the last step and those about to touch, see `contacts`.
        calm: per body CALM, COMOVING or SEARCHED, see `broad_phase`.
        bodies, restitution: as for `find_contacts`.
        rows: set.

    Returns:
        number of rows; beyond the capacity they are counted but not stored.
    """
    n_rows = 0
    for k in range(n_active):
        ahead = active[min(k + AHEAD, n_active - 1)]
        prefetch(bodies.rotations, int(memory.pairs[ahead, 0]))
        prefetch(bodies.positions, int(memory.pairs[ahead, 0]))
        prefetch(bodies.positions, int(memory.pairs[ahead, 1]))
        row = active[k]
        if calm[memory.pairs[row, 0]] == CALM and calm[memory.pairs[row, 1]] == CALM:
            n_rows = _follow_row(memory, row, bodies, restitution, rows, n_rows)
    return n_rows


@kernel
def _calc_own_speed(positions: Array, velocities: Array, a: int, b: int, radius_b: float) -> float:
    """Return how fast rock b moves against rock a at most, seen from a, which turns [m/s]."""
    v, w = velocities[a], velocities[b]
    x, y, z = (
        positions[b, 0] - positions[a, 0],
        positions[b, 1] - positions[a, 1],
        positions[b, 2] - positions[a, 2],
    )
    dx = w[3] - v[3] - (v[1] * z - v[2] * y)
    dy = w[4] - v[4] - (v[2] * x - v[0] * z)
    dz = w[5] - v[5] - (v[0] * y - v[1] * x)
    spin2 = (w[0] - v[0]) ** 2 + (w[1] - v[1]) ** 2 + (w[2] - v[2]) ** 2
    return math.sqrt(dx * dx + dy * dy + dz * dz) + radius_b * math.sqrt(spin2)


@kernel
def calc_signed_core_distance(
    shapes: ConvexShapes,
    shape_a: int,
    scale_a: float,
    r_a: Rotation,
    shape_b: int,
    scale_b: float,
    r_b: Rotation,
    px: float,
    py: float,
    pz: float,
    gx: float,
    gy: float,
    gz: float,
    hx: float,
    hy: float,
    hz: float,
    simplex: int,
    max_distance: float,
    workspace: GjkWorkspace,
) -> tuple[int, float, float, float, float, float, float, float, int]:
    """Find how far two cores are apart, or how deep they are in each other.

    Args:
        shapes, ..., pz, gx, gy, gz, simplex, max_distance, workspace: as for `calc_core_distance`.
        hx, hy, hz: as for `calc_core_penetration`.

    Returns:
        ``(status, distance, nx, ny, nz, ax, ay, az, simplex)``: status and simplex as of `calc_core_distance`, the
        distance (negative: overlap), the unit normal from A to B, and A's point. SEPARATED: n an axis that tells the
        cores apart, of any length; distance and point of no use.
    """
    status, vx, vy, vz, ax, ay, az, simplex = calc_core_distance(
        shapes, shape_a, scale_a, r_a, shape_b, scale_b, r_b, px, py, pz, gx, gy, gz, simplex, max_distance,
        workspace,
    )  # fmt: skip
    if status == SEPARATED:
        return status, max_distance, vx, vy, vz, ax, ay, az, simplex
    if status == OVERLAPPING:
        distance, nx, ny, nz, ax, ay, az = calc_core_penetration(
            shapes, shape_a, scale_a, r_a, shape_b, scale_b, r_b, px, py, pz, hx, hy, hz, MIN_COSINE_TO_HISTORY
        )  # fmt: skip
        return status, distance, nx, ny, nz, ax, ay, az, simplex
    distance = math.sqrt(vx * vx + vy * vy + vz * vz)
    return status, distance, vx / distance, vy / distance, vz / distance, ax, ay, az, simplex


@kernel
def _look_up_pairs(
    pair_a: Array,
    pair_b: Array,
    n_pairs: int,
    memory: Memory,
    table: Array,
    axis_cache: AxisCache,
    remembered: Array,
    known_axes: Array,
) -> None:
    """Set each pair's first row in memory (-1: none) and its separating axis, all zero if it is not known.

    Both are anywhere in large tables. Looked up for one pair after the other, with nothing else between, the processor
    fetches several at once.
    """
    for pair in range(n_pairs):
        ahead = min(pair + FAR_AHEAD, n_pairs - 1)
        prefetch_places(make_key(pair_a[ahead], pair_b[ahead]), table, axis_cache)
        ahead = min(pair + AHEAD, n_pairs - 1)
        prefetch_remembered(make_key(pair_a[ahead], pair_b[ahead]), memory, table)
        key = make_key(pair_a[pair], pair_b[pair])
        remembered[pair] = find_in_memory(key, memory, table)
        place, known = find_axis(key, axis_cache)
        for d in range(3):
            known_axes[pair, d] = axis_cache.axes[place, d] if known else 0.0


@kernel
def _prefetch_pair(
    pair_b: Array, remembered: Array, pair: int, bodies: CollisionBodies, velocities: Array, memory: Memory
) -> None:
    """Ask for what a pair needs of its second body; its first is at hand, as the pairs of a body are in line."""
    b = pair_b[pair]
    prefetch(bodies.positions, b)
    prefetch(bodies.rotations, b)
    prefetch(velocities, bodies.solver_body[b])
    prefetch(bodies.shape, b)
    prefetch(bodies.scale, b)
    prefetch(bodies.friction, b)
    if remembered[pair] >= 0:
        prefetch(memory.values, remembered[pair])


@kernel
def find_contacts(
    pair_a: Array,
    pair_b: Array,
    n_pairs: int,
    n_rocks: int,
    first_plane: int,
    first_piece: int,
    planes: Array,
    shapes: ConvexShapes,
    bodies: CollisionBodies,
    velocities: Array,
    restitution: Array,
    time_step: float,
    margin: float,
    manifold_gap: float,
    face_cosine: float,
    max_points: int,
    calm: Array,
    slow_speed: float,
    foreseen: Array,
    memory: Memory,
    table: Array,
    axis_cache: AxisCache,
    remembered: Array,
    known_axes: Array,
    rows: ContactRows,
    n_rows: int,
    statistics: Array,
    workspace: Workspace,
) -> int:
    """Find the contact points of all pairs.

    Args:
        pair_a, pair_b, n_pairs: pairs from the broad phase, first a rock.
        n_rocks, first_plane, first_piece: where statics, planes and machine pieces start (statics at n_rocks).
        planes: (p, 4).
        shapes: all shapes.
        bodies: rocks, static pieces, planes, pieces of the machine, in this order.
        velocities: (solver bodies, 6) angular, translational, at the last step.
        restitution: (2,) rock against rock or site, rock against machine.
        time_step: [s]; pairs that can meet within it get contacts beforehand.
        margin: contacts are found up to this gap [m].
        manifold_gap: further points of a pair up to this gap [m], or up to `margin` if the pair may close it in a step.
        face_cosine: see `make_manifold`.
        max_points: points of a pair, MAX_POINTS at most.
        calm: per body CALM, COMOVING or SEARCHED, see `broad_phase`.
        slow_speed: pairs of rocks that are not SEARCHED, slower than this against each other, follow [m/s].
        foreseen: per body, by how much its pairs may be faster than before the step, see `foresight` [m/s].
        memory, table: loaded points of the last step, see `contacts`.
        axis_cache: skips pairs, never changes a result.
        remembered, known_axes: (n_pairs,) integers and (n_pairs, 3) at least: scratch.
        rows: set from `n_rows` on.
        n_rows: number of rows before.
        statistics: (4,) set: pairs skipped, distances computed, overlapping cores, rows.
        workspace: from `make_workspace`.

    Returns:
        number of rows; beyond the capacity they are counted but not stored.
    """
    gjk_workspace, manifold_workspace, all_points, known_points = workspace
    shape, scale, positions, rotations = bodies.shape, bodies.scale, bodies.positions, bodies.rotations
    points = all_points[:max_points]
    statistics[:] = 0
    _look_up_pairs(pair_a, pair_b, n_pairs, memory, table, axis_cache, remembered, known_axes)
    for pair in range(n_pairs):
        _prefetch_pair(pair_b, remembered, min(pair + AHEAD, n_pairs - 1), bodies, velocities, memory)
        a, b = pair_a[pair], pair_b[pair]
        key = make_key(a, b)
        shape_a, scale_a = shape[a], scale[a]
        r_a = get_rotation(rotations, a)
        body_1, body_2 = bodies.solver_body[a], bodies.solver_body[b]
        speed2 = 0.0
        for d in range(3, 6):
            speed2 += (velocities[body_1, d] - velocities[body_2, d]) ** 2
        spin_a = math.sqrt(velocities[a, 0] ** 2 + velocities[a, 1] ** 2 + velocities[a, 2] ** 2)
        reach = math.sqrt(speed2) + spin_a * scale_a * shapes.radius[shape_a] + max(foreseen[a], foreseen[b])
        first_row = remembered[pair]
        if (
            first_row >= 0
            and b < n_rocks
            and calm[a] != SEARCHED
            and calm[b] != SEARCHED
            and _calc_own_speed(positions, velocities, a, b, scale[b] * shapes.radius[shape[b]]) < slow_speed
        ):
            row = first_row
            while row < len(memory.pairs) and read_key(memory, row) == key:
                n_rows = _follow_row(memory, row, bodies, restitution, rows, n_rows)
                row += 1
            continue
        # The direction in which the pair pushed last starts the search; where it did is preferred.
        hx, hy, hz = 0.0, 0.0, 0.0
        n_known = 0
        if first_row >= 0:
            row = first_row
            while row < len(memory.pairs) and read_key(memory, row) == key:
                ix, iy, iz = read_vector(memory, row, MEMORY_IMPULSE)
                hx, hy, hz = hx + ix, hy + iy, hz + iz
                if n_known < MAX_POINTS and is_loaded(memory, row):
                    x, y, z = read_vector(memory, row, MEMORY_POINT)
                    known_points[n_known, 0], known_points[n_known, 1], known_points[n_known, 2] = rotate(
                        r_a, x, y, z
                    )
                    n_known += 1
                row += 1
        simplex = 0
        if first_plane <= b < first_piece:
            plane = planes[b - first_plane]
            nx, ny, nz = -plane[0], -plane[1], -plane[2]
            n_points = _find_plane_points(
                shapes, shape_a, scale_a, r_a, positions[a, 0], positions[a, 1], positions[a, 2], plane,
                margin + time_step * reach, known_points, n_known, points, manifold_workspace[-1],
            )  # fmt: skip
            if n_points == 0:
                continue
        else:
            shape_b, scale_b = shape[b], scale[b]
            r_b = get_rotation(rotations, b)
            spin_b = math.sqrt(
                velocities[body_2, 0] ** 2 + velocities[body_2, 1] ** 2 + velocities[body_2, 2] ** 2
            )
            reach += spin_b * scale_b * shapes.radius[shape_b]
            max_gap = margin + time_step * reach
            roundings = scale_a * shapes.rounding[shape_a] + scale_b * shapes.rounding[shape_b]
            px, py, pz = (
                positions[b, 0] - positions[a, 0],
                positions[b, 1] - positions[a, 1],
                positions[b, 2] - positions[a, 2],
            )
            gx: float = np.float64(known_axes[pair, 0])
            gy: float = np.float64(known_axes[pair, 1])
            gz: float = np.float64(known_axes[pair, 2])
            if gx != 0.0 or gy != 0.0 or gz != 0.0:
                along = (
                    gx * px
                    + gy * py
                    + gz * pz
                    - calc_support_distance(shapes, shape_a, scale_a, r_a, gx, gy, gz)
                    - calc_support_distance(shapes, shape_b, scale_b, r_b, -gx, -gy, -gz)
                )
                limit = roundings + max_gap
                if along > 0.0 and along * along > limit * limit * (gx * gx + gy * gy + gz * gz):
                    statistics[0] += 1
                    continue
            length = math.sqrt(hx * hx + hy * hy + hz * hz)
            if length > 0.0:
                hx, hy, hz = hx / length, hy / length, hz / length
                gx, gy, gz = hx, hy, hz
            else:
                gx, gy, gz = px, py, pz
                if gx * gx + gy * gy + gz * gz < 1e-12:
                    gx = 1.0
            statistics[1] += 1
            if first_row >= 0:
                simplex = read_simplex(memory, first_row)
            status, distance, nx, ny, nz, ax, ay, az, simplex = calc_signed_core_distance(
                shapes, shape_a, scale_a, r_a, shape_b, scale_b, r_b, px, py, pz, gx, gy, gz, hx, hy, hz, simplex,
                roundings + max_gap, gjk_workspace,
            )  # fmt: skip
            if status == SEPARATED:
                store_axis(key, nx, ny, nz, axis_cache)
                continue
            statistics[2] += status == OVERLAPPING
            gap = distance - roundings
            shift = scale_a * shapes.rounding[shape_a] + 0.5 * gap
            points[0, 0], points[0, 1], points[0, 2] = ax + shift * nx, ay + shift * ny, az + shift * nz
            points[0, 3] = gap
            # A face that is about to land, lands on all corners that it can reach within the step, or it would be spun.
            further = max_gap if time_step * reach > manifold_gap else max(manifold_gap, gap)
            n_points = make_manifold(
                shapes, shape_a, scale_a, r_a, shape_b, scale_b, r_b, px, py, pz, nx, ny, nz,
                further, face_cosine, known_points, n_known, points, manifold_workspace,
            )  # fmt: skip
            if b >= n_rocks and time_step * reach > FAST:
                offset = nx * ax + ny * ay + nz * az + distance - scale_b * shapes.rounding[shape_b]
                n_points = _add_fast_points(
                    shapes, shape_a, scale_a, r_a, nx, ny, nz, offset, max_gap, points, n_points,
                    manifold_workspace[-1],
                )  # fmt: skip
        match_limit = 0.3 * scale_a * shapes.radius[shape_a]
        used = 0
        for k in range(n_points):
            if n_rows >= len(rows.values):
                n_rows += 1
                continue
            x, y, z = points[k, 0], points[k, 1], points[k, 2]
            ix, iy, iz = 0.0, 0.0, 0.0
            if first_row >= 0:
                lx, ly, lz = rotate_back(r_a, x, y, z)
                nearest = match_limit * match_limit
                found = -1
                row = first_row
                while row < len(memory.pairs) and read_key(memory, row) == key:
                    mx, my, mz = read_vector(memory, row, MEMORY_POINT)
                    distance2 = (mx - lx) ** 2 + (my - ly) ** 2 + (mz - lz) ** 2
                    if distance2 < nearest and (used >> (row - first_row)) & 1 == 0:
                        nearest = distance2
                        found = row
                    row += 1
                if found >= 0:
                    used |= 1 << (found - first_row)
                    ix, iy, iz = read_vector(memory, found, MEMORY_IMPULSE)
            _write_row(
                rows, n_rows, bodies, a, b, (nx, ny, nz), (x, y, z), points[k, 3], (ix, iy, iz),
                restitution[1] if body_2 > n_rocks else restitution[0], simplex,
            )  # fmt: skip
            n_rows += 1
    statistics[3] = n_rows
    return n_rows
