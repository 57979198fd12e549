"""The motors are the same under both rock engines: a boom holds, a context repeats.

A handful of rocks, far from the machine, which finds nothing to dig: every function is commanded to zero.
"""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.analysis import InitializeParams, Simulator

from drakerock import scatter_rocks
from drakerock.config import parse_config
from drakerock.loading.scenario import Scenario
from drakerock.loading.station import make_station


def start(engine: str, *overrides: str) -> tuple:
    scenario = parse_config("", Scenario, [f"dynamics.rocks={engine}", *overrides])
    station = make_station(scenario, scatter_rocks(4, (0.5, -1.0, 0.2), (2.0, 1.0, 2.0)), visible=False)
    simulator = Simulator(station.diagram)
    station.initialize(simulator.get_mutable_context())
    return station, simulator


def run(station, simulator, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return boom angles [rad] and torques [N m] at the beginning of each step."""
    plant, context = station.plant, simulator.get_context()
    plant_context = plant.GetMyContextFromRoot(context)
    instance = station.machine.instance
    place = list(plant.GetActuatorNames(instance)).index("boom_joint")
    joint = plant.GetJointByName("boom_joint", instance)
    motors = station.diagram.GetSubsystemByName("motors")
    rows = []
    for _ in range(steps):
        torque = motors.GetOutputPort("motor_torques").Eval(motors.GetMyContextFromRoot(context))[place]
        rows.append((joint.get_angle(plant_context), torque))
        simulator.AdvanceTo(context.get_time() + plant.time_step())
    return tuple(np.array(rows).T)


@pytest.mark.parametrize("engine", ["nonsmooth", "plant"])
def test_boom_holds_and_repeats_from_a_saved_context(engine):
    station, simulator = start(engine)
    angles, torques = run(station, simulator, 20)
    # A spring of D / h under the weight of boom and bucket, which the method's motor lets sag ten times as far.
    assert np.abs(torques[5:]).min() > 2e5
    assert np.ptp(angles) < 2.0 * np.abs(torques).max() * station.plant.time_step() / 1e8
    assert np.ptp(angles[10:]) < 1e-6
    saved = simulator.get_context().Clone()
    first = run(station, simulator, 5)
    simulator.get_mutable_context().SetTimeStateAndParametersFrom(saved)
    simulator.Initialize(InitializeParams(suppress_initialization_events=True))
    np.testing.assert_array_equal(run(station, simulator, 5), first)


def test_both_engines_have_the_same_motors():
    torques = [run(*start(engine), 10)[1] for engine in ("nonsmooth", "plant")]
    np.testing.assert_allclose(*torques, rtol=1e-6)
