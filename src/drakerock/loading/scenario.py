"""A scenario: everything that one loading cycle depends on, as one YAML document."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field, model_validator

from drakerock.config import Config, load_config
from drakerock.lhd.config import MachineConfig
from drakerock.loading.config import LoadingConfig
from drakerock.resources import find_data
from drakerock.rocks.config import PileConfig, RocksConfig, SiteConfig
from drakerock.rocks.engine.config import DynamicsConfig
from drakerock.rocks.making.recipe import PileRecipe


class RecordingConfig(Config):
    """What is kept for the replay."""

    frame_rate: Annotated[float, Field(gt=0, le=100, description="frames per second [1/s]")] = 25.0
    motion_threshold: Annotated[
        float, Field(ge=0, le=0.1, description="a rock is drawn anew when it moved this far [m]")
    ] = 0.01


class Scenario(Config):
    """Machine, site, rocks, pile, dynamics and loading of one cycle. All keys have defaults."""

    seed: Annotated[int, Field(ge=0, description="of all randomness")] = 0
    machine: MachineConfig = MachineConfig()
    site: SiteConfig = SiteConfig()
    rocks: RocksConfig = RocksConfig()
    pile: PileConfig = PileConfig()
    dynamics: DynamicsConfig = DynamicsConfig()
    loading: LoadingConfig = LoadingConfig()
    recording: RecordingConfig = RecordingConfig()

    @property
    def tau_c(self) -> float:
        """The critical moment of the bucket's hinge [N m]: `performance.tau_c`, or the machine's."""
        tau_c = self.loading.performance.tau_c or self.machine.data.critical_moment
        assert tau_c is not None, "checked"
        return tau_c

    def resolve(self) -> Scenario:
        """Return it with what it derives from the machine written out, as it is stored beside results."""
        return self.replace(
            **{"loading.performance.tau_c": self.tau_c, "machine.expected": self.machine.data}
        )

    @model_validator(mode="after")
    def _check_critical_moment(self) -> Scenario:
        if self.loading.performance.tau_c is None and self.machine.data.critical_moment is None:
            # Of a machine that is nowhere, or no machine, that is what has to be said first.
            from drakerock.lhd.model_file import (
                check_machine_file,  # Drake: not for those who only read a scenario
            )

            check_machine_file(self.machine)
            raise ValueError(
                f"machine.expected.critical_moment: what moment the bucket's hinge of {self.machine.model} may carry "
                "is not known, and the damage measure needs it; give it here [N m], or as loading.performance.tau_c"
            )
        return self

    @model_validator(mode="after")
    def _check_emitter(self) -> Scenario:
        top = self.pile.emission_top
        roof = self.site.drift_height - self.site.roof_sag
        if self.pile.emission_reach > 0 and top > roof:
            raise ValueError(
                f"pile.emission_reach: before the brow rocks would appear up to {top:.2f} m, above the roof, which is "
                f"{roof:.2f} m high at the sides; 0, or lower emission_height or emission_interval"
            )
        return self


def load_scenario(path: str | Path | None = None, overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario.

    Args:
        path: a YAML file; None means the shipped ``studies/demo.yaml``.
        overrides: ``"dotted.key=value"`` strings on top of it.

    Raises:
        InputError: see `drakerock.config.load_config`.
    """
    return load_config(path or find_data("studies", "demo.yaml"), Scenario, overrides)


def make_recipe(scenario: Scenario) -> PileRecipe:
    """Return what the scenario's pile depends on."""
    return PileRecipe(
        seed=scenario.seed,
        site=scenario.site,
        rocks=scenario.rocks,
        pile=scenario.pile,
        dynamics=scenario.dynamics,
    )
