"""Penetration of two overlapping convex cores by the separating axis theorem, exact.

Along a unit axis n the cores are apart by  s(n) = n . p - h_A(n) - h_B(-n),  with p from A's origin to B's and h the
support distances. The direction of least penetration is the n with the greatest s, and of two polyhedra that is a face
normal of one of them or the cross product of an edge of each whose arcs cross on the Gauss map (D. Gregorius, "The
separating axis test between convex polyhedra", Game Developers Conference 2013). Overlapping cores are rare: all
candidates are tried.
"""

from __future__ import annotations

import math

import numpy as np

from drakerock.rocks.engine.collision.geometry import (
    Core,
    calc_support_distance,
    find_support_corner,
    get_corner,
)
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Vector, kernel
from drakerock.rocks.engine.vectors import add, cross, dot, get_vector, negate, rotate, scale, subtract

# Edges are parallel if the sine of their angle is below this: their cross product is no direction.
PARALLEL = 1e-6
# By how much edges have to be better than faces, whose manifolds are better [m].
EDGE_PENALTY = 1e-6

# The best axis so far: separation [m], unit normal from A to B, point on A's core from A's origin.
_Axis = tuple[float, Vector, Vector]


@kernel
def _is_allowed(direction: Vector, history: Vector, min_cosine: float) -> bool:
    """Return whether a direction is near enough to the one in which the pair was pushed before (unit, or zero)."""
    return not (dot(history, history) > 0.5 and dot(direction, history) < min_cosine)


@kernel
def _try_faces(
    shapes: ConvexShapes,
    core: Core,
    other: Core,
    p: Vector,
    sign: float,
    history: Vector,
    min_cosine: float,
    best: _Axis,
) -> _Axis:
    """Return the best of an axis and the face normals of one core, which is A if the sign is 1."""
    for face in range(shapes.face_start[core.shape], shapes.face_start[core.shape + 1]):
        normal = get_vector(shapes.face_normals[face])
        outward = rotate(core.rotation, normal)
        if not _is_allowed(scale(sign, outward), history, min_cosine):
            continue
        corner = get_vector(shapes.vertices[shapes.face_vertices[shapes.face_vertex_start[face]]])
        offset = core.scale * dot(corner, normal)
        deepest, reach = find_support_corner(shapes, other, negate(outward))
        separation = sign * dot(outward, p) - other.scale * reach - offset
        if separation > best[0]:
            point = get_corner(shapes, deepest, other)
            if sign > 0.0:
                # B's deepest corner, taken back onto A's face
                point = subtract(add(point, p), scale(separation, outward))
            best = (separation, scale(sign, outward), point)
    return best


@kernel
def _get_edge(
    shapes: ConvexShapes, edge: int, core: Core, sign: float
) -> tuple[Vector, Vector, Vector, Vector]:
    """Return an edge's first corner, its way to the other, and the normals of its faces times a sign."""
    start = get_corner(shapes, shapes.edge_vertices[edge, 0], core)
    end = get_corner(shapes, shapes.edge_vertices[edge, 1], core)
    one = get_vector(shapes.face_normals[shapes.edge_faces[edge, 0]])
    other = get_vector(shapes.face_normals[shapes.edge_faces[edge, 1]])
    r = core.rotation
    return start, subtract(end, start), rotate(r, scale(sign, one)), rotate(r, scale(sign, other))


@kernel
def _calc_edge_axis(
    u: Vector, m0: Vector, m1: Vector, v: Vector, n0: Vector, n1: Vector
) -> tuple[bool, Vector]:
    """Return whether two edges u, v give an axis, and that axis, outwards from A.

    Their arcs m0 m1 and n0 n1 on the Gauss map have to cross; edges stand for m0 x m1 and n0 x n1, and the normals of
    B's faces are negated: the Gauss map of -B.
    """
    nowhere = (0.0, 0.0, 1.0)
    if dot(n0, u) * dot(n1, u) >= 0.0 or dot(m0, v) * dot(m1, v) >= 0.0:
        return False, nowhere
    axis = cross(u, v)
    length = math.sqrt(dot(axis, axis))
    if length < PARALLEL * math.sqrt(dot(u, u) * dot(v, v)):
        return False, nowhere
    # On the side of A's two faces (their sum; the cross product may point inwards).
    if dot(axis, add(m0, m1)) < 0.0:
        length = -length
    axis = (axis[0] / length, axis[1] / length, axis[2] / length)
    # Arcs that cross on opposite sides of the sphere are no candidates.
    return dot(axis, add(n0, n1)) >= 0.0, axis


@kernel
def _calc_nearest_on_edge(u: Vector, v: Vector, d: Vector) -> float:
    """Return where along the edge u its line is nearest to that of v, whose start is at d from its own (0 to 1)."""
    uu, vv, uv, ud, vd = dot(u, u), dot(v, v), dot(u, v), dot(u, d), dot(v, d)
    return min(max((ud * vv - vd * uv) / (uu * vv - uv * uv), 0.0), 1.0)


@kernel
def _try_edges(
    shapes: ConvexShapes, a: Core, b: Core, p: Vector, history: Vector, min_cosine: float, best: _Axis
) -> _Axis:
    """Return the best of an axis and the cross products of all edges of A and B."""
    for edge_a in range(shapes.edge_start[a.shape], shapes.edge_start[a.shape + 1]):
        start_a, u, m0, m1 = _get_edge(shapes, edge_a, a, 1.0)
        for edge_b in range(shapes.edge_start[b.shape], shapes.edge_start[b.shape + 1]):
            start_b, v, n0, n1 = _get_edge(shapes, edge_b, b, -1.0)
            crosses, axis = _calc_edge_axis(u, m0, m1, v, n0, n1)
            if not crosses or not _is_allowed(axis, history, min_cosine):
                continue
            d = subtract(add(p, start_b), start_a)
            separation = dot(axis, d)
            if separation > best[0] + EDGE_PENALTY:
                t = _calc_nearest_on_edge(u, v, d)
                best = (separation, axis, add(start_a, scale(t, u)))
    return best


@kernel
def calc_core_penetration(
    shapes: ConvexShapes, a: Core, b: Core, p: Vector, history: Vector, min_cosine: float
) -> tuple[float, Vector, Vector]:
    """Find the direction of least penetration of two cores.

    Args:
        shapes, a, b, p: as for `calc_core_distance`.
        history: unit direction from A to B in which the pair was pushed before, or zero if unknown.
        min_cosine: only directions at most this far from it are allowed, so that a rock that is pressed
            into a plate is not handed through to the other side.

    Returns:
        ``(separation, n, a)``: how far the cores overlap (negative), the unit normal from A to B, and the point on A's
        core at which they touch, from A's origin.
    """
    best = (-np.inf, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    best = _try_faces(shapes, a, b, p, 1.0, history, min_cosine, best)
    best = _try_faces(shapes, b, a, p, -1.0, history, min_cosine, best)
    best = _try_edges(shapes, a, b, p, history, min_cosine, best)
    if dot(history, history) > 0.5:
        # The old direction itself is always allowed; none else may be.
        reach_a = calc_support_distance(shapes, a, history)
        separation = dot(history, p) - reach_a - calc_support_distance(shapes, b, negate(history))
        if separation > best[0]:
            corner, _ = find_support_corner(shapes, a, history)
            best = (separation, history, get_corner(shapes, corner, a))
    return best
