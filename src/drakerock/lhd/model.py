"""From SDFormat to a plant: names checked, motors set."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains

from drakerock.errors import InputError
from drakerock.lhd import names
from drakerock.lhd.config import MachineConfig, MotorConfig
from drakerock.lhd.model_file import Loop, check_machine_file, parse_machine


@dataclass(frozen=True)
class MotorLimits:
    """A motor's limits: `effort` [N m], `velocity` [rad/s]."""

    effort: float
    velocity: float


@dataclass(frozen=True)
class Machine:
    """A machine in a plant; bodies, joints and frames are found by name (`names`) and `instance`.

    Attributes:
        instance: the model instance of all its elements.
        config: what it was made from.
        wheel, boom, bucket: limits of one wheel's, the boom's and the bucket's motor.
        steering_angle: angle held at the articulation [rad].
        loops: the linkage's closed loops.
        ignored: what stands in its file without any effect, a line each.
    """

    instance: ModelInstanceIndex
    config: MachineConfig
    wheel: MotorLimits
    boom: MotorLimits
    bucket: MotorLimits
    steering_angle: float
    loops: tuple[Loop, ...]
    ignored: tuple[str, ...]


def add_machine(plant: MultibodyPlant, config: MachineConfig) -> Machine:
    """Parse the machine into `plant` (before Finalize) and set its motors.

    The motors are velocity motors (section 2): position gain 0, a large velocity gain, an effort limit; the
    discrete solver treats them implicitly. The articulation's actuator holds the steering angle.

    Raises:
        InputError: no such file, or something in it that cannot be used (`check_machine_file`).
    """
    file = check_machine_file(config)
    instance, _ = parse_machine(plant, file.path, config.model)
    _warn_of(file.ignored)

    wheels = [_apply_motor(plant, instance, j, config.wheel, config) for j in names.WHEEL_JOINTS]
    steering_angle = math.radians(config.steering_angle_deg)
    articulation = plant.GetJointByName("articulation", instance)
    if not articulation.position_lower_limit() <= steering_angle <= articulation.position_upper_limit():
        raise InputError(
            f"machine.steering_angle_deg: {config.steering_angle_deg} is outside the articulation's range, "
            f"+-{math.degrees(articulation.position_upper_limit()):.1f} deg in {config.model}"
        )
    articulation.set_default_angle(steering_angle)
    return Machine(
        instance=instance,
        config=config,
        wheel=wheels[0],
        boom=_apply_motor(plant, instance, "boom_joint", config.boom, config),
        bucket=_apply_motor(plant, instance, "bucket_joint", config.bucket, config),
        steering_angle=steering_angle,
        loops=file.loops,
        ignored=file.ignored,
    )


def calc_motor_targets(
    plant: MultibodyPlant, machine: Machine, wheel: float, boom: float, bucket: float
) -> np.ndarray:
    """Return the desired state [q, v] for ``plant.get_desired_state_input_port(machine.instance)``.

    Args:
        plant: the finalized plant.
        machine: the machine in it.
        wheel, boom, bucket: wanted joint rates [rad/s]; clamped to the motors' velocity limits.

    Returns:
        (2 n,) positions (only the articulation's counts) and velocities of the n actuators, in Drake's order.
    """
    return order_motor_targets(machine, find_motor_joints(plant, machine), wheel, boom, bucket)


def find_motor_joints(plant: MultibodyPlant, machine: Machine) -> list[str]:
    """Return the names of the joints that the machine's actuators turn, in Drake's order."""
    return [
        plant.get_joint_actuator(index).joint().name()
        for index in plant.GetJointActuatorIndices(machine.instance)
    ]


def order_motor_targets(
    machine: Machine, joints: list[str], wheel: float, boom: float, bucket: float
) -> np.ndarray:
    """Return what `calc_motor_targets` does, for the joints that `find_motor_joints` found."""
    limits = np.array([machine.wheel.velocity, machine.boom.velocity, machine.bucket.velocity])
    wheel, boom, bucket = np.clip([wheel, boom, bucket], -limits, limits).tolist()
    rates = {"articulation": 0.0, "boom_joint": boom, "bucket_joint": bucket}
    positions = [machine.steering_angle if name == "articulation" else 0.0 for name in joints]
    return np.array(positions + [rates.get(name, wheel) for name in joints])


@cache
def _warn_of(lines: tuple[str, ...]) -> None:
    """Tell once a process."""
    for line in lines:
        logging.getLogger("drakerock").warning(line)


def _apply_motor(
    plant: MultibodyPlant, instance: ModelInstanceIndex, name: str, motor: MotorConfig, config: MachineConfig
) -> MotorLimits:
    actuator = plant.GetJointActuatorByName(name, instance)
    joint = plant.GetJointByName(name, instance)
    if motor.effort is not None:
        actuator.set_effort_limit(motor.effort)
    damping = config.motor_damping
    if damping is None:
        damping = actuator.get_controller_gains().d
    actuator.set_controller_gains(PdControllerGains(p=0.0, d=damping))
    velocity = float(joint.velocity_upper_limits()[0]) if motor.velocity is None else motor.velocity
    return MotorLimits(float(actuator.effort_limit()), velocity)
