"""The choice that looks ahead: the strategy that leaves the better pile, by the learned models of outcome and pile."""

from __future__ import annotations

from typing import Self

import numpy as np

from drakerock.autonomy.choices import BARRED, Choice, Proposal, explain_gain, minimise, to_unit
from drakerock.autonomy.outcome_models import OutcomeModel, get_gamma
from drakerock.autonomy.pile_model import PileModel
from drakerock.autonomy.preference import CostScale, Preference
from drakerock.autonomy.situation import Situation
from drakerock.exploration.problem import Array
from drakerock.randomness import make_generator


class LookAheadChoice:
    """Plans `depth` loadings by cross-entropy search and takes the first: receding horizon.

    Each candidate sequence of strategies is followed over `n_piles` possible futures of the pile, drawn with the pile
    model's own uncertainty, the same noise for every candidate. The first loading's prediction is of the pile as it was
    sensed; with depth 1 it is `PileAwareChoice`.
    """

    name, sees_pile = "look_ahead", True

    def __init__(
        self,
        outcome: OutcomeModel,
        piles: PileModel | None,
        scale: CostScale,
        gamma: float,
        start: Choice,
        *,
        depth: int = 3,
        n_piles: int = 2,
        seed: int = 0,
    ) -> None:
        """Make it.

        Args:
            outcome: predicts a loading.
            piles: predicts the pile after; not needed with depth 1.
            scale: of the costs.
            gamma: where the machine enters if that is no variable.
            start: a choice whose proposal, repeated, is among the candidates.
            depth: loadings looked ahead.
            n_piles: futures of the pile.
            seed: of the search.
        """
        self._outcome, self._piles, self._scale, self._gamma, self._start = (
            outcome,
            piles,
            scale,
            gamma,
            start,
        )
        self._depth, self._n_piles, self._seed = depth, n_piles, seed

    def choose(self, situation: Situation, preference: Preference) -> Proposal:
        """Return the first strategy of the best sequence."""
        problem = self._scale.problem
        d = len(problem.variables)

        def calc_cost(U: Array) -> Array:
            steps = [problem.unscale(2.0 * part - 1.0) for part in np.split(U, self._depth, axis=1)]
            barred = situation.is_barred(get_gamma(problem, steps[0], self._gamma))
            return self._follow(situation.field.h, steps, preference) + BARRED * barred

        first = self._start.choose(situation, preference)
        start = np.tile(to_unit(problem, first.x[None]), (1, self._depth))
        rng = make_generator(self._seed, "look ahead")
        u, cost = minimise(calc_cost, start, rng, n=64, rounds=5)
        x = problem.unscale(2.0 * u[:d] - 1.0)
        mean, std = self._outcome.predict(situation.field.h[None], x[None])
        return Proposal(x, mean[0], std[0], explain_gain(float(calc_cost(start)[0]) - cost, self._depth))

    def learn(self, h: Array, x: Array, Y: Array) -> Self:
        """Return the same choice."""
        return self

    def _follow(self, h: Array, steps: list[Array], preference: Preference) -> Array:
        """Return the mean cost of a loading (m,) along sequences of design points (m, d) each."""
        m, r = len(steps[0]), self._n_piles
        cost = self._scale.calc_cautious_cost(preference, *self._outcome.predict(h[None], steps[0]))
        if self._depth == 1:
            return cost
        assert self._piles is not None
        H = h[None]
        X = np.repeat(steps[0], r, axis=0)
        for number, following in enumerate(steps[1:]):
            H = self._piles.draw(H, X, _SharedNoise(self._seed, number, m, r))  # type: ignore[arg-type]
            X = np.repeat(following, r, axis=0)
            now = self._scale.calc_cautious_cost(preference, *self._outcome.predict(H, X))
            cost = cost + now.reshape(m, r).mean(axis=1)
        return cost / self._depth


class _SharedNoise:
    """Normal numbers for r futures of m candidates, the same for each, so that their costs can be compared."""

    def __init__(self, seed: int, number: int, m: int, r: int) -> None:
        self._rng, self._m, self._r = make_generator(seed, "futures", number), m, r

    def standard_normal(self, shape: tuple[int, ...]) -> Array:
        """Return numbers (m r, p)."""
        half = self._rng.standard_normal((self._r - self._r // 2, shape[1]))
        # Antithetic: the futures' mean is the expectation.
        return np.tile(np.vstack([half, -half])[: self._r], (self._m, 1))
