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


class MachineConfig(Config):
    """Which machine, and what differs from its SDFormat file."""

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
