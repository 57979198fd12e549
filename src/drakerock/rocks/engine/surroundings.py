"""What rocks meet that does not move: half-spaces and convex pieces, and the box outside of which a rock is lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class HalfSpace:
    """Solid where ``normal @ p < offset``.

    Attributes:
        normal: (3,) unit vector out of the solid, in W.
        offset: ``normal @ p`` of the surface [m].
        friction: its coefficient; a pair has 2 a b / (a + b).
    """

    normal: Array
    offset: float
    friction: float


@dataclass(frozen=True, eq=False)
class StaticPiece:
    """A convex solid.

    Attributes:
        vertices: (k, 3) corners in W [m].
        friction: its coefficient; a pair has 2 a b / (a + b).
    """

    vertices: Array
    friction: float


@dataclass(frozen=True, eq=False)
class Surroundings:
    """All that is at rest in W.

    Attributes:
        half_spaces, pieces: what is solid.
        lower, upper: (3,) corners of the box outside of which a rock is lost [m].
    """

    half_spaces: tuple[HalfSpace, ...]
    pieces: tuple[StaticPiece, ...]
    lower: Array
    upper: Array

    @property
    def half_space_array(self) -> Array:
        """The half-spaces as rows (m, 4): normal, offset."""
        rows = [[*plane.normal, plane.offset] for plane in self.half_spaces]
        return np.array(rows, float).reshape(-1, 4)


def is_half_space_within(normals: Array, offsets: Array, face: int, lower: Array, upper: Array) -> bool:
    """Return whether a convex solid is, inside a box, nothing but the half-space below one of its faces.

    Args:
        normals, offsets: (f, 3), (f,) of its faces, ``normal @ p < offset`` inside.
        face: the face.
        lower, upper: (3,) corners of the box [m].
    """
    corners = np.array(np.meshgrid(*zip(lower, upper, strict=True))).reshape(3, 8).T
    others = np.arange(len(normals)) != face
    return bool(np.all(corners @ normals[others].T <= offsets[others]))
