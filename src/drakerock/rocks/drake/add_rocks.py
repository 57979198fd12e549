"""`AddRocks`: thousands of rocks in anybody's Diagram."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.geometry import GeometryId, ProximityProperties, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, InputPort
from pydrake.systems.primitives import ConstantVectorSource

from drakerock.errors import InputError
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.drake.geometry import PlantGeometry, read_plant_geometry
from drakerock.rocks.drake.interface import RockSystem
from drakerock.rocks.drake.plant_engine import PlantRocks, RockBodies
from drakerock.rocks.drake.plant_view import PlantView, WakeBox
from drakerock.rocks.drake.scene import add_rock_poses
from drakerock.rocks.drake.system import NonsmoothRocks
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.engine import NonsmoothEngine
from drakerock.rocks.shapes import RockShape, load_rock_shapes
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]

# How far around the pile a rock may get before it is lost, if no bounds are given [m].
BOUNDS_MARGIN = 20.0
# Drake's default, which the plant does not tell in Python [m/s].
STICTION_TOLERANCE = 1e-3


def AddRocks(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    pile: PileState,
    config: RocksConfig | None = None,
    *,
    engine: NonsmoothConfig | RockBodies | None = None,
    shapes: tuple[RockShape, ...] | None = None,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
    wake_boxes: Sequence[WakeBox] | None = None,
    ignored: Sequence[GeometryId] = (),
    stiction_tolerance: float = STICTION_TOLERANCE,
    visible: bool = True,
    proximity: ProximityProperties | None = None,
) -> RockSystem:
    """Add rocks to a Diagram and connect them with its plant: call it last, just before the Diagram is built.

    Rocks meet every proximity geometry of the plant: bodies that are welded to the world stand still, all others,
    of any number of models, take part in the contact solve with their inertia, motors, stops, closed loops (ball
    constraints) and own contacts.
    Gravity and time step are the plant's. The rocks' forces reach the plant in the same step, beside the applied
    forces of others.

    What drives the plant has to be connected before, since rocks feel it: actuation, desired states, applied forces.
    The ports for actuation and for generalised forces that nothing is connected to are given zeros here; applied
    spatial forces can still be connected, to the rocks' own port ``applied_spatial_force``.

    Args:
        builder: of the Diagram that holds `plant` and `scene_graph`.
        plant: finalized, discrete.
        scene_graph: its.
        pile: the rocks, where they start.
        config: rock shapes and material.
        engine: settings of the nonsmooth engine; or what `AddRockBodies` returned: then rocks are the plant's own
            bodies, and this only shows them by the same ports.
        shapes: the rock shapes, if not those of `config.shapes`.
        bounds: lower and upper corner of the box outside of which a rock is lost [m]; default: the box of the pile,
            20 m wider to all sides.
        wake_boxes: where bodies keep the rocks around them awake; default: the box of each body that moves,
            `rest.sensor_margin` wider.
        ignored: proximity geometries that rocks do not meet.
        stiction_tolerance: the plant's, if it was changed [m/s].
        visible: register the rocks with `scene_graph` (illustration and perception); where they are is told only when
            it is asked.
        proximity: also give them proximity geometry there, for queries; the plant itself does not see it.

    Returns:
        The rocks' system; its ports are those of `RockSystem`.

    Raises:
        InputError: an unfinalized or a continuous plant, a plant without SceneGraph, a shape that rocks cannot meet, a
            body without mass, motors that nothing drives. When the Diagram is initialised: a body inside the pile.
    """
    config = config or RocksConfig()
    _require_usable(builder, plant)
    lower, upper = _find_bounds(pile, bounds)
    geometry = read_plant_geometry(plant, scene_graph, lower, upper, _find_ignored(engine, ignored))
    rocks: RockSystem
    if isinstance(engine, RockBodies):
        rocks = builder.AddSystem(PlantRocks(plant, engine, geometry.bodies))
        builder.Connect(plant.get_state_output_port(), rocks.GetInputPort("state"))
        builder.Connect(plant.get_contact_results_output_port(), rocks.GetInputPort("contact_results"))
        builder.Connect(plant.get_body_poses_output_port(), rocks.GetInputPort("body_poses"))
        return rocks
    settings = engine or NonsmoothConfig()
    gravity = plant.gravity_field().gravity_vector()
    if not gravity.any():
        # Rocks that float rest on nothing: one asleep would take a blow like a wall.
        settings = settings.replace(reduction="none")
    shapes = shapes or load_rock_shapes(config)
    solver = NonsmoothEngine(
        config, shapes, geometry.surroundings, settings, plant.time_step(), pile.shape, pile.size, pile.fixed,
        geometry.pieces, len(geometry.bodies), gravity,
    )  # fmt: skip
    rocks = builder.AddSystem(NonsmoothRocks(plant, solver, pile, shapes, geometry))
    if visible:
        _give_plant_its_own_geometry(builder, plant, scene_graph)
        add_rock_poses(builder, scene_graph, rocks, proximity)
    if geometry.bodies:
        if wake_boxes is None:
            wake_boxes = _make_wake_boxes(geometry, settings.rest.sensor_margin)
        view = builder.AddSystem(PlantView(plant, geometry.bodies, wake_boxes, stiction_tolerance))
        _connect_view(builder, plant, view)
        builder.Connect(
            rocks.GetOutputPort("spatial_force_of_others"), view.GetInputPort("applied_spatial_force")
        )
        builder.Connect(view.GetOutputPort("plant_step"), rocks.GetInputPort("plant_step"))
    _connect_forces(builder, plant, rocks)
    return rocks


def _require_usable(builder: DiagramBuilder, plant: MultibodyPlant) -> None:
    if any(isinstance(system, RockSystem) for system in builder.GetSystems()):
        raise InputError(
            "AddRocks: the Diagram has rocks already; add them once, as one pile (PileState.join)"
        )
    if not plant.is_finalized():
        raise InputError("AddRocks: the plant is not finalized; call plant.Finalize() before")
    if not plant.time_step() > 0.0:
        raise InputError("AddRocks: the plant is continuous; rocks need a discrete one (time_step > 0)")
    if not plant.geometry_source_is_registered():
        raise InputError("AddRocks: the plant has no SceneGraph; make both by AddMultibodyPlantSceneGraph")


def _find_ignored(
    engine: NonsmoothConfig | RockBodies | None, ignored: Sequence[GeometryId]
) -> tuple[GeometryId, ...]:
    own = engine.geometries if isinstance(engine, RockBodies) else ()
    return (*ignored, *own)


def _find_bounds(pile: PileState, bounds: tuple[ArrayLike, ArrayLike] | None) -> tuple[Array, Array]:
    if bounds is not None:
        return np.asarray(bounds[0], float), np.asarray(bounds[1], float)
    if len(pile) == 0:
        return np.full(3, -BOUNDS_MARGIN), np.full(3, BOUNDS_MARGIN)
    return pile.p_WRs.min(axis=0) - BOUNDS_MARGIN, pile.p_WRs.max(axis=0) + BOUNDS_MARGIN


def _make_wake_boxes(geometry: PlantGeometry, margin: float) -> list[WakeBox]:
    boxes = []
    for number, body in enumerate(geometry.bodies):
        if any(piece.body == number for piece in geometry.pieces):
            lower, upper = geometry.calc_box(number)
            boxes.append(WakeBox(body, lower - margin, upper + margin))
    return boxes


def _give_plant_its_own_geometry(
    builder: DiagramBuilder, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    """Let the plant ask a copy of SceneGraph, without rocks, for its contacts.

    SceneGraph brings all its frames up to date when any of them is asked for: thousands of rocks in every step, which
    nobody looks at.
    """
    contact_geometry = scene_graph.Clone()
    contact_geometry.set_name("contact_geometry")
    builder.AddSystem(contact_geometry)
    for k in range(scene_graph.num_input_ports()):
        port = scene_graph.get_input_port(k)
        builder.ConnectToSame(port, contact_geometry.GetInputPort(port.get_name()))
    query = plant.get_geometry_query_input_port()
    if builder.IsConnectedOrExported(query):
        builder.Disconnect(scene_graph.get_query_output_port(), query)
    builder.Connect(contact_geometry.get_query_output_port(), query)


def _connect_view(builder: DiagramBuilder, plant: MultibodyPlant, view: PlantView) -> None:
    builder.Connect(plant.get_state_output_port(), view.GetInputPort("state"))
    builder.ConnectToSame(plant.get_geometry_query_input_port(), view.GetInputPort("geometry_query"))
    for port in _find_driving_ports(plant):
        if not builder.ConnectToSame(port, view.GetInputPort(port.get_name())):
            _occupy(builder, plant, port)


def _find_driving_ports(plant: MultibodyPlant) -> list[InputPort]:
    ports = [plant.get_actuation_input_port(), plant.get_applied_generalized_force_input_port()]
    actuators = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    ports += [
        plant.get_actuation_input_port(instance)
        for instance in dict.fromkeys(actuator.model_instance() for actuator in actuators)
    ]
    ports += [
        plant.get_desired_state_input_port(instance)
        for instance in dict.fromkeys(
            actuator.model_instance() for actuator in actuators if actuator.has_controller()
        )
    ]
    return ports


def _occupy(builder: DiagramBuilder, plant: MultibodyPlant, port: InputPort) -> None:
    """Take a port that nothing is connected to, so that nothing can be later that rocks would not feel."""
    name: str = port.get_name()
    if name.endswith("_desired_state"):
        raise InputError(
            f"AddRocks: nothing is connected to the plant's port '{name}', which its motors with gains need; connect "
            "what drives them first, and call AddRocks after"
        )
    if port.size():
        builder.Connect(
            builder.AddSystem(ConstantVectorSource(np.zeros(port.size()))).get_output_port(), port
        )


def _connect_forces(builder: DiagramBuilder, plant: MultibodyPlant, rocks: RockSystem) -> None:
    """Put the rocks between the plant and whatever applies spatial forces to it already."""
    port = plant.get_applied_spatial_force_input_port()
    if builder.IsConnectedOrExported(port):
        source = builder.connection_map().get((plant, port.get_index()))
        if source is None:
            raise InputError(
                "AddRocks: the plant's port 'applied_spatial_force' is exported; export the rocks' port of that name "
                "instead, after AddRocks"
            )
        output = source[0].get_output_port(source[1])
        builder.Disconnect(output, port)
        builder.Connect(output, rocks.GetInputPort("applied_spatial_force"))
    builder.Connect(rocks.GetOutputPort("applied_spatial_force"), port)
