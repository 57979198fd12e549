"""A discrete plant as the dynamics' configuration has it."""

from __future__ import annotations

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import DiagramBuilder

from drakerock.rocks.engine.config import DynamicsConfig


def add_plant(builder: DiagramBuilder, config: DynamicsConfig) -> tuple[MultibodyPlant, SceneGraph]:
    """Add a discrete MultibodyPlant and its SceneGraph.

    The output ports are not sampled, so that the plant's state is purely discrete and what is read at a time
    (contact forces, reactions) belongs to the step that starts then. With `sap` every geometry that says nothing of its
    relaxation time gets the configuration's.
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
    if config.contact_approximation == "sap":
        settings = scene_graph.get_config()
        settings.default_proximity_properties.relaxation_time = config.plant.relaxation_time
        scene_graph.set_config(settings)
    return plant, scene_graph
