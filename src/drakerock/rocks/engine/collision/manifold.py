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

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.collision.geometry import Core, get_corner, get_radius, get_rounding
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Record, Vector, kernel
from drakerock.rocks.engine.records import CANDIDATE
from drakerock.rocks.engine.vectors import (
    add,
    dot,
    get_vector,
    negate,
    rotate,
    rotate_back,
    scale,
    set_vector,
    subtract,
)

# Corners of an outline, and candidates, at most; others are left out.
MAX_OUTLINE = 96
# Points of a pair at most: a face rests on four.
MAX_POINTS = 4
# A corner is a known point of the last step if this near to it [radius of the smaller body].
KNOWN_DISTANCE = 0.03
# By how much a corner has to be deeper than a known one to be the first point instead [m].
KNOWN_DEPTH = 3e-4
# By how much farther, squared, it has to be from the points chosen already.
KNOWN_FACTOR = 2.0
# Points of a pair are at least this far from each other [radius of the smaller body].
SPREAD = 0.2
# The nearest point gives way to a corner that is farther apart by less than this [m].
CORNER_GAP = 1e-3


class ManifoldWorkspace(NamedTuple):
    """Scratch memory, all of MAX_OUTLINE rows: a face's corners, what is left of it, what is cut, candidates."""

    corners: NDArray[np.float64]
    outline: NDArray[np.float64]
    clipped: NDArray[np.float64]
    candidates: Array


def make_manifold_workspace() -> ManifoldWorkspace:
    """Return scratch memory for `make_manifold`."""
    return ManifoldWorkspace(
        np.zeros((MAX_OUTLINE, 3)),
        np.zeros((MAX_OUTLINE, 3)),
        np.zeros((MAX_OUTLINE, 4)),
        np.zeros(MAX_OUTLINE, CANDIDATE),
    )


class _Side(NamedTuple):
    """One of a pair's bodies: its face in contact, its core, where it is from A's origin, its normal in its frame."""

    face: int
    core: Core
    position: Vector
    normal: Vector


@kernel
def _calc_cosine(shapes: ConvexShapes, face: int, direction: Vector) -> float:
    return float(dot(get_vector(shapes.face_normals[face]), direction))


@kernel
def _find_face(shapes: ConvexShapes, shape: int, direction: Vector) -> tuple[int, float]:
    """Return the face of a core whose normal is nearest to a direction, and the cosine between them."""
    best = -2.0
    index = shapes.face_start[shape]
    for face in range(shapes.face_start[shape], shapes.face_start[shape + 1]):
        cosine = _calc_cosine(shapes, face, direction)
        if cosine > best:
            best = cosine
            index = face
    return index, best


@kernel
def _clip(n_points: int, normal: Vector, offset: float, outline: Array, clipped: Array) -> int:
    """Cut away the part of an outline outside the plane ``n p = offset``; return the number of its corners."""
    n_outside = 0
    for k in range(n_points):
        clipped[k, 3] = dot(get_vector(outline[k]), normal) - offset
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
def _find_nearest(point: Array, others: Array, n_others: int) -> float:
    """Return the square of the distance from a point to the nearest of others [m^2]."""
    nearest2 = np.inf
    for j in range(n_others):
        d = subtract(get_vector(point), get_vector(others[j]))
        nearest2 = min(nearest2, dot(d, d))
    return nearest2


@kernel
def add_candidate(point: Vector, gap: float, n_candidates: int, candidates: Array) -> int:
    """Add a corner to the candidates, if there is room; return their number."""
    if n_candidates < len(candidates):
        candidate = candidates[n_candidates]
        set_vector(point, candidate.point)
        candidate.gap, candidate.known = gap, 0.0
        n_candidates += 1
    return n_candidates


@kernel
def set_point(candidate: Record, point: Array) -> None:
    """Set a manifold's point (4,) to a candidate: position and gap."""
    set_vector(get_vector(candidate.point), point)
    point[3] = candidate.gap


@kernel
def find_first_point(n_candidates: int, known: Array, n_known: int, radius: float, candidates: Array) -> int:
    """Mark the known candidates; return the deepest, a known one if it is nearly as deep.

    Reads:
        n_candidates: number of candidates.
        known, n_known: (.., 3) points that carried load in the last step.
        radius: of the smaller body [m].
    Writes:
        candidates: (n,) records `CANDIDATE`; whether they are known.
    """
    first = 0
    least = np.inf
    for k in range(n_candidates):
        candidate = candidates[k]
        nearest2 = _find_nearest(candidate.point, known, n_known)
        candidate.known = 1.0 if nearest2 < (KNOWN_DISTANCE * radius) ** 2 else 0.0
        gap = candidate.gap - KNOWN_DEPTH * candidate.known
        if gap < least:
            least = gap
            first = k
    return first


@kernel
def add_spread_points(
    candidates: Array, n_candidates: int, n_points: int, min_distance: float, points: Array
) -> int:
    """Add those candidates to a manifold that are farthest from the points it has, up to its room.

    Known candidates go before others that are not much farther.

    Reads:
        candidates, n_candidates: records `CANDIDATE`.
        n_points: number of points so far.
        min_distance: between points [m].
    Writes:
        points: (m, 4) positions and gaps.

    Returns:
        the number of points.
    """
    while n_points < len(points):
        best = 0.0
        chosen = -1
        for k in range(n_candidates):
            nearest2 = _find_nearest(candidates[k].point, points, n_points)
            factor = KNOWN_FACTOR if candidates[k].known > 0.0 else 1.0
            if nearest2 > min_distance * min_distance / factor and factor * nearest2 > best:
                best = factor * nearest2
                chosen = k
        if chosen < 0:
            break
        set_point(candidates[chosen], points[n_points])
        n_points += 1
    return n_points


@kernel
def _add_face_pair(
    shapes: ConvexShapes,
    reference: _Side,
    face: int,
    n_corners: int,
    roundings: float,
    max_gap: float,
    n_candidates: int,
    workspace: ManifoldWorkspace,
) -> int:
    """Clip the incident face's corners against a face of the reference; add what remains to the candidates.

    All in the reference's frame. Gaps are measured along the pair's normal, to the face's plane.
    """
    corners, outline, clipped, candidates = workspace
    normal = get_vector(shapes.face_normals[face])
    along = dot(normal, reference.normal)
    level = reference.core.scale * shapes.face_offsets[face] + roundings * along
    limit = level + max_gap * along
    least = np.inf
    for k in range(n_corners):
        corner = get_vector(corners[k])
        set_vector(corner, outline[k])
        least = min(least, dot(corner, normal))
    if least >= limit:
        return n_candidates
    n_outline = n_corners
    for k in range(shapes.face_vertex_start[face], shapes.face_vertex_start[face + 1]):
        side, offset = get_vector(shapes.side_normals[k]), reference.core.scale * shapes.side_offsets[k]
        n_outline = _clip(n_outline, side, offset, outline, clipped)
    for k in range(n_outline):
        corner = get_vector(outline[k])
        height = dot(corner, normal)
        if height < limit:
            n_candidates = add_candidate(corner, (height - level) / along, n_candidates, candidates)
    return n_candidates


@kernel
def _collect_candidates(
    shapes: ConvexShapes,
    reference: _Side,
    incident: _Side,
    max_gap: float,
    min_cosine: float,
    workspace: ManifoldWorkspace,
) -> int:
    """Clip all faces near the incident one against all near the reference's; return the number of candidates."""
    near, corners = shapes.near_faces, workspace.corners
    roundings = get_rounding(shapes, reference.core) + get_rounding(shapes, incident.core)
    n_candidates = 0
    for j in range(shapes.near_start[incident.face], shapes.near_start[incident.face + 1]):
        if near[j] != incident.face and _calc_cosine(shapes, near[j], incident.normal) < min_cosine:
            continue
        first = shapes.face_vertex_start[near[j]]
        n_corners = shapes.face_vertex_start[near[j] + 1] - first
        for k in range(n_corners):
            corner = get_corner(shapes, shapes.face_vertices[first + k], incident.core)
            corner = subtract(add(corner, incident.position), reference.position)
            set_vector(rotate_back(reference.core.rotation, corner), corners[k])
        for i in range(shapes.near_start[reference.face], shapes.near_start[reference.face + 1]):
            if near[i] != reference.face and _calc_cosine(shapes, near[i], reference.normal) < min_cosine:
                continue
            n_candidates = _add_face_pair(
                shapes, reference, near[i], n_corners, roundings, max_gap, n_candidates, workspace
            )
    return n_candidates


@kernel
def make_manifold(
    shapes: ConvexShapes,
    a: Core,
    b: Core,
    p: Vector,
    normal: Vector,
    max_gap: float,
    min_cosine: float,
    known: Array,
    n_known: int,
    points: Array,
    workspace: ManifoldWorkspace,
) -> int:
    """Extend the nearest point of a pair to a manifold of at most as many points as `points` has rows.

    Reads:
        shapes, a, b, p: as for `calc_core_distance`.
        normal: unit, from A to B.
        max_gap: points farther apart than this are left out [m].
        min_cosine: a face belongs to the contact if its normal is within this cosine of the pair's.
        known, n_known: (.., 3) points of the last step that carried load, from A's origin.
    Writes:
        points: (m, 4) positions (half way between the surfaces, from A's origin) and gaps; row 0 holds the
            nearest point on entry, the others are set.
        workspace: scratch.

    Returns:
        the number of points, at least 1.
    """
    # The normal in either body's frame, outwards.
    normal_a, normal_b = rotate_back(a.rotation, normal), rotate_back(b.rotation, negate(normal))
    face_a, cosine_a = _find_face(shapes, a.shape, normal_a)
    face_b, cosine_b = _find_face(shapes, b.shape, normal_b)
    if max(cosine_a, cosine_b) < min_cosine:
        return 1
    candidates = workspace.candidates
    side_a, side_b = _Side(face_a, a, (0.0, 0.0, 0.0), normal_a), _Side(face_b, b, p, normal_b)
    if cosine_a >= cosine_b:
        reference, incident, sign = side_a, side_b, 1.0
    else:
        reference, incident, sign = side_b, side_a, -1.0
    n_candidates = _collect_candidates(shapes, reference, incident, max_gap, min_cosine, workspace)
    if n_candidates == 0:
        return 1
    rounding = get_rounding(shapes, incident.core)
    for k in range(n_candidates):
        point = candidates[k].point
        place = add(rotate(reference.core.rotation, get_vector(point)), reference.position)
        shift = -sign * (rounding + 0.5 * candidates[k].gap)
        set_vector(add(place, scale(shift, normal)), point)
    radius = min(get_radius(shapes, a), get_radius(shapes, b))
    chosen = find_first_point(n_candidates, known, n_known, radius, candidates)
    # Where a face or an edge carries, its corners do; the nearest point, which wanders over them, is dropped.
    if n_candidates >= 2 and candidates[chosen].gap < points[0, 3] + CORNER_GAP:
        set_point(candidates[chosen], points[0])
    return add_spread_points(candidates, n_candidates, 1, SPREAD * radius, points)
