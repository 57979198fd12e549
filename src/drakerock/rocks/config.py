"""The pile's part of the configuration: rocks, site, pile making (method section 3)."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
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


class ScanConfig(Config):
    """A measured pile: the cloud's file, how it lies in the site, how it is cleaned."""

    file_fields = ("file",)

    file: Annotated[str, Field(description="point cloud: .ply, .las, .laz, .xyz, .txt, .asc, .pts or .csv")]
    unit: Annotated[Literal["m", "cm", "mm", "ft"], Field(description="of the file's numbers")] = "m"
    rotation_deg: Annotated[
        tuple[float, float, float],
        Field(description="roll, pitch, yaw about the site's x, y, z; applied first"),
    ] = (0.0, 0.0, 0.0)
    translation: Annotated[
        tuple[float, float, float], Field(description="then added; the brow is x = 0, the floor z = 0 [m]")
    ] = (0.0, 0.0, 0.0)
    matrix: Annotated[
        tuple[tuple[float, float, float, float], ...] | None,
        Field(description="instead of both: 4 rows of 4, from the cloud in metres to the site; no scale"),
    ] = None
    cell: Annotated[float, Field(ge=0.05, le=2, description="grid spacing of the surface [m]")] = 0.26
    max_hole: Annotated[
        float, Field(ge=0, le=20, description="holes up to this width are filled linearly [m]")
    ] = 1.5
    edge_slope_deg: Annotated[
        float, Field(ge=0, le=60, description="slope of the pile along the drift beyond the cloud's edges")
    ] = 35.0
    outlier_deviations: Annotated[
        float,
        Field(gt=0, description="an outlier's distance to its neighbours, in deviations above the median's"),
    ] = 4.0
    trust: Annotated[bool, Field(description="true: no checks of unit and of which side is up")] = False

    @model_validator(mode="after")
    def _check_matrix(self) -> ScanConfig:
        if self.matrix is None:
            return self
        matrix = np.array(self.matrix)
        turn = matrix[:3, :3] if matrix.shape == (4, 4) else np.zeros((3, 3))
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) or np.linalg.det(turn) < 0.0:
            raise ValueError(
                "matrix must have 4 rows of 4 numbers, its upper left 3 x 3 a rotation without scale"
            )
        if not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
            raise ValueError("matrix: the last row must be 0 0 0 1")
        if any(self.rotation_deg) or any(self.translation):
            raise ValueError("matrix stands instead of rotation_deg and translation; give one or the other")
        return self


class PileConfig(Config):
    """How the pile is made: rocks emitted from above and simulated to rest (method section 3)."""

    file_fields = ("source",)

    scan: Annotated[
        ScanConfig | None, Field(description="a measured surface to fill with rocks instead of emitting them")
    ] = None

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

    @model_validator(mode="after")
    def _check_origin(self) -> PileConfig:
        if self.scan is not None and (self.source is not None or self.rocks is not None):
            raise ValueError("scan stands instead of source and rocks: leave them out")
        return self

    @property
    def fills_void(self) -> bool:
        """Whether rocks are emitted until the void is full, not in a given number or to a measured surface."""
        return self.rocks is None and self.scan is None

    @property
    def emission_top(self) -> float:
        """Upper side of the emitter [m]; between two batches it empties by their fall."""
        interval = self.emission_interval
        return self.emission_height + (START_SPEED * interval + 0.5 * GRAVITY * interval**2)
