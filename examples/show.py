"""What the examples share: a box of a plant, and a page of what Meshcat saw."""

from collections.abc import Sequence
from pathlib import Path

import pydrake.all as drake


def add_box(
    plant: drake.MultibodyPlant,
    body: drake.RigidBody,
    size: Sequence[float],
    p: Sequence[float],
    friction: float = 1.0,
) -> None:
    """Give a body a box of `size` with its centre at `p` [m], to touch and to see."""
    X_BG, shape, name = drake.RigidTransform(p), drake.Box(*size), f"box_{p}"
    surface = drake.ProximityProperties()
    # With Drake's default dissipation [s/m] bodies sink into each other.
    drake.AddContactMaterial(1.0, 1e8, drake.CoulombFriction(friction, friction), surface)
    plant.RegisterCollisionGeometry(body, X_BG, shape, name, surface)
    plant.RegisterVisualGeometry(body, X_BG, shape, name, [0.4, 0.5, 0.4, 1.0])


def simulate(builder: drake.DiagramBuilder, time: float, out: str) -> drake.Simulator:
    """Build the Diagram, run it for `time` [s] and write an HTML page of it to `out`, if that is given."""
    if out:
        scene_graph, meshcat = builder.GetSubsystemByName("scene_graph"), drake.Meshcat()
        drake.MeshcatVisualizer.AddToBuilder(builder, scene_graph, meshcat)
    simulator = drake.Simulator(builder.Build())
    if out:
        meshcat.StartRecording()
    simulator.AdvanceTo(time)
    if out:
        meshcat.PublishRecording()
        Path(out).parent.mkdir(parents=True, exist_ok=True)
        Path(out).write_text(meshcat.StaticHtml())
    return simulator
