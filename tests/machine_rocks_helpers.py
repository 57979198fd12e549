"""Diagrams with the machine and nonsmooth rocks for tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from drakerock.lhd.config import MachineConfig
from drakerock.lhd.model import add_machine
from drakerock.lhd.motors import add_motors
from drakerock.lhd.placement import set_machine_pose
from drakerock.lhd.rocks import add_lhd_rocks
from drakerock.rocks.config import RocksConfig, SiteConfig
from drakerock.rocks.drake.drift import AddDrift
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.engine.config import DynamicsConfig
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.site import make_site


class Rates(LeafSystem):
    """Joint rates of wheels, boom and bucket as a function of time."""

    def __init__(self, rates: Callable[[float], tuple[float, float, float]]):
        super().__init__()
        self.DeclareVectorOutputPort(
            "motor_speeds", 3, lambda context, output: output.SetFromVector(rates(context.get_time()))
        )


class Scene:
    """Machine, site and rocks in one Diagram, placed and ready to run."""

    def __init__(self, pile, rates, site=None, dynamics=None, rocks=None, shapes=None, **pose):
        self.dynamics = dynamics or DynamicsConfig()
        rocks = rocks or RocksConfig()
        self.shapes = shapes or load_rock_shapes(rocks)
        self.site = make_site(site or SiteConfig())
        builder = DiagramBuilder()
        self.plant, self.scene_graph = add_plant(builder, self.dynamics)
        AddDrift(self.plant, self.site, self.dynamics.plant)
        self.machine = add_machine(self.plant, MachineConfig())
        self.plant.Finalize()
        motors = add_motors(builder, self.plant, self.machine)
        source = builder.AddSystem(Rates(rates))
        builder.Connect(source.get_output_port(), motors.GetInputPort("motor_speeds"))
        self.rocks = add_lhd_rocks(
            builder, self.plant, self.scene_graph, self.machine, pile, rocks, self.dynamics, self.site.config,
            shapes=self.shapes,
        )  # fmt: skip
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        self.plant_context = self.plant.GetMyMutableContextFromRoot(self.context)
        set_machine_pose(self.plant, self.plant_context, self.machine, **pose)
        # Heaps are strewn into the bucket at random: some rocks start inside its walls, and are pushed out.
        self.simulator.Initialize(InitializeParams(suppress_initialization_events=True))

    def step(self) -> None:
        self.simulator.AdvanceTo(self.context.get_time() + self.dynamics.time_step)

    def get_bucket_force(self) -> np.ndarray:
        """(6,) of the last step."""
        port = self.rocks.get_body_force_output_port(self.plant.GetBodyByName("bucket").index())
        return port.Eval(self.rocks.GetMyContextFromRoot(self.context)).copy()

    def get_summary(self) -> np.ndarray:
        return self.rocks.GetOutputPort("summary").Eval(self.rocks.GetMyContextFromRoot(self.context)).copy()

    def get_torque(self, joint: str) -> float:
        index = [
            self.plant.get_joint_actuator(k).joint().name()
            for k in self.plant.GetJointActuatorIndices(self.machine.instance)
        ].index(joint)
        port = self.plant.get_net_actuation_output_port(self.machine.instance)
        return float(port.Eval(self.plant_context)[index])

    def get_machine_momentum(self) -> np.ndarray:
        momentum = self.plant.CalcSpatialMomentumInWorldAboutPoint(
            self.plant_context, [self.machine.instance], np.zeros(3)
        )
        return momentum.translational().copy()
