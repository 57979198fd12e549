"""From SDFormat to a plant: names checked, motors set."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from functools import cache

from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, PdControllerGains, RevoluteJoint

from drakerock.errors import InputError
from drakerock.lhd import names
from drakerock.lhd.config import (
    NO_LOAD_SHARE,
    RELIEF_SHARE,
    FunctionConfig,
    MachineConfig,
    MotorConfig,
    WheelConfig,
)
from drakerock.lhd.model_file import Loop, check_machine_file, parse_machine
from drakerock.lhd.motor_law import Motor


@dataclass(frozen=True)
class Machine:
    """A machine in a plant; bodies, joints and frames are found by name (`names`) and `instance`.

    Attributes:
        instance: the model instance of all its elements.
        config: what it was made from.
        wheel, boom, bucket: the motors of one wheel, the boom and the bucket.
        steering_angle: angle held at the articulation [rad].
        loops: the linkage's closed loops.
        ignored: what stands in its file without any effect, a line each.
    """

    instance: ModelInstanceIndex
    config: MachineConfig
    wheel: Motor
    boom: Motor
    bucket: Motor
    steering_angle: float
    loops: tuple[Loop, ...]
    ignored: tuple[str, ...]


def add_machine(plant: MultibodyPlant, config: MachineConfig) -> Machine:
    """Parse the machine into `plant` (before Finalize) and set its motors.

    The motors' actuators have position gain 0, a large velocity gain and an effort limit (section 2); the discrete
    solver treats them implicitly. `add_motors` drives them. The articulation's actuator holds the steering angle.

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


@cache
def _warn_of(lines: tuple[str, ...]) -> None:
    """Tell once a process."""
    for line in lines:
        logging.getLogger("drakerock").warning(line)


def _apply_motor(
    plant: MultibodyPlant,
    instance: ModelInstanceIndex,
    name: str,
    config: MotorConfig,
    machine: MachineConfig,
) -> Motor:
    actuator = plant.GetJointActuatorByName(name, instance)
    joint = plant.GetJointByName(name, instance)
    damping = machine.motor_damping
    if damping is None:
        damping = actuator.get_controller_gains().d
    effort = float(actuator.effort_limit()) if config.effort is None else config.effort
    velocity = float(joint.velocity_upper_limits()[0]) if config.velocity is None else config.velocity
    motor = Motor(effort, velocity, damping)
    if isinstance(config, FunctionConfig):
        relief = RELIEF_SHARE * effort if config.relief is None else config.relief
        motor = replace(motor, holds=config.holds, check_valve=config.check_valve, relief=relief)
    elif isinstance(config, WheelConfig) and config.torque_curve:
        no_load = NO_LOAD_SHARE * velocity if config.no_load_speed is None else config.no_load_speed
        curve = tuple((no_load * rate, effort * torque) for rate, torque in config.torque_curve)
        motor = replace(motor, curve=curve, inertia=_calc_inertia(joint), time_step=plant.time_step())
    actuator.set_effort_limit(motor.half_window)
    actuator.set_controller_gains(PdControllerGains(p=0.0, d=damping))
    return motor


def _calc_inertia(joint: RevoluteJoint) -> float:
    """Return what the joint's child alone has about the joint's axis [kg m^2]."""
    X_BJ = joint.frame_on_child().GetFixedPoseInBodyFrame()
    inertia = joint.child_body().default_spatial_inertia().Shift(X_BJ.translation())
    axis = X_BJ.rotation() @ joint.revolute_axis()
    return float(axis @ inertia.CalcRotationalInertia().CopyToFullMatrix3() @ axis)
