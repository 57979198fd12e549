"""The plant with the site in it; machine and rocks come on top."""

from __future__ import annotations

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import (
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    Convex,
    HalfSpace,
    ProximityProperties,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.systems.framework import DiagramBuilder

from drakerock.rocks.engine.config import DynamicsConfig
from drakerock.rocks.site import Site

# A plane that faces up by more than this is a floor.
FLOOR_COSINE = 0.5
# Walls: slabs wide enough for any drift, thick enough that nothing passes [m].
SLAB_WIDTH = 400.0
SLAB_THICKNESS = 10.0


def add_plant(builder: DiagramBuilder, config: DynamicsConfig) -> tuple[MultibodyPlant, SceneGraph]:
    """Add a discrete MultibodyPlant and its SceneGraph.

    The output ports are not sampled, so that the plant's state is purely discrete and what is read at a time
    (contact forces, reactions) belongs to the step that starts then.
    """
    plant, scene_graph = AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=config.time_step,
            contact_model="point" if config.plant.contact_model == "point" else "hydroelastic_with_fallback",
            discrete_contact_approximation=config.contact_approximation,
            stiction_tolerance=config.stiction_tolerance,
            use_sampled_output_ports=False,
        ),
        builder,
    )
    plant.set_name("plant")
    return plant, scene_graph


def add_site(plant: MultibodyPlant, site: Site, config: DynamicsConfig) -> None:
    """Register the site's planes and convex pieces as collision geometry of the world body.

    The floor is a half-space, which wheels and rocks meet in closed form; walls are slabs. With several
    half-spaces, whose boxes have no bounds, Drake's proximity engine reads stray memory now and then when a
    context is made (1.58: a segmentation fault in its trees).
    """
    properties = ProximityProperties()
    # Drake's default dissipation, estimated from a penetration allowance, is so large that rocks sink into
    # the floor; the site gets the rocks' own, and is stiff beside them.
    AddContactMaterial(
        dissipation=config.plant.dissipation,
        point_stiffness=config.plant.site_stiffness,
        friction=CoulombFriction(site.config.friction, site.config.friction),
        properties=properties,
    )
    if config.plant.contact_model == "hydroelastic":
        AddRigidHydroelasticProperties(properties)
    world = plant.world_body()
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


def make_convex(vertices: np.ndarray, name: str, scale: float = 1.0) -> Convex:
    """Return the convex hull of `vertices` (k, 3) [m], scaled, as a Drake shape held in memory."""
    return Convex(points=np.asfortranarray(vertices.T), label=name, scale=scale)


def make_pose(q_WR: np.ndarray, p_WR: np.ndarray) -> RigidTransform:
    """Return the pose of a quaternion (w, x, y, z), normalised here, and a position [m]."""
    return RigidTransform(Quaternion(q_WR / np.linalg.norm(q_WR)), p_WR)
