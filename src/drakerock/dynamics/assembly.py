"""The plant with the site in it; machine and rocks come on top."""

from __future__ import annotations

import numpy as np
import trimesh
from pydrake.common import MemoryFile
from pydrake.geometry import (
    AddContactMaterial,
    Convex,
    HalfSpace,
    InMemoryMesh,
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

from drakerock.dynamics.config import DynamicsConfig
from drakerock.pile.site import Site


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


def add_site(plant: MultibodyPlant, site: Site) -> None:
    """Register the site's half-spaces and convex pieces as collision geometry of the world body."""
    friction = site.config.friction
    for plane in site.planes:
        properties = ProximityProperties()
        AddContactMaterial(friction=CoulombFriction(friction, friction), properties=properties)
        X_WG = HalfSpace.MakePose(plane.normal, plane.normal * plane.offset)
        plant.RegisterCollisionGeometry(plant.world_body(), X_WG, HalfSpace(), plane.name, properties)
    for piece in site.pieces:
        properties = ProximityProperties()
        AddContactMaterial(friction=CoulombFriction(friction, friction), properties=properties)
        plant.RegisterCollisionGeometry(
            plant.world_body(), RigidTransform(), make_convex(piece.vertices, piece.name), piece.name, properties
        )


def make_convex(vertices: np.ndarray, name: str, scale: float = 1.0) -> Convex:
    """Return the convex hull of `vertices` (k, 3) [m], scaled, as a Drake shape held in memory."""
    hull = trimesh.convex.convex_hull(vertices)
    text = trimesh.exchange.obj.export_obj(hull, include_normals=False, header=None)
    return Convex(InMemoryMesh(mesh_file=MemoryFile(text, ".obj", name)), scale=np.full(3, scale))
