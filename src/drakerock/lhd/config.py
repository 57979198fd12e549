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
    """What is known of a machine: what `run_machine_checks` expects of it, and what its loadings are judged by."""

    total_mass: float | None = Field(default=None, gt=0, description="[kg]")
    payload: float | None = Field(
        default=None,
        gt=0,
        description="mass the boom has to lift at the bucket [kg]; `machine check` needs it",
    )
    heaped_capacity: float | None = Field(default=None, gt=0, description="heaped bucket volume [m^3]")
    breakout_force: float | None = Field(
        default=None, gt=0, description="vertical tip force, chassis held [N]"
    )
    reach: float | None = Field(default=None, gt=0, description="r_ft at the slope below [m]")
    reach_slope_deg: float = Field(
        default=40.0, gt=0, lt=80, description="slope at which r_ft is taken [deg]"
    )
    critical_moment: float | None = Field(
        default=None, gt=0, description="tau_c of the damage measure: what the bucket's hinge may carry [N m]"
    )


SHIPPED_MODEL = "package://drakerock/lhd/lhd.sdf"
SHIPPED_DATA = MachineData(
    total_mass=60580.0,
    payload=21000.0,
    heaped_capacity=8.0,
    breakout_force=378e3,
    reach=4.24,
    critical_moment=145e3,
)
"""Of the method's LH621-class machine (sections 2 and 5)."""


class MachineConfig(Config):
    """Which machine, and what differs from its SDFormat file."""

    file_fields = ("model",)

    model: str = Field(
        default=SHIPPED_MODEL,
        description="the SDFormat file: a path, or package://drakerock/...",
    )
    wheel: MotorConfig = MotorConfig()
    boom: MotorConfig = MotorConfig()
    bucket: MotorConfig = MotorConfig()
    motor_damping: float | None = Field(
        default=None, gt=0, description="velocity gain of the three motors [N m s/rad]; none: as in the file"
    )
    steering_angle_deg: float = Field(
        default=0.0,
        ge=-45,
        le=45,
        description="angle held at the articulation: the rear unit's, so that negative turns left [deg]",
    )
    expected: MachineData = MachineData()

    @property
    def data(self) -> MachineData:
        """`expected`; of the shipped machine with the method's values where that is silent."""
        if self.model != SHIPPED_MODEL:
            return self.expected
        given = self.expected.model_dump(exclude_none=True, exclude={"reach_slope_deg"})
        return SHIPPED_DATA.replace(**given, reach_slope_deg=self.expected.reach_slope_deg)
