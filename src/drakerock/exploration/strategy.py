"""From a front to one strategy: by weights, by bounds, or at the knee."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drakerock.errors import InputError
from drakerock.exploration.config import Bound
from drakerock.exploration.pareto import ParetoFront
from drakerock.exploration.problem import Array, Problem, format_number
from drakerock.exploration.verdict import Grade, Verdict


@dataclass(frozen=True)
class Strategy:
    """One Pareto-optimal strategy.

    Attributes:
        problem: variables and objectives.
        x: (d,) the design point.
        y: (k,) predicted objectives, natural senses.
        std: (k,) standard deviations of the prediction.
        index: its place on the front.
        chosen_by: what was asked for, in words.
        p_optimal: share of the surrogate's draws in which it stays Pareto-optimal; NaN if not calculated.
        bounds: the limits it keeps, each with the probability that it does.
        verdict: how far the surrogate can be relied on; None if it was not judged. What it is unfit for is not told.
    """

    problem: Problem
    x: Array
    y: Array
    std: Array
    index: int
    chosen_by: str
    p_optimal: float = float("nan")
    bounds: tuple[tuple[Bound, float], ...] = ()
    verdict: Verdict | None = None

    def is_known(self, objective: str) -> bool:
        """Return whether an objective's prediction means anything."""
        return self.verdict is None or self.verdict.get(objective).grade > Grade.UNFIT

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON: strategy, objectives and their standard deviations by name.

        An objective that the surrogate is unfit for is null.
        """
        variables, objectives = self.problem.variable_names, self.problem.objective_names
        known = [self.is_known(name) for name in objectives]
        y, std = (
            [float(v) if k else None for v, k in zip(row, known, strict=True)] for row in (self.y, self.std)
        )
        return {
            "chosen_by": self.chosen_by,
            "strategy": dict(zip(variables, map(float, self.x), strict=True)),
            "objectives": dict(zip(objectives, y, strict=True)),
            "standard_deviations": dict(zip(objectives, std, strict=True)),
            "p_optimal": None if np.isnan(self.p_optimal) else float(self.p_optimal),
            "bounds": {str(bound): p if self.is_known(bound.objective) else None for bound, p in self.bounds},
            "verdict": None if self.verdict is None else self.verdict.to_dict(),
        }

    def to_text(self) -> str:
        """Return a few lines for a person; +- is one standard deviation of the prediction."""
        lines = [f"Strategy chosen by {self.chosen_by}"]
        width = max(len(name) for name in (*self.problem.variable_names, *self.problem.objective_names))
        for v, value in zip(self.problem.variables, self.x, strict=True):
            unit = "" if v.unit == "-" else f" {v.unit}"
            lines.append(f"  {v.name:<{width}}  {value:.3f}{unit}{f'   ({v.meaning})' if v.meaning else ''}")
        lines.append("Predicted")
        for o, value, std in zip(self.problem.objectives, self.y, self.std, strict=True):
            unit = "" if o.unit == "-" else f" {o.unit}"
            text = f"{format_number(value, 4)} +- {format_number(std, 2)}{unit}"
            lines.append(
                f"  {o.name:<{width}}  {text if self.is_known(o.name) else 'not known (see the verdict)'}"
            )
        for bound, p in self.bounds:
            sure = (
                f"holds with a probability of {100 * p:.0f} %"
                if self.is_known(bound.objective)
                else "not known"
            )
            lines.append(f"  {bound}: {sure}")
        if self.verdict is not None:
            lines.append(f"Verdict on the study: {self.verdict.to_text()}")
        return "\n".join(lines)


def parse_weights(text: str, problem: Problem) -> dict[str, float]:
    """Read weights such as ``production=0.6,damage=0.2,debris=0.2``.

    Raises:
        InputError: not of that form, unknown objective, negative weight, all zero.
    """
    weights: dict[str, float] = {}
    for part in text.split(","):
        name, sep, value = part.partition("=")
        if name.strip() in weights:
            raise InputError(f"weights '{text}': '{name.strip()}' has two")
        try:
            weights[name.strip()] = float(value)
        except ValueError:
            sep = ""
        if not sep:
            raise InputError(
                f"weights '{text}': expected objective=number,..., "
                "such as production=0.6,damage=0.2,debris=0.2"
            )
    return _check_weights(weights, problem)


def choose_strategy(
    front: ParetoFront, weights: Mapping[str, float] | None = None, bounds: Sequence[Bound] = ()
) -> Strategy:
    """Return the strategy of the front that fits a trade-off.

    Args:
        front: the Pareto front.
        weights: weight of each objective by name, left-out ones zero, any positive scale. The chosen point
            minimises the weighted Chebyshev distance max_j w_j r_j + 1e-3 sum_j w_j r_j, with r_j the regret
            of objective j: 0 at its best, 1 at its worst value on the front. This reaches every point of the
            front, also in its hollows, and more weight never makes an objective worse. None: the knee, the
            point with the least sum of regrets (farthest in front of the plane through the single-objective
            optima, Das 1999).
        bounds: limits that the chosen point must keep.

    Raises:
        InputError: unknown objective, bad weights, no point of the front within the bounds.
    """
    problem = front.problem
    inside = np.ones(len(front), dtype=bool)
    for bound in bounds:
        inside &= bound.calc_violation(problem, front.Y, front.std) <= 1e-9 * abs(bound.value)
    wanted = ", ".join(str(bound) for bound in bounds)
    if not inside.any():
        best = ", ".join(
            f"{o.name} {low:.4g} to {high:.4g}"
            for o, low, high in zip(problem.objectives, front.Y.min(axis=0), front.Y.max(axis=0), strict=True)
        )
        raise InputError(f"no strategy of the front satisfies {wanted}; the front has {best}")
    regret = front.calc_regret()
    if weights is None:
        cost, name = regret.sum(axis=1), "knee point"
    else:
        weights = _check_weights(weights, problem)
        w = np.array([weights.get(o, 0.0) for o in problem.objective_names])
        weighted = regret * (w / w.sum())
        # The small sums leave no weakly dominated point in a tie, also among objectives without weight.
        cost = weighted.max(axis=1) + 1e-3 * weighted.sum(axis=1) + 1e-6 * regret.sum(axis=1)
        name = "weights " + ", ".join(f"{o} {value:g}" for o, value in weights.items())
    i = int(np.argmin(np.where(inside, cost, np.inf)))
    p_optimal = front.uncertainty.p_optimal[i] if front.uncertainty else float("nan")
    return Strategy(
        problem,
        front.X[i],
        front.Y[i],
        front.std[i],
        i,
        f"{name}{f', within {wanted}' if wanted else ''}",
        p_optimal,
        tuple(
            (bound, float(bound.calc_probability(problem, front.Y[[i]], front.std[[i]])[0]))
            for bound in bounds
        ),
    )


def _check_weights(weights: Mapping[str, float], problem: Problem) -> dict[str, float]:
    for name, value in weights.items():
        problem.get_objective(name)
        if not (np.isfinite(value) and value >= 0.0):
            raise InputError(f"weight of {name} is {value:g}; weights must be finite and not negative")
    if not any(value > 0.0 for value in weights.values()):
        raise InputError("at least one weight must be positive")
    return dict(weights)
