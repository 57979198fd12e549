"""The machine's shapes as plain arrays: the bucket's inside, and convex pieces for engines outside Drake."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import GeometryId, SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from drakerock.lhd import names
from drakerock.lhd.model import Machine
from drakerock.rocks.drake.geometry import ConvexPiece, read_body_pieces

Array = np.ndarray


@dataclass(frozen=True)
class BucketGeometry:
    """The inside of the bucket, in its frame B.

    Attributes:
        profile: (k, 2) x, z of the inside in side view [m], from the lip's edge to the top edge of the back;
            the line from last to first point is the strike line.
        load_region: (k + 2, 2) profile with the largest heap above the strike line [m]: what lies in it and
            within the inner width counts as load.
        inner_width: between the side plates [m].
        outer_width: over the side plates [m].
    """

    profile: Array
    load_region: Array
    inner_width: float
    outer_width: float


def make_bucket_geometry(plant: MultibodyPlant, scene_graph: SceneGraph, machine: Machine) -> BucketGeometry:
    """Read the bucket's geometry off the finalized plant."""
    corners = read_profile(plant, machine)
    profile = corners[:, [0, 2]]
    # Loose rock stands at about 45 degrees at most: a heap's height is half of the strike line's length.
    strike = profile[-1] - profile[0]
    up = np.array([strike[1], -strike[0]]) / 2
    pieces = collision_pieces(plant, scene_graph, machine)["bucket"]
    return BucketGeometry(
        profile=profile,
        load_region=np.vstack([profile, profile[-1] + up, profile[0] + up]),
        inner_width=float(2 * np.abs(corners[:, 1]).min()),
        outer_width=float(np.ptp(np.vstack([piece.vertices for piece in pieces])[:, 1])),
    )


def read_profile(plant: MultibodyPlant, machine: Machine) -> Array:
    """Return (k, 3): the corners of the bucket's inside in side view, in B [m], on the left side plate."""
    points: list[Array] = []
    while plant.HasFrameNamed(f"{names.PROFILE}{len(points)}", machine.instance):
        frame = plant.GetFrameByName(f"{names.PROFILE}{len(points)}", machine.instance)
        points.append(frame.GetFixedPoseInBodyFrame().translation())
    return np.array(points)


def calc_area(polygon: Array) -> float:
    """Return the area [m^2] of a simple polygon (k, 2)."""
    x, z = polygon.T
    return float(abs(np.dot(x, np.roll(z, -1)) - np.dot(z, np.roll(x, -1))) / 2)


def calc_heaped_capacity(bucket: BucketGeometry) -> float:
    """Return the heaped capacity [m^3] after SAE J742: struck volume, and a heap of slope 1:2 on top."""
    width, length = bucket.inner_width, float(np.linalg.norm(bucket.profile[-1] - bucket.profile[0]))
    short, long = sorted((width, length))
    heap = short**2 * (3 * long - short) / 24
    return calc_area(bucket.profile) * width + heap


def find_pads(plant: MultibodyPlant, scene_graph: SceneGraph, machine: Machine) -> tuple[GeometryId, ...]:
    """Return the bucket's wear pads: proximity geometries that touch the floor only."""
    inspector = scene_graph.model_inspector()
    return tuple(
        geometry
        for index in plant.GetBodyIndices(machine.instance)
        for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(index))
        if inspector.GetName(geometry).split("::")[-1].startswith(names.PAD)
    )


def collision_pieces(
    plant: MultibodyPlant, scene_graph: SceneGraph, machine: Machine
) -> dict[str, list[ConvexPiece]]:
    """Return the machine's contact shapes as convex pieces by body name, without the bucket's wear pads.

    Round shapes become polyhedra: a tyre is 24 facets around and 5 rings across.
    """
    pads = find_pads(plant, scene_graph, machine)
    bodies = [plant.get_body(index) for index in plant.GetBodyIndices(machine.instance)]
    pieces = read_body_pieces(plant, scene_graph, bodies, pads)
    return {body.name(): found for body, found in zip(bodies, pieces, strict=True) if found}
