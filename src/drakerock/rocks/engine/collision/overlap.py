"""Penetration of two overlapping convex cores by the separating axis theorem, exact.

The direction of least penetration of two polyhedra is a face normal of one of them or the cross product of
an edge of each whose arcs cross on the Gauss map (D. Gregorius, "The separating axis test between convex
polyhedra", Game Developers Conference 2013). Overlapping cores are rare: all candidates are tried.
"""

from __future__ import annotations

import math

import numpy as np

from drakerock.rocks.engine.collision.geometry import (
    calc_support_distance,
    find_support,
    get_corner,
    rotate,
    rotate_back,
)
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Rotation, kernel


@kernel
def calc_core_penetration(
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
    hx: float,
    hy: float,
    hz: float,
    min_cosine: float,
) -> tuple[float, float, float, float, float, float, float]:
    """Find the direction of least penetration of two cores.

    Args:
        shapes, shape_a, scale_a, r_a, shape_b, scale_b, r_b, px, py, pz: as for `calc_core_distance`.
        hx, hy, hz: unit direction from A to B in which the pair was pushed before, or zero if unknown.
        min_cosine: only directions at most this far from it are allowed, so that a rock that is pressed
            into a plate is not handed through to the other side.

    Returns:
        ``(separation, nx, ny, nz, ax, ay, az)``: how far the cores overlap (negative), the unit normal from
        A to B, and the point on A's core at which they touch, from A's origin.
    """
    has_history = hx * hx + hy * hy + hz * hz > 0.5
    best = -np.inf
    nx, ny, nz, cx, cy, cz = 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    vertices = shapes.vertices
    for side in range(2):
        if side == 0:
            shape, scale, r, other, other_scale, other_r, sign = (
                shape_a, scale_a, r_a, shape_b, scale_b, r_b, 1.0,
            )  # fmt: skip
        else:
            shape, scale, r, other, other_scale, other_r, sign = (
                shape_b, scale_b, r_b, shape_a, scale_a, r_a, -1.0,
            )  # fmt: skip
        first, last = shapes.vertex_start[other], shapes.vertex_start[other + 1]
        for face in range(shapes.face_start[shape], shapes.face_start[shape + 1]):
            fx, fy, fz = (
                shapes.face_normals[face, 0],
                shapes.face_normals[face, 1],
                shapes.face_normals[face, 2],
            )
            wx, wy, wz = rotate(r, fx, fy, fz)
            if has_history and sign * (wx * hx + wy * hy + wz * hz) < min_cosine:
                continue
            corner = shapes.face_vertices[shapes.face_vertex_start[face]]
            offset = scale * (vertices[corner, 0] * fx + vertices[corner, 1] * fy + vertices[corner, 2] * fz)
            lx, ly, lz = rotate_back(other_r, -wx, -wy, -wz)
            deepest, reach = find_support(vertices, first, last, lx, ly, lz)
            separation = sign * (wx * px + wy * py + wz * pz) - other_scale * reach - offset
            if separation > best:
                best = separation
                nx, ny, nz = sign * wx, sign * wy, sign * wz
                cx, cy, cz = get_corner(shapes.vertices, deepest, other_scale, other_r)
                if side == 0:
                    # B's deepest corner, taken back onto A's face
                    cx, cy, cz = (
                        cx + px - separation * wx,
                        cy + py - separation * wy,
                        cz + pz - separation * wz,
                    )
    for edge_a in range(shapes.edge_start[shape_a], shapes.edge_start[shape_a + 1]):
        a0x, a0y, a0z = get_corner(shapes.vertices, shapes.edge_vertices[edge_a, 0], scale_a, r_a)
        a1x, a1y, a1z = get_corner(shapes.vertices, shapes.edge_vertices[edge_a, 1], scale_a, r_a)
        ux, uy, uz = a1x - a0x, a1y - a0y, a1z - a0z
        face = shapes.edge_faces[edge_a, 0]
        m0x, m0y, m0z = rotate(
            r_a, shapes.face_normals[face, 0], shapes.face_normals[face, 1], shapes.face_normals[face, 2]
        )
        face = shapes.edge_faces[edge_a, 1]
        m1x, m1y, m1z = rotate(
            r_a, shapes.face_normals[face, 0], shapes.face_normals[face, 1], shapes.face_normals[face, 2]
        )
        for edge_b in range(shapes.edge_start[shape_b], shapes.edge_start[shape_b + 1]):
            b0x, b0y, b0z = get_corner(shapes.vertices, shapes.edge_vertices[edge_b, 0], scale_b, r_b)
            b1x, b1y, b1z = get_corner(shapes.vertices, shapes.edge_vertices[edge_b, 1], scale_b, r_b)
            vx, vy, vz = b1x - b0x, b1y - b0y, b1z - b0z
            face = shapes.edge_faces[edge_b, 0]
            # B's normals enter negated: the Gauss map of -B.
            n0x, n0y, n0z = rotate(
                r_b,
                -shapes.face_normals[face, 0],
                -shapes.face_normals[face, 1],
                -shapes.face_normals[face, 2],
            )
            face = shapes.edge_faces[edge_b, 1]
            n1x, n1y, n1z = rotate(
                r_b,
                -shapes.face_normals[face, 0],
                -shapes.face_normals[face, 1],
                -shapes.face_normals[face, 2],
            )
            # Do the arcs m0 m1 and n0 n1 cross? Edges stand for m0 x m1 and n0 x n1.
            side_n0 = n0x * ux + n0y * uy + n0z * uz
            side_n1 = n1x * ux + n1y * uy + n1z * uz
            side_m0 = m0x * vx + m0y * vy + m0z * vz
            side_m1 = m1x * vx + m1y * vy + m1z * vz
            if side_n0 * side_n1 >= 0.0 or side_m0 * side_m1 >= 0.0:
                continue
            wx, wy, wz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            length = math.sqrt(wx * wx + wy * wy + wz * wz)
            if length < 1e-6 * math.sqrt((ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz)):
                continue
            # Outwards from A: on the side of its two faces (their sum; the cross product may point inwards).
            if wx * (m0x + m1x) + wy * (m0y + m1y) + wz * (m0z + m1z) < 0.0:
                length = -length
            wx, wy, wz = wx / length, wy / length, wz / length
            # Arcs that cross on opposite sides of the sphere are no candidates.
            if wx * (n0x + n1x) + wy * (n0y + n1y) + wz * (n0z + n1z) < 0.0:
                continue
            if has_history and wx * hx + wy * hy + wz * hz < min_cosine:
                continue
            dx, dy, dz = px + b0x - a0x, py + b0y - a0y, pz + b0z - a0z
            separation = wx * dx + wy * dy + wz * dz
            # Faces win ties: their manifolds are better.
            if separation > best + 1e-6:
                best = separation
                nx, ny, nz = wx, wy, wz
                # nearest points of the two lines
                uu = ux * ux + uy * uy + uz * uz
                vv = vx * vx + vy * vy + vz * vz
                uv = ux * vx + uy * vy + uz * vz
                ud = ux * dx + uy * dy + uz * dz
                vd = vx * dx + vy * dy + vz * dz
                t = min(max((ud * vv - vd * uv) / (uu * vv - uv * uv), 0.0), 1.0)
                cx, cy, cz = a0x + t * ux, a0y + t * uy, a0z + t * uz
    if has_history:
        # The old direction itself is always allowed; none else may be.
        separation = (
            hx * px
            + hy * py
            + hz * pz
            - calc_support_distance(shapes, shape_a, scale_a, r_a, hx, hy, hz)
            - calc_support_distance(shapes, shape_b, scale_b, r_b, -hx, -hy, -hz)
        )
        if separation > best:
            lx, ly, lz = rotate_back(r_a, hx, hy, hz)
            corner, _ = find_support(
                vertices, shapes.vertex_start[shape_a], shapes.vertex_start[shape_a + 1], lx, ly, lz
            )
            best = separation
            nx, ny, nz = hx, hy, hz
            cx, cy, cz = get_corner(shapes.vertices, corner, scale_a, r_a)
    return best, nx, ny, nz, cx, cy, cz
