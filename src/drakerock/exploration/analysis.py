"""From a response table to everything the report shows: the steps of method section 6 in a row."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from drakerock.exploration.config import ExplorationConfig
from drakerock.exploration.confirmation import Confirmation
from drakerock.exploration.pareto import Indices, ParetoFront, pareto_front, select_spread
from drakerock.exploration.problem import REFERENCE_STRATEGIES, Array
from drakerock.exploration.sensitivity import Sensitivity, calc_sensitivity
from drakerock.exploration.strategy import Strategy, choose_strategy
from drakerock.exploration.surrogate import Surrogate, fit_surrogate
from drakerock.exploration.table import ResponseTable
from drakerock.exploration.validation import Accuracy, calc_learning_curve, validate
from drakerock.exploration.verdict import Verdict, judge

Progress = Callable[[str, float | None], None]
"""Called with what is being done and the share of it that is done, None where that is not known."""


@dataclass(frozen=True)
class Exploration:
    """The results.

    Attributes:
        table: what was explored.
        config, seed: how.
        surrogate: fitted to the table's samples.
        accuracy, sensitivity: one per objective.
        learning_sizes, learning_nrmse: (s,) and (s, k) of `calc_learning_curve`.
        front: the Pareto front.
        strategies: by name: the knee, equal weights, the best of each objective.
        references: by name: design point (d,), predicted objectives (k,) and standard deviations (k,) of the
            method's reference strategies; empty for problems with other variables.
        to_confirm: indices of the front points to re-simulate.
        confirmation: their re-simulation, where it has been done.
    """

    table: ResponseTable
    config: ExplorationConfig
    seed: int
    surrogate: Surrogate
    accuracy: tuple[Accuracy, ...]
    sensitivity: tuple[Sensitivity, ...]
    learning_sizes: Array
    learning_nrmse: Array
    front: ParetoFront
    strategies: dict[str, Strategy]
    references: dict[str, tuple[Array, Array, Array]]
    to_confirm: Indices
    confirmation: Confirmation | None = None

    @cached_property
    def verdict(self) -> Verdict:
        """How far all this can be relied on."""
        return judge(self.accuracy, self.table.role.count("sample"), self.learning_sizes, self.learning_nrmse)


def explore(
    table: ResponseTable,
    config: ExplorationConfig | None = None,
    seed: int = 0,
    confirmation: Confirmation | None = None,
    progress: Progress | None = None,
) -> Exploration:
    """Fit, validate, rank, search the front and choose; a function of the arguments only.

    Args:
        table: what to explore.
        config: settings.
        seed: seed of the study.
        confirmation: of an earlier front, for the report.
        progress: told what is being done, and which share of it is.

    Raises:
        InputError: too few points with responses, bounds that no point satisfies.
    """
    config = config or ExplorationConfig()
    tell = progress or (lambda _stage, _share: None)
    problem = table.problem
    tell("fitting", None)
    surrogate = fit_surrogate(table, config.surrogate, seed)
    tell("validating", None)
    sizes, nrmse = calc_learning_curve(surrogate, table)
    front = pareto_front(
        surrogate, config=config.pareto, seed=seed, progress=lambda share: tell("searching the front", share)
    )
    tell("ranking variables", None)
    strategies = {"knee": choose_strategy(front)}
    if len(problem.objectives) > 1:
        strategies["equal weights"] = choose_strategy(front, dict.fromkeys(problem.objective_names, 1.0))
        for name in problem.objective_names:
            strategies[f"best {name}"] = choose_strategy(front, {name: 1.0})
    return Exploration(
        table,
        config,
        seed,
        surrogate,
        validate(surrogate, table),
        calc_sensitivity(surrogate.predict, problem, config.sensitivity, seed),
        sizes,
        nrmse,
        front,
        strategies,
        _predict_references(surrogate),
        select_spread(front, config.n_confirm, [strategies["knee"].index]),
        confirmation,
    )


def _predict_references(surrogate: Surrogate) -> dict[str, tuple[Array, Array, Array]]:
    problem = surrogate.problem_
    result: dict[str, tuple[Array, Array, Array]] = {}
    if problem.variable_names != ("alpha", "beta", "gamma", "kappa"):
        return result
    for name, values in REFERENCE_STRATEGIES.items():
        x = np.array(values)
        if np.all((x >= problem.low) & (x <= problem.high)):
            mean, std = surrogate.predict(x[None], return_std=True)
            result[name] = (x, mean[0], std[0])
    return result


def summarize(exploration: Exploration) -> dict[str, Any]:
    """Return the numbers of an exploration as plain data for JSON."""
    problem = exploration.table.problem
    objectives = {}
    for model, accuracy, sensitivity in zip(
        exploration.surrogate.models_, exploration.accuracy, exploration.sensitivity, strict=True
    ):
        objectives[accuracy.objective] = {
            "theta": dict(zip(problem.variable_names, map(float, model.theta_), strict=True)),
            "lambda": model.lam_,
            "sigma": float(np.sqrt(model.sigma2_)),
            "trend": model.trend_,
            "log_likelihood": _finite(model.log_likelihood_),
            "loo_nrmse": _finite(accuracy.loo_nrmse),
            "validation_nrmse": _finite(accuracy.validation_nrmse),
            "noise_floor": _finite(accuracy.noise_floor),
            "coverage_95": _finite(accuracy.coverage[-1]),
            "sobol_first": dict(zip(problem.variable_names, map(float, sensitivity.first), strict=True)),
            "sobol_total": dict(zip(problem.variable_names, map(float, sensitivity.total), strict=True)),
            "ranking": list(sensitivity.ranking),
        }
    roles = exploration.table.role
    return {
        "points": {role: roles.count(role) for role in ("sample", "validation")},
        "loadings": {"run": sum(exploration.table.n_loadings), "failed": sum(exploration.table.n_failed)},
        "verdict": exploration.verdict.to_dict(),
        "objectives": objectives,
        "front_points": len(exploration.front),
        "strategies": {name: strategy.to_dict() for name, strategy in exploration.strategies.items()},
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
