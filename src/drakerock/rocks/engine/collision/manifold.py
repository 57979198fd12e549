"""Contact manifolds: up to four points per pair, so that faces rest on faces.

The face of one body that points best along the normal is the reference; the other body's face is clipped
against the reference's sides (Sutherland and Hodgman) and the corners that remain, with their gaps, are
thinned to four points that are far apart. A side of a rock is often several faces at a few degrees: all that are
within `min_cosine` of the normal take part on either body, or a manifold would end at the edge between two of them
and jump when the other becomes the better one. Corners that carried load in the last step are preferred: faces that
touch have many corners of nearly the same depth, and a choice by depth alone changes from step to step, which
shakes the pile.
"""

from __future__ import annotations

import numpy as np

from drakerock.rocks.engine.collision.geometry import get_corner, rotate, rotate_back
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Rotation, kernel

MAX_OUTLINE = 96
MAX_POINTS = 4
# A corner is a known point of the last step if this near to it [radius of the smaller body].
KNOWN_DISTANCE = 0.03
# By how much a corner has to be deeper than a known one to be the first point instead [m].
KNOWN_DEPTH = 3e-4
# By how much farther, squared, it has to be from the points chosen already.
KNOWN_FACTOR = 2.0
# Columns of a candidate: position, gap, 1 if known.
KNOWN = 4
CANDIDATE_WIDTH = 5


def make_manifold_workspace() -> tuple[Array, Array, Array, Array]:
    """Return (corners, outline, clipped, candidates), all of MAX_OUTLINE rows."""
    return (
        np.zeros((MAX_OUTLINE, 3)),
        np.zeros((MAX_OUTLINE, 3)),
        np.zeros((MAX_OUTLINE, 4)),
        np.zeros((MAX_OUTLINE, CANDIDATE_WIDTH)),
    )


@kernel
def _calc_cosine(normals: Array, face: int, x: float, y: float, z: float) -> float:
    return float(normals[face, 0] * x + normals[face, 1] * y + normals[face, 2] * z)


@kernel
def _find_face(shapes: ConvexShapes, shape: int, x: float, y: float, z: float) -> tuple[int, float]:
    """Return the face of a core whose normal is nearest to (x, y, z), and the cosine between them."""
    best = -2.0
    index = shapes.face_start[shape]
    normals = shapes.face_normals
    for face in range(shapes.face_start[shape], shapes.face_start[shape + 1]):
        cosine = _calc_cosine(normals, face, x, y, z)
        if cosine > best:
            best = cosine
            index = face
    return index, best


@kernel
def _clip(
    outline: Array, n_points: int, clipped: Array, nx: float, ny: float, nz: float, offset: float
) -> int:
    """Cut away the part of an outline outside the plane ``n p = offset``; return the number of its corners."""
    n_outside = 0
    for k in range(n_points):
        clipped[k, 3] = outline[k, 0] * nx + outline[k, 1] * ny + outline[k, 2] * nz - offset
        n_outside += clipped[k, 3] > 0.0
    if n_outside == 0 or n_outside == n_points:
        return n_points - n_outside
    n_kept = 0
    for k in range(n_points):
        follower = k + 1 if k + 1 < n_points else 0
        d0, d1 = clipped[k, 3], clipped[follower, 3]
        if d0 <= 0.0:
            for d in range(3):
                clipped[n_kept, d] = outline[k, d]
            n_kept += 1
        if (d0 < 0.0 < d1) or (d1 < 0.0 < d0):
            t = d0 / (d0 - d1)
            for d in range(3):
                clipped[n_kept, d] = outline[k, d] + t * (outline[follower, d] - outline[k, d])
            n_kept += 1
    for k in range(n_kept):
        for d in range(3):
            outline[k, d] = clipped[k, d]
    return n_kept


@kernel
def find_first_point(candidates: Array, n_candidates: int, known: Array, n_known: int, radius: float) -> int:
    """Mark the known candidates; return the deepest, a known one if it is nearly as deep.

    Args:
        candidates, n_candidates: corners with gaps; column KNOWN is set.
        known, n_known: (.., 3) points that carried load in the last step.
        radius: of the smaller body [m].
    """
    first = 0
    least = np.inf
    for k in range(n_candidates):
        nearest2 = np.inf
        for j in range(n_known):
            dx = candidates[k, 0] - known[j, 0]
            dy = candidates[k, 1] - known[j, 1]
            dz = candidates[k, 2] - known[j, 2]
            nearest2 = min(nearest2, dx * dx + dy * dy + dz * dz)
        candidates[k, KNOWN] = 1.0 if nearest2 < (KNOWN_DISTANCE * radius) ** 2 else 0.0
        gap = candidates[k, 3] - KNOWN_DEPTH * candidates[k, KNOWN]
        if gap < least:
            least = gap
            first = k
    return first


@kernel
def add_spread_points(
    candidates: Array, n_candidates: int, points: Array, n_points: int, min_distance: float
) -> int:
    """Add to the manifold `points` (m, 4) those candidates that are farthest from the points it has, up to m.

    Known candidates go before others that are not much farther. Returns the number of points.
    """
    while n_points < len(points):
        best = 0.0
        chosen = -1
        for k in range(n_candidates):
            nearest2 = np.inf
            for j in range(n_points):
                dx = candidates[k, 0] - points[j, 0]
                dy = candidates[k, 1] - points[j, 1]
                dz = candidates[k, 2] - points[j, 2]
                nearest2 = min(nearest2, dx * dx + dy * dy + dz * dz)
            factor = KNOWN_FACTOR if candidates[k, KNOWN] > 0.0 else 1.0
            if nearest2 > min_distance * min_distance / factor and factor * nearest2 > best:
                best = factor * nearest2
                chosen = k
        if chosen < 0:
            break
        for d in range(4):
            points[n_points, d] = candidates[chosen, d]
        n_points += 1
    return n_points


@kernel
def make_manifold(
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
    nx: float,
    ny: float,
    nz: float,
    max_gap: float,
    min_cosine: float,
    known: Array,
    n_known: int,
    points: Array,
    workspace: tuple[Array, Array, Array, Array],
) -> int:
    """Extend the nearest point of a pair to a manifold of at most as many points as `points` has rows.

    Args:
        shapes, shape_a, scale_a, r_a, shape_b, scale_b, r_b, px, py, pz: as for `calc_core_distance`.
        nx, ny, nz: unit normal from A to B.
        max_gap: points farther apart than this are left out [m].
        min_cosine: a face belongs to the contact if its normal is within this cosine of the pair's.
        known, n_known: (.., 3) points of the last step that carried load, from A's origin.
        points: (m, 4) positions (half way between the surfaces, from A's origin) and gaps; row 0 holds the
            nearest point on entry, the others are set.
        workspace: from `make_manifold_workspace`.

    Returns:
        the number of points, at least 1.
    """
    # The normal in either body's frame, outwards.
    ax, ay, az = rotate_back(r_a, nx, ny, nz)
    bx, by, bz = rotate_back(r_b, -nx, -ny, -nz)
    face_a, cosine_a = _find_face(shapes, shape_a, ax, ay, az)
    face_b, cosine_b = _find_face(shapes, shape_b, bx, by, bz)
    if max(cosine_a, cosine_b) < min_cosine:
        return 1
    corners, outline, clipped, candidates = workspace
    roundings = scale_a * shapes.rounding[shape_a] + scale_b * shapes.rounding[shape_b]
    # Reference and incident body; positions from A's origin.
    if cosine_a >= cosine_b:
        reference, incident, sign = face_a, face_b, 1.0
        ref_scale, ref_r, rx, ry, rz, lx, ly, lz = scale_a, r_a, 0.0, 0.0, 0.0, ax, ay, az
        inc_scale, inc_r, ix, iy, iz, mx, my, mz = scale_b, r_b, px, py, pz, bx, by, bz
        inc_rounding = scale_b * shapes.rounding[shape_b]
    else:
        reference, incident, sign = face_b, face_a, -1.0
        ref_scale, ref_r, rx, ry, rz, lx, ly, lz = scale_b, r_b, px, py, pz, bx, by, bz
        inc_scale, inc_r, ix, iy, iz, mx, my, mz = scale_a, r_a, 0.0, 0.0, 0.0, ax, ay, az
        inc_rounding = scale_a * shapes.rounding[shape_a]
    normals, near, sides = shapes.face_normals, shapes.near_faces, shapes.side_normals
    n_candidates = 0
    for j in range(shapes.near_start[incident], shapes.near_start[incident + 1]):
        if near[j] != incident and _calc_cosine(normals, near[j], mx, my, mz) < min_cosine:
            continue
        first = shapes.face_vertex_start[near[j]]
        n_corners = shapes.face_vertex_start[near[j] + 1] - first
        for k in range(n_corners):
            x, y, z = get_corner(shapes.vertices, shapes.face_vertices[first + k], inc_scale, inc_r)
            corners[k, 0], corners[k, 1], corners[k, 2] = rotate_back(
                ref_r, x + ix - rx, y + iy - ry, z + iz - rz
            )
        for i in range(shapes.near_start[reference], shapes.near_start[reference + 1]):
            if near[i] != reference and _calc_cosine(normals, near[i], lx, ly, lz) < min_cosine:
                continue
            # In the reference's frame. Gaps are measured along the pair's normal, to the reference's plane.
            fx, fy, fz = normals[near[i], 0], normals[near[i], 1], normals[near[i], 2]
            along = fx * lx + fy * ly + fz * lz
            level = ref_scale * shapes.face_offsets[near[i]] + roundings * along
            limit = level + max_gap * along
            least = np.inf
            for k in range(n_corners):
                x, y, z = corners[k, 0], corners[k, 1], corners[k, 2]
                outline[k, 0], outline[k, 1], outline[k, 2] = x, y, z
                least = min(least, x * fx + y * fy + z * fz)
            if least >= limit:
                continue
            n_outline = n_corners
            for k in range(shapes.face_vertex_start[near[i]], shapes.face_vertex_start[near[i] + 1]):
                n_outline = _clip(
                    outline, n_outline, clipped, sides[k, 0], sides[k, 1], sides[k, 2],
                    ref_scale * shapes.side_offsets[k],
                )  # fmt: skip
            for k in range(n_outline):
                x, y, z = outline[k, 0], outline[k, 1], outline[k, 2]
                height = x * fx + y * fy + z * fz
                if height < limit and n_candidates < len(candidates):
                    candidates[n_candidates, 0] = x
                    candidates[n_candidates, 1] = y
                    candidates[n_candidates, 2] = z
                    candidates[n_candidates, 3] = (height - level) / along
                    n_candidates += 1
    if n_candidates == 0:
        return 1
    for k in range(n_candidates):
        x, y, z = rotate(ref_r, candidates[k, 0], candidates[k, 1], candidates[k, 2])
        shift = -sign * (inc_rounding + 0.5 * candidates[k, 3])
        candidates[k, 0] = x + rx + shift * nx
        candidates[k, 1] = y + ry + shift * ny
        candidates[k, 2] = z + rz + shift * nz
    radius = min(scale_a * shapes.radius[shape_a], scale_b * shapes.radius[shape_b])
    chosen = find_first_point(candidates, n_candidates, known, n_known, radius)
    # Where a face or an edge carries, its corners do; the nearest point, which wanders over them, is dropped.
    if n_candidates >= 2 and candidates[chosen, 3] < points[0, 3] + 1e-3:
        for d in range(4):
            points[0, d] = candidates[chosen, d]
    spread = 0.2 * radius
    return add_spread_points(candidates, n_candidates, points, 1, spread)
