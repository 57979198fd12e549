"""The pile's part of the configuration: rocks, site, pile making (method section 3)."""

from __future__ import annotations

import math
from typing import Annotated

from pydantic import Field, model_validator

from drakerock.config import Config

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]

# Rocks leave the emitter as if they had fallen from 0.5 m above it, so that it clears in time [m/s].
START_SPEED = 3.0
GRAVITY = 9.81
# Rocks that a pile may have.
MAX_ROCKS = 100_000
# Corners of a rock shape, unless said otherwise: the cost of a contact grows with them.
MAX_CORNERS = 40


class SizeClass(Config):
    """One class of the gradation: rocks of one sieve width and their share of the total mass."""

    size_m: Annotated[float, Field(gt=0.01, le=5.0, description="sieve width [m]")]
    mass_fraction: Annotated[float, Field(gt=0, le=1)]


class RocksConfig(Config):
    """The rocks: shapes, gradation, material (method section 3, table)."""

    file_fields = ("shapes",)

    shapes: Annotated[
        tuple[str, ...],
        Field(min_length=1, description="mesh files (.obj), one per convex shape, at any scale"),
    ] = tuple(f"package://drakerock/rocks/rock_{k}.obj" for k in range(6))
    max_corners: Annotated[
        int, Field(ge=8, le=128, description="a shape with more corners is reduced to so many")
    ] = MAX_CORNERS
    gradation: Annotated[tuple[SizeClass, ...], Field(min_length=1)] = (
        SizeClass(size_m=0.3, mass_fraction=0.2),
        SizeClass(size_m=0.4, mass_fraction=0.3),
        SizeClass(size_m=0.6, mass_fraction=0.3),
        SizeClass(size_m=0.8, mass_fraction=0.2),
    )
    density: Annotated[float, Field(gt=0, le=20_000, description="[kg/m^3]")] = 2500.0
    friction: Annotated[float, Field(gt=0, le=3, description="per body; a pair has 2 a b / (a + b)")] = 0.9
    elastic_modulus: Annotated[float, Field(gt=0, description="[Pa]")] = 1.0e9
    poisson_ratio: Annotated[float, Field(ge=0, lt=0.5)] = 0.3
    restitution: Annotated[float, Field(ge=0, le=1, description="rock against rock")] = 0.0
    restitution_machine: Annotated[float, Field(ge=0, le=1, description="machine against rock")] = 0.1

    @model_validator(mode="after")
    def _check_gradation(self) -> RocksConfig:
        total = sum(item.mass_fraction for item in self.gradation)
        if abs(total - 1.0) > 1e-6:
            raise ValueError(f"gradation: the mass fractions must sum to 1, not {total:g}")
        sizes = [item.size_m for item in self.gradation]
        if len(set(sizes)) != len(sizes):
            raise ValueError("gradation: each size_m may stand once only")
        return self


class SiteConfig(Config):
    """The drift and the void behind its brow (method section 3)."""

    drift_width: Annotated[float, Field(gt=1, le=30, description="[m]")] = 6.5
    drift_height: Annotated[float, Field(gt=1, le=20, description="at the crown [m]")] = 5.0
    roof_sag: Annotated[float, Field(ge=0, le=3, description="crown above the roof's springing [m]")] = 0.4
    drift_length: Annotated[float, Field(gt=5, le=200, description="[m]")] = 40.0
    void_depth: Annotated[float, Field(gt=0.5, le=50, description="brow to rear wall [m]")] = 8.6
    void_height: Annotated[
        float, Field(gt=1, le=60, description="height of the walls above the floor [m]")
    ] = 12.0
    rear_layer: Annotated[
        float,
        Field(ge=0, le=10, description="thickness of the static rocks on the rear wall, 0: none [m]"),
    ] = 1.0
    void_taper_deg: Annotated[
        float,
        Field(ge=0, le=30, description="lean of the void's side and rear walls inwards, towards the floor"),
    ] = 0.0
    wall_lean_deg: Annotated[
        float,
        Field(
            ge=-30,
            le=30,
            description="lean of the face above the brow from the vertical; > 0: away from the rocks",
        ),
    ] = 10.0
    friction: Annotated[float, Field(gt=0, le=3, description="per body; a pair has 2 a b / (a + b)")] = 1.125

    @model_validator(mode="after")
    def _check_heights(self) -> SiteConfig:
        if self.roof_sag >= 0.5 * self.drift_height:
            raise ValueError("roof_sag must be below half of drift_height")
        if self.void_height < self.drift_height:
            raise ValueError("void_height must be at least drift_height")
        if self.rear_layer and self.rear_layer > self.void_depth - 0.5:
            raise ValueError("rear_layer must leave 0.5 m of void_depth (0: no static rocks)")
        foot = self.void_height * math.tan(math.radians(self.void_taper_deg))
        if foot and (foot > 0.25 * self.drift_width or foot > 0.25 * self.void_depth):
            raise ValueError("void_taper_deg must leave half of the void's width and depth at the floor")
        return self


class PileConfig(Config):
    """How the pile is made: rocks emitted from above and simulated to rest (method section 3)."""

    file_fields = ("source",)

    source: Annotated[str | None, Field(description="a stored pile (.npz) to take instead of making one")] = (
        None
    )
    rocks: Annotated[
        int | None,
        Field(
            gt=0,
            le=MAX_ROCKS,
            description="number of moving rocks to emit; null: until the void is full to the emitter",
        ),
    ] = None
    emission_height: Annotated[float, Field(gt=0, le=60, description="underside of the emitter [m]")] = 8.0
    emission_reach: Annotated[
        float, Field(ge=0, le=50, description="how far before the brow rocks are emitted [m]")
    ] = 0.0
    emission_interval: Annotated[
        float, Field(ge=0.1, le=2, description="time between emitted batches [s]")
    ] = 0.5
    settle_speed: Annotated[
        float, Field(gt=0, description="at rest when 99 % of the rocks are slower than this [m/s]")
    ] = 0.002
    settle_window: Annotated[float, Field(gt=0, description="... by displacement over this time [s]")] = 0.5
    max_time: Annotated[float, Field(gt=0, description="give up settling after this time [s]")] = 30.0
    balance_time: Annotated[
        float,
        Field(gt=0, le=30, description="then all rocks are awake for this time: forces find balance [s]"),
    ] = 3.0
    contact_gap: Annotated[
        float,
        Field(ge=0, le=0.1, description="rocks nearer than this touch: debris is what touches no pile [m]"),
    ] = 0.005

    @property
    def emission_top(self) -> float:
        """Upper side of the emitter [m]; between two batches it empties by their fall."""
        interval = self.emission_interval
        return self.emission_height + (START_SPEED * interval + 0.5 * GRAVITY * interval**2)
