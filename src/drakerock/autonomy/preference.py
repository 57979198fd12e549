"""What is wanted of a loading: weights of the objectives, and bounds that they keep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drakerock.errors import InputError
from drakerock.exploration.config import Bound
from drakerock.exploration.pareto import parse_bound
from drakerock.exploration.problem import Array, Problem
from drakerock.exploration.strategy import parse_weights

# What breaking a bound by one range of its objective costs; the worst weighted regret on the front is 1.
_PENALTY = 10.0


@dataclass(frozen=True)
class Preference:
    """Weights and bounds; the value at the loader's input port ``preference``.

    Attributes:
        weights: (objective, weight) pairs; empty: all objectives count alike.
        bounds: limits on the objectives, in their natural senses.
    """

    weights: tuple[tuple[str, float], ...] = ()
    bounds: tuple[Bound, ...] = ()

    def __str__(self) -> str:
        weights = ",".join(f"{name}={value:g}" for name, value in self.weights) or "equal weights"
        return ", ".join([weights, *(str(bound) for bound in self.bounds)])


@dataclass(frozen=True, eq=False)
class CostScale:
    """What costs are relative to: best and worst value of each objective on the Pareto front of fixed strategies.

    Attributes:
        problem: variables and objectives.
        ideal, nadir: (k,) natural senses.
    """

    problem: Problem
    ideal: Array
    nadir: Array

    def calc_cautious_cost(self, preference: Preference, Y: Array, std: Array) -> Array:
        """Return costs (n,) with each objective one standard deviation of its prediction worse than expected.

        Who searches for the least predicted cost finds where the model errs to its favour; this keeps the search where
        something is known. Arguments as of `calc_cost`.
        """
        return self.calc_cost(preference, Y + self.problem.signs * std, std)

    def calc_cost(self, preference: Preference, Y: Array, std: Array) -> Array:
        """Return what a loading costs (n,): as `choose_strategy` weighs a front, plus a penalty for broken bounds.

        The weighted Chebyshev distance max_j w_j r_j + 1e-3 sum_j w_j r_j of the regrets r_j, 0 at `ideal` and 1 at
        `nadir`; better than ideal is negative.

        Args:
            preference: what is wanted.
            Y, std: (n, k) predicted objectives, natural senses, and their standard deviations.
        """
        spread = self.nadir - self.ideal
        spread = np.where(spread == 0.0, 1.0, spread)
        regret = (Y - self.ideal) / spread
        given = dict(preference.weights)
        w = np.array([given.get(name, 0.0) if given else 1.0 for name in self.problem.objective_names])
        weighted = regret * (w / w.sum())
        # Only among what counts: a regret of zero without weight would hide one below zero.
        cost = weighted[:, w > 0.0].max(axis=1) + 1e-3 * weighted.sum(axis=1) + 1e-6 * regret.sum(axis=1)
        for bound in preference.bounds:
            j = self.problem.get_objective(bound.objective)[0]
            broken = np.maximum(bound.calc_violation(self.problem, Y, std), 0.0)
            cost = cost + _PENALTY * broken / abs(spread[j])
        return cost


def make_preference(
    problem: Problem, weights: str | None = None, bounds: Sequence[str] = (), probability: float | None = None
) -> Preference:
    """Read a preference.

    Args:
        problem: whose objectives are meant.
        weights: such as ``production=0.6,damage=0.2,debris=0.2``; None: all alike.
        bounds: such as ``debris<=500``.
        probability: with which each bound has to hold; None: 0.9.

    Raises:
        InputError: not of that form, unknown objective, bounds that contradict each other.
    """
    pairs = () if not weights else tuple(parse_weights(weights, problem).items())
    limits = tuple(parse_bound(text, problem, probability) for text in bounds)
    for name in problem.objective_names:
        low = [bound for bound in limits if bound.objective == name and bound.relation == ">="]
        high = [bound for bound in limits if bound.objective == name and bound.relation == "<="]
        if low and high:
            most, least = max(low, key=lambda bound: bound.value), min(high, key=lambda bound: bound.value)
            if most.value > least.value:
                raise InputError(f"bounds {most} and {least} contradict each other: no {name} keeps both")
    return Preference(pairs, limits)
