"""Convex shapes as flat arrays: cores with a rounding, their faces and their edges.

A shape is the Minkowski sum of a polyhedral *core* and a ball. The core is the given convex hull with its
faces moved inwards by the ball's radius, so that flat faces stay where they are and only edges and corners are
rounded. Cores of touching rocks are apart, so that distance and normal are well conditioned.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Faces within 15 degrees of each other are near.
NEAR_COSINE = 0.966
# How far a corner moves inwards at most: a needle's tip would run away [roundings].
MAX_INSET = 4.0
# Planes that meet in a corner count as parallel below this singular value, as a share of the largest.
MIN_SINGULAR_VALUE = 1e-3
# Triangles whose planes differ by less are one face [size of the shape, 1 m at least].
SAME_PLANE = 1e-6
# Cores that are kept, for further engines of the same shapes.
CORES = 512


class ConvexShapes(NamedTuple):
    """All shapes of a simulation, at scale 1 (s shapes; lists of a shape are ranges ``start[k]:start[k + 1]``).

    Attributes:
        vertex_start: (s + 1,).
        vertices: (v, 3) corners of the cores in the shapes' frames.
        face_start: (s + 1,).
        face_normals: (f, 3) outward.
        face_vertex_start: (f + 1,).
        face_offsets: (f,) of the faces' planes, ``normal p = offset``.
        face_vertices: corners of each face, counter-clockwise seen from outside; indices into `vertices`.
        side_normals: (.., 3) per corner of a face, of the side from it to the next corner: unit, in the face's plane,
            outward.
        side_offsets: of the planes that stand on these sides, ``normal p = offset``.
        near_start: (f + 1,).
        near_faces: of each face, itself and the others of its shape within `NEAR_COSINE` of it, indices into
            `face_normals`.
        edge_start: (s + 1,).
        edge_vertices: (e, 2) indices into `vertices`.
        edge_faces: (e, 2) indices into `face_normals`.
        rounding: (s,) radius of the ball.
        radius: (s,) of the sphere about the frame's origin that holds core and ball.
    """

    vertex_start: IntArray
    vertices: Array
    face_start: IntArray
    face_normals: Array
    face_vertex_start: IntArray
    face_offsets: Array
    face_vertices: IntArray
    side_normals: Array
    side_offsets: Array
    near_start: IntArray
    near_faces: IntArray
    edge_start: IntArray
    edge_vertices: IntArray
    edge_faces: IntArray
    rounding: Array
    radius: Array


def make_convex_shapes(vertices: Sequence[Array], roundings: Sequence[float]) -> ConvexShapes:
    """Build the arrays of convex shapes.

    Args:
        vertices: per shape (k, 3) points; their convex hull is taken.
        roundings: per shape the ball's radius, in the units of the points; 0 keeps the hull as it is.

    Raises:
        ValueError: points that span no volume, or a rounding that leaves no core.
    """
    lists = [
        _make_core(np.ascontiguousarray(points, float).tobytes(), r)
        for points, r in zip(vertices, roundings, strict=True)
    ]
    vertex_start = _make_starts([len(core) for core, _, _ in lists])
    face_start = _make_starts([len(faces) for _, faces, _ in lists])
    face_lists = [face + vertex_start[k] for k, (_, faces, _) in enumerate(lists) for face in faces]
    near = [
        face_start[k] + np.flatnonzero(normals @ normal > NEAR_COSINE)
        for k, (_, _, normals) in enumerate(lists)
        for normal in normals
    ]
    edges = [_find_edges(faces) for _, faces, _ in lists]
    outlines = [
        (core[face], normal)
        for core, faces, normals in lists
        for face, normal in zip(faces, normals, strict=True)
    ]
    sides = [_calc_sides(outline, normal) for outline, normal in outlines]
    return ConvexShapes(
        vertex_start=vertex_start,
        vertices=_stack([core for core, _, _ in lists]),
        face_start=face_start,
        face_normals=_stack([normals for _, _, normals in lists]),
        face_vertex_start=_make_starts([len(face) for face in face_lists]),
        face_offsets=np.array([normal @ outline[0] for outline, normal in outlines], float),
        face_vertices=np.concatenate([*face_lists, np.zeros(0, np.int64)]),
        side_normals=_stack([side for side, _ in sides]),
        side_offsets=np.concatenate([*(offset for _, offset in sides), np.zeros(0)]),
        near_start=_make_starts([len(faces) for faces in near]),
        near_faces=np.concatenate([*near, np.zeros(0, np.int64)]),
        edge_start=_make_starts([len(edge) for edge in edges]),
        edge_vertices=_stack_int([edge[:, :2] + vertex_start[k] for k, edge in enumerate(edges)]),
        edge_faces=_stack_int([edge[:, 2:] + face_start[k] for k, edge in enumerate(edges)]),
        rounding=np.asarray(roundings, float).reshape(-1),
        radius=np.array(
            [
                np.linalg.norm(core, axis=1).max() + r
                for (core, _, _), r in zip(lists, roundings, strict=True)
            ],
            float,
        ).reshape(-1),
    )


@lru_cache(maxsize=CORES)
def _make_core(points: bytes, rounding: float) -> tuple[Array, list[IntArray], Array]:
    """Return the core's corners, its faces as lists of corners, and the faces' normals; none is to be changed.

    A loading makes several engines of the same shapes, a study thousands.
    """
    corners, faces, normals = _find_faces(np.frombuffer(points).reshape(-1, 3))
    if rounding == 0.0:
        return corners, faces, normals
    # Every corner moves inwards until the planes that meet there have moved by the rounding. Where more than
    # three meet this holds in the mean (least squares), so that no corner has to be split.
    core = corners.copy()
    for k, corner in enumerate(corners):
        planes = normals[[k in face for face in faces]]
        inset = np.linalg.lstsq(planes, np.full(len(planes), -rounding), rcond=MIN_SINGULAR_VALUE)[0]
        core[k] = corner + inset * min(1.0, MAX_INSET * rounding / np.linalg.norm(inset))
    offsets = np.array([normal @ corners[face[0]] for normal, face in zip(normals, faces, strict=True)])
    if not ((normals @ core.mean(axis=0)) < offsets - rounding).all():
        raise ValueError(f"a rounding of {rounding:g} leaves no core")
    return _find_faces(core)


def _find_faces(points: Array) -> tuple[Array, list[IntArray], Array]:
    """Return the corners of a convex hull, its faces as lists of corners, and the faces' normals."""
    size = float(np.ptp(points, axis=0).max())
    try:
        hull = ConvexHull(points)
    except Exception as error:  # qhull has its own exception type
        raise ValueError(f"the points span no volume: {error}") from None
    chosen = np.sort(hull.vertices)
    corners = points[chosen]
    index = {int(corner): k for k, corner in enumerate(chosen)}
    # Triangles of one plane make one face, so that its outline is known for clipping.
    groups: list[tuple[Array, set[int]]] = []
    for simplex, equation in zip(hull.simplices, hull.equations, strict=True):
        for equation_0, members in groups:
            if np.abs(equation_0 - equation).max() < SAME_PLANE * max(1.0, size):
                members.update(index[int(corner)] for corner in simplex)
                break
        else:
            groups.append((equation, {index[int(corner)] for corner in simplex}))
    normals = np.array([equation[:3] for equation, _ in groups])
    faces = [
        _order_outline(corners, np.array(sorted(members)), normal)
        for (_, members), normal in zip(groups, normals, strict=True)
    ]
    return corners, faces, normals


def _order_outline(points: Array, members: IntArray, normal: Array) -> IntArray:
    """Return the corners of one plane counter-clockwise about its normal."""
    arms = points[members] - points[members].mean(axis=0)
    first = arms[0] / np.linalg.norm(arms[0])
    second = np.cross(normal, first)
    return members[np.argsort(np.arctan2(arms @ second, arms @ first))]


def _calc_sides(outline: Array, normal: Array) -> tuple[Array, Array]:
    """Return normals and offsets of the planes that stand on the sides of a face."""
    sides = np.cross(np.roll(outline, -1, axis=0) - outline, normal)
    sides /= np.linalg.norm(sides, axis=1, keepdims=True)
    return sides, (sides * outline).sum(axis=1)


def _find_edges(faces: list[IntArray]) -> IntArray:
    """Return (e, 4): the corners of each edge and the two faces that meet there."""
    sides: dict[tuple[int, int], int] = {}
    for k, face in enumerate(faces):
        for a, b in zip(face, np.roll(face, -1), strict=True):
            sides[int(a), int(b)] = k
    return np.array(
        [[a, b, k, sides[b, a]] for (a, b), k in sides.items() if a < b and (b, a) in sides], np.int64
    ).reshape(-1, 4)


def _make_starts(lengths: list[int]) -> IntArray:
    return np.concatenate([[0], np.cumsum(np.array(lengths, np.int64))]).astype(np.int64)


def _stack(arrays: list[Array]) -> Array:
    return np.ascontiguousarray(np.concatenate([*arrays, np.zeros((0, 3))]))


def _stack_int(arrays: list[IntArray]) -> IntArray:
    return np.ascontiguousarray(np.concatenate([*arrays, np.zeros((0, 2), np.int64)]))
