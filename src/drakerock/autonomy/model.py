"""The model that advises: everything that is learned from a study, each part when it is first asked for."""

from __future__ import annotations

import hashlib
import os
from contextlib import suppress
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from platformdirs import user_cache_path
from pydrake.systems.framework import DiagramBuilder

from drakerock.autonomy.bandit import BanditChoice
from drakerock.autonomy.choices import BestFixedChoice, Choice, FixedChoice, PileAwareChoice
from drakerock.autonomy.data import LoadingData, read_loading_data
from drakerock.autonomy.encoding import PileEncoder
from drakerock.autonomy.entry import PileGrid
from drakerock.autonomy.hazards import HazardLimits, calibrate_limits, find_hazards
from drakerock.autonomy.look_ahead import LookAheadChoice
from drakerock.autonomy.novelty import Novelty
from drakerock.autonomy.outcome_models import BlindOutcome, FeatureOutcome, FieldOutcome, fit_field_outcome
from drakerock.autonomy.pile_model import PileModel
from drakerock.autonomy.preference import CostScale, Preference
from drakerock.autonomy.situation import Situation
from drakerock.errors import InputError
from drakerock.exploration.config import ParetoConfig
from drakerock.exploration.pareto import ParetoFront, pareto_front
from drakerock.exploration.problem import Array
from drakerock.exploration.surrogate import Surrogate, fit_surrogate
from drakerock.exploration.table import average_loadings
from drakerock.identity import calc_config_hash
from drakerock.lhd.model import add_machine
from drakerock.loading.config import StrategyConfig
from drakerock.loading.field import HeightField
from drakerock.loading.planning import DiggingMachine
from drakerock.loading.scenario import Scenario
from drakerock.loading.station import make_digging_machine
from drakerock.rocks.drake.plant import add_plant

CHOICES = {
    "fixed": "the scenario's own strategy, loading.strategy",
    "best_fixed": "the best strategy of the study's Pareto front",
    "features": "by the pile: its features joined to the design variables in a Kriging",
    "field": "by the pile: regression over the height field and the entry",
    "look_ahead": "as field, over several loadings with a learned model of the pile after",
    "bandit": "as field, learning on from its own loadings by Thompson sampling",
}
"""Names of the choices, and what they are."""

# The front counts as at least so wide, in ranges of the objectives over nine tenths of the loadings.
_LEAST_SPREAD = 0.1
_FRONT = ParetoConfig(population=200, evaluations=12_000, n_draws=0)


class _Learned(cached_property):  # type: ignore[type-arg]
    """A part of the model that takes long to learn: kept in the model's folder, where it has one."""

    def __get__(self, model: Any, owner: Any = None) -> Any:
        if model is None or self.attrname in vars(model):
            return super().__get__(model, owner)
        path = None if model.folder is None else model.folder / f"{self.attrname}.joblib"
        if path is None or not self._read(model, path):
            part = super().__get__(model, owner)
            if path is not None and self._write(part, path):
                # Arrays that were read may lie otherwise in memory, and sums over them differ in the last bit: who
                # learns goes on with what the next one will read.
                self._read(model, path)
        return vars(model)[self.attrname]

    def _read(self, model: Any, path: Path) -> bool:
        with suppress(Exception):  # missing, or damaged: whatever unpickling then raises
            vars(model)[self.attrname] = joblib.load(path)
            return True
        return False

    def _write(self, part: Any, path: Path) -> bool:
        with suppress(OSError):  # no room, no permission: it is learned again next time
            path.parent.mkdir(parents=True, exist_ok=True)
            partial = path.with_suffix(f".{os.getpid()}")
            joblib.dump(part, partial)
            partial.replace(path)
            return True
        return False


class LoaderModel:
    """What a study's loadings teach.

    Args:
        data: the loadings to learn from.
        seed: of all randomness in learning and choosing.
        machine: the machine's size; None: of the data's scenario.
        cache: folder in which what is learned is kept, for the next model of the same data; None: nowhere.

    Raises:
        InputError: the study's variables are not those of a strategy.
    """

    def __init__(
        self,
        data: LoadingData,
        seed: int = 0,
        machine: DiggingMachine | None = None,
        cache: Path | None = None,
    ) -> None:
        known = tuple(StrategyConfig.model_fields)
        keys = data.keys or tuple(f"loading.strategy.{name}" for name in data.problem.variable_names)
        other = [
            f"{name} ({key})" if name in known else name
            for name, key in zip(data.problem.variable_names, keys, strict=True)
            if name not in known or key != f"loading.strategy.{name}"
        ]
        if other:
            raise InputError(
                f"the study varies {', '.join(other)}; an autonomous loader chooses among {', '.join(known)} only"
            )
        self.data, self.seed, self.problem = data, seed, data.problem
        scenario = data.scenario
        self.machine = machine or measure_machine(scenario)
        self.gamma = scenario.loading.strategy.gamma
        self.grid = self.make_grid(HeightField(data.x, data.y, data.before[0], data.cell), scenario)
        # A machine that is given is no part of what the folder is named by.
        self.folder = cache / self._calc_hash() if cache is not None and machine is None else None

    def _calc_hash(self) -> str:
        """Return what everything that is learned depends on, as 16 digits."""
        packages = ("drakerock", "numpy", "scipy", "scikit-learn", "pymoo")
        known = [
            self.learned_from, str(self.seed), *map(version, packages),
            *(hashlib.sha256(np.ascontiguousarray(getattr(self.data, name)).tobytes()).hexdigest()
              for name in ("following", "features", "loading")),
            *self.data.point.tolist(),
        ]  # fmt: skip
        return calc_config_hash(self.data.scenario, *known)

    def make_grid(self, field: HeightField, scenario: Scenario) -> PileGrid:
        """Return the grid of a field, and where the machine can enter on it."""
        half_room = (
            0.5 * (scenario.site.drift_width - self.machine.width) - scenario.loading.planning.wall_clearance
        )
        front_height = scenario.loading.sensing.front_height
        return PileGrid(
            field.x, field.y, field.cell, front_height, half_room, self.machine.bucket.outer_width
        )

    def check_fits(self, scenario: Scenario) -> None:
        """Raise InputError if a scenario's machine or sensor is another one than the study's."""
        study = self.data.scenario
        one, two = (calc_config_hash(item.resolve().machine) for item in (study, scenario))
        if one != two:
            raise InputError(
                f"the model was learned with another machine ({study.machine.model}) than the scenario's "
                f"({scenario.machine.model}); what it advises holds for that one only"
            )
        for key, learned, given in (
            ("site.drift_width", study.site.drift_width, scenario.site.drift_width),
            ("site.drift_length", study.site.drift_length, scenario.site.drift_length),
            ("loading.sensing.cell", study.loading.sensing.cell, scenario.loading.sensing.cell),
        ):
            if abs(learned - given) > 1e-9:
                raise InputError(
                    f"the model was learned with {key} = {learned:g}, the scenario has {given:g}: their height fields "
                    "differ"
                )

    def list_differences(self, scenario: Scenario) -> list[str]:
        """Return which parts of the loading a scenario has otherwise than the study; predictions may be off by them."""
        names = ("sensing", "planning", "control", "steering", "performance")
        one, two = self.data.scenario.loading, scenario.loading
        found = [f"loading.{name}" for name in names if getattr(one, name) != getattr(two, name)]
        if one.parts.controller != two.parts.controller:
            found.append("loading.parts.controller")
        return found

    def look_at(self, field: HeightField, scenario: Scenario) -> Situation:
        """Return what a sensed pile is to a choice.

        Raises:
            InputError: a field on another grid than the study's.
        """
        if field.h.shape != self.data.before.shape[1:] or abs(field.cell - self.data.cell) > 1e-9:
            raise InputError(
                f"a height field of {field.h.shape[0]} x {field.h.shape[1]} cells of {field.cell:g} m; the model was "
                f"learned with {' x '.join(map(str, self.data.before.shape[1:]))} of {self.data.cell:g} m"
            )
        grid = self.make_grid(field, scenario)
        hazards = find_hazards(grid, field.h, self.machine.width, self.hazard_limits)
        return Situation(field, grid, self.novelty.calc(field.h), hazards)

    def make_choice(self, name: str, strategy: StrategyConfig, depth: int = 3) -> Choice:
        """Return a choice by its name.

        Args:
            name: one of `CHOICES`.
            strategy: the scenario's own.
            depth: loadings that ``look_ahead`` looks ahead.

        Raises:
            InputError: no such choice; too few loadings for what it needs.
        """
        best = BestFixedChoice(self.front)
        if name == "fixed":
            x = np.array([getattr(strategy, variable) for variable in self.problem.variable_names])
            return FixedChoice(x, BlindOutcome(self.surrogate), "the scenario's own strategy")
        if name == "best_fixed":
            return best
        if name == "features":
            return PileAwareChoice(name, self.feature_outcome, self.scale, self.gamma, best, self.seed)
        if name == "field":
            return PileAwareChoice(name, self.field_outcome, self.scale, self.gamma, best, self.seed)
        if name == "look_ahead":
            piles = self.pile_model if depth > 1 else None
            return LookAheadChoice(
                self.field_outcome, piles, self.scale, self.gamma, best, depth=depth, seed=self.seed
            )
        if name == "bandit":
            return BanditChoice(self.field_outcome, self.scale, best, seed=self.seed)
        raise InputError(f"unknown choice '{name}'; there are {', '.join(CHOICES)}")

    @cached_property
    def learned_from(self) -> str:
        """What tells these loadings from others: the first 16 digits of their hash."""
        digest = hashlib.sha256(self.problem.model_dump_json().encode())
        for array in (self.data.X, self.data.Y, self.data.before):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]

    @_Learned
    def surrogate(self) -> Surrogate:
        """The exploration's surrogate, fitted to the means over each point's loadings.

        Raises:
            InputError: too few points.
        """
        data = self.data
        n = len(data)
        # Attempts at one point are sequences of their own.
        sequences = [f"{point}/{attempt}" for point, attempt in zip(data.point, data.attempt, strict=True)]
        table = average_loadings(
            self.problem, sequences, data.loading.tolist(), data.X, data.Y, ["sample"] * n, [""] * n,
            [""] * n, failed=[False] * n, provenance={},
        )  # fmt: skip
        return fit_surrogate(table, seed=self.seed)

    @_Learned
    def front(self) -> ParetoFront:
        """Its Pareto front: of fixed strategies."""
        return pareto_front(self.surrogate, config=_FRONT, seed=self.seed)

    @cached_property
    def scale(self) -> CostScale:
        """What costs are relative to."""
        # A front that is all but a point would make a hair's breadth of an objective decide.
        least = _LEAST_SPREAD * np.ptp(np.quantile(self.data.Y, (0.05, 0.95), axis=0), axis=0)
        spread = np.maximum(np.abs(self.front.nadir - self.front.ideal), least)
        return CostScale(self.problem, self.front.ideal, self.front.ideal + self.problem.signs * spread)

    @_Learned
    def encoder(self) -> PileEncoder:
        """Codes of height fields."""
        return PileEncoder().fit(self.data.before)

    @_Learned
    def hazard_limits(self) -> HazardLimits:
        """From when on something is a hazard: what is usual in the study is none."""
        return calibrate_limits(self.grid, self.data.before, self.machine.width)

    @_Learned
    def novelty(self) -> Novelty:
        """How unlike the training set a pile is."""
        return Novelty(self.data, self.encoder, self.seed)

    @_Learned
    def feature_outcome(self) -> FeatureOutcome:
        """The first rung: features of the pile."""
        return FeatureOutcome(self.data, self.grid, self.seed)

    @_Learned
    def field_outcome(self) -> FieldOutcome:
        """The second rung: the height field."""
        return fit_field_outcome(self.data, self.grid, self.encoder, self.gamma, self.seed)

    @_Learned
    def pile_model(self) -> PileModel:
        """The pile after."""
        return PileModel(self.data, self.grid, self.encoder, self.gamma, self.seed)

    @cached_property
    def robust(self) -> FixedChoice:
        """The fixed strategy for a pile that nothing is known of.

        Of the points that were simulated, the one of least cost, all objectives alike, where each is as bad as its
        surrogate's standard deviation allows: nothing in it is extrapolated.
        """
        X = np.unique(self.data.X, axis=0)
        mean, std = self.surrogate.predict(X, return_std=True)
        cost = self.scale.calc_cost(Preference(), mean + self.problem.signs * std, std)
        x: Array = X[int(np.argmin(cost))]
        return FixedChoice(
            x, BlindOutcome(self.surrogate), "robust: of least cost among the simulated strategies"
        )


def load_model(source: str | Path, seed: int = 0) -> LoaderModel:
    """Return the model that the loadings of a study teach, see `read_loading_data`.

    What is learned is kept in the user's cache.

    Raises:
        InputError: see `read_loading_data` and `LoaderModel`.
    """
    return LoaderModel(read_loading_data(source), seed, cache=user_cache_path("drakerock") / "loaders")


def measure_machine(scenario: Scenario) -> DiggingMachine:
    """Return a scenario's machine as a plan needs to know it.

    Raises:
        InputError: its SDFormat file cannot be used.
    """
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, scenario.dynamics)
    machine = add_machine(plant, scenario.machine)
    plant.Finalize()
    builder.Build()  # pydrake frees a plant only with its Diagram
    return make_digging_machine(plant, scene_graph, machine)
