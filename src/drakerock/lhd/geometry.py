"""The machine's shapes as plain arrays: the bucket's inside, and convex pieces for engines outside Drake."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import (
    Box,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    Mesh,
    SceneGraph,
    SceneGraphInspector,
    Shape,
    Sphere,
)
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant

from drakerock.errors import InputError
from drakerock.lhd import names
from drakerock.lhd.model import Machine

Array = np.ndarray

# Of what has no ``drake:point_contact_stiffness`` [N/m].
POINT_STIFFNESS = 1e8


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


@dataclass(frozen=True)
class CollisionPiece:
    """A convex piece of a body.

    Attributes:
        vertices: (k, 3) in the body's frame [m].
        mu: its Coulomb friction.
        stiffness: of its point contacts, in series with the other body's [N/m].
    """

    vertices: Array
    mu: float
    stiffness: float


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


def collision_pieces(
    plant: MultibodyPlant, scene_graph: SceneGraph, machine: Machine
) -> dict[str, list[CollisionPiece]]:
    """Return the machine's contact shapes as convex pieces by body name, without the bucket's wear pads.

    Round shapes become polyhedra: a tyre is 24 facets around and 5 rings across.
    """
    inspector = scene_graph.model_inspector()
    pieces: dict[str, list[CollisionPiece]] = {}
    for index in plant.GetBodyIndices(machine.instance):
        body = plant.get_body(index)
        for geometry in plant.GetCollisionGeometriesForBody(body):
            if inspector.GetName(geometry).split("::")[-1].startswith(names.PAD):
                continue
            X_BG = inspector.GetPoseInFrame(geometry)
            vertices = _make_vertices(inspector, geometry)
            piece = CollisionPiece(
                (X_BG.rotation().matrix() @ vertices.T).T + X_BG.translation(),
                *get_material(inspector, geometry),
            )
            pieces.setdefault(body.name(), []).append(piece)
    return pieces


def get_material(inspector: SceneGraphInspector, geometry: GeometryId) -> tuple[float, float]:
    """Return a collision geometry's dynamic friction and the stiffness of its point contacts [N/m]."""
    properties = inspector.GetProximityProperties(geometry)
    friction: CoulombFriction = properties.GetProperty("material", "coulomb_friction")  # type: ignore[assignment]
    stiffness = properties.GetPropertyOrDefault("material", "point_contact_stiffness", POINT_STIFFNESS)
    return float(friction.dynamic_friction()), float(stiffness)


def _make_vertices(inspector: SceneGraphInspector, geometry: GeometryId) -> Array:
    shape: Shape = inspector.GetShape(geometry)
    if isinstance(shape, Convex | Mesh):
        hull = inspector.GetConvexHull(geometry)
        return np.array([hull.vertex(i) for i in range(hull.num_vertices())])
    if isinstance(shape, Box):
        return np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T * shape.size() / 2
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    if isinstance(shape, Cylinder):
        ring = np.column_stack([np.cos(around), np.sin(around), np.zeros(24)]) * shape.radius()
        return np.vstack([ring + np.array([0, 0, side * shape.length() / 2]) for side in (-1, 1)])
    if isinstance(shape, Ellipsoid | Sphere):
        radii = [shape.radius()] * 3 if isinstance(shape, Sphere) else [shape.a(), shape.b(), shape.c()]
        return np.vstack(
            [
                np.column_stack(
                    [np.cos(around) * np.sqrt(1 - s * s), np.full(24, s), np.sin(around) * np.sqrt(1 - s * s)]
                )
                for s in (-0.9, -0.5, 0.0, 0.5, 0.9)
            ]
        ) * np.array(radii)
    raise InputError(
        f"collision shape {type(shape).__name__} of {inspector.GetName(geometry)} is not supported"
    )
