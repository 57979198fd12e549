"""The machine's motors as a system: commands, state and torques of the laws of `motor_law`."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
    ValueProducer,
)

from drakerock.errors import InputError
from drakerock.lhd.model import Machine
from drakerock.lhd.motor_law import MotorCommand, MotorState
from drakerock.memory import weak


class Motors(LeafSystem):
    """Drives the machine's actuators by three commanded rates.

    Input ports:
        ``motor_speeds``: (3,) of wheels, boom and bucket [rad/s]; clamped to the motors' limits.
        ``steering_angle``: (1,) of the articulation [rad]; unconnected: the machine's.
        ``machine_state``: the plant's state output of the machine's instance.
        ``net_actuation``: the plant's output of that name, of the machine's instance.

    Output ports, for the plant's input ports of these names:
        ``desired_state``: positions (only the articulation's counts) and rates of the actuators, in Drake's order.
        ``actuation``: feed-forward torques in that order [N m].
        ``applied_generalized_force``: (v,) of the whole plant: the biases.
    And ``motor_torques``: what the actuators give over the step that begins, in that order [N m].

    State, in the actuators' order: torques [N m] in the step before, and the joints' rates [rad/s] at its beginning.
    """

    def __init__(self, plant: MultibodyPlant, machine: Machine) -> None:
        """Make it for `machine` in the finalized `plant`."""
        super().__init__()
        self.set_name("motors")
        actuators = [plant.get_joint_actuator(k) for k in plant.GetJointActuatorIndices(machine.instance)]
        joints = [actuator.joint().name() for actuator in actuators]
        of_joint = {"boom_joint": machine.boom, "bucket_joint": machine.bucket}
        # Per actuator: its motor, and which of the commanded rates it follows; none holds the steering angle.
        self._motors = [
            None if name == "articulation" else of_joint.get(name, machine.wheel) for name in joints
        ]
        self._sources = [{"boom_joint": 1, "bucket_joint": 2}.get(name, 0) for name in joints]
        self._steering_angle = machine.steering_angle
        self._starts = [actuator.joint().velocity_start() for actuator in actuators]
        velocities = plant.GetVelocitiesFromArray(
            machine.instance, np.arange(plant.num_velocities(), dtype=float)
        )
        row = {int(v): plant.num_positions(machine.instance) + k for k, v in enumerate(velocities)}
        self._rates = [row[start] for start in self._starts]
        n = len(actuators)
        self._speeds = self.DeclareVectorInputPort("motor_speeds", 3)
        self._angle = self.DeclareVectorInputPort("steering_angle", 1)
        self._machine_state = self.DeclareVectorInputPort(
            "machine_state", plant.num_multibody_states(machine.instance)
        )
        self._net_actuation = self.DeclareVectorInputPort("net_actuation", n)
        state = self.DeclareDiscreteState(np.zeros(2 * n))
        self.DeclarePeriodicDiscreteUpdateEvent(plant.time_step(), 0.0, self._update)
        # Not of the net actuation, which follows from these; nor of time, so that a step is solved once.
        commands = self.DeclareCacheEntry(
            "commands",
            ValueProducer(allocate=lambda: Value[object]([]), calc=weak(self._calc_commands)),
            {self._speeds.ticket(), self._machine_state.ticket(), self.discrete_state_ticket(state)},
        )
        self._commands = commands.cache_index()
        sources = {commands.ticket()}
        self.DeclareVectorOutputPort(
            "desired_state", 2 * n, self._calc_desired_state, sources | {self._angle.ticket()}
        )
        self.DeclareVectorOutputPort("actuation", n, self._calc_actuation, sources)
        self.DeclareVectorOutputPort(
            "applied_generalized_force", plant.num_velocities(), self._calc_generalized_force, sources
        )
        self.DeclareVectorOutputPort(
            "motor_torques", n, self._calc_motor_torques, sources | {self._net_actuation.ticket()}
        )

    def _calc_commands(self, context: Context, value: Value) -> None:
        speeds, state = self._speeds.Eval(context), self._machine_state.Eval(context)
        before = context.get_discrete_state_vector().value().reshape(2, -1).T
        value.set_value(
            [
                MotorCommand(0.0, 0.0, 0.0)
                if motor is None
                else motor.calc_command(
                    float(speeds[self._sources[k]]),
                    float(state[self._rates[k]]),
                    MotorState(*map(float, before[k])),
                )
                for k, motor in enumerate(self._motors)
            ]
        )

    def _get_commands(self, context: Context) -> list[MotorCommand]:
        commands: list[MotorCommand] = self.get_cache_entry(self._commands).Eval(context)
        return commands

    def _calc_desired_state(self, context: Context, output: BasicVector) -> None:
        angle = float(self._angle.Eval(context)[0]) if self._angle.HasValue(context) else self._steering_angle
        positions = [angle if motor is None else 0.0 for motor in self._motors]
        output.SetFromVector(positions + [command.rate for command in self._get_commands(context)])

    def _calc_actuation(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([command.feedforward for command in self._get_commands(context)])

    def _calc_generalized_force(self, context: Context, output: BasicVector) -> None:
        force = np.zeros(output.size())
        force[self._starts] = [command.bias for command in self._get_commands(context)]
        output.SetFromVector(force)

    def _calc_motor_torques(self, context: Context, output: BasicVector) -> None:
        bias = [command.bias for command in self._get_commands(context)]
        output.SetFromVector(self._net_actuation.Eval(context) + bias)

    def _update(self, context: Context, values: DiscreteValues) -> None:
        torques = self.GetOutputPort("motor_torques").Eval(context)
        values.set_value(np.concatenate([torques, self._machine_state.Eval(context)[self._rates]]))


def add_motors(builder: DiagramBuilder, plant: MultibodyPlant, machine: Machine) -> Motors:
    """Add the machine's motors and connect them to the plant; what commands them is connected by the caller.

    Args:
        builder: of the Diagram that `plant` is in; before `AddRocks`, since rocks feel motors.
        plant: finalized, with output ports that are not sampled: a torque has to be that of the step that begins.
        machine: the machine in it.

    Raises:
        InputError: the plant's output ports are sampled.
    """
    if plant.has_sampled_output_ports():
        raise InputError(
            "add_motors: the plant's output ports are sampled; make it with use_sampled_output_ports=False"
        )
    instance = machine.instance
    motors = builder.AddSystem(Motors(plant, machine))
    builder.Connect(plant.get_state_output_port(instance), motors.GetInputPort("machine_state"))
    builder.Connect(plant.get_net_actuation_output_port(instance), motors.GetInputPort("net_actuation"))
    for name, port in (
        ("desired_state", plant.get_desired_state_input_port(instance)),
        ("actuation", plant.get_actuation_input_port(instance)),
        ("applied_generalized_force", plant.get_applied_generalized_force_input_port()),
    ):
        builder.Connect(motors.GetOutputPort(name), port)
    return motors
