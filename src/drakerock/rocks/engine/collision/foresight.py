"""Overlaps that a step is about to make: loaded pairs, looked at where the solve has sent them.

Contacts are linear over a step: a point keeps its place on both bodies. A rock that is pressed hard beside its support
may be spun within a step by more than its next corners are away, and is deep in its neighbour at once. Such a step is
solved again, with contacts for all corners that the pair's motion brings near.
"""

from __future__ import annotations

import math

from drakerock.rocks.engine.collision.geometry import calc_support_distance, get_rotation
from drakerock.rocks.engine.collision.narrow_phase import (
    CollisionBodies,
    Workspace,
    calc_signed_core_distance,
)
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Rotation, Vector, kernel
from drakerock.rocks.engine.contacts import GAP, IMPULSE, NORMAL, ContactRows, split_key


@kernel
def turn_rotation(r: Rotation, x: float, y: float, z: float) -> Rotation:
    """Return the rotation R turned by the rotation vector a = (x, y, z), in W: exp(a) R."""
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    # sin(t) / t and (1 - cos(t)) / t^2, by their series where t is small
    s = math.sin(angle) / angle if angle > 1e-4 else 1.0 - angle2 / 6.0
    c = (1.0 - math.cos(angle)) / angle2 if angle > 1e-4 else 0.5 - angle2 / 24.0
    t = 1.0 - c * angle2
    m0, m1, m2 = t + c * x * x, c * x * y - s * z, c * x * z + s * y
    m3, m4, m5 = c * x * y + s * z, t + c * y * y, c * y * z - s * x
    m6, m7, m8 = c * x * z - s * y, c * y * z + s * x, t + c * z * z
    return (
        m0 * r[0] + m1 * r[3] + m2 * r[6], m0 * r[1] + m1 * r[4] + m2 * r[7], m0 * r[2] + m1 * r[5] + m2 * r[8],
        m3 * r[0] + m4 * r[3] + m5 * r[6], m3 * r[1] + m4 * r[4] + m5 * r[7], m3 * r[2] + m4 * r[5] + m5 * r[8],
        m6 * r[0] + m7 * r[3] + m8 * r[6], m6 * r[1] + m7 * r[4] + m8 * r[7], m6 * r[2] + m7 * r[5] + m8 * r[8],
    )  # fmt: skip


@kernel
def _calc_pose_after(
    bodies: CollisionBodies, velocities: Array, body: int, time_step: float
) -> tuple[Rotation, Vector]:
    """Return rotation and position of a body, no plane, after a step with constant velocities."""
    v = velocities[bodies.solver_body[body]]
    r = get_rotation(bodies.rotations, body)
    p = bodies.positions[body]
    return (
        turn_rotation(r, time_step * v[0], time_step * v[1], time_step * v[2]),
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
def foresee_overlaps(
    rows: ContactRows,
    n_rows: int,
    first_plane: int,
    first_piece: int,
    planes: Array,
    shapes: ConvexShapes,
    bodies: CollisionBodies,
    velocities: Array,
    time_step: float,
    depth: float,
    speeds: Array,
    workspace: Workspace,
) -> int:
    """Find the loaded pairs that a step leaves deep in each other, and that were not before it.

    Args:
        rows, n_rows: the step's contacts, solved; rows of a pair are in line.
        first_plane, first_piece, planes, shapes: as for `find_contacts`.
        bodies: where they are before the step.
        velocities: (solver bodies, 6) angular, translational, after it.
        time_step: [s].
        depth: overlaps count that are deeper than this, and have become so by half of it at least [m].
        speeds: (bodies,) changed: of both bodies of such a pair, at least their speed against each other, their turning
            included [m/s].
        workspace: of the narrow phase.

    Returns:
        the number of such pairs.
    """
    n_found = 0
    slowest = 0.5 * depth / time_step
    row = 0
    while row < n_rows:
        first, key = row, rows.key[row]
        while row < n_rows and rows.key[row] == key:
            row += 1
        a, b = split_key(key)
        is_plane = first_plane <= b < first_piece
        v, w = velocities[a], velocities[bodies.solver_body[b]]
        way2 = (w[3] - v[3]) ** 2 + (w[4] - v[4]) ** 2 + (w[5] - v[5]) ** 2
        turning2_a = _calc_squared_turning(shapes, bodies, velocities, a)
        turning2_b = 0.0 if is_plane else _calc_squared_turning(shapes, bodies, velocities, b)
        # Few are fast enough: the sum of three is at most this.
        if 3.0 * (way2 + turning2_a + turning2_b) < slowest * slowest:
            continue
        before, load = 0.0, 0.0
        for k in range(first, row):
            before = max(before, -rows.values[k, GAP])
            load += rows.values[k, IMPULSE]
        if load == 0.0:
            continue
        speed = math.sqrt(way2) + math.sqrt(turning2_a) + math.sqrt(turning2_b)
        least = max(depth, before + 0.5 * depth)
        if before + time_step * speed < least:
            continue
        r_a, p_a = _calc_pose_after(bodies, velocities, a, time_step)
        shape_a, scale_a = bodies.shape[a], bodies.scale[a]
        gap = -scale_a * shapes.rounding[shape_a]
        if is_plane:
            plane = planes[b - first_plane]
            gap += plane[0] * p_a[0] + plane[1] * p_a[1] + plane[2] * p_a[2] - plane[3]
            gap -= calc_support_distance(shapes, shape_a, scale_a, r_a, -plane[0], -plane[1], -plane[2])
        else:
            r_b, p_b = _calc_pose_after(bodies, velocities, b, time_step)
            shape_b, scale_b = bodies.shape[b], bodies.scale[b]
            px, py, pz = p_b[0] - p_a[0], p_b[1] - p_a[1], p_b[2] - p_a[2]
            values = rows.values[first]
            nx, ny, nz = values[NORMAL], values[NORMAL + 1], values[NORMAL + 2]
            gap -= scale_b * shapes.rounding[shape_b]
            # Separated by more than their roundings, they do not touch.
            _, distance, _, _, _, _, _, _, _ = calc_signed_core_distance(
                shapes, shape_a, scale_a, r_a, shape_b, scale_b, r_b, px, py, pz, nx, ny, nz, nx, ny, nz, 0, -gap,
                workspace[0],
            )  # fmt: skip
            gap += distance
        if -gap > least:
            speeds[a] = max(speeds[a], speed)
            speeds[b] = max(speeds[b], speed)
            n_found += 1
    return n_found
