"""Which rocks of a resting pile touch each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    ProximityProperties,
    SceneGraph,
)
from pydrake.math import RigidTransform
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from drakerock.rocks.drake.drift import make_convex
from drakerock.rocks.drake.poses import make_pose
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState


def find_contacts(pile: PileState, shapes: tuple[RockShape, ...], gap: float) -> NDArray[np.int64]:
    """Return the pairs of rocks (m, 2) whose surfaces are nearer than `gap` [m] or overlap."""
    if len(pile) < 2:
        return np.zeros((0, 2), np.int64)
    radii = np.array([shape.radius for shape in shapes])[pile.shape] * pile.size
    pairs = cKDTree(pile.p_WRs).query_pairs(2.0 * radii.max() + gap, output_type="ndarray")
    distance = np.linalg.norm(pile.p_WRs[pairs[:, 0]] - pile.p_WRs[pairs[:, 1]], axis=1)
    pairs = pairs[distance <= radii[pairs[:, 0]] + radii[pairs[:, 1]] + gap]

    scene_graph = SceneGraph()
    source = scene_graph.RegisterSource("rocks")
    poses, geometries = {}, []
    for rock in range(len(pile)):
        frame = scene_graph.RegisterFrame(source, GeometryFrame(f"rock_{rock}"))
        shape = shapes[pile.shape[rock]]
        convex = make_convex(shape.vertices, shape.name, float(pile.size[rock]))
        geometry = GeometryInstance(RigidTransform(), convex, f"rock_{rock}")
        geometry.set_proximity_properties(ProximityProperties())
        geometries.append(scene_graph.RegisterGeometry(source, frame, geometry))
        poses[frame] = make_pose(pile.q_WRs[rock], pile.p_WRs[rock])
    context = scene_graph.CreateDefaultContext()
    port = scene_graph.get_source_pose_port(source)
    vector = FramePoseVector()
    for frame, pose in poses.items():
        vector.set_value(frame, pose)
    port.FixValue(context, vector)
    query = scene_graph.get_query_output_port().Eval(context)
    near = [
        query.ComputeSignedDistancePairClosestPoints(geometries[a], geometries[b]).distance < gap
        for a, b in pairs
    ]
    return pairs[np.array(near, bool)]


def find_loose(pile: PileState, shapes: tuple[RockShape, ...], gap: float) -> NDArray[np.bool_]:
    """Return which rocks (n,) are not connected to the pile through contacts (gap below `gap` [m]).

    The pile is the connected body of largest mass, and every body that holds a fixed rock.
    """
    n = len(pile)
    if n == 0:
        return np.zeros(0, bool)
    pairs = find_contacts(pile, shapes, gap)
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    mass = np.bincount(label, weights=pile.size**3, minlength=count)
    is_pile = np.zeros(count, bool)
    is_pile[np.argmax(mass)] = True
    is_pile[np.unique(label[pile.fixed])] = True
    return ~is_pile[label]
