"""What is explored: design variables with ranges and units, objectives with units and senses.

Nothing in this room is tied to the method's four variables and three objectives: they are the default
`Problem`, and any other table of points and responses brings its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, StringConstraints, model_validator

from drakerock.config import Config
from drakerock.errors import InputError

Array = NDArray[np.float64]
# A name is also a column of the table, part of a command-line option and of a figure's file name.
Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=100)]
# Columns of the tables that a study and the exploration write: of points, of loadings, of the front.
OWN_COLUMNS = (
    "point", "role", "loading", "n_loadings", "n_failed", "failure", "replay", "attempt", "status", "reason",
    "p_optimal", "bucket_mass_kg", "bucket_rocks", "weighed_mass_kg", "loading_time_s", "energy_J",
    "peak_push_force_N", "mean_push_force_N", "sim_time_s", "steps", "seed", "scenario_hash", "wall_time_s",
    "rocks_total", "rocks_awake_mean", "rocks_awake_max", "seconds", "inputs_hash",
    "load_t", "payload_percent", "fill_factor", "bucket_phase_kWh_per_t", "loading_kWh_per_t",
    "tractive_effort_mean_N", "tractive_effort_peak_N", "wheel_slip_m", "breakout_use", "spillage_share",
)  # fmt: skip
# What is written beside an objective has its name and one of these.
OBJECTIVE_SUFFIXES = ("_se", "_std", "_predicted", "_predicted_std", "_simulated", "_simulated_se", "_z")
# Beyond it, hypervolumes of five objectives and squares overflow.
MAX_MAGNITUDE = 1e60

Magnitude = Annotated[float, Field(ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE)]


class Variable(Config):
    """One design variable and its range."""

    name: Name
    low: Magnitude
    high: Magnitude
    unit: str = "-"
    symbol: str = ""
    meaning: str = ""

    @model_validator(mode="after")
    def _check_range(self) -> Self:
        if not self.low < self.high:
            raise ValueError(
                f"variable '{self.name}': low must be below high, got {self.low} and {self.high}"
            )
        return self

    @property
    def label(self) -> str:
        """The symbol, or the name where there is none."""
        return self.symbol or self.name


class Objective(Config):
    """One objective. Tables and people see it in its natural sense; the exploration minimises."""

    name: Name
    sense: Literal["min", "max"] = "min"
    unit: str = "-"
    meaning: str = ""
    worst: Annotated[
        Magnitude | None,
        Field(
            description="value of a loading that has no finite one, such as energy per mass of nothing; a bound"
        ),
    ] = None
    lowest: Annotated[
        Magnitude | None,
        Field(description="values below do not exist, such as negative masses; predictions are cut there"),
    ] = None

    @property
    def sign(self) -> float:
        """Factor from the natural value to the minimised one: -1 for an objective to be maximised."""
        return -1.0 if self.sense == "max" else 1.0

    @property
    def label(self) -> str:
        """Name and unit, for an axis."""
        return self.name if self.unit == "-" else f"{self.name} [{self.unit}]"


class Problem(Config):
    """The design variables and the objectives; the defaults are the method's (section 5)."""

    variables: tuple[Variable, ...] = Field(
        default=(
            Variable(name="alpha", symbol="α", low=0.2, high=2.0, meaning="bucket fill ratio aimed at"),
            Variable(name="beta", symbol="β", low=0.0, high=1.0, meaning="dig height: 0 deep, 1 shallow"),
            Variable(
                name="gamma", symbol="γ", low=0.0, high=1.0, meaning="entry point: 0 rear-most, 1 front-most"
            ),
            Variable(
                name="kappa", symbol="κ", low=0.0, high=1.0, meaning="share of the curl done while lifting"
            ),
        ),
        min_length=1,
    )
    objectives: tuple[Objective, ...] = Field(
        default=(
            Objective(
                name="production",
                sense="max",
                unit="kg/s",
                meaning="loaded mass over loading time",
                lowest=0.0,
            ),
            Objective(name="damage", meaning="overload of the bucket hinge over time", lowest=0.0),
            Objective(name="debris", unit="kg", meaning="rock left on the floor after loading", lowest=0.0),
        ),
        min_length=1,
    )

    @model_validator(mode="after")
    def _check_names(self) -> Self:
        names = [*self.variable_names, *self.objective_names]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"variable and objective names must differ; used twice: {', '.join(twice)}")
        beside = {name + suffix: name for name in self.objective_names for suffix in OBJECTIVE_SUFFIXES}
        own = {name.casefold() for name in OWN_COLUMNS}
        for name in names:
            if name.casefold() in own:
                raise ValueError(
                    f"no variable or objective may be called '{name}', a column of the tables; taken are "
                    + ", ".join(OWN_COLUMNS)
                )
            if name in beside:
                raise ValueError(
                    f"no variable or objective may be called '{name}', a column that belongs to '{beside[name]}'"
                )
        return self

    @property
    def variable_names(self) -> tuple[str, ...]:
        """Names of the variables, in order."""
        return tuple(v.name for v in self.variables)

    @property
    def objective_names(self) -> tuple[str, ...]:
        """Names of the objectives, in order."""
        return tuple(o.name for o in self.objectives)

    @property
    def low(self) -> Array:
        """Lower ends of the ranges, (d,)."""
        return np.array([v.low for v in self.variables])

    @property
    def high(self) -> Array:
        """Upper ends of the ranges, (d,)."""
        return np.array([v.high for v in self.variables])

    @property
    def signs(self) -> Array:
        """Factors from natural to minimised objectives and back, (k,)."""
        return np.array([o.sign for o in self.objectives])

    def scale(self, X: ArrayLike) -> Array:
        """Map points (n, d) from the variables' ranges to [-1, 1] (method section 6)."""
        return 2.0 * (np.asarray(X, dtype=float) - self.low) / (self.high - self.low) - 1.0

    def unscale(self, U: ArrayLike) -> Array:
        """Map points (n, d) from [-1, 1] to the variables' ranges; the ends are met exactly."""
        X = self.low + 0.5 * (np.asarray(U, dtype=float) + 1.0) * (self.high - self.low)
        return np.clip(X, self.low, self.high)

    def get_objective(self, name: str) -> tuple[int, Objective]:
        """Return index and objective of that name; `InputError` names the ones there are."""
        for i, objective in enumerate(self.objectives):
            if objective.name == name:
                return i, objective
        raise InputError(f"unknown objective '{name}'; there are: {', '.join(self.objective_names)}")

    def make_point(self, values: Mapping[str, float]) -> Array:
        """Return the point (d,) from values by variable name; all must be given and inside their ranges."""
        if set(values) != set(self.variable_names):
            got = ", ".join(values) or "nothing"
            raise InputError(f"a point needs exactly {', '.join(self.variable_names)}; got {got}")
        for v in self.variables:
            if not v.low <= values[v.name] <= v.high:
                raise InputError(
                    f"{v.name} = {values[v.name]:g} is outside its range [{v.low:g}, {v.high:g}]"
                )
        return np.array([float(values[name]) for name in self.variable_names])


def format_number(value: float, digits: int = 3) -> str:
    """Return a number for a person, with so many significant digits; - for NaN."""
    if not np.isfinite(value):
        return "-"
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e" in text and 1.0 <= abs(value) < 1e6 else text


# The method's reference strategies [alpha, beta, gamma, kappa] (section 6), to draw and compare.
REFERENCE_STRATEGIES: dict[str, tuple[float, ...]] = {
    "reference 1": (1.3, 0.85, 1.0, 0.6),
    "reference 2": (0.3, 0.6, 0.6, 0.2),
    "reference 3": (1.8, 0.1, 0.2, 1.0),
}
