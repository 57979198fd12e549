"""Fixtures shared by all tests."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile

import numpy as np
import platformdirs
import pytest
from hypothesis import settings
from pydrake.systems.framework import DiagramBuilder

from drakerock.lhd.config import MachineConfig
from drakerock.lhd.geometry import make_bucket_geometry
from drakerock.lhd.kinematics import make_kinematics
from drakerock.lhd.model import add_machine
from drakerock.loading.plan import DigPlan
from drakerock.loading.planning import DiggingMachine
from drakerock.loading.scenario import Scenario
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.engine.config import DynamicsConfig
from drakerock.rocks.shapes import RockShape, load_rock_shapes
from drakerock.rocks.state import PileState

# Piles made by tests never come from, nor go to, the user's cache; pytest-xdist's workers share one. Kernels are kept
# by a hash of their sources: they can come from there, and what uses the same checkout after the tests has them.
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ.setdefault("NUMBA_CACHE_DIR", platformdirs.user_cache_dir("drakerock"))
    os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="drakerock-cache-")
    atexit.register(shutil.rmtree, os.environ["XDG_CACHE_HOME"], ignore_errors=True)

settings.register_profile("drakerock", deadline=None, max_examples=30, derandomize=True)
settings.load_profile("drakerock")


@pytest.fixture(scope="session")
def shapes() -> tuple[RockShape, ...]:
    return load_rock_shapes(RocksConfig())


@pytest.fixture(scope="session")
def digger() -> DiggingMachine:
    """The default machine's geometry, as the planner needs it."""
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, DynamicsConfig())
    machine = add_machine(plant, MachineConfig())
    plant.Finalize()
    return DiggingMachine(
        make_kinematics(plant, machine), make_bucket_geometry(plant, scene_graph, machine), 3.1
    )


@pytest.fixture(scope="session")
def plan(digger: DiggingMachine) -> DigPlan:
    """A plan for an even slope."""
    from tests.unit.loading.test_planning import make_wedge, plan_for

    return plan_for(digger, make_wedge(), beta=0.6, kappa=0.6)


@pytest.fixture
def heap() -> PileState:
    return make_heap()


def make_heap() -> PileState:
    """Return twelve rocks in a row of three layers on the floor, apart by a hair."""
    rng = np.random.default_rng(3)
    p_WRs = np.array(
        [
            [-1.0 - 0.5 * i, 0.45 * (j - 1), 0.25 + 0.5 * k]
            for i in range(2)
            for j in range(3)
            for k in range(2)
        ]
    )
    q_WRs = rng.normal(size=(12, 4))
    q_WRs /= np.linalg.norm(q_WRs, axis=1)[:, None]
    return PileState(
        p_WRs,
        q_WRs,
        np.zeros((12, 6)),
        np.arange(12) % 6,
        np.full(12, 0.3),
        np.zeros(12, bool),
        {"made_by": "test"},
    )


@pytest.fixture(scope="session")
def small_scenario() -> Scenario:
    """A scenario of few rocks that makes its pile in a few seconds."""
    return Scenario.model_validate(
        {
            "seed": 5,
            "site": {"drift_width": 3.9, "void_depth": 0.6, "rear_layer": 0.0},
            "pile": {
                "rocks": 60,
                "emission_height": 2.0,
                "emission_reach": 1.2,
                "emission_interval": 0.25,
                "settle_speed": 0.2,
            },
            "dynamics": {"rocks": "plant"},
            "loading": {"strategy": {"alpha": 0.3, "beta": 0.4, "gamma": 1.0, "kappa": 0.5}},
        }
    )
