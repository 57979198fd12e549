"""The machine's part of the configuration."""

from __future__ import annotations

import math
from itertools import pairwise

from pydantic import Field, field_validator

from drakerock.config import Config


class MotorConfig(Config):
    """A motor's limits, where they differ from the SDFormat file's."""

    effort: float | None = Field(default=None, gt=0, description="largest torque [N m]; none: as in the file")
    velocity: float | None = Field(
        default=None, gt=0, description="largest rate [rad/s]; none: as in the file"
    )


RELIEF_SHARE = 1.07
"""Relief of a closed valve over the effort, as port reliefs stand above the pump's: docs/machine.md has the source."""


class FunctionConfig(MotorConfig):
    """A hydraulic function: the boom's lift or the bucket's tilt."""

    holds: bool = Field(
        default=True,
        description="commanded to zero it holds like a closed valve; false: the method's compliance, torque over "
        "motor_damping",
    )
    check_valve: bool = Field(
        default=True, description="a load does not push it back against its command, if it holds"
    )
    relief: float | None = Field(
        default=None,
        gt=0,
        description=f"torque at which the closed valve yields [N m]; none: {RELIEF_SHARE} times the effort",
    )


NO_LOAD_SHARE = 1.2
"""No-load speed of the wheels, over their largest commanded rate."""


class WheelConfig(MotorConfig):
    """A wheel's drive; `effort` is its torque at rest (stall)."""

    torque_curve: tuple[tuple[float, float], ...] | None = Field(
        default=((0.0, 1.0), (1.0, 0.0)),
        description="speed over no-load speed and torque over stall torque, from [0, 1] to [1, 0]; null: the method's "
        "constant limit",
    )
    no_load_speed: float | None = Field(
        default=None, gt=0, description=f"[rad/s]; none: {NO_LOAD_SHARE} times the largest rate"
    )

    @field_validator("torque_curve")
    @classmethod
    def _check_curve(cls, curve: tuple[tuple[float, float], ...] | None) -> object:
        if curve is None:
            return curve
        if len(curve) < 2 or curve[0] != (0.0, 1.0) or curve[-1] != (1.0, 0.0):
            raise ValueError("expected points [speed share, torque share] from [0, 1] to [1, 0]")
        # The shortest piece still has a slope that a step can be solved with.
        if not all(b[0] - a[0] >= 1e-3 and b[1] <= a[1] for a, b in pairwise(curve)) or not all(
            map(math.isfinite, sum(curve, ()))
        ):
            raise ValueError("expected speeds that rise by 0.001 at least and torques that do not")
        return curve


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
    wheel: WheelConfig = WheelConfig()
    boom: FunctionConfig = FunctionConfig()
    bucket: FunctionConfig = FunctionConfig()
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
