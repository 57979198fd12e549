"""Rocks before an LHD: `AddRocks` with what is particular to the machine."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from drakerock.lhd.geometry import collision_pieces, find_pads
from drakerock.lhd.model import Machine
from drakerock.rocks.config import RocksConfig, SiteConfig
from drakerock.rocks.drake.add_rocks import AddRocks
from drakerock.rocks.drake.interface import RockSystem
from drakerock.rocks.drake.plant_engine import RockBodies
from drakerock.rocks.drake.plant_view import WakeBox
from drakerock.rocks.engine.config import DynamicsConfig, RestConfig
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.site import calc_bounds
from drakerock.rocks.state import PileState


def add_lhd_rocks(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    machine: Machine,
    pile: PileState,
    rocks: RocksConfig,
    dynamics: DynamicsConfig,
    site: SiteConfig,
    *,
    shapes: tuple[RockShape, ...] | None = None,
    bodies: RockBodies | None = None,
    visible: bool = False,
) -> RockSystem:
    """Add rocks to a Diagram with an LHD in a drift, and connect them (after the machine's motors).

    The bucket keeps rocks awake as the method's refinement sensor does; its wear pads touch the floor only.

    Args:
        builder: of the Diagram that holds `plant` and `scene_graph`.
        plant, scene_graph: finalized, with machine and drift.
        machine: the machine in it.
        pile: the rocks.
        rocks, dynamics, site: what they are, how they move, where they are lost.
        shapes: the rock shapes, if not those of `rocks.shapes`.
        bodies: the rocks as the plant's own bodies, if `AddRockBodies` made them.
        visible: show rocks to `scene_graph`.

    Raises:
        InputError: see `AddRocks`.
    """
    return AddRocks(
        builder,
        plant,
        scene_graph,
        pile,
        rocks,
        engine=bodies or dynamics.nonsmooth,
        shapes=shapes,
        bounds=calc_bounds(site),
        wake_boxes=[make_wake_box(plant, scene_graph, machine, dynamics.nonsmooth.rest)],
        ignored=find_pads(plant, scene_graph, machine),
        stiction_tolerance=dynamics.stiction_tolerance,
        visible=visible,
    )


def make_wake_box(
    plant: MultibodyPlant, scene_graph: SceneGraph, machine: Machine, rest: RestConfig
) -> WakeBox:
    """Return the method's refinement sensor: in front of the bucket, and a margin around it."""
    pieces = collision_pieces(plant, scene_graph, machine)["bucket"]
    corners = np.vstack([piece.vertices for piece in pieces])
    lower, upper = corners.min(axis=0) - rest.sensor_margin, corners.max(axis=0) + rest.sensor_margin
    upper[0] = corners[:, 0].max() + rest.sensor_length
    return WakeBox(plant.GetBodyByName("bucket", machine.instance).index(), lower, upper)
