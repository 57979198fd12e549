"""Distance of two convex cores by Gilbert, Johnson and Keerthi's algorithm.

The search runs on the Minkowski difference B - A with sub-problems solved by Voronoi regions (C. Ericson,
Real-Time Collision Detection, 2005, sections 5.1 and 9.5). All vectors are in W's axes, from A's origin.
"""

from __future__ import annotations

import math

import numpy as np

from drakerock.rocks.engine.collision.geometry import find_support, get_corner, rotate_back
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Rotation, Vector, kernel

SEPARATED, NEAR, OVERLAPPING = 1, 0, -1
MAX_ITERATIONS = 32
# A simplex in one number: two bits for the number of its points, then for each the corners of A and B.
CORNER_BITS = 7
MAX_CORNER = 1 << CORNER_BITS

Workspace = tuple[Array, Array, Array, Array]


def make_gjk_workspace() -> Workspace:
    """Return (points, on_a, weights, corners).

    The simplex of the difference (4, 3), its points on A (4, 3), barycentric weights (4,), and the corners of A and
    B (4, 2) that its points are the difference of, counted from each shape's first.
    """
    return np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(4), np.zeros((4, 2), np.int64)


@kernel
def encode_simplex(corners: Array, n_points: int) -> int:
    """Return a simplex of at most three pairs of corners as a number; 0 if it cannot be told."""
    if n_points > 3:
        return 0
    code = n_points
    for k in range(n_points):
        if corners[k, 0] >= MAX_CORNER or corners[k, 1] >= MAX_CORNER:
            return 0
        code |= (corners[k, 0] | (corners[k, 1] << CORNER_BITS)) << (2 + 2 * CORNER_BITS * k)
    return code


@kernel
def decode_simplex(code: int, corners: Array) -> int:
    """Set the pairs of corners of a simplex; return how many there are."""
    n_points = code & 3
    for k in range(n_points):
        pair = code >> (2 + 2 * CORNER_BITS * k)
        corners[k, 0] = pair & (MAX_CORNER - 1)
        corners[k, 1] = (pair >> CORNER_BITS) & (MAX_CORNER - 1)
    return n_points


@kernel
def calc_triangle_weights(
    ax: float, ay: float, az: float, bx: float, by: float, bz: float, cx: float, cy: float, cz: float
) -> Vector:
    """Return the barycentric weights of the point of triangle abc nearest to the origin."""
    ux, uy, uz = bx - ax, by - ay, bz - az
    vx, vy, vz = cx - ax, cy - ay, cz - az
    d1 = -(ux * ax + uy * ay + uz * az)
    d2 = -(vx * ax + vy * ay + vz * az)
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    d3 = -(ux * bx + uy * by + uz * bz)
    d4 = -(vx * bx + vy * by + vz * bz)
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    on_ab = d1 * d4 - d3 * d2
    if on_ab <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        return 1.0 - v, v, 0.0
    d5 = -(ux * cx + uy * cy + uz * cz)
    d6 = -(vx * cx + vy * cy + vz * cz)
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    on_ac = d5 * d2 - d1 * d6
    if on_ac <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        return 1.0 - w, 0.0, w
    on_bc = d3 * d6 - d5 * d4
    if on_bc <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - w, w
    inverse = 1.0 / (on_bc + on_ac + on_ab)
    return on_bc * inverse, on_ac * inverse, on_ab * inverse


@kernel
def _calc_weights(points: Array, n_points: int, weights: Array) -> bool:
    """Set the weights of the point of the simplex nearest to the origin; True if the origin is inside."""
    if n_points == 1:
        weights[0] = 1.0
        return False
    if n_points == 2:
        ux, uy, uz = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2]
        length2 = ux * ux + uy * uy + uz * uz
        t = -(ux * points[0, 0] + uy * points[0, 1] + uz * points[0, 2])
        t = 0.0 if t <= 0.0 else (1.0 if t >= length2 else t / length2)
        weights[0] = 1.0 - t
        weights[1] = t
        return False
    if n_points == 3:
        weights[0], weights[1], weights[2] = calc_triangle_weights(
            points[0, 0], points[0, 1], points[0, 2],
            points[1, 0], points[1, 1], points[1, 2],
            points[2, 0], points[2, 1], points[2, 2],
        )  # fmt: skip
        return False
    inside = True
    nearest = np.inf
    for face in range(4):
        if face == 0:
            a, b, c, opposite = 0, 1, 2, 3
        elif face == 1:
            a, b, c, opposite = 0, 2, 3, 1
        elif face == 2:
            a, b, c, opposite = 0, 3, 1, 2
        else:
            a, b, c, opposite = 1, 3, 2, 0
        ax, ay, az = points[a, 0], points[a, 1], points[a, 2]
        bx, by, bz = points[b, 0], points[b, 1], points[b, 2]
        cx, cy, cz = points[c, 0], points[c, 1], points[c, 2]
        nx = (by - ay) * (cz - az) - (bz - az) * (cy - ay)
        ny = (bz - az) * (cx - ax) - (bx - ax) * (cz - az)
        nz = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        origin_side = -(nx * ax + ny * ay + nz * az)
        inner_side = (
            nx * (points[opposite, 0] - ax)
            + ny * (points[opposite, 1] - ay)
            + nz * (points[opposite, 2] - az)
        )
        # A flat tetrahedron has no inside.
        if origin_side * inner_side <= 0.0 or abs(inner_side) < 1e-14:
            inside = False
            wa, wb, wc = calc_triangle_weights(ax, ay, az, bx, by, bz, cx, cy, cz)
            x = wa * ax + wb * bx + wc * cx
            y = wa * ay + wb * by + wc * cy
            z = wa * az + wb * bz + wc * cz
            distance2 = x * x + y * y + z * z
            if distance2 < nearest:
                nearest = distance2
                weights[:] = 0.0
                weights[a], weights[b], weights[c] = wa, wb, wc
    return inside


@kernel
def _is_known(points: Array, n_points: int, x: float, y: float, z: float) -> bool:
    known = False
    for k in range(n_points):
        if points[k, 0] == x and points[k, 1] == y and points[k, 2] == z:
            known = True
    return known


@kernel
def _add_point(
    workspace: Workspace,
    n_points: int,
    wx: float,
    wy: float,
    wz: float,
    ax: float,
    ay: float,
    az: float,
    corner_a: int,
    corner_b: int,
) -> None:
    """Add a point of the difference to the simplex; it has no weight yet."""
    points, on_a, weights, corners = workspace
    points[n_points, 0], points[n_points, 1], points[n_points, 2] = wx, wy, wz
    on_a[n_points, 0], on_a[n_points, 1], on_a[n_points, 2] = ax, ay, az
    weights[n_points] = 0.0
    corners[n_points, 0], corners[n_points, 1] = corner_a, corner_b


@kernel
def calc_core_distance(
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
    simplex: int,
    max_distance: float,
    workspace: Workspace,
) -> tuple[int, float, float, float, float, float, float, int]:
    """Find the nearest points of two cores.

    Args:
        shapes: all shapes.
        shape_a, scale_a, r_a: A's shape, scale and rotation (9 numbers); likewise B's.
        px, py, pz: from A's origin to B's, in W.
        gx, gy, gz: a guess of the direction from A to B, any length but zero.
        simplex: the simplex that an earlier search of this pair ended with, where this one starts; or 0.
        max_distance: give up when the cores are proven to be farther apart [m].
        workspace: from `make_gjk_workspace`.

    Returns:
        ``(status, vx, vy, vz, ax, ay, az, simplex)``. NEAR: v from A's nearest point to B's, a A's nearest point.
        SEPARATED: v an axis on which the cores are farther apart than `max_distance`. OVERLAPPING: no use.
    """
    points, on_a, weights, corners = workspace
    vertices = shapes.vertices
    first_a, last_a = shapes.vertex_start[shape_a], shapes.vertex_start[shape_a + 1]
    first_b, last_b = shapes.vertex_start[shape_b], shapes.vertex_start[shape_b + 1]
    vx, vy, vz = gx, gy, gz
    last2 = np.inf
    squared = 0.0
    status = NEAR
    n_points = 0
    for k in range(decode_simplex(simplex, corners)):
        corner_a, corner_b = first_a + corners[k, 0], first_b + corners[k, 1]
        ax, ay, az = get_corner(vertices, corner_a, scale_a, r_a)
        bx, by, bz = get_corner(vertices, corner_b, scale_b, r_b)
        wx, wy, wz = px + bx - ax, py + by - ay, pz + bz - az
        if not _is_known(points, n_points, wx, wy, wz):
            _add_point(workspace, n_points, wx, wy, wz, ax, ay, az, corner_a - first_a, corner_b - first_b)
            n_points += 1
    reduce = n_points > 0
    for _ in range(MAX_ITERATIONS):
        if reduce:
            if _calc_weights(points, n_points, weights):
                return OVERLAPPING, vx, vy, vz, 0.0, 0.0, 0.0, 0
            kept = 0
            vx, vy, vz = 0.0, 0.0, 0.0
            for k in range(n_points):
                weight = weights[k]
                if weight > 0.0:
                    vx += weight * points[k, 0]
                    vy += weight * points[k, 1]
                    vz += weight * points[k, 2]
                    if kept != k:
                        weights[kept] = weight
                        corners[kept, 0], corners[kept, 1] = corners[k, 0], corners[k, 1]
                        for d in range(3):
                            points[kept, d] = points[k, d]
                            on_a[kept, d] = on_a[k, d]
                    kept += 1
            n_points = kept
            squared = vx * vx + vy * vy + vz * vz
            if squared < 1e-10:
                return OVERLAPPING, vx, vy, vz, 0.0, 0.0, 0.0, 0
            if squared >= last2 * (1.0 - 1e-12):
                break
            last2 = squared
        reduce = True
        lx, ly, lz = rotate_back(r_a, vx, vy, vz)
        corner_a, _ = find_support(vertices, first_a, last_a, lx, ly, lz)
        lx, ly, lz = rotate_back(r_b, -vx, -vy, -vz)
        corner_b, _ = find_support(vertices, first_b, last_b, lx, ly, lz)
        ax, ay, az = get_corner(vertices, corner_a, scale_a, r_a)
        bx, by, bz = get_corner(vertices, corner_b, scale_b, r_b)
        wx, wy, wz = px + bx - ax, py + by - ay, pz + bz - az
        bound = vx * wx + vy * wy + vz * wz
        if bound > 0.0 and bound * bound > max_distance * max_distance * (vx * vx + vy * vy + vz * vz):
            return SEPARATED, vx, vy, vz, 0.0, 0.0, 0.0, 0
        if n_points > 0 and squared - bound <= 1e-9 * squared:
            break
        if _is_known(points, n_points, wx, wy, wz):
            break
        _add_point(workspace, n_points, wx, wy, wz, ax, ay, az, corner_a - first_a, corner_b - first_b)
        n_points += 1
    ax, ay, az = 0.0, 0.0, 0.0
    for k in range(n_points):
        ax += weights[k] * on_a[k, 0]
        ay += weights[k] * on_a[k, 1]
        az += weights[k] * on_a[k, 2]
    if math.sqrt(squared) > max_distance:
        status = SEPARATED
    return status, vx, vy, vz, ax, ay, az, encode_simplex(corners, n_points)
