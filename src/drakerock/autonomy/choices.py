"""Choices of a strategy, one class each behind one interface: fixed, best fixed, by the pile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np

from drakerock.autonomy.outcome_models import OutcomeModel, get_gamma
from drakerock.autonomy.preference import CostScale, Preference
from drakerock.autonomy.situation import Situation
from drakerock.exploration.pareto import ParetoFront
from drakerock.exploration.problem import Array, Problem
from drakerock.exploration.strategy import choose_strategy
from drakerock.randomness import make_generator

# More than any cost: an entry that a hazard bars is taken only where all are barred.
BARRED = 1e3


@dataclass(frozen=True, eq=False)
class Proposal:
    """What a choice proposes.

    Attributes:
        x: (d,) the design point.
        Y, std: (k,) predicted objectives and the predictions' standard deviations; None: nothing is predicted.
        reason: why this one, in words.
    """

    x: Array
    Y: Array | None
    std: Array | None
    reason: str


class Choice(Protocol):
    """Chooses a strategy for a pile. A function of its arguments: what it learns makes another choice.

    Attributes:
        name: as commands name it.
        sees_pile: whether the pile matters to it, so that one unlike the training set may mislead it.
    """

    name: str
    sees_pile: bool

    def choose(self, situation: Situation, preference: Preference) -> Proposal:
        """Return the design point for a pile."""

    def learn(self, h: Array, x: Array, Y: Array) -> Choice:
        """Return the choice that knows of one more loading.

        Args:
            h: (nx, ny) heights of the pile before it [m].
            x: (d,) the design point.
            Y: (k,) what came, natural senses.
        """


class _Unlearning:
    """A choice that learns nothing from its own loadings."""

    def learn(self, h: Array, x: Array, Y: Array) -> Self:
        """Return the same choice."""
        return self


class FixedChoice(_Unlearning):
    """Always the same strategy."""

    name, sees_pile = "fixed", False

    def __init__(self, x: Array, model: OutcomeModel, reason: str = "fixed") -> None:
        """Make it of a design point x (d,) and what predicts its outcome."""
        self._x, self._model, self._reason = x, model, reason

    def choose(self, situation: Situation, preference: Preference) -> Proposal:
        """Return it."""
        mean, std = self._model.predict(situation.field.h[None], self._x[None])
        return Proposal(self._x, mean[0], std[0], self._reason)


class BestFixedChoice(_Unlearning):
    """The strategy of the Pareto front that `drakerock strategy` gives for the preference."""

    name, sees_pile = "best_fixed", False

    def __init__(self, front: ParetoFront) -> None:
        """Make it of a front."""
        self._front = front

    def choose(self, situation: Situation, preference: Preference) -> Proposal:
        """Return it.

        Raises:
            InputError: no strategy of the front keeps the bounds.
        """
        names = self._front.problem.objective_names
        weights = dict(preference.weights) or dict.fromkeys(names, 1.0)
        chosen = choose_strategy(self._front, weights, preference.bounds)
        return Proposal(chosen.x, chosen.y, chosen.std, f"best on the front by {chosen.chosen_by}")


class PileAwareChoice(_Unlearning):
    """The strategy of least cautious cost on this pile, by a model that sees the pile."""

    sees_pile = True

    def __init__(
        self, name: str, model: OutcomeModel, scale: CostScale, gamma: float, start: Choice, seed: int = 0
    ) -> None:
        """Make it.

        Args:
            name: as commands name it.
            model: sees the pile.
            scale: of the costs.
            gamma: where the machine enters if that is no variable.
            start: a choice whose proposal is among the candidates.
            seed: of the search.
        """
        self.name = name
        self._model, self._scale, self._gamma, self._start, self._seed = model, scale, gamma, start, seed

    def choose(self, situation: Situation, preference: Preference) -> Proposal:
        """Return it."""
        problem, h = self._scale.problem, situation.field.h[None]

        def calc_cost(U: Array) -> Array:
            X = problem.unscale(2.0 * U - 1.0)
            cost = self._scale.calc_cautious_cost(preference, *self._model.predict(h, X))
            return cost + BARRED * situation.is_barred(get_gamma(problem, X, self._gamma))

        first = self._start.choose(situation, preference)
        start = to_unit(problem, first.x[None])
        rng = make_generator(self._seed, "pile aware")
        u, cost = minimise(calc_cost, start, rng, n=128, rounds=4)
        x = problem.unscale(2.0 * u - 1.0)
        mean, std = self._model.predict(h, x[None])
        gain = float(calc_cost(start)[0]) - cost
        return Proposal(x, mean[0], std[0], explain_gain(gain, 1))


def explain_gain(gain: float, depth: int) -> str:
    """Return in words why a strategy was chosen, by how much less it costs than the best fixed one here."""
    ahead = f" over {depth} loadings" if depth > 1 else ""
    if gain < 1e-6:
        return f"no strategy is predicted to be better on this pile{ahead} than the best fixed one"
    if gain >= BARRED / 2:
        return "a hazard bars the best fixed strategy's entry; the best of the others"
    return f"predicted to cost {gain:.3f} less on this pile{ahead} than the best fixed strategy"


def minimise(
    cost: Callable[[Array], Array], start: Array, rng: np.random.Generator, *, n: int, rounds: int
) -> tuple[Array, float]:
    """Return the best point (d,) tried in the unit cube and its cost: cross-entropy search (Rubinstein 1999).

    Args:
        cost: of points (m, d), (m,).
        start: (s, d) points among the first candidates.
        rng: of the candidates.
        n: candidates a round, of which an eighth are the elite.
        rounds: how many.
    """
    d = start.shape[1]
    candidates = np.vstack([start, rng.uniform(size=(n, d))])
    best, least = start[0], np.inf
    for _ in range(rounds):
        values = cost(candidates)
        order = np.argsort(values, kind="stable")[: max(n // 8, 2)]
        if values[order[0]] < least:
            best, least = candidates[order[0]], float(values[order[0]])
        elite = candidates[order]
        drawn = rng.normal(elite.mean(axis=0), elite.std(axis=0) + 0.01, size=(n, d))
        candidates = np.clip(np.vstack([best[None], drawn]), 0.0, 1.0)
    return best, least


def to_unit(problem: Problem, X: Array) -> Array:
    """Return design points (n, d) in the unit cube."""
    return np.clip(0.5 * (problem.scale(X) + 1.0), 0.0, 1.0)
