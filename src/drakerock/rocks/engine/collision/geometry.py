"""Convex cores in their place: corners and supports."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Rotation, Vector, kernel
from drakerock.rocks.engine.vectors import dot, get_vector, rotate, rotate_back, scale


class Core(NamedTuple):
    """A core in a pair (see `shapes`).

    Attributes:
        shape: number of its shape.
        scale: on the shape's points.
        rotation: from its frame to W, by rows.
    """

    shape: int
    scale: float
    rotation: Rotation


@kernel
def find_support(vertices: Array, first: int, last: int, direction: Vector) -> tuple[int, float]:
    """Return the corner among ``vertices[first:last]`` farthest along a direction, and how far it is."""
    best = -np.inf
    index = first
    for k in range(first, last):
        value = dot(get_vector(vertices[k]), direction)
        if value > best:
            best = value
            index = k
    return index, best


@kernel
def find_support_corner(shapes: ConvexShapes, core: Core, direction: Vector) -> tuple[int, float]:
    """Return the corner of a core farthest along a direction in W, and how far it is at scale 1."""
    first, last = shapes.vertex_start[core.shape], shapes.vertex_start[core.shape + 1]
    return find_support(shapes.vertices, first, last, rotate_back(core.rotation, direction))


@kernel
def calc_support_distance(shapes: ConvexShapes, core: Core, direction: Vector) -> float:
    """Return how far a core reaches along a direction in W, measured from its frame's origin."""
    _, reach = find_support_corner(shapes, core, direction)
    return core.scale * reach


@kernel
def get_corner(shapes: ConvexShapes, corner: int, core: Core) -> Vector:
    """Return a corner of a core in W's axes, from the frame's origin."""
    return rotate(core.rotation, scale(core.scale, get_vector(shapes.vertices[corner])))


@kernel
def get_rounding(shapes: ConvexShapes, core: Core) -> float:
    """Return the radius of the ball about a core [m]."""
    return core.scale * shapes.rounding[core.shape]


@kernel
def get_radius(shapes: ConvexShapes, core: Core) -> float:
    """Return the radius of the sphere that holds a core and its rounding [m]."""
    return core.scale * shapes.radius[core.shape]
