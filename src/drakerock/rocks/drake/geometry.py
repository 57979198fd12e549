"""The proximity geometry of a plant as rocks meet it: half-spaces, convex pieces at rest, convex pieces of bodies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    HalfSpace,
    Mesh,
    SceneGraph,
    SceneGraphInspector,
    Shape,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody

from drakerock.errors import InputError
from drakerock.rocks.engine import surroundings
from drakerock.rocks.engine.engine import MachinePiece

Array = NDArray[np.float64]

# A mesh whose hull has so much more volume than the mesh itself is not convex.
CONVEXITY_TOLERANCE = 0.01
# Corners around a cylinder, an ellipsoid's rings, and where along its y axis these are [half axes].
AROUND = 24
RINGS = (-0.9, -0.5, 0.0, 0.5, 0.9)


@dataclass(frozen=True, eq=False)
class Material:
    """Of a proximity geometry.

    Attributes:
        friction: its dynamic Coulomb coefficient.
        stiffness: of its point contacts, in series with the other body's [N/m].
        dissipation: Hunt and Crossley's [s/m].
        relaxation_time: that SAP has in place of dissipation [s].
    """

    friction: float
    stiffness: float
    dissipation: float
    relaxation_time: float


@dataclass(frozen=True, eq=False)
class ConvexPiece:
    """A proximity geometry of a body as a convex solid.

    Attributes:
        vertices: (k, 3) in the body's frame [m].
        material: of its surface.
    """

    vertices: Array
    material: Material


@dataclass(frozen=True, eq=False)
class PlantGeometry:
    """What of a plant touches rocks.

    Attributes:
        surroundings: all that is welded to the world.
        bodies: the others with proximity geometry, in the plant's order.
        pieces: their convex pieces, numbered by their place in `bodies`.
    """

    surroundings: surroundings.Surroundings
    bodies: tuple[BodyIndex, ...]
    pieces: tuple[MachinePiece, ...]

    def calc_box(self, number: int) -> Array:
        """Return (2, 3): lower and upper corner of a body's pieces in its frame [m]; `number` in `bodies`."""
        corners = np.vstack([piece.vertices for piece in self.pieces if piece.body == number])
        return np.array([corners.min(axis=0), corners.max(axis=0)])


def read_plant_geometry(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    lower: Array,
    upper: Array,
    ignored: Sequence[GeometryId] = (),
) -> PlantGeometry:
    """Return the proximity geometry of all bodies of a finalized plant.

    Round shapes become polyhedra. A box at rest that is, inside the bounds, nothing but the half-space below one of its
    faces is met as that: a wall of slabs costs no more than one of planes.

    Args:
        plant, scene_graph: the finalized plant and where its geometry is.
        lower, upper: (3,) corners of the box outside of which a rock is lost [m].
        ignored: proximity geometries that rocks do not meet.

    Raises:
        InputError: a shape that is not supported, or a body without mass; the message names the body.
    """
    scene_context, context = scene_graph.CreateDefaultContext(), plant.CreateDefaultContext()
    # A context's geometry has SceneGraph's default material where it has none of its own; the model's has not.
    query = scene_graph.get_query_output_port().Eval(scene_context)
    inspector = query.inspector()
    static_bodies = {int(body.index()) for body in plant.GetBodiesWeldedTo(plant.world_body())}
    half_spaces: list[surroundings.HalfSpace] = []
    static: list[surroundings.StaticPiece] = []
    bodies: list[BodyIndex] = []
    pieces: list[MachinePiece] = []
    for index in map(BodyIndex, range(plant.num_bodies())):
        body = plant.get_body(index)
        geometries = [g for g in plant.GetCollisionGeometriesForBody(body) if g not in ignored]
        if int(index) in static_bodies:
            X_WB = body.EvalPoseInWorld(context)
            for geometry in geometries:
                found = _read_static(inspector, body, geometry, X_WB, lower, upper)
                if isinstance(found, surroundings.HalfSpace):
                    half_spaces.append(found)
                else:
                    static.append(found)
        elif geometries:
            _require_mass(plant, body)
            for piece in _read_pieces(inspector, body, geometries):
                pieces.append(
                    MachinePiece(
                        len(bodies), piece.vertices, piece.material.friction, piece.material.stiffness
                    )
                )
            bodies.append(index)
    return PlantGeometry(
        surroundings.Surroundings(tuple(half_spaces), tuple(static), lower, upper),
        tuple(bodies),
        tuple(pieces),
    )


def read_body_pieces(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    bodies: Sequence[RigidBody],
    ignored: Sequence[GeometryId] = (),
) -> list[list[ConvexPiece]]:
    """Return each body's proximity geometries as convex pieces in its frame; arguments and errors as above."""
    context = scene_graph.CreateDefaultContext()
    query = scene_graph.get_query_output_port().Eval(context)
    geometries = [
        [g for g in plant.GetCollisionGeometriesForBody(body) if g not in ignored] for body in bodies
    ]
    return [
        list(_read_pieces(query.inspector(), body, own)) for body, own in zip(bodies, geometries, strict=True)
    ]


def _read_pieces(
    inspector: SceneGraphInspector, body: RigidBody, geometries: Sequence[GeometryId]
) -> Iterator[ConvexPiece]:
    for geometry in geometries:
        vertices = _make_vertices(inspector, body, geometry)
        X_BG = inspector.GetPoseInFrame(geometry)
        yield ConvexPiece(_transform(X_BG, vertices), read_material(inspector, geometry))


def _read_static(
    inspector: SceneGraphInspector,
    body: RigidBody,
    geometry: GeometryId,
    X_WB: RigidTransform,
    lower: Array,
    upper: Array,
) -> surroundings.HalfSpace | surroundings.StaticPiece:
    X_WG = X_WB.multiply(inspector.GetPoseInFrame(geometry))
    friction = read_material(inspector, geometry).friction
    shape: Shape = inspector.GetShape(geometry)
    if isinstance(shape, HalfSpace):
        normal = X_WG.rotation().col(2)
        return surroundings.HalfSpace(normal, float(normal @ X_WG.translation()), friction)
    if isinstance(shape, Box):
        axes = X_WG.rotation().matrix().T
        normals = np.vstack([axes, -axes])
        offsets = normals @ X_WG.translation() + np.tile(shape.size() / 2, 2)
        for face in range(6):
            if surroundings.is_half_space_within(normals, offsets, face, lower, upper):
                return surroundings.HalfSpace(normals[face], float(offsets[face]), friction)
    return surroundings.StaticPiece(_transform(X_WG, _make_vertices(inspector, body, geometry)), friction)


def read_material(inspector: SceneGraphInspector, geometry: GeometryId) -> Material:
    """Return what a proximity geometry's surface is like; the inspector is of a context, which has all defaults."""
    properties = inspector.GetProximityProperties(geometry)
    friction: CoulombFriction = properties.GetProperty("material", "coulomb_friction")
    numbers = ("point_contact_stiffness", "hunt_crossley_dissipation", "relaxation_time")
    return Material(
        float(friction.dynamic_friction()),
        *(float(properties.GetProperty("material", name)) for name in numbers),
    )


def _require_mass(plant: MultibodyPlant, body: RigidBody) -> None:
    mass = sum(other.default_mass() for other in plant.GetBodiesWeldedTo(body))
    if not mass > 0.0:
        raise InputError(f"body '{body.scoped_name()}' touches rocks and has no mass: give it inertia")


def _transform(X: RigidTransform, p: Array) -> Array:
    return np.asarray((X.rotation().matrix() @ p.T).T + X.translation())


def _make_vertices(inspector: SceneGraphInspector, body: RigidBody, geometry: GeometryId) -> Array:
    """Return the corners (k, 3) of a shape in its own frame [m]."""
    shape: Shape = inspector.GetShape(geometry)
    if isinstance(shape, Mesh):
        _require_convex(inspector, body, geometry, shape)
    if isinstance(shape, Convex | Mesh):
        hull = inspector.GetConvexHull(geometry)
        return np.array([hull.vertex(i) for i in range(hull.num_vertices())])
    if isinstance(shape, Box):
        return np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T * shape.size() / 2
    if isinstance(shape, Sphere):
        return np.asarray(trimesh.creation.icosphere(subdivisions=2, radius=shape.radius()).vertices)
    if isinstance(shape, Capsule):
        count = [AROUND, AROUND // 2]
        capsule = trimesh.creation.capsule(shape.length(), shape.radius(), count=count)
        return np.asarray(capsule.convex_hull.vertices - [0.0, 0.0, capsule.bounds.mean(axis=0)[2]])
    around = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    if isinstance(shape, Cylinder):
        ring = np.column_stack([np.cos(around), np.sin(around), np.zeros(AROUND)]) * shape.radius()
        return np.vstack([ring + np.array([0, 0, side * shape.length() / 2]) for side in (-1, 1)])
    if isinstance(shape, Ellipsoid):
        rings = [
            np.column_stack([np.cos(around) * r, np.full(AROUND, s), np.sin(around) * r])
            for s, r in ((s, np.sqrt(1 - s * s)) for s in RINGS)
        ]
        return np.vstack(rings) * np.array([shape.a(), shape.b(), shape.c()])
    why = "a half-space cannot move" if isinstance(shape, HalfSpace) else "not a convex shape"
    raise InputError(
        f"body '{body.scoped_name()}': collision geometry '{inspector.GetName(geometry)}' is a "
        f"{type(shape).__name__}, which rocks cannot meet ({why}); use a box, sphere, capsule, cylinder, "
        "ellipsoid or convex mesh"
    )


def _require_convex(
    inspector: SceneGraphInspector, body: RigidBody, geometry: GeometryId, shape: Mesh
) -> None:
    if not shape.source().is_path():
        return
    mesh = trimesh.load_mesh(shape.source().path())
    hull = mesh.convex_hull
    if abs(mesh.volume) < (1.0 - CONVEXITY_TOLERANCE) * hull.volume:
        raise InputError(
            f"body '{body.scoped_name()}': collision mesh '{inspector.GetName(geometry)}' is not convex, its hull has "
            f"{hull.volume / max(abs(mesh.volume), 1e-12):.2f} times its volume; split it into convex pieces, or "
            "declare it convex (drake:declare_convex) to have its hull"
        )
