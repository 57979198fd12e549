"""The dynamics' part of the configuration (method section 4)."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from drakerock.config import Config


class PlantEngineConfig(Config):
    """The `plant` engine: rocks as free bodies of the MultibodyPlant."""

    contact_model: Literal["point", "hydroelastic"] = "point"
    dissipation: Annotated[float, Field(ge=0, le=5, description="Hunt-Crossley [s/m]; more sinks")] = 1.0
    site_stiffness: Annotated[float, Field(gt=0, description="of floor and walls [N/m]")] = 1e9
    hydroelastic_resolution: Annotated[float, Field(gt=0, description="hint, share of a rock's size")] = 0.5


class DynamicsConfig(Config):
    """Time stepping and contact of the whole Diagram."""

    rocks: Annotated[Literal["plant"], Field(description="the engine that moves the rocks")] = "plant"
    time_step: Annotated[float, Field(gt=1e-4, le=0.05, description="[s]")] = 0.01
    contact_approximation: Annotated[
        Literal["similar", "lagged", "sap"], Field(description="Drake's discrete contact approximation")
    ] = "lagged"
    stiction_tolerance: Annotated[float, Field(gt=0, le=0.1, description="[m/s]")] = 1e-2
    reference_overlap: Annotated[
        float, Field(gt=0, le=0.05, description="overlap at which the contact stiffness is taken [m]")
    ] = 1e-3
    plant: PlantEngineConfig = PlantEngineConfig()
