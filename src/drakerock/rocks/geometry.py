"""The rocks of a pile as one triangle mesh, and rays cast at it."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]


def make_pile_mesh(pile: PileState, shapes: tuple[RockShape, ...]) -> trimesh.Trimesh:
    """Return all rocks' surfaces in W as one mesh, in the order of the rocks."""
    vertices, triangles, offset = [], [], 0
    R_WRs = (
        Rotation.from_quat(pile.q_WRs, scalar_first=True).as_matrix() if len(pile) else np.zeros((0, 3, 3))
    )
    for rock in range(len(pile)):
        shape = shapes[pile.shape[rock]]
        vertices.append(pile.size[rock] * shape.vertices @ R_WRs[rock].T + pile.p_WRs[rock])
        triangles.append(shape.triangles + offset)
        offset += len(shape.vertices)
    if not vertices:
        return trimesh.Trimesh()
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(triangles), process=False)


def cast_rays(mesh: trimesh.Trimesh, origins: Array, directions: Array) -> Array:
    """Return the distance along each ray to the first surface (m,) [m]; inf where nothing is hit.

    Args:
        mesh: what the rays are cast at.
        origins: (m, 3) in W.
        directions: (m, 3) unit vectors in W.
    """
    distance = np.full(len(origins), np.inf)
    if len(mesh.faces) == 0 or len(origins) == 0:
        return distance
    points, rays, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    distance[rays] = np.einsum("ij,ij->i", points - origins[rays], directions[rays])
    return distance
