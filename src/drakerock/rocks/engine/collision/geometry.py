"""Small vector helpers of the kernels: rotations as 9 numbers by rows, supports of convex shapes."""

from __future__ import annotations

import math

import numpy as np

from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Rotation, Vector, kernel


@kernel
def get_rotation(rotations: Array, k: int) -> Rotation:
    """Return rotation `k` of (n, 3, 3) as 9 numbers by rows."""
    return (
        rotations[k, 0, 0],
        rotations[k, 0, 1],
        rotations[k, 0, 2],
        rotations[k, 1, 0],
        rotations[k, 1, 1],
        rotations[k, 1, 2],
        rotations[k, 2, 0],
        rotations[k, 2, 1],
        rotations[k, 2, 2],
    )


@kernel
def rotate(r: Rotation, x: float, y: float, z: float) -> Vector:
    """Return R (x, y, z)."""
    return r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z


@kernel
def rotate_back(r: Rotation, x: float, y: float, z: float) -> Vector:
    """Return R^T (x, y, z)."""
    return r[0] * x + r[3] * y + r[6] * z, r[1] * x + r[4] * y + r[7] * z, r[2] * x + r[5] * y + r[8] * z


@kernel
def make_tangents(nx: float, ny: float, nz: float) -> tuple[float, float, float, float, float, float]:
    """Return two unit vectors that complete the unit vector (nx, ny, nz) to a right-handed frame."""
    if abs(nx) > 0.57:
        scale = 1.0 / math.sqrt(nx * nx + ny * ny)
        tx, ty, tz = -ny * scale, nx * scale, 0.0
    else:
        scale = 1.0 / math.sqrt(ny * ny + nz * nz)
        tx, ty, tz = 0.0, -nz * scale, ny * scale
    return tx, ty, tz, ny * tz - nz * ty, nz * tx - nx * tz, nx * ty - ny * tx


@kernel
def find_support(vertices: Array, first: int, last: int, x: float, y: float, z: float) -> tuple[int, float]:
    """Return the corner among ``vertices[first:last]`` farthest along (x, y, z), and how far it is."""
    best = -np.inf
    index = first
    for k in range(first, last):
        value = vertices[k, 0] * x + vertices[k, 1] * y + vertices[k, 2] * z
        if value > best:
            best = value
            index = k
    return index, best


@kernel
def calc_support_distance(
    shapes: ConvexShapes, shape: int, scale: float, r: Rotation, x: float, y: float, z: float
) -> float:
    """Return how far a core reaches along (x, y, z) (in W), measured from its frame's origin."""
    lx, ly, lz = rotate_back(r, x, y, z)
    _, reach = find_support(
        shapes.vertices, shapes.vertex_start[shape], shapes.vertex_start[shape + 1], lx, ly, lz
    )
    return scale * reach


@kernel
def get_corner(vertices: Array, corner: int, scale: float, r: Rotation) -> Vector:
    """Return a corner of a core in W's axes, from the frame's origin."""
    return rotate(
        r,
        scale * vertices[corner, 0],
        scale * vertices[corner, 1],
        scale * vertices[corner, 2],
    )
