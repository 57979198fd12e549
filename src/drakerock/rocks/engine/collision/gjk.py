"""Distance of two convex cores by Gilbert, Johnson and Keerthi's algorithm.

The search runs on the Minkowski difference B - A with sub-problems solved by Voronoi regions (C. Ericson,
Real-Time Collision Detection, 2005, sections 5.1 and 9.5). All vectors are in W's axes, from A's origin.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.collision.geometry import Core, find_support_corner, get_corner
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Vector, kernel
from drakerock.rocks.engine.vectors import add, cross, dot, get_vector, negate, scale, set_vector, subtract

SEPARATED, NEAR, OVERLAPPING = 1, 0, -1
# Iterations of a search; one from scratch takes about seven. More would only circle on rounding errors.
MAX_ITERATIONS = 32
# Cores nearer than the root of this overlap: their normal could not be told [m^2].
MIN_SQUARED_DISTANCE = 1e-10
# A search ends when the distance cannot get smaller by more than this share of its square.
TOLERANCE = 1e-9
# ... or when an iteration has made its square smaller by less than this share.
PROGRESS = 1e-12
# A simplex is flat if its volume is less than a sixth of this [m^3].
MIN_VOLUME = 1e-14
# The three corners of each face of a tetrahedron, and the one opposite.
TETRAHEDRON_FACES = ((0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 1, 2), (1, 3, 2, 0))
# A simplex in one number: two bits for the number of its points, then for each the corners of A and B. Shapes with more
# corners than these bits tell are searched from scratch.
CORNER_BITS = 7
MAX_CORNER = 1 << CORNER_BITS


class GjkWorkspace(NamedTuple):
    """Scratch memory of a search: the simplex of up to four points of the Minkowski difference.

    Attributes:
        points: (4, 3) points of the difference [m].
        on_a: (4, 3) the points on A [m].
        weights: (4,) barycentric weights of the point nearest to the origin.
        corners: (4, 2) the corners of A and B that the points are the difference of, counted from each shape's first.
    """

    points: NDArray[np.float64]
    on_a: NDArray[np.float64]
    weights: NDArray[np.float64]
    corners: NDArray[np.int64]


def make_gjk_workspace() -> GjkWorkspace:
    """Return scratch memory for `calc_core_distance`."""
    return GjkWorkspace(np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(4), np.zeros((4, 2), np.int64))


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
def calc_triangle_weights(a: Vector, b: Vector, c: Vector) -> Vector:
    """Return the barycentric weights of the point of triangle abc nearest to the origin."""
    u, v = subtract(b, a), subtract(c, a)
    d1, d2 = -dot(u, a), -dot(v, a)
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    d3, d4 = -dot(u, b), -dot(v, b)
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    on_ab = d1 * d4 - d3 * d2
    if on_ab <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3)
        return 1.0 - t, t, 0.0
    d5, d6 = -dot(u, c), -dot(v, c)
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    on_ac = d5 * d2 - d1 * d6
    if on_ac <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
        return 1.0 - t, 0.0, t
    on_bc = d3 * d6 - d5 * d4
    if on_bc <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - t, t
    inverse = 1.0 / (on_bc + on_ac + on_ab)
    return on_bc * inverse, on_ac * inverse, on_ab * inverse


@kernel
def _calc_weights(points: Array, n_points: int, weights: Array) -> bool:
    """Set the weights of the point of the simplex nearest to the origin; True if the origin is inside."""
    if n_points == 1:
        weights[0] = 1.0
        return False
    if n_points == 2:
        first = get_vector(points[0])
        u = subtract(get_vector(points[1]), first)
        length2 = dot(u, u)
        t = -dot(u, first)
        t = 0.0 if t <= 0.0 else (1.0 if t >= length2 else t / length2)
        weights[0], weights[1] = 1.0 - t, t
        return False
    if n_points == 3:
        nearest = calc_triangle_weights(get_vector(points[0]), get_vector(points[1]), get_vector(points[2]))
        set_vector(nearest, weights)
        return False
    return _calc_tetrahedron_weights(points, weights)


@kernel
def _calc_tetrahedron_weights(points: Array, weights: Array) -> bool:
    """Set the weights of the point of a tetrahedron's faces nearest to the origin; True if the origin is inside."""
    inside = True
    nearest = np.inf
    for face in range(4):
        i, j, k, other = TETRAHEDRON_FACES[face]
        a, b, c = get_vector(points[i]), get_vector(points[j]), get_vector(points[k])
        normal = cross(subtract(b, a), subtract(c, a))
        origin_side = -dot(normal, a)
        inner_side = dot(normal, subtract(get_vector(points[other]), a))
        # A flat tetrahedron has no inside.
        if origin_side * inner_side <= 0.0 or abs(inner_side) < MIN_VOLUME:
            inside = False
            wa, wb, wc = calc_triangle_weights(a, b, c)
            point = add(add(scale(wa, a), scale(wb, b)), scale(wc, c))
            distance2 = dot(point, point)
            if distance2 < nearest:
                nearest = distance2
                weights[:] = 0.0
                weights[i], weights[j], weights[k] = wa, wb, wc
    return inside


@kernel
def _is_known(points: Array, n_points: int, w: Vector) -> bool:
    known = False
    for k in range(n_points):
        if points[k, 0] == w[0] and points[k, 1] == w[1] and points[k, 2] == w[2]:
            known = True
    return known


@kernel
def _add_point(
    n_points: int, w: Vector, on_a: Vector, corner_a: int, corner_b: int, workspace: GjkWorkspace
) -> None:
    """Add a point of the difference to the simplex; it has no weight yet."""
    set_vector(w, workspace.points[n_points])
    set_vector(on_a, workspace.on_a[n_points])
    workspace.weights[n_points] = 0.0
    workspace.corners[n_points, 0], workspace.corners[n_points, 1] = corner_a, corner_b


@kernel
def _start_simplex(
    shapes: ConvexShapes, a: Core, b: Core, p: Vector, simplex: int, workspace: GjkWorkspace
) -> int:
    """Start with the simplex that an earlier search ended with; return the number of its points."""
    points, corners = workspace.points, workspace.corners
    first_a, first_b = shapes.vertex_start[a.shape], shapes.vertex_start[b.shape]
    n_points = 0
    for k in range(decode_simplex(simplex, corners)):
        corner_a, corner_b = corners[k, 0], corners[k, 1]
        on_a = get_corner(shapes, first_a + corner_a, a)
        w = subtract(add(p, get_corner(shapes, first_b + corner_b, b)), on_a)
        if not _is_known(points, n_points, w):
            _add_point(n_points, w, on_a, corner_a, corner_b, workspace)
            n_points += 1
    return n_points


@kernel
def _reduce_simplex(n_points: int, workspace: GjkWorkspace) -> tuple[int, Vector]:
    """Drop the points without weight; return the number of the others, and their mean, which is nearest."""
    points, on_a, weights, corners = workspace
    n_kept = 0
    x, y, z = 0.0, 0.0, 0.0
    for k in range(n_points):
        weight = weights[k]
        if weight > 0.0:
            x += weight * points[k, 0]
            y += weight * points[k, 1]
            z += weight * points[k, 2]
            if n_kept != k:
                weights[n_kept] = weight
                corners[n_kept, 0], corners[n_kept, 1] = corners[k, 0], corners[k, 1]
                for d in range(3):
                    points[n_kept, d] = points[k, d]
                    on_a[n_kept, d] = on_a[k, d]
            n_kept += 1
    return n_kept, (x, y, z)


@kernel
def _calc_point_on_a(n_points: int, workspace: GjkWorkspace) -> Vector:
    """Return the nearest point on A."""
    x, y, z = 0.0, 0.0, 0.0
    for k in range(n_points):
        x += workspace.weights[k] * workspace.on_a[k, 0]
        y += workspace.weights[k] * workspace.on_a[k, 1]
        z += workspace.weights[k] * workspace.on_a[k, 2]
    return x, y, z


@kernel
def calc_core_distance(
    shapes: ConvexShapes,
    a: Core,
    b: Core,
    p: Vector,
    guess: Vector,
    simplex: int,
    max_distance: float,
    workspace: GjkWorkspace,
) -> tuple[int, Vector, Vector, int]:
    """Find the nearest points of two cores.

    Reads:
        shapes, a, b: all shapes, and the two cores.
        p: from A's origin to B's, in W [m].
        guess: of the direction from A to B, any length but zero.
        simplex: the simplex that an earlier search of this pair ended with, where this one starts; or 0.
        max_distance: give up when the cores are proven to be farther apart [m].
    Writes:
        workspace: scratch.

    Returns:
        ``(status, v, a, simplex)``. NEAR: v from A's nearest point to B's, a A's nearest point. SEPARATED: v an axis on
        which the cores are farther apart than `max_distance`. OVERLAPPING: no use.
    """
    points, weights = workspace.points, workspace.weights
    first_a, first_b = shapes.vertex_start[a.shape], shapes.vertex_start[b.shape]
    nowhere = (0.0, 0.0, 0.0)
    v = guess
    last2 = np.inf
    squared = 0.0
    n_points = _start_simplex(shapes, a, b, p, simplex, workspace)
    reduce = n_points > 0
    for _ in range(MAX_ITERATIONS):
        if reduce:
            if _calc_weights(points, n_points, weights):
                return OVERLAPPING, v, nowhere, 0
            n_points, v = _reduce_simplex(n_points, workspace)
            squared = dot(v, v)
            if squared < MIN_SQUARED_DISTANCE:
                return OVERLAPPING, v, nowhere, 0
            if squared >= last2 * (1.0 - PROGRESS):
                break
            last2 = squared
        reduce = True
        corner_a, _ = find_support_corner(shapes, a, v)
        corner_b, _ = find_support_corner(shapes, b, negate(v))
        on_a = get_corner(shapes, corner_a, a)
        w = subtract(add(p, get_corner(shapes, corner_b, b)), on_a)
        bound = dot(v, w)
        if bound > 0.0 and bound * bound > max_distance * max_distance * dot(v, v):
            return SEPARATED, v, nowhere, 0
        if n_points > 0 and squared - bound <= TOLERANCE * squared:
            break
        if _is_known(points, n_points, w):
            break
        _add_point(n_points, w, on_a, corner_a - first_a, corner_b - first_b, workspace)
        n_points += 1
    status = SEPARATED if math.sqrt(squared) > max_distance else NEAR
    return status, v, _calc_point_on_a(n_points, workspace), encode_simplex(workspace.corners, n_points)
