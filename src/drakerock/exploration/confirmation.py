"""Predicted against simulated: chosen points of the front, simulated again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from drakerock.errors import InputError
from drakerock.exploration.problem import Array, Problem
from drakerock.exploration.surrogate import Surrogate

# From a point (d,) to the mean responses (k,) and their standard errors (k,), natural senses. A short
# sequence knows its own autocorrelation badly: pool it over the study (`noise.calc_autocorrelation`).
Evaluate = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class Confirmation:
    """Re-simulated points.

    Attributes:
        problem: variables and objectives.
        X: (n, d) points.
        predicted, predicted_std: (n, k) by the surrogate.
        simulated, simulated_se: (n, k); NaN where the simulation failed or the spread is unknown.
        failure: (n,) reason of a failure, "" otherwise.
    """

    problem: Problem
    X: Array
    predicted: Array
    predicted_std: Array
    simulated: Array
    simulated_se: Array
    failure: tuple[str, ...]

    @property
    def z(self) -> Array:
        """(n, k) difference over its own standard deviation: beyond 2 the surrogate misled at that point."""
        spread = np.hypot(self.predicted_std, np.nan_to_num(self.simulated_se))
        return (self.simulated - self.predicted) / np.where(spread > 0.0, spread, np.nan)

    def to_rows(self) -> list[dict[str, Any]]:
        """Return one dictionary per point, for JSON and tables; None where there is no number."""
        rows = []
        z = self.z
        for i, x in enumerate(self.X):
            row: dict[str, Any] = dict(zip(self.problem.variable_names, map(float, x), strict=True))
            for j, name in enumerate(self.problem.objective_names):
                values = {
                    "predicted": self.predicted[i, j],
                    "predicted_std": self.predicted_std[i, j],
                    "simulated": self.simulated[i, j],
                    "simulated_se": self.simulated_se[i, j],
                    "z": z[i, j],
                }
                row |= {f"{name}_{k}": float(v) if np.isfinite(v) else None for k, v in values.items()}
            rows.append(row | {"failure": self.failure[i]})
        return rows

    @classmethod
    def from_rows(cls, problem: Problem, rows: list[dict[str, Any]]) -> Confirmation:
        """Return what `to_rows` was made from."""

        def read(suffix: str) -> Array:
            data = [[row[f"{name}_{suffix}"] for name in problem.objective_names] for row in rows]
            return np.array(data, dtype=float).reshape(len(rows), len(problem.objectives))

        try:
            X = np.array([[row[name] for name in problem.variable_names] for row in rows], dtype=float)
            X = X.reshape(len(rows), len(problem.variables))
            failure = tuple(str(row["failure"]) for row in rows)
            return cls(
                problem,
                X,
                read("predicted"),
                read("predicted_std"),
                read("simulated"),
                read("simulated_se"),
                failure,
            )
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"confirmation: not the rows of a confirmation of this problem: {error}"
            ) from None


def confirm_points(surrogate: Surrogate, X: Array, evaluate: Evaluate) -> Confirmation:
    """Simulate points X (n, d) again with `evaluate` and set the results beside the surrogate's predictions.

    A point whose simulation raises is kept with its reason; the others go on.
    """
    predicted, std = surrogate.predict(X, return_std=True)
    simulated, se = np.full_like(predicted, np.nan), np.full_like(predicted, np.nan)
    failure = [""] * len(X)
    for i, x in enumerate(X):
        try:
            simulated[i], se[i] = evaluate(x)
        except Exception as error:  # whatever a simulation dies of, the other points are still wanted
            failure[i] = f"{type(error).__name__}: {error}"
    return Confirmation(surrogate.problem_, X, predicted, std, simulated, se, tuple(failure))
