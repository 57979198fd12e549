"""Rocks in SceneGraph: seen by Meshcat and cameras, and where asked for by proximity queries."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.geometry import (
    FrameId,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    IllustrationProperties,
    PerceptionProperties,
    ProximityProperties,
    RenderLabel,
    SceneGraph,
    SourceId,
)
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem, ValueProducer

from drakerock.memory import weak
from drakerock.rocks.drake.drift import make_convex, make_looks
from drakerock.rocks.drake.interface import RockSystem
from drakerock.rocks.drake.poses import make_poses
from drakerock.rocks.state import PileState, make_empty_pile

ROCK_COLOR = (0.55, 0.47, 0.38, 1.0)
FIXED_COLOR = (0.45, 0.45, 0.45, 1.0)
FIRST_ROCK_LABEL = 2000
"""Render label of the first rock for cameras, the next is the second's; a plant's bodies have their index."""


def make_illustration(fixed: bool) -> IllustrationProperties:
    """Return how a rock looks in Meshcat."""
    return make_looks(IllustrationProperties, FIXED_COLOR if fixed else ROCK_COLOR)


def make_perception(rock: int, fixed: bool) -> PerceptionProperties:
    """Return how a rock looks to cameras."""
    label = min(FIRST_ROCK_LABEL + rock, int(RenderLabel.kMaxUnreserved))
    return make_looks(PerceptionProperties, FIXED_COLOR if fixed else ROCK_COLOR, label)


class RockPoses(LeafSystem):
    """Tells SceneGraph where the rocks are, when SceneGraph is asked for them and at no other time.

    Input port ``pile``: abstract, a `PileState`.
    Output port ``geometry_pose``: FramePoseVector of the rocks that are not fixed.
    """

    def __init__(self, pile: PileState, frames: dict[int, FrameId]) -> None:
        """Make it for the frames of rocks."""
        super().__init__()
        self.set_name("rock_poses")
        self._rocks = np.array(list(frames), np.int64)
        self._frames = list(frames.values())
        self._pile = self.DeclareAbstractInputPort("pile", Value[object](make_empty_pile()))
        n = len(frames)
        # What the output holds, so that only what has moved is written anew.
        self._shown = self.DeclareCacheEntry(
            "shown",
            ValueProducer(allocate=lambda: Value[object](np.full((n, 7), np.nan)), calc=lambda _, __: None),
            {self.nothing_ticket()},
        ).cache_index()
        self.DeclareAbstractOutputPort(
            "geometry_pose", lambda: Value(FramePoseVector()), weak(self._calc), {self._pile.ticket()}
        )

    def _calc(self, context: Context, output: Value) -> None:
        pile: PileState = self._pile.Eval(context)
        shown: NDArray[np.float64] = self.get_cache_entry(self._shown).Eval(context)
        poses = np.hstack([pile.q_WRs, pile.p_WRs])[self._rocks]
        vector = output.get_mutable_value()
        stale = (
            np.flatnonzero((poses != shown).any(axis=1))
            if vector.size() == len(poses)
            else np.arange(len(poses))
        )
        for k, X_WR in zip(stale, make_poses(poses[stale, :4], poses[stale, 4:]), strict=True):
            vector.set_value(self._frames[k], X_WR)
        shown[:] = poses


def register_rocks(
    scene_graph: SceneGraph, rocks: RockSystem, proximity: ProximityProperties | None = None
) -> tuple[SourceId, dict[int, FrameId]]:
    """Register the rocks with SceneGraph: one frame a rock, fixed ones with the world's.

    Args:
        scene_graph: where.
        rocks: which.
        proximity: properties of their proximity geometry; None: they have none.

    Returns:
        The source, and the frames by rock.
    """
    pile, shapes = rocks.pile, rocks.shapes
    source = scene_graph.RegisterSource("rocks")
    convex = {
        (int(k), float(s)): make_convex(shapes[int(k)].vertices, shapes[int(k)].name, float(s))
        for k, s in {(int(k), float(s)) for k, s in zip(pile.shape, pile.size, strict=True)}
    }
    illustration = {fixed: make_illustration(fixed) for fixed in (False, True)}
    X_WRs = make_poses(pile.q_WRs, pile.p_WRs)
    frames: dict[int, FrameId] = {}
    for rock in range(len(pile)):
        fixed, name = bool(pile.fixed[rock]), f"rock_{rock}"
        X = X_WRs[rock] if fixed else RigidTransform()
        instance = GeometryInstance(X, convex[int(pile.shape[rock]), float(pile.size[rock])], name)
        instance.set_illustration_properties(illustration[fixed])
        instance.set_perception_properties(make_perception(rock, fixed))
        if proximity is not None:
            instance.set_proximity_properties(proximity)
        if fixed:
            scene_graph.RegisterAnchoredGeometry(source, instance)
        else:
            frames[rock] = scene_graph.RegisterFrame(source, GeometryFrame(name))
            scene_graph.RegisterGeometry(source, frames[rock], instance)
    return source, frames


def add_rock_poses(
    builder: DiagramBuilder, scene_graph: SceneGraph, rocks: RockSystem, proximity: ProximityProperties | None
) -> RockPoses:
    """Register the rocks with SceneGraph and connect their poses."""
    source, frames = register_rocks(scene_graph, rocks, proximity)
    poses = builder.AddSystem(RockPoses(rocks.pile, frames))
    builder.Connect(rocks.GetOutputPort("pile"), poses.GetInputPort("pile"))
    builder.Connect(poses.GetOutputPort("geometry_pose"), scene_graph.get_source_pose_port(source))
    return poses
