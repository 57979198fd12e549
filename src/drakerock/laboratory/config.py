"""What each test of the laboratory can be told; lengths are multiples of the rocks' mean size where they say so.

The mean size is the mean sieve width by mass. Benches are as large as their number of rocks makes them.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from drakerock.config import Config

Stresses = Annotated[
    tuple[Annotated[float, Field(gt=0, le=2000)], ...], Field(min_length=2, description="[kPa]")
]
Lengths = tuple[Annotated[float, Field(gt=0, le=50)], ...]


class LabSettings(Config):
    """Of every test."""

    rocks: Annotated[int, Field(ge=20, le=20_000, description="in each specimen")] = 250
    repeats: Annotated[int, Field(ge=1, le=100, description="specimens, each of rocks of its own")] = 3


class ReposeSettings(LabSettings):
    """Angle of repose: behind a withdrawn wall, and in a tilted box."""

    repeats: Annotated[int, Field(ge=1, le=100, description="specimens, each of rocks of its own")] = 4
    gate_speed: Annotated[float, Field(gt=0, le=5, description="of the withdrawn wall [m/s]")] = 1.0
    tilt_rate_deg: Annotated[float, Field(gt=0, le=20, description="of the box [deg/s]")] = 6.0


class ShearSettings(LabSettings):
    """Triaxial compression between smooth platens, without gravity."""

    filling_friction: Annotated[
        float,
        Field(
            gt=0, le=1, description="while rocks are squeezed together, over their own: the less, the denser"
        ),
    ] = 0.3
    stresses_kPa: Stresses = (50.0, 100.0, 200.0)
    strain_rate: Annotated[float, Field(gt=0, le=0.5, description="axial [1/s]")] = 0.05
    strain: Annotated[float, Field(ge=0.05, le=0.5, description="axial, at the end")] = 0.15


class DischargeSettings(LabSettings):
    """Rocks run out of a slot, and out of a hopper with a slot."""

    rocks: Annotated[int, Field(ge=20, le=20_000, description="in each specimen")] = 1500
    openings: Annotated[Lengths, Field(min_length=3, description="of the slot [mean size]")] = (5.5, 6.5, 7.5)
    hopper_angle_deg: Annotated[
        float, Field(ge=10, le=45, description="of the hopper's walls, to the vertical")
    ] = 30.0


class SiloSettings(LabSettings):
    """A silo whose floor is let down a little: what the floor carries."""

    wall_friction: Annotated[
        float, Field(gt=0.05, le=1.0, description="between wall and rock")
    ] = 0.4  # fmt: skip
    slenderness: Annotated[float, Field(ge=1, le=10, description="height over width")] = 4.0


class SettlementSettings(LabSettings):
    """Rocks dropped in layers, then loaded by a lid."""

    drops: Annotated[
        tuple[Annotated[float, Field(ge=0.1, le=20)], ...],
        Field(min_length=1, description="heights over the bed [m]"),
    ] = (0.3, 3.0)
    stresses_kPa: Stresses = (50.0, 100.0, 200.0)


class PenetrationSettings(LabSettings):
    """A tool pushed level into a slope at imposed speeds."""

    rocks: Annotated[int, Field(ge=20, le=20_000, description="in each specimen")] = 1000
    repeats: Annotated[int, Field(ge=1, le=100, description="specimens, each of rocks of its own")] = 4
    speeds: Annotated[
        tuple[Annotated[float, Field(gt=0, le=3)], ...], Field(min_length=1, description="[m/s]")
    ] = (0.3, 0.6, 1.2)
    depths: Annotated[Lengths, Field(min_length=2, description="of the tip [mean size]")] = (
        2.0,
        4.0,
        6.0,
    )
    height: Annotated[
        float,
        Field(
            ge=0.02,
            le=10,
            description="of the edge over the floor [mean size]; rocks that fit under it jam between both",
        ),
    ] = 0.1


class DragSettings(LabSettings):
    """A vertical blade as wide as the bed, drawn through it."""

    rocks: Annotated[int, Field(ge=20, le=20_000, description="in each specimen")] = 900
    depths: Annotated[Lengths, Field(min_length=1, description="of the blade's edge [mean size]")] = (
        2.5,
        4.0,
    )
    speed: Annotated[float, Field(gt=0, le=2, description="[m/s]")] = 0.3
    travel: Annotated[float, Field(ge=1, le=20, description="[depth]")] = 1.5
    blade_friction: Annotated[float, Field(ge=0, le=1, description="between blade and rock")] = 0.4
    friction_angle_deg: Annotated[
        float | None,
        Field(
            gt=5,
            lt=70,
            description="that the prediction takes; null: from a shear test of these rocks, made first",
        ),
    ] = None
