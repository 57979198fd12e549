"""The drift as world geometry of a plant, with all three roles."""

from __future__ import annotations

import logging

import numpy as np
from pydrake.geometry import (
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    Convex,
    GeometryInstance,
    HalfSpace,
    IllustrationProperties,
    PerceptionProperties,
    ProximityProperties,
    RenderLabel,
    Rgba,
    Shape,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant

from drakerock.rocks.engine.config import PlantEngineConfig
from drakerock.rocks.site import Site

# A plane that faces up by more than this is a floor.
FLOOR_COSINE = 0.5
# Walls: slabs wide enough for any drift, thick enough that nothing passes [m].
SLAB_WIDTH = 400.0
SLAB_THICKNESS = 10.0
# What is drawn of floor and walls: panels as long as the site and so thick [m], and their colours.
PANEL_THICKNESS = 0.05
FLOOR_COLOR = (0.35, 0.33, 0.31, 1.0)
WALL_COLOR = (0.45, 0.43, 0.41, 0.25)
DRIFT_LABEL = 1999
"""Render label of the drift for cameras; a plant's bodies have their index."""


def AddDrift(plant: MultibodyPlant, site: Site, config: PlantEngineConfig | None = None) -> None:
    """Register the site with the world body (before Finalize): proximity, illustration and perception geometry.

    For contact the floor is a half-space, which wheels and rocks meet in closed form; walls are slabs. With several
    half-spaces, whose boxes have no bounds, Drake's proximity engine reads stray memory now and then when a
    context is made (1.58: a segmentation fault in its trees).

    Args:
        plant: not finalized, with a SceneGraph.
        site: drift and void.
        config: stiffness and dissipation of the plant's own contacts with it.
    """
    config = config or PlantEngineConfig()
    properties = ProximityProperties()
    # Drake's default dissipation, estimated from a penetration allowance, is so large that rocks sink into
    # the floor; the site gets the rocks' own, and is stiff beside them.
    AddContactMaterial(
        dissipation=config.dissipation,
        point_stiffness=config.site_stiffness,
        friction=CoulombFriction(site.config.friction, site.config.friction),
        properties=properties,
    )
    if config.contact_model == "hydroelastic":
        AddRigidHydroelasticProperties(properties)
    world = plant.world_body()
    logging.getLogger("drake").addFilter(_is_not_of_the_floor)
    for plane in site.planes:
        X_WG = HalfSpace.MakePose(plane.normal, plane.normal * plane.offset)
        if plane.normal[2] > FLOOR_COSINE:
            plant.RegisterCollisionGeometry(world, X_WG, HalfSpace(), plane.name, properties)
        else:
            slab = Box(SLAB_WIDTH, SLAB_WIDTH, SLAB_THICKNESS)
            X_GS = RigidTransform([0.0, 0.0, -0.5 * SLAB_THICKNESS])
            plant.RegisterCollisionGeometry(world, X_WG @ X_GS, slab, plane.name, properties)
    for piece in site.pieces:
        convex = make_convex(piece.vertices, piece.name)
        plant.RegisterCollisionGeometry(world, RigidTransform(), convex, piece.name, properties)
    _add_looks(plant, site)


def _is_not_of_the_floor(record: logging.LogRecord) -> bool:
    """Return False for Drake's note that deformable bodies, of which there are none, fall through a half-space."""
    return "half spaces are not currently supported for deformable" not in record.getMessage()


def _add_looks(plant: MultibodyPlant, site: Site) -> None:
    """Show floor and walls as panels as long as the site, the rock above them as it is."""
    size = site.config
    half, thick = 0.5 * size.drift_width, PANEL_THICKNESS
    x_low, x_high = -size.drift_length, size.void_depth
    length, x_middle = x_high - x_low, 0.5 * (x_low + x_high)
    z = 0.5 * size.void_height
    panels = {
        "floor": (Box(length, size.drift_width, thick), [x_middle, 0.0, -0.5 * thick]),
        "left_wall": (Box(size.void_depth, thick, 2 * z), [0.5 * x_high, half + 0.5 * thick, z]),
        "right_wall": (Box(size.void_depth, thick, 2 * z), [0.5 * x_high, -half - 0.5 * thick, z]),
        "rear_wall": (Box(thick, size.drift_width, 2 * z), [x_high + 0.5 * thick, 0.0, z]),
    }
    for name, (shape, p) in panels.items():
        _add_look(plant, RigidTransform(p), shape, name, FLOOR_COLOR if name == "floor" else WALL_COLOR)
    for side, y in (("left", half + 0.5 * thick), ("right", -half - 0.5 * thick)):
        shape = Box(-x_low, thick, size.drift_height)
        X_WG = RigidTransform([0.5 * x_low, y, 0.5 * size.drift_height])
        _add_look(plant, X_WG, shape, f"drift_{side}", WALL_COLOR)
    for piece in site.pieces:
        shape = make_convex(piece.vertices, piece.name)
        _add_look(plant, RigidTransform(), shape, piece.name, WALL_COLOR)


def _add_look(
    plant: MultibodyPlant, X_WG: RigidTransform, shape: Shape, name: str, color: tuple[float, ...]
) -> None:
    geometry = GeometryInstance(X_WG, shape, f"{name}_look")
    geometry.set_illustration_properties(make_looks(IllustrationProperties, color))
    geometry.set_perception_properties(make_looks(PerceptionProperties, color[:3] + (1.0,), DRIFT_LABEL))
    plant.RegisterVisualGeometry(plant.world_body(), geometry)


def make_looks[P](kind: type[P], color: tuple[float, ...], label: int | None = None) -> P:
    """Return illustration or perception properties of a colour (r, g, b, a) in [0, 1], and a render label."""
    properties = kind()
    properties.AddProperty("phong", "diffuse", Rgba(*color))  # type: ignore[attr-defined]
    if label is not None:
        properties.AddProperty("label", "id", RenderLabel(label))  # type: ignore[attr-defined]
    return properties


def make_convex(vertices: np.ndarray, name: str, scale: float = 1.0) -> Convex:
    """Return the convex hull of `vertices` (k, 3) [m], scaled, as a Drake shape held in memory."""
    return Convex(points=np.asfortranarray(vertices.T), label=name, scale=scale)
