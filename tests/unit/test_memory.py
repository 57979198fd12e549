"""A Diagram that nobody uses any more is freed: studies run hundreds of loadings in one process."""

import weakref

import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import EventStatus

from drakerock.loading.scenario import Scenario
from drakerock.loading.station import make_station
from drakerock.memory import free_diagrams, weak


def simulate(scenario, pile):
    """Build a station, use every output port and a monitor, and return weak references to its parts."""
    station = make_station(scenario, pile)
    simulator = Simulator(station.diagram)
    root = simulator.get_mutable_context()
    station.initialize(root)
    mode = station.diagram.GetOutputPort("mode")

    def monitor(context):
        mode.Eval(root)
        return EventStatus.DidNothing()

    simulator.set_monitor(monitor)
    simulator.AdvanceTo(0.02)
    for k in range(station.diagram.num_output_ports()):
        station.diagram.get_output_port(k).Eval(root)
    station.rocks.get_pile(root)
    parts = {system.get_name(): weakref.ref(system) for system in station.diagram.GetSystems()}
    whole = {
        "diagram": station.diagram,
        "simulator": simulator,
        "context": root,
        "states": read_states(station, root),
    }
    return parts | {name: weakref.ref(part) for name, part in whole.items()}


def read_states(station, root):
    """Return what holds the rocks' state in a context."""
    context = station.rocks.GetMyContextFromRoot(root)
    return context.get_abstract_state().get_value(0).get_value() if context.num_abstract_states() else station


@pytest.mark.parametrize("rocks", ["nonsmooth", "plant"])
@pytest.mark.parametrize("kind", ["ideal", "scanner"])
def test_a_station_is_freed_after_use(heap, rocks, kind):
    scenario = Scenario.model_validate({"dynamics": {"rocks": rocks}, "loading": {"sensing": {"kind": kind}}})
    parts = simulate(scenario, heap)
    assert {"plant", "scene_graph", "rocks", "pile_sensor", "dig_planner"} < set(parts)
    free_diagrams()
    assert not [name for name, part in parts.items() if part() is not None]


def test_weak_callback_calls_its_method_and_does_not_keep_its_object():
    class Adder:
        def add(self, a, b):
            return a + b

    adder = Adder()
    call, reference = weak(adder.add), weakref.ref(adder)
    assert call(1, 2) == 3
    del adder
    assert reference() is None
