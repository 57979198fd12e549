from __future__ import annotations

from collections.abc import Callable

import pytest
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import Diagram, DiagramBuilder

from drakerock.lhd.config import MachineConfig
from drakerock.lhd.kinematics import Kinematics, make_kinematics
from drakerock.lhd.model import Machine, add_machine

Model = tuple[Diagram, MultibodyPlant, SceneGraph, Machine]


def make_model(config: MachineConfig | None = None) -> Model:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01), builder)
    machine = add_machine(plant, config or MachineConfig())
    plant.Finalize()
    return builder.Build(), plant, scene_graph, machine


@pytest.fixture(scope="session")
def build() -> Callable[..., Model]:
    return make_model


@pytest.fixture(scope="session")
def model() -> Model:
    return make_model()


@pytest.fixture(scope="session")
def kin(model: Model) -> Kinematics:
    _, plant, _, machine = model
    return make_kinematics(plant, machine)
