"""The machine's part of the configuration."""

from __future__ import annotations

from pydantic import Field

from drakerock.config import Config


class MotorConfig(Config):
    """A motor's limits, where they differ from the SDFormat file's."""

    effort: float | None = Field(default=None, gt=0, description="largest torque [N m]; none: as in the file")
    velocity: float | None = Field(
        default=None, gt=0, description="largest rate [rad/s]; none: as in the file"
    )


class MachineData(Config):
    """What `run_machine_checks` expects of the machine; none: the value is reported without judgement."""

    total_mass: float | None = Field(default=60580.0, gt=0, description="[kg]")
    payload: float = Field(default=21000.0, gt=0, description="mass the boom has to lift at the bucket [kg]")
    heaped_capacity: float | None = Field(default=8.0, gt=0, description="heaped bucket volume [m^3]")
    breakout_force: float | None = Field(
        default=378e3, gt=0, description="vertical tip force, chassis held [N]"
    )
    reach: float | None = Field(default=4.24, gt=0, description="r_ft at the slope below [m]")
    reach_slope_deg: float = Field(
        default=40.0, gt=0, lt=80, description="slope at which r_ft is taken [deg]"
    )
    critical_moment: float | None = Field(
        default=145e3, gt=0, description="tau_c of the damage measure, for comparison only [N m]"
    )


class MachineConfig(Config):
    """Which machine, and what differs from its SDFormat file."""

    file_fields = ("model",)

    model: str = Field(
        default="package://drakerock/lhd/lhd.sdf",
        description="the SDFormat file: a path, or package://drakerock/...",
    )
    wheel: MotorConfig = MotorConfig()
    boom: MotorConfig = MotorConfig()
    bucket: MotorConfig = MotorConfig()
    motor_damping: float | None = Field(
        default=None, gt=0, description="velocity gain of the three motors [N m s/rad]; none: as in the file"
    )
    steering_angle_deg: float = Field(
        default=0.0, ge=-45, le=45, description="angle held at the articulation, positive turns left [deg]"
    )
    expected: MachineData = MachineData()
