"""Speculative contacts for what a step is about to do: loaded pairs, looked at where the solve has sent them.

Contacts are linear over a step: a point keeps its place on both bodies. A rock that is pressed hard beside its support
may be spun within a step by more than its next corners are away, and is deep in its neighbour at once. Such a step is
solved again, with contacts for all corners that the pair's motion brings near.
"""

from __future__ import annotations

import math

from drakerock.rocks.engine.collision.geometry import Core, calc_support_distance, get_rounding
from drakerock.rocks.engine.collision.gjk import GjkWorkspace
from drakerock.rocks.engine.collision.narrow_phase import CollisionGeometry, calc_signed_core_distance
from drakerock.rocks.engine.collision.poses import CollisionBodies
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Vector, kernel
from drakerock.rocks.engine.solve.rows import ContactRows, split_key
from drakerock.rocks.engine.vectors import (
    dot,
    get_rotation,
    get_vector,
    negate,
    rotate_rotation,
    scale,
    subtract,
)


@kernel
def _calc_pose_after(
    bodies: CollisionBodies, velocities: Array, body: int, time_step: float
) -> tuple[Core, Vector]:
    """Return core and position of a body, no plane, after a step with constant velocities."""
    v = velocities[bodies.solver_body[body]]
    p = bodies.positions[body]
    rotation = rotate_rotation(get_rotation(bodies.rotations, body), scale(time_step, get_vector(v)))
    return (
        Core(bodies.shape[body], bodies.scale[body], rotation),
        (p[0] + time_step * v[3], p[1] + time_step * v[4], p[2] + time_step * v[5]),
    )


@kernel
def _calc_squared_turning(
    shapes: ConvexShapes, bodies: CollisionBodies, velocities: Array, body: int
) -> float:
    """Return the square of the speed that a body's turning gives its farthest corner [m^2/s^2]."""
    v = velocities[bodies.solver_body[body]]
    radius = bodies.scale[body] * shapes.radius[bodies.shape[body]]
    return float(radius * radius * (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]))


@kernel
def _calc_gap_after(
    a: int,
    b: int,
    normal: Vector,
    geometry: CollisionGeometry,
    bodies: CollisionBodies,
    velocities: Array,
    time_step: float,
    workspace: GjkWorkspace,
) -> float:
    """Return the gap of a pair after a step with constant velocities [m]; at least 0 if they do not touch."""
    shapes = geometry.shapes
    core_a, p_a = _calc_pose_after(bodies, velocities, a, time_step)
    gap = -get_rounding(shapes, core_a)
    if geometry.first_plane <= b < geometry.first_piece:
        plane = geometry.planes[b - geometry.first_plane]
        up = get_vector(plane)
        gap += dot(up, p_a) - plane[3]
        return gap - calc_support_distance(shapes, core_a, negate(up))
    core_b, p_b = _calc_pose_after(bodies, velocities, b, time_step)
    gap -= get_rounding(shapes, core_b)
    # Separated by more than their roundings, they do not touch.
    _, distance, _, _, _ = calc_signed_core_distance(
        shapes, core_a, core_b, subtract(p_b, p_a), normal, normal, 0, -gap, workspace
    )
    return gap + distance


@kernel
def find_deep_overlaps(
    n_rows: int,
    rows: ContactRows,
    geometry: CollisionGeometry,
    bodies: CollisionBodies,
    velocities: Array,
    time_step: float,
    depth: float,
    extra_speeds: Array,
    workspace: GjkWorkspace,
) -> int:
    """Find the loaded pairs that a step leaves deep in each other, and that were not before it.

    Reads:
        n_rows, rows: the step's contacts, solved; rows of a pair are in line.
        geometry: shapes, planes, and which bodies are what.
        bodies: where they are before the step.
        velocities: (bodies of the solve, 6) angular, translational, after it.
        time_step: [s].
        depth: overlaps count that are deeper than this, and have become so by half of it at least [m].
    Writes:
        extra_speeds: (bodies,) of both bodies of such a pair, at least their speed against each other, their turning
            included [m/s].
        workspace: scratch.

    Returns:
        the number of such pairs.
    """
    n_found = 0
    shapes = geometry.shapes
    slowest = 0.5 * depth / time_step
    row = 0
    while row < n_rows:
        first, key = row, rows.key[row]
        while row < n_rows and rows.key[row] == key:
            row += 1
        a, b = split_key(key)
        v, w = velocities[a], velocities[bodies.solver_body[b]]
        way2 = (w[3] - v[3]) ** 2 + (w[4] - v[4]) ** 2 + (w[5] - v[5]) ** 2
        turning2_a = _calc_squared_turning(shapes, bodies, velocities, a)
        is_plane = geometry.first_plane <= b < geometry.first_piece
        turning2_b = 0.0 if is_plane else _calc_squared_turning(shapes, bodies, velocities, b)
        # Few are fast enough: the sum of three is at most this.
        if 3.0 * (way2 + turning2_a + turning2_b) < slowest * slowest:
            continue
        before, load = _sum_pair(rows, first, row)
        if load == 0.0:
            continue
        speed = math.sqrt(way2) + math.sqrt(turning2_a) + math.sqrt(turning2_b)
        least = max(depth, before + 0.5 * depth)
        if before + time_step * speed < least:
            continue
        normal = get_vector(rows.values[first].normal)
        gap = _calc_gap_after(a, b, normal, geometry, bodies, velocities, time_step, workspace)
        if -gap > least:
            extra_speeds[a] = max(extra_speeds[a], speed)
            extra_speeds[b] = max(extra_speeds[b], speed)
            n_found += 1
    return n_found


@kernel
def _sum_pair(rows: ContactRows, first: int, last: int) -> tuple[float, float]:
    """Return the deepest overlap of a range of rows [m], and the sum of their normal impulses [N s]."""
    before, load = 0.0, 0.0
    for k in range(first, last):
        before = max(before, -rows.values[k].gap)
        load += rows.values[k].impulse[0]
    return before, load
