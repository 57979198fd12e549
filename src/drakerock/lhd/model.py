"""From SDFormat to a plant: names checked, motors set."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains

from drakerock.errors import InputError
from drakerock.lhd import names
from drakerock.lhd.config import MachineConfig, MotorConfig
from drakerock.lhd.linkage import Loop, read_loops
from drakerock.resources import find_data
from drakerock.rocks.drake.plant_view import BallConstraint


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
    """

    instance: ModelInstanceIndex
    config: MachineConfig
    wheel: MotorLimits
    boom: MotorLimits
    bucket: MotorLimits
    steering_angle: float
    loops: tuple[Loop, ...]


def add_machine(plant: MultibodyPlant, config: MachineConfig) -> Machine:
    """Parse the machine into `plant` (before Finalize) and set its motors.

    The motors are velocity motors (section 2): position gain 0, a large velocity gain, an effort limit; the
    discrete solver treats them implicitly. The articulation's actuator holds the steering angle.

    Raises:
        InputError: no such file, an SDFormat error, or a name of `names` that is missing.
    """
    instance, loops = _parse(plant, config.model)
    _require_names(plant, instance, config.model)

    for name in ("articulation", "boom_joint", "bucket_joint", *names.WHEEL_JOINTS):
        if not plant.HasJointActuatorNamed(name, instance):
            raise InputError(f"{config.model}: joint '{name}' has no actuator (effort limit 0)")
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
        loops=loops,
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
    rates = {
        "articulation": 0.0,
        "boom_joint": float(np.clip(boom, -machine.boom.velocity, machine.boom.velocity)),
        "bucket_joint": float(np.clip(bucket, -machine.bucket.velocity, machine.bucket.velocity)),
    }
    wheel = float(np.clip(wheel, -machine.wheel.velocity, machine.wheel.velocity))
    joints = [
        plant.get_joint_actuator(index).joint().name()
        for index in plant.GetJointActuatorIndices(machine.instance)
    ]
    positions = [machine.steering_angle if name == "articulation" else 0.0 for name in joints]
    return np.array(positions + [rates.get(name, wheel) for name in joints])


def find_ball_constraints(plant: MultibodyPlant, machine: Machine) -> list[BallConstraint]:
    """Return the linkage's closed loops as `AddRocks` wants them."""
    return [
        BallConstraint(
            plant.GetBodyByName(loop.body_A, machine.instance).index(),
            np.array(loop.p_AP),
            plant.GetBodyByName(loop.body_B, machine.instance).index(),
            np.array(loop.p_BQ),
        )
        for loop in machine.loops
    ]


def _parse(plant: MultibodyPlant, model: str) -> tuple[ModelInstanceIndex, tuple[Loop, ...]]:
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(find_data("models", "package.xml")))
    try:
        file = parser.package_map().ResolveUrl(model) if model.startswith("package://") else model
        if not Path(file).is_file():
            raise InputError(f"machine.model: {model}: no such file")
        found = parser.AddModels(file)
    except RuntimeError as error:
        raise InputError(f"machine.model: {model}: {error}") from None
    if len(found) != 1:
        raise InputError(f"machine.model: {model}: expected one <model>, found {len(found)}")
    return found[0], read_loops(file)


def _require_names(plant: MultibodyPlant, instance: ModelInstanceIndex, model: str) -> None:
    wanted = [
        ("link", names.BODIES, plant.HasBodyNamed),
        ("joint", names.JOINTS, plant.HasJointNamed),
        ("frame", (*names.FRAMES, f"{names.PROFILE}0"), plant.HasFrameNamed),
    ]
    missing = [f"{kind} '{name}'" for kind, group, has in wanted for name in group if not has(name, instance)]
    if missing:
        raise InputError(f"machine.model: {model}: missing {', '.join(missing)}")


def _apply_motor(
    plant: MultibodyPlant, instance: ModelInstanceIndex, name: str, motor: MotorConfig, config: MachineConfig
) -> MotorLimits:
    actuator = plant.GetJointActuatorByName(name, instance)
    joint = plant.GetJointByName(name, instance)
    if motor.effort is not None:
        actuator.set_effort_limit(motor.effort)
    damping = config.motor_damping
    if damping is None:
        if not actuator.has_controller():
            raise InputError(f"machine.model: {config.model}: joint '{name}' has no drake:controller_gains")
        damping = actuator.get_controller_gains().d
    actuator.set_controller_gains(PdControllerGains(p=0.0, d=damping))
    velocity = float(joint.velocity_upper_limit()) if motor.velocity is None else motor.velocity
    return MotorLimits(float(actuator.effort_limit()), velocity)
