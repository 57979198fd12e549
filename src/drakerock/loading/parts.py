"""A controller, planner or sensor of one's own in a loading station.

A part is a System with ports of known names; the station connects what it has. In a scenario it is named as
``module:function``, and the function is called with a `StationView` and the part's parameters by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, OutputPort, System

from drakerock.errors import InputError
from drakerock.lhd.model import Machine
from drakerock.loading.config import PartConfig
from drakerock.loading.planning import DiggingMachine
from drakerock.loading.scenario import Scenario
from drakerock.modules import import_named
from drakerock.rocks.shapes import RockShape

OUTPUTS = {"controller": "motor_speeds", "planner": "plan", "sensor": "height_field"}
"""The output port that each part must have."""


@dataclass(frozen=True, eq=False)
class StationView:
    """What a part may know of the station that it will be in.

    Attributes:
        scenario: the whole configuration.
        plant, scene_graph: Drake's, the plant finalized.
        machine: the machine's names and limits in the plant.
        digger: its kinematics and bucket.
        shapes: the rock shapes.
    """

    scenario: Scenario
    plant: MultibodyPlant
    scene_graph: SceneGraph
    machine: Machine
    digger: DiggingMachine
    shapes: tuple[RockShape, ...]


MakePart = Callable[..., System]
"""Makes a part from a `StationView`."""


def make_part(
    role: str, given: MakePart | None, config: PartConfig, view: StationView, default: Callable[[], System]
) -> System:
    """Return a part of the station.

    Args:
        role: controller, planner or sensor.
        given: what makes it, if the caller gave something.
        config: what the scenario names otherwise.
        view: what the part may know.
        default: makes ours, if nobody names another.

    Raises:
        InputError: no such module or function, parameters that it does not take, not a System, or one without the
            output port of its role.
    """
    where = f"loading.parts.{role}"
    if given is None and config.system is None:
        if config.parameters:
            raise InputError(f"{where}.parameters: given without a system; name one in {where}.system")
        return default()
    make = given or load_function(str(config.system), f"{where}.system")
    try:
        part = make(view, **config.parameters)
    except TypeError as error:
        raise InputError(f"{where}: {config.system or make} cannot be called so: {error}") from error
    if not isinstance(part, System):
        raise InputError(f"{where}: {config.system or make} made a {type(part).__name__}, not a Drake System")
    if not part.HasOutputPort(OUTPUTS[role]):
        raise InputError(
            f"{where}: the system has no output port '{OUTPUTS[role]}', which a {role} must have"
        )
    return part


def load_function(name: str, where: str) -> MakePart:
    """Return the function that ``module:function`` or ``file.py:function`` names.

    Raises:
        InputError: no such module, file or function, or one that cannot be imported; `where` is the key.
    """
    module_name, _, function = name.rpartition(":")
    try:
        module = import_named(module_name)
    except Exception as error:
        raise InputError(f"{where}: {module_name} cannot be imported: {error}") from error
    found = getattr(module, function, None)
    if not callable(found):
        raise InputError(f"{where}: {module_name} has no function '{function}'")
    return found


OPEN_INPUTS = {"planner": ("preference",)}
"""Input ports that a part may have and the station has no signal for: they become input ports of its Diagram."""


def connect_inputs(
    builder: DiagramBuilder, role: str, part: System, signals: Mapping[str, OutputPort]
) -> None:
    """Connect each of a part's input ports to the signal of its name; those of `OPEN_INPUTS` are exported.

    Raises:
        InputError: a port of a name that the station has no signal for.
    """
    for k in range(part.num_input_ports()):
        port = part.get_input_port(k)
        if port.get_name() in OPEN_INPUTS.get(role, ()):
            builder.ExportInput(port, port.get_name())
            continue
        source = signals.get(port.get_name())
        if source is None:
            raise InputError(
                f"loading.parts.{role}: the station has no signal for its input port '{port.get_name()}'; it has "
                f"{', '.join(sorted(signals))}"
            )
        builder.Connect(source, port)
