"""The surrogate (method section 6): the objectives as functions of the design variables, one `Kriging` each."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import ArrayLike
from pydantic import ValidationError
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted

from drakerock.errors import InputError
from drakerock.exploration.config import SurrogateConfig
from drakerock.exploration.kriging import Kriging
from drakerock.exploration.problem import Array, Problem
from drakerock.exploration.table import ResponseTable
from drakerock.files import read_json, write_text
from drakerock.randomness import derive_seed
from drakerock.resources import find_study_file


class Surrogate(MultiOutputMixin, RegressorMixin, BaseEstimator):
    """The objectives as functions of the design variables: one `Kriging` per objective.

    Objectives are in their natural sense and unit here, as in the table (production positive).

    Args:
        problem: variables and objectives.
        config: how to fit.
        seed: seed of the study; the fit is a function of it and of the data only.

    After `fit` there are ``models_``, the fitted `Kriging` models in the objectives' order, and what they are fitted
    to: ``X_`` (n, d), ``Y_`` (n, k) and ``noise_`` (n, k); NaN where there is none.
    """

    def __init__(
        self, problem: Problem | None = None, config: SurrogateConfig | None = None, seed: int = 0
    ) -> None:
        self.problem = problem
        self.config = config
        self.seed = seed

    def fit(self, X: ArrayLike, Y: ArrayLike, noise: ArrayLike | None = None) -> Self:
        """Fit to points X (n, d) and responses Y (n, k).

        A NaN response leaves its point out for that objective. A NaN standard error is replaced by the
        root mean square of the known ones.

        Raises:
            InputError: shapes that do not fit the problem, NaN variables, too few points for an objective.
        """
        self.X_, self.Y_, self.noise_ = self._check(X, Y, noise)
        self.models_ = [self._fit_objective(i) for i in range(len(self.problem_.objectives))]
        return self

    def _check(self, X: ArrayLike, Y: ArrayLike, noise: ArrayLike | None) -> tuple[Array, Array, Array]:
        problem = self.problem_ = self.problem or Problem()
        config = self.config or SurrogateConfig()
        X, Y = np.asarray(X, dtype=float), np.asarray(Y, dtype=float)
        d, k = len(problem.variables), len(problem.objectives)
        Y = Y[:, None] if Y.ndim == 1 else Y
        if X.ndim != 2 or X.shape[1] != d or Y.shape != (len(X), k):
            raise InputError(
                f"surrogate: expected X (n, {d}) for {', '.join(problem.variable_names)} and Y (n, {k}) for "
                f"{', '.join(problem.objective_names)}; got {X.shape} and {Y.shape}"
            )
        if not np.isfinite(X).all():
            raise InputError("surrogate: the design variables of every point must be finite numbers")
        if np.ndim(config.p) and np.size(config.p) != d:
            raise InputError(f"surrogate: p must be one number or {d} numbers, got {np.size(config.p)}")
        se = np.full(Y.shape, np.nan) if noise is None else np.asarray(noise, dtype=float).reshape(Y.shape)
        return X, Y, se

    def _fit_objective(self, i: int, **found: Any) -> Kriging:
        """Return the model of an objective; `found`: hyperparameters of `Kriging` that are known already."""
        config, objective = self.config or SurrogateConfig(), self.problem_.objectives[i]
        good = np.isfinite(self.Y_[:, i])
        distinct, d = len(np.unique(self.X_[good], axis=0)), self.X_.shape[1]
        if distinct < d + 2:
            raise InputError(
                f"surrogate: '{objective.name}' has a response at {distinct} distinct points; "
                f"{d} variables need at least {d + 2}"
            )
        settings: dict[str, Any] = {"trend": config.trend} | found
        model = Kriging(
            bounds=np.stack([self.problem_.low, self.problem_.high]),
            p=config.p,
            n_starts=config.n_starts,
            random_state=derive_seed(self.seed, "surrogate", objective.name),
            **settings,
        )
        known = _fill_noise(self.noise_[good, i]) if config.use_noise else None
        return model.fit(self.X_[good], self.Y_[good, i], known)

    def save(self, path: str | Path) -> None:
        """Write the fitted surrogate as JSON: problem, settings, points and hyperparameters.

        Raises:
            InputError: the file cannot be written.
        """
        check_is_fitted(self)
        data = {
            "problem": self.problem_.model_dump(mode="json"),
            "config": (self.config or SurrogateConfig()).model_dump(mode="json"),
            "seed": self.seed,
            "X": self.X_.tolist(),
            "Y": _write_numbers(self.Y_),
            "noise": _write_numbers(self.noise_),
            "models": {
                objective.name: {
                    "theta": model.theta_.tolist(),
                    "lam": model.lam_,
                    "variance": model.variance_,
                    "trend": model.trend_,
                }
                for objective, model in zip(self.problem_.objectives, self.models_, strict=True)
            },
        }
        write_text(Path(path), json.dumps(data) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return what `save` wrote: it predicts the same, bit for bit, and nothing is searched for.

        ``studies/full_size/surrogate.json`` is shipped.

        Raises:
            InputError: missing, or not a fitted surrogate.
        """
        data = read_json(find_study_file(Path(path)), "a readable surrogate")
        try:
            problem = Problem.model_validate(data["problem"])
            config = SurrogateConfig.model_validate(data["config"])
            surrogate = cls(problem, config, int(data["seed"]))
            X, Y, noise = (np.array(data[name], dtype=float) for name in ("X", "Y", "noise"))
            surrogate.X_, surrogate.Y_, surrogate.noise_ = surrogate._check(X, Y, noise)
            found: list[Mapping[str, Any]] = [data["models"][name] for name in problem.objective_names]
            surrogate.models_ = [
                surrogate._fit_objective(
                    i,
                    theta=np.array(values["theta"], dtype=float),
                    **{name: float(values[name]) for name in ("lam", "variance", "trend")},
                )
                for i, values in enumerate(found)
            ]
        except (KeyError, TypeError, ValueError, OverflowError, ValidationError, LinAlgError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else str(error).splitlines()[0]
            raise InputError(f"{path}: not a readable surrogate: {what}") from None
        return surrogate

    def predict(self, X: ArrayLike, return_std: bool = False) -> Any:
        """Return predicted objectives (n, k) and, with `return_std`, their standard deviations (n, k)."""
        check_is_fitted(self)
        if not return_std:
            return self._cut(np.column_stack([model.predict(X) for model in self.models_]))
        pairs = [model.predict(X, return_std=True) for model in self.models_]
        return self._cut(np.column_stack([m for m, _ in pairs])), np.column_stack([s for _, s in pairs])

    def draw(self, X: ArrayLike, n_draws: int, rng: np.random.Generator) -> Array:
        """Return joint posterior draws (n_draws, n, k) at X (n, d); objectives are independent."""
        check_is_fitted(self)
        return self._cut(np.stack([model.draw(X, n_draws, rng) for model in self.models_], axis=2))

    def _cut(self, Y: Array) -> Array:
        """Return objectives (..., k) without values that do not exist."""
        lowest = [objective.lowest for objective in self.problem_.objectives]
        return np.maximum(Y, [-np.inf if value is None else value for value in lowest])


def fit_surrogate(table: ResponseTable, config: SurrogateConfig | None = None, seed: int = 0) -> Surrogate:
    """Fit the surrogate to the sample points of a table; validation points take no part in it."""
    samples = table.select("sample")
    if len(samples) == 0:
        raise InputError("surrogate: the table has no point with the role 'sample'")
    return Surrogate(table.problem, config, seed).fit(samples.X, samples.Y, samples.noise)


def _write_numbers(values: Array) -> list[list[float | None]]:
    return [[float(value) if np.isfinite(value) else None for value in row] for row in values]


def _fill_noise(se: Array) -> Array | None:
    known = np.isfinite(se)
    if not known.any():
        return None
    return np.where(known, se, np.sqrt(np.mean(se[known] ** 2)))


def calc_ranges(Y: ArrayLike) -> Array:
    """Return max - min of each column of Y (n, k), NaN left out; a constant column gives 1, to divide by."""
    Y = np.asarray(Y, dtype=float)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a column of NaN only
        spread = np.nanmax(Y, axis=0) - np.nanmin(Y, axis=0)
    return np.where(spread > 0.0, spread, 1.0)
