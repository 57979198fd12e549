"""The station: machine, drift, rocks, sensor, planner and controller wired into one Diagram. The only wiring."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    OutputPort,
    System,
)
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink

from drakerock.errors import SimulationFailure
from drakerock.lhd.geometry import collision_pieces, make_bucket_geometry
from drakerock.lhd.hinge import add_hinge_moment
from drakerock.lhd.kinematics import make_kinematics
from drakerock.lhd.measurement import add_machine_sensor
from drakerock.lhd.model import Machine, add_machine
from drakerock.lhd.motors import add_motors
from drakerock.lhd.placement import set_machine_pose
from drakerock.lhd.rocks import add_lhd_rocks
from drakerock.lhd.wall_contact import add_wall_contact
from drakerock.loading.control import FeedforwardController
from drakerock.loading.field import HeightField
from drakerock.loading.parts import MakePart, StationView, connect_inputs, make_part
from drakerock.loading.plan import DigPlan
from drakerock.loading.plan_file import load_plan
from drakerock.loading.planning import DiggingMachine, DigPlanner
from drakerock.loading.scenario import Scenario
from drakerock.loading.segments import SegmentTracker
from drakerock.loading.sensing import PileSensor
from drakerock.loading.steering import LineSteering
from drakerock.memory import get_own_context
from drakerock.rocks.drake.drift import AddDrift
from drakerock.rocks.drake.interface import RockSystem, find_start_inside
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.drake.plant_engine import AddRockBodies
from drakerock.rocks.shapes import RockShape, load_rock_shapes
from drakerock.rocks.site import Site, make_site
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]

# Where a loose rock lies in the machine's place, it starts so much farther back, at most so far [m].
BACK_STEP, MAX_BACK = 0.25, 8.0


@dataclass(frozen=True, eq=False)
class Station:
    """A built Diagram and its parts; `initialize` puts a context of it to the start of a loading.

    Attributes:
        diagram: everything, ready for a Simulator. Its exported ports are ``measurement``, ``plan``,
            ``height_field``, ``mode``, ``progress``, ``motor_speeds``, ``pile``, ``bucket_force``.
        scenario: what it was made from.
        plant, scene_graph: Drake's.
        site: the drift.
        machine: the machine's names and limits in the plant.
        digger: its kinematics and bucket.
        shapes: the rock shapes.
        rocks: the rocks' system.
        sensor, planner, controller, tracker: the loading systems.
        logs: one per-step log by name of the quantity.
    """

    diagram: Diagram
    scenario: Scenario
    plant: MultibodyPlant
    scene_graph: SceneGraph
    site: Site
    machine: Machine
    digger: DiggingMachine
    shapes: tuple[RockShape, ...]
    rocks: RockSystem
    sensor: System
    planner: System
    controller: System
    tracker: System
    logs: dict[str, VectorLogSink]

    def initialize(self, root_context: Context) -> HeightField:
        """Put a context of the Diagram to the start of a loading: pile looked at, plan made, machine placed.

        The context may be that of a larger Diagram that this one is a part of.

        Sensing and planning come first, since they tell where the machine starts; only a scanner's view depends on
        where it stands meanwhile. A Simulator's own initialisation afterwards keeps the plan.

        Returns:
            What was seen.

        Raises:
            InputError: the machine cannot reach its starting pose.
        """
        loading = self.scenario.loading
        context = get_own_context(self.diagram, root_context)
        root_context.SetTime(0.0)
        context.SetStateAndParametersFrom(self.diagram.CreateDefaultContext())
        self.rocks.set_pile(root_context, self.rocks.pile)
        self._place(root_context, x_tip=-loading.sensing.scanner.distance, y=0.0)
        for part in (self.sensor, self.planner):
            part.ExecuteInitializationEvents(part.GetMyMutableContextFromRoot(root_context))
        field: HeightField = self.diagram.GetOutputPort("height_field").Eval(context)
        plan = self.diagram.GetOutputPort("plan").Eval(context)
        if isinstance(plan, DigPlan):
            self._place_clear(root_context, float(plan.waypoint_x[0]) - loading.planning.run_up, plan.y)
        return field

    def read_strategy(self, root_context: Context) -> dict[str, float]:
        """Return the strategy that is planned: the planner's, if it has an output port ``strategy``, or the scenario's.

        Args:
            root_context: an initialised one.
        """
        strategy: dict[str, float] = self.scenario.loading.strategy.model_dump()
        if not self.planner.HasOutputPort("strategy"):
            return strategy
        context = self.planner.GetMyContextFromRoot(root_context)
        values = self.planner.GetOutputPort("strategy").Eval(context)
        return dict(zip(strategy, map(float, values), strict=True))

    def find_scanning_pose(self) -> RigidTransform:
        """Return the pose X_WF of the front unit, which carries the scanner, while the machine looks at the pile.

        Raises:
            InputError: the machine cannot reach it.
        """
        root_context = self.diagram.CreateDefaultContext()
        self._place(root_context, x_tip=-self.scenario.loading.sensing.scanner.distance, y=0.0)
        front = self.plant.GetBodyByName("front_unit", self.machine.instance)
        return self.plant.EvalBodyPoseInWorld(self.plant.GetMyContextFromRoot(root_context), front)

    def _place_clear(self, root_context: Context, x_tip: float, y: float) -> None:
        """Place the machine, farther back than `x_tip` if rocks lie there, off the pile or in front of its other parts.

        Raises:
            InputError: the machine cannot reach that pose.
        """
        rocks = self.rocks.GetMyContextFromRoot(root_context)
        for back in np.arange(0.0, MAX_BACK, BACK_STEP):
            self._place(root_context, x_tip=x_tip - back, y=y)
            try:
                contacts = self.rocks.GetOutputPort("contacts").Eval(rocks)
            except SimulationFailure:
                return  # of the rocks; the simulation will tell, too
            if find_start_inside(contacts, self.rocks.pile.size) is None:
                return

    def _place(self, root_context: Context, x_tip: float, y: float) -> None:
        set_machine_pose(
            self.plant,
            self.plant.GetMyMutableContextFromRoot(root_context),
            self.machine,
            x_tip=x_tip,
            y=y,
            z_tip=self.scenario.loading.planning.floor_clearance,
            kin=self.digger.kinematics,
        )


def make_station(
    scenario: Scenario,
    pile: PileState,
    controller: MakePart | None = None,
    planner: MakePart | None = None,
    sensor: MakePart | None = None,
    *,
    visible: bool = True,
    extend: Callable[[DiagramBuilder, StationView], None] | None = None,
) -> Station:
    """Build the Diagram of one loading cycle.

    Args:
        scenario: the whole configuration.
        pile: the rocks.
        controller, planner, sensor: make a part from a `StationView` (see `drakerock.loading.parts`); default: what the
            scenario names in `loading.parts`, or ours. Their input ports are connected by name to the station's
            signals: measurement, plan, height_field, mode, progress, bucket_force, hinge_moment, pile, body_poses,
            body_spatial_velocities, machine_state, geometry_query, rock_summary. A planner's input port ``preference``
            becomes one of the Diagram's. A planner that chooses the strategy tells it at an output port ``strategy``.
        visible: show rocks to SceneGraph, for Meshcat and cameras.
        extend: called with the builder before the Diagram is built, to add what else is wanted (a visualizer).

    Raises:
        InputError: the machine's SDFormat file, a rock mesh, a stored plan or a part cannot be used.
    """
    dynamics, loading = scenario.dynamics, scenario.loading
    site = make_site(scenario.site)
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, dynamics)
    AddDrift(plant, site, dynamics.plant)
    machine = add_machine(plant, scenario.machine)
    shapes = load_rock_shapes(scenario.rocks)
    bodies = None
    if dynamics.rocks == "plant":
        bodies = AddRockBodies(
            plant, pile, scenario.rocks, dynamics.plant, dynamics.reference_overlap, shapes
        )
    plant.Finalize()
    digger = make_digging_machine(plant, scene_graph, machine)
    bucket = plant.GetBodyByName("bucket", machine.instance).index()

    motors = add_motors(builder, plant, machine)
    rocks = add_lhd_rocks(
        builder, plant, scene_graph, machine, pile, scenario.rocks, dynamics, scenario.site,
        shapes=shapes, bodies=bodies, visible=visible,
    )  # fmt: skip
    machine_sensor = add_machine_sensor(builder, plant, machine, digger.kinematics)
    hinge = add_hinge_moment(builder, plant, machine)
    walls = add_wall_contact(builder, plant, scene_graph, machine)

    view = StationView(scenario, plant, scene_graph, machine, digger, shapes)
    parts = loading.parts
    sensor_system = builder.AddSystem(
        make_part("sensor", sensor, parts.sensor, view, lambda: _make_sensor(view))
    )
    planner_system = builder.AddSystem(
        make_part("planner", planner, parts.planner, view, lambda: _make_planner(view))
    )
    controller_system = builder.AddSystem(
        make_part(
            "controller",
            controller,
            parts.controller,
            view,
            lambda: FeedforwardController(digger.kinematics, loading.control.weight_transfer),
        )
    )
    tracker = controller_system
    if not controller_system.HasOutputPort("progress"):
        tracker = builder.AddSystem(SegmentTracker(digger.kinematics, loading.control, plant.time_step()))
    signals: dict[str, OutputPort] = {
        "measurement": machine_sensor.GetOutputPort("measurement"),
        "height_field": sensor_system.GetOutputPort("height_field"),
        "plan": planner_system.GetOutputPort("plan"),
        "mode": tracker.GetOutputPort("mode"),
        "progress": tracker.GetOutputPort("progress"),
        "bucket_force": rocks.get_body_force_output_port(bucket),
        "hinge_moment": hinge.GetOutputPort("moment"),
        "pile": rocks.GetOutputPort("pile"),
        "rock_summary": rocks.GetOutputPort("summary"),
        "body_poses": plant.get_body_poses_output_port(),
        "body_spatial_velocities": plant.get_body_spatial_velocities_output_port(),
        "machine_state": plant.get_state_output_port(machine.instance),
        "geometry_query": scene_graph.get_query_output_port(),
    }
    connect_inputs(builder, "sensor", sensor_system, signals)
    connect_inputs(builder, "planner", planner_system, signals)
    connect_inputs(builder, "controller", controller_system, signals)
    if tracker is not controller_system:
        connect_inputs(builder, "tracker", tracker, signals)
    motor_speeds = controller_system.GetOutputPort("motor_speeds")
    builder.Connect(motor_speeds, motors.GetInputPort("motor_speeds"))
    if loading.steering.hold_line and not controller_system.HasOutputPort("steering_angle"):
        steering = builder.AddSystem(LineSteering(plant, machine, loading.steering))
        connect_inputs(builder, "steering", steering, signals)
        builder.Connect(steering.GetOutputPort("steering_angle"), motors.GetInputPort("steering_angle"))
    elif controller_system.HasOutputPort("steering_angle"):
        builder.Connect(
            controller_system.GetOutputPort("steering_angle"), motors.GetInputPort("steering_angle")
        )

    signals |= {
        "motor_speeds": motor_speeds,
        "motor_torques": motors.GetOutputPort("motor_torques"),
        "wall_contact": walls.GetOutputPort("wall_contact"),
    }
    logs = {}
    for name in LOGGED:
        logs[name] = LogVectorOutput(signals[name], builder, plant.time_step())
        logs[name].set_name(f"log_{name}")
    for name in EXPORTED:
        builder.ExportOutput(signals[name], name)
    if extend:
        extend(builder, view)
    diagram = builder.Build()
    diagram.set_name("station")
    return Station(
        diagram=diagram,
        scenario=scenario,
        plant=plant,
        scene_graph=scene_graph,
        site=site,
        machine=machine,
        digger=digger,
        shapes=shapes,
        rocks=rocks,
        sensor=sensor_system,
        planner=planner_system,
        controller=controller_system,
        tracker=tracker,
        logs=logs,
    )


LOGGED = (
    "measurement", "motor_speeds", "mode", "motor_torques", "machine_state", "hinge_moment", "bucket_force",
    "rock_summary", "wall_contact",
)  # fmt: skip
"""Signals that are logged in every step."""
EXPORTED = ("measurement", "plan", "height_field", "mode", "progress", "motor_speeds", "pile", "bucket_force")
"""Signals that are output ports of the station's Diagram."""


def _make_sensor(view: StationView) -> PileSensor:
    scenario = view.scenario
    return PileSensor(
        view.shapes,
        scenario.site,
        scenario.loading.sensing,
        scenario.site.drift_length / 2,
        seed=scenario.seed,
        front_unit=view.plant.GetBodyByName("front_unit", view.machine.instance).index(),
    )


def _make_planner(view: StationView) -> DigPlanner:
    loading = view.scenario.loading
    source = loading.planning.source
    view.digger.check_room(view.scenario.site.drift_width, loading.planning.wall_clearance)
    return DigPlanner(
        loading.strategy,
        view.digger,
        loading.planning,
        loading.sensing,
        view.scenario.site.drift_width,
        loading.control.speed_floor,
        stored=None if source is None else load_plan(source)[0],
    )


def make_digging_machine(plant: MultibodyPlant, scene_graph: SceneGraph, machine: Machine) -> DiggingMachine:
    """Return what a plan needs to know of the machine in a finalized plant.

    Raises:
        InputError: see `make_kinematics` and `make_bucket_geometry`.
    """
    return DiggingMachine(
        make_kinematics(plant, machine),
        make_bucket_geometry(plant, scene_graph, machine),
        _calc_machine_width(plant, scene_graph, machine),
    )


def _calc_machine_width(plant: MultibodyPlant, scene_graph: SceneGraph, machine: Machine) -> float:
    """Return the machine's largest width from its collision geometry [m]."""
    context = plant.CreateDefaultContext()
    reach = 0.0
    for name, pieces in collision_pieces(plant, scene_graph, machine).items():
        X_WB = plant.GetBodyByName(name, machine.instance).EvalPoseInWorld(context)
        for piece in pieces:
            p_WV = X_WB.rotation().matrix() @ piece.vertices.T + X_WB.translation()[:, None]
            reach = max(reach, float(np.abs(p_WV[1]).max()))
    return 2.0 * reach
