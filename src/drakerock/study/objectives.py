"""The registry of objectives: functions of a cycle's outcome, by name."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from dataclasses import dataclass

from drakerock.errors import InputError
from drakerock.exploration.problem import MAX_MAGNITUDE, Objective
from drakerock.loading.outcome import CycleOutcome
from drakerock.modules import import_named

ObjectiveFunction = Callable[[CycleOutcome], float | None]
"""From the outcome of a finished cycle to the objective in its natural sense.

None (or NaN): no value, the loading is left out of this objective's mean. An infinite number, or a division by zero:
the objective's `worst`, and no value where none is registered. A finite value beyond `worst` counts as `worst`.
"""


@dataclass(frozen=True)
class RegisteredObjective:
    """An objective's description and its function."""

    objective: Objective
    function: ObjectiveFunction

    def evaluate(self, outcome: CycleOutcome) -> float:
        """Return the objective of a cycle that has not failed, finite; NaN: no value.

        Raises:
            InputError: the function raised something else than a division by zero, or returned no number.
        """
        objective = self.objective
        try:
            result = self.function(outcome)
            value = math.nan if result is None else float(result)
        except ZeroDivisionError:
            value = math.inf
        except Exception as error:  # whatever a user's function dies of
            raise InputError(f"objective '{objective.name}': {type(error).__name__}: {error}") from error
        if math.isnan(value):
            return value
        if objective.worst is None:
            if math.isfinite(value) and abs(value) > MAX_MAGNITUDE:
                raise InputError(
                    f"objective '{objective.name}': {value:g}; numbers up to {MAX_MAGNITUDE:g} are taken, or an "
                    "infinite one for the worst value"
                )
            return value if math.isfinite(value) else math.nan
        if math.isinf(value):
            return objective.worst
        # Worst is the largest value of what is minimised, the smallest of what is maximised.
        return objective.sign * min(objective.sign * value, objective.sign * objective.worst)


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
        import_named(name)
    except Exception as error:  # whatever a user's module dies of
        raise InputError(f"modules: {name}: cannot be imported: {type(error).__name__}: {error}") from error


@register_objective(
    Objective(
        name="production", sense="max", unit="kg/s", meaning="loaded mass over loading time", lowest=0.0
    )
)
def _get_production(outcome: CycleOutcome) -> float | None:
    return outcome.objectives["production"]


@register_objective(Objective(name="damage", meaning="overload of the bucket hinge over time", lowest=0.0))
def _get_damage(outcome: CycleOutcome) -> float | None:
    return outcome.objectives["damage"]


@register_objective(
    Objective(name="debris", unit="kg", meaning="rock left on the floor after loading", lowest=0.0)
)
def _get_debris(outcome: CycleOutcome) -> float | None:
    return outcome.objectives["debris"]


@register_objective(
    # A full bucket takes some 300 J/kg; a megajoule for a rock of 100 kg is as bad as nothing.
    Objective(
        name="specific_energy",
        unit="J/kg",
        meaning="the motors' work over the loaded mass",
        worst=1e4,
        lowest=0.0,
    )
)
def _calc_specific_energy(outcome: CycleOutcome) -> float | None:
    if outcome.energy_J is None or outcome.bucket_mass_kg is None:
        return None
    return outcome.energy_J / outcome.bucket_mass_kg


@register_objective(
    Objective(
        name="peak_force", unit="N", meaning="largest force of the rocks against the bucket", lowest=0.0
    )
)
def _get_peak_force(outcome: CycleOutcome) -> float | None:
    return outcome.peak_push_force_N


def _register_mining(key: str, objective: Objective) -> None:
    """Register one of the numbers of `drakerock.loading.mining`; without a load, those per tonne have their worst."""

    @register_objective(objective)
    def get_number(outcome: CycleOutcome) -> float | None:
        if outcome.mining is None:
            return None
        if objective.unit == "kWh/t" and outcome.mining["load_t"] == 0.0:
            return math.inf
        return outcome.mining[key]


for _key, _objective in {
    "payload_percent": Objective(
        name="payload", sense="max", unit="%", meaning="load over the machine's payload"
    ),
    "fill_factor": Objective(
        name="fill", sense="max", meaning="loose volume of the load over the bucket's heaped capacity"
    ),
    # As of specific_energy: 1e4 J/kg.
    "bucket_phase_kWh_per_t": Objective(
        name="digging_energy",
        unit="kWh/t",
        meaning="the motors' work until the bucket is tilted, per tonne",
        worst=2.8,
    ),
    "loading_kWh_per_t": Objective(
        name="loading_energy", unit="kWh/t", meaning="the motors' work of a loading per tonne", worst=2.8
    ),
    "wheel_slip_m": Objective(name="slip_distance", unit="m", meaning="way of the tyres that slips"),
    "breakout_use": Objective(name="breakout", meaning="largest torque of the bucket's motor over its limit"),
    "spillage_share": Objective(name="spillage", meaning="debris over load and debris", worst=1.0),
}.items():
    _register_mining(_key, _objective)
