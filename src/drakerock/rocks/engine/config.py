"""The dynamics' part of the configuration (method section 4)."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from drakerock.config import Config


def _advanced(**settings: Any) -> Any:
    """Return a field for those who know the method; users judge a simulation by the others."""
    return Field(json_schema_extra={"advanced": True}, **settings)


class RestConfig(Config):
    """When rocks fall asleep and when they are woken (reduction: rest).

    A sleeping rock is not solved and pairs of sleeping rocks are not searched; their contact impulses are kept.
    """

    displacement: Annotated[
        float, _advanced(gt=0, description="a rock falls asleep when it moved less than this [m] ...")
    ] = 0.0002
    time: Annotated[float, _advanced(gt=0, description="... within this time [s]")] = 0.1
    speed: Annotated[float, _advanced(gt=0, description="... and is slower than this [m/s, rad/s]")] = 0.05
    mover_speed: Annotated[
        float, _advanced(gt=0, description="... and leans on none that is faster than this, a mover [m/s]")
    ] = 0.001
    wake_load: Annotated[
        float,
        _advanced(
            gt=0,
            description="it wakes when the sum of its contact impulses has changed by this multiple of its weight's",
        ),
    ] = 0.3
    wake_share: Annotated[
        float, _advanced(ge=0, description="... and of half the sum of their sizes, the pressure on it")
    ] = 0.3
    wake_near_movers: Annotated[
        float, _advanced(ge=0, le=1, description="... both times this, if it leans on a mover")
    ] = 0.1
    wake_steps: Annotated[int, _advanced(ge=1, description="... for this many steps on end")] = 1
    recheck_period: Annotated[
        float,
        _advanced(gt=0, description="this often all that have moved since the start are woken together [s]"),
    ] = 2.0
    sensor_length: Annotated[
        float, _advanced(ge=0, le=10, description="rocks this far in front of the bucket are awake [m]")
    ] = 2.0
    sensor_margin: Annotated[
        float, _advanced(ge=0, le=5, description="... and this far from it to the other sides [m]")
    ] = 0.3


class NonsmoothConfig(Config):
    """The nonsmooth engine: stepper, contact solve, collision margins, sleeping rocks.

    Six settings are a user's: `iterations`, `stiffness_factor`, `linear_overlap`, `rounding`, `reduction`,
    `max_penetration`. The others are advanced: parameters of the method, marked as such in the JSON schema.
    """

    iterations: Annotated[
        int, Field(ge=1, le=2000, description="Gauss-Seidel iterations over all contacts in each step")
    ] = 50
    machine_sweeps: Annotated[
        int,
        _advanced(
            ge=0, le=100, description="further iterations after each over the contacts around the machine"
        ),
    ] = 1
    momentum: Annotated[
        float,
        _advanced(
            ge=0,
            lt=1,
            description="Nesterov acceleration: greatest share of two iterations' change by which they are "
            "extrapolated; 0: none",
        ),
    ] = 0.8
    impact_iterations: Annotated[
        int, _advanced(ge=1, le=500, description="Gauss-Seidel iterations of the impact stage")
    ] = 10
    impact_threshold: Annotated[
        float, _advanced(gt=0, description="contacts that approach faster are impacts [m/s]")
    ] = 0.1
    damping_time: Annotated[
        float, _advanced(ge=0, description="SPOOK's tau, time in which overlaps decay [time steps]")
    ] = 4.5
    stiffness_factor: Annotated[
        float,
        Field(
            gt=0,
            description="on Hertz's stiffness by modulus and Poisson ratio, of balls whose radii are the sieve widths",
        ),
    ] = 1.0
    linear_overlap: Annotated[
        float,
        Field(
            ge=0,
            description="0: Hertz's law, and what comes near is met rigidly; above: the plant engine's linear law, "
            "with Hertz's force at this overlap, also for what comes near [m]",
        ),
    ] = 0.0
    spin_damping: Annotated[
        float, _advanced(ge=0, le=20, description="each loaded contact damps the pair's relative spin [1/s]")
    ] = 2.0
    max_recovery_speed: Annotated[
        float, _advanced(gt=0, description="overlaps without load are pushed apart at most this fast [m/s]")
    ] = 1.0
    rounding: Annotated[
        float, Field(gt=0, le=0.1, description="rounding of the rocks' edges [sieve width]")
    ] = 0.03
    contact_margin: Annotated[
        float, _advanced(gt=0, le=0.2, description="contacts are found this far ahead of touching [m]")
    ] = 0.005
    search_distance: Annotated[
        float,
        _advanced(
            ge=0,
            le=0.01,
            description="contacts of slow rocks are searched after this way, their turning included, and follow their "
            "motion between [m]",
        ),
    ] = 0.001
    search_period: Annotated[
        int,
        _advanced(
            ge=1,
            le=20,
            description="contacts of faster rocks that move together are searched every so many steps (1: all contacts "
            "are searched in every step)",
        ),
    ] = 6
    slow_speed: Annotated[
        float, _advanced(ge=0, le=0.1, description="rocks are slow below this, their turning included [m/s]")
    ] = 0.02
    manifold_gap: Annotated[
        float, _advanced(ge=0, le=0.2, description="corners of faces that touch count up to this gap [m]")
    ] = 0.003
    face_cosine: Annotated[
        float, _advanced(gt=0, le=1, description="faces touch if this well aligned with the contact's normal")
    ] = 0.985
    manifold_points: Annotated[
        int,
        _advanced(
            ge=1, le=4, description="points per pair; with 1, as in point contact, faces roll on faces"
        ),
    ] = 4
    reduction: Literal["none", "rest"] = "rest"
    rest: RestConfig = RestConfig()
    max_residual: Annotated[
        float,
        _advanced(
            gt=0,
            description="a step with more is flagged and solved again with more iterations, then fails",
        ),
    ] = 0.05
    max_penetration: Annotated[
        float,
        Field(
            gt=0,
            description="overlaps beyond it are flagged, beyond 3/8 of it solved with more iterations [m]",
        ),
    ] = 0.04
    memory_per_rock: Annotated[
        int,
        _advanced(ge=3, le=50, description="loaded contact points that the contact cache can keep, per rock"),
    ] = 4

    @model_validator(mode="after")
    def _check_margins(self) -> NonsmoothConfig:
        if self.manifold_gap > self.contact_margin:
            raise ValueError("manifold_gap must not be above contact_margin")
        return self


class PlantEngineConfig(Config):
    """The `plant` engine: rocks as free bodies of the MultibodyPlant."""

    contact_model: Literal["point", "hydroelastic"] = "point"
    dissipation: Annotated[float, Field(ge=0, le=5, description="Hunt-Crossley [s/m]; more sinks")] = 1.0
    site_stiffness: Annotated[float, Field(gt=0, description="of floor and walls [N/m]")] = 1e9
    hydroelastic_modulus: Annotated[
        float,
        Field(
            gt=0,
            description="of rocks [Pa]; softer, faces carry over small patches, and rocks roll off each other",
        ),
    ] = 1e9
    relaxation_time: Annotated[
        float,
        Field(
            gt=0,
            le=1,
            description="of every body, with `contact_approximation: sap` [s]; by Drake's own 0.1 rocks sink",
        ),
    ] = 0.005

    @model_validator(mode="after")
    def _check_effect(self) -> PlantEngineConfig:
        if self.contact_model == "point" and self.hydroelastic_modulus != 1e9:
            raise ValueError("hydroelastic_modulus has no effect with contact_model: point")
        return self


class DynamicsConfig(Config):
    """Time stepping and contact of the whole Diagram."""

    rocks: Annotated[Literal["plant", "nonsmooth"], Field(description="the engine that moves the rocks")] = (
        "nonsmooth"
    )
    time_step: Annotated[float, Field(gt=1e-4, le=0.05, description="[s]")] = 0.01
    contact_approximation: Annotated[
        Literal["similar", "lagged", "sap"], Field(description="Drake's discrete contact approximation")
    ] = "lagged"
    stiction_tolerance: Annotated[float, Field(gt=0, le=0.1, description="[m/s]")] = 1e-2
    reference_overlap: Annotated[
        float, Field(gt=0, le=0.05, description="overlap at which the contact stiffness is taken [m]")
    ] = 1e-3
    plant: PlantEngineConfig = PlantEngineConfig()
    nonsmooth: NonsmoothConfig = NonsmoothConfig()

    @model_validator(mode="after")
    def _check_effect(self) -> DynamicsConfig:
        """Refuse what would have no effect: it is taken for more than it is."""
        plant, sap = PlantEngineConfig(), self.contact_approximation == "sap"
        idle = {
            "stiction_tolerance": sap and self.stiction_tolerance != 1e-2,
            "plant.dissipation": sap and self.plant.dissipation != plant.dissipation,
            "plant.relaxation_time": not sap and self.plant.relaxation_time != plant.relaxation_time,
        }
        for key, is_idle in idle.items():
            if is_idle:
                raise ValueError(
                    f"{key} has no effect with contact_approximation: {self.contact_approximation}"
                )
        if self.rocks == "plant" and self.nonsmooth != NonsmoothConfig():
            raise ValueError("nonsmooth has no effect with rocks: plant")
        return self
