"""The registry of objectives: functions of a cycle's outcome, by name."""

from __future__ import annotations

import difflib
import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from drakerock.errors import InputError
from drakerock.exploration.problem import Objective
from drakerock.loading.outcome import CycleOutcome

ObjectiveFunction = Callable[[CycleOutcome], float | None]
"""From the outcome of a finished cycle to the objective in its natural sense; None: no value."""


@dataclass(frozen=True)
class RegisteredObjective:
    """An objective's description and its function."""

    objective: Objective
    function: ObjectiveFunction


_REGISTRY: dict[str, RegisteredObjective] = {}


def register_objective(objective: Objective) -> Callable[[ObjectiveFunction], ObjectiveFunction]:
    """Make a function an objective that studies can name; to be used as a decorator.

    Example::

        @register_objective(Objective(name="energy", unit="J", meaning="the motors' work"))
        def calc_energy(outcome: CycleOutcome) -> float | None:
            return outcome.energy_J
    """

    def register(function: ObjectiveFunction) -> ObjectiveFunction:
        _REGISTRY[objective.name] = RegisteredObjective(objective, function)
        return function

    return register


def get_objective(name: str) -> RegisteredObjective:
    """Return a registered objective.

    Raises:
        InputError: there is none of that name.
    """
    if name not in _REGISTRY:
        near = difflib.get_close_matches(name, _REGISTRY, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        raise InputError(
            f"unknown objective '{name}'; {hint}registered: {', '.join(sorted(_REGISTRY))} "
            "(register your own in a module listed under 'modules')"
        )
    return _REGISTRY[name]


def import_module(name: str) -> None:
    """Import a module that registers objectives: an importable name, or the path of a .py file.

    Raises:
        InputError: it is not there or cannot be imported.
    """
    try:
        if name.endswith(".py"):
            spec = importlib.util.spec_from_file_location(Path(name).stem, name)
            if spec is None or spec.loader is None:
                raise ImportError("not a Python file")
            spec.loader.exec_module(importlib.util.module_from_spec(spec))
        else:
            importlib.import_module(name)
    except Exception as error:  # whatever a user's module dies of
        raise InputError(f"modules: {name}: cannot be imported: {type(error).__name__}: {error}") from error


@register_objective(
    Objective(name="production", sense="max", unit="kg/s", meaning="loaded mass over loading time")
)
def _get_production(outcome: CycleOutcome) -> float | None:
    return outcome.objectives["production"]


@register_objective(Objective(name="damage", meaning="overload of the bucket hinge over time"))
def _get_damage(outcome: CycleOutcome) -> float | None:
    return outcome.objectives["damage"]


@register_objective(Objective(name="debris", unit="kg", meaning="rock left on the floor after loading"))
def _get_debris(outcome: CycleOutcome) -> float | None:
    return outcome.objectives["debris"]


@register_objective(
    Objective(name="specific_energy", unit="J/kg", meaning="the motors' work over the loaded mass")
)
def _calc_specific_energy(outcome: CycleOutcome) -> float | None:
    if outcome.energy_J is None or not outcome.bucket_mass_kg:
        return None  # an empty bucket has no finite value
    return outcome.energy_J / outcome.bucket_mass_kg


@register_objective(
    Objective(name="peak_force", unit="N", meaning="largest force of the rocks against the bucket")
)
def _get_peak_force(outcome: CycleOutcome) -> float | None:
    return outcome.peak_push_force_N
