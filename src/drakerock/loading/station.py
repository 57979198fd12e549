"""The station: machine, site, rocks, sensor, planner and controller wired into one Diagram. The only wiring."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput, VectorLogSink

from drakerock.lhd.geometry import collision_pieces, make_bucket_geometry
from drakerock.lhd.hinge import add_hinge_moment
from drakerock.lhd.kinematics import make_kinematics
from drakerock.lhd.measurement import add_machine_sensor
from drakerock.lhd.model import Machine, add_machine, calc_motor_targets
from drakerock.loading.control import FeedforwardController
from drakerock.loading.plan_file import load_plan
from drakerock.loading.planning import DiggingMachine, DigPlanner
from drakerock.loading.scenario import Scenario
from drakerock.loading.sensing import PileSensor
from drakerock.rocks.drake.assembly import add_plant, add_site
from drakerock.rocks.drake.interface import RockSystem
from drakerock.rocks.drake.plant_engine import PlantRocks, add_plant_rocks, add_rock_bodies
from drakerock.rocks.drake.system import NonsmoothRocks, add_nonsmooth_rocks
from drakerock.rocks.shapes import RockShape, load_rock_shapes
from drakerock.rocks.site import Site, make_site
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Station:
    """A built Diagram and its parts.

    Attributes:
        diagram: everything, ready for a Simulator. Its exported ports are ``measurement``, ``plan``,
            ``height_field``, ``mode``, ``progress`` and ``rock_poses``.
        scenario: what it was made from.
        plant, scene_graph: Drake's.
        site: the drift.
        machine: the machine's names and limits in the plant.
        digger: its kinematics and bucket.
        shapes: the rock shapes.
        rocks: the rock engine's system (`RockSystem`).
        pile_sensor, planner, controller: the loading systems.
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
    pile_sensor: PileSensor
    planner: DigPlanner
    controller: FeedforwardController
    logs: dict[str, VectorLogSink]


class MotorTargets(LeafSystem):
    """Orders the controller's three speeds as the plant's desired state.

    Input port ``motor_speeds``: (3,) wheels, boom, bucket [rad/s].
    Output port ``desired_state``: as the plant's desired-state port of the machine wants it.
    """

    def __init__(self, plant: MultibodyPlant, machine: Machine) -> None:
        """Make it for `machine` in the finalized `plant`."""
        super().__init__()
        self.set_name("motor_targets")
        self._plant, self._machine = plant, machine
        self._speeds = self.DeclareVectorInputPort("motor_speeds", 3)
        size = len(calc_motor_targets(plant, machine, 0.0, 0.0, 0.0))
        self.DeclareVectorOutputPort("desired_state", size, self._calc, {self._speeds.ticket()})

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(calc_motor_targets(self._plant, self._machine, *self._speeds.Eval(context)))


def make_station(scenario: Scenario, pile: PileState) -> Station:
    """Build the Diagram of one loading cycle.

    Args:
        scenario: the whole configuration.
        pile: the rocks; their poses are written into a context by ``station.rocks.set_pile``.

    Raises:
        InputError: the machine's SDFormat file, a rock mesh or a stored plan cannot be used.
    """
    dynamics, loading = scenario.dynamics, scenario.loading
    shapes = load_rock_shapes(scenario.rocks.shapes, scenario.rocks.max_corners)
    site = make_site(scenario.site)

    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, dynamics)
    add_site(plant, site, dynamics)
    machine = add_machine(plant, scenario.machine)
    rocks: PlantRocks | NonsmoothRocks
    motor_inputs = []
    if dynamics.rocks == "plant":
        geometries = add_rock_bodies(plant, pile, shapes, scenario.rocks, dynamics)
        plant.Finalize()
        rocks = add_plant_rocks(builder, plant, pile, geometries)
    else:
        plant.Finalize()
        rocks, view = add_nonsmooth_rocks(
            builder, plant, scene_graph, machine, site, shapes, scenario.rocks, dynamics, pile
        )
        motor_inputs.append(view.GetInputPort("desired_state"))
    motor_inputs.append(plant.get_desired_state_input_port(machine.instance))

    kinematics = make_kinematics(plant, machine)
    digger = DiggingMachine(
        kinematics,
        make_bucket_geometry(plant, scene_graph, machine),
        _calc_machine_width(plant, scene_graph, machine),
    )
    machine_sensor = add_machine_sensor(builder, plant, machine, kinematics)
    pile_sensor = builder.AddSystem(
        PileSensor(
            pile,
            shapes,
            scenario.site,
            loading.sensing,
            scenario.site.drift_length / 2,
            seed=scenario.seed,
            front_unit=plant.GetBodyByName("front_unit", machine.instance).index(),
        )
    )
    if loading.sensing.kind == "scanner":
        builder.Connect(plant.get_body_poses_output_port(), pile_sensor.GetInputPort("body_poses"))
    builder.Connect(rocks.GetOutputPort("rock_poses"), pile_sensor.GetInputPort("rock_poses"))
    source = loading.planning.source
    planner = builder.AddSystem(
        DigPlanner(
            loading.strategy,
            digger,
            loading.planning,
            loading.sensing,
            scenario.site.drift_width,
            loading.control.speed_floor,
            stored=None if source is None else load_plan(source)[0],
        )
    )
    builder.Connect(pile_sensor.GetOutputPort("height_field"), planner.GetInputPort("height_field"))
    controller = builder.AddSystem(FeedforwardController(kinematics, loading.control, dynamics.time_step))
    builder.Connect(planner.GetOutputPort("plan"), controller.GetInputPort("plan"))
    builder.Connect(machine_sensor.GetOutputPort("measurement"), controller.GetInputPort("measurement"))
    motors = builder.AddSystem(MotorTargets(plant, machine))
    builder.Connect(controller.GetOutputPort("motor_speeds"), motors.GetInputPort("motor_speeds"))
    for port in motor_inputs:
        builder.Connect(motors.GetOutputPort("desired_state"), port)
    hinge = add_hinge_moment(builder, plant, machine)

    logged = {
        "measurement": machine_sensor.GetOutputPort("measurement"),
        "motor_speeds": controller.GetOutputPort("motor_speeds"),
        "mode": controller.GetOutputPort("mode"),
        "torques": plant.get_net_actuation_output_port(machine.instance),
        "machine_state": plant.get_state_output_port(machine.instance),
        "hinge_moment": hinge.GetOutputPort("moment"),
        "F_B_W": rocks.GetOutputPort("F_B_W"),
        "rock_summary": rocks.GetOutputPort("rock_summary"),
    }
    logs = {}
    for name, port in logged.items():
        logs[name] = LogVectorOutput(port, builder, dynamics.time_step)
        logs[name].set_name(f"log_{name}")
    builder.ExportOutput(machine_sensor.GetOutputPort("measurement"), "measurement")
    builder.ExportOutput(planner.GetOutputPort("plan"), "plan")
    builder.ExportOutput(pile_sensor.GetOutputPort("height_field"), "height_field")
    builder.ExportOutput(controller.GetOutputPort("mode"), "mode")
    builder.ExportOutput(controller.GetOutputPort("progress"), "progress")
    builder.ExportOutput(rocks.GetOutputPort("rock_poses"), "rock_poses")
    diagram = builder.Build()
    diagram.set_name("station")
    return Station(
        diagram, scenario, plant, scene_graph, site, machine, digger, shapes, rocks,
        pile_sensor, planner, controller, logs,
    )  # fmt: skip


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
