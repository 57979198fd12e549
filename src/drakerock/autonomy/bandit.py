"""The choice that goes on learning at the site: a Bayesian bandit over strategies and piles."""

from __future__ import annotations

import numpy as np

from drakerock.autonomy.choices import BARRED, Choice, Proposal, minimise, to_unit
from drakerock.autonomy.outcome_models import FieldOutcome, cut, get_gamma
from drakerock.autonomy.preference import CostScale, Preference
from drakerock.autonomy.situation import Situation
from drakerock.exploration.problem import Array
from drakerock.randomness import make_generator


class BanditChoice:
    """Thompson sampling: draws one possible world from what is believed, and takes the best strategy in it.

    The belief begins as the study's posterior, its standard deviations doubled: the site may differ from it. Each
    loading updates it by Bayes' rule, exactly, since the model is linear in its weights.
    """

    name, sees_pile = "bandit", True
    _DOUBT = 2.0

    def __init__(
        self,
        model: FieldOutcome,
        scale: CostScale,
        start: Choice,
        *,
        seed: int = 0,
        n_learned: int = 0,
        fresh: bool = True,
    ) -> None:
        """Make it.

        Args:
            model: the belief.
            scale: of the costs.
            start: a choice whose proposal is among the candidates.
            seed: of the draws.
            n_learned: loadings it has learned from; each has a draw of its own.
            fresh: whether the belief is the study's, to be doubted.
        """
        if fresh:
            models = tuple(item.doubt(self._DOUBT) for item in model.models)
            model = FieldOutcome(model.problem, model.grid, model.encoder, model.gamma, models)
        self._model, self._scale, self._start = model, scale, start
        self._seed, self._n_learned = seed, n_learned

    def choose(self, situation: Situation, preference: Preference) -> Proposal:
        """Return the best strategy in a world drawn for this loading."""
        problem, h = self._scale.problem, situation.field.h[None]

        def calc_cost(U: Array) -> Array:
            X = problem.unscale(2.0 * U - 1.0)
            Z = self._model.join(h, X)
            # The same seed each time: one world.
            worlds = [
                item.draw(Z, make_generator(self._seed, "world", self._n_learned, j))
                for j, item in enumerate(self._model.models)
            ]
            Y = cut(problem, np.column_stack(worlds))
            cost = self._scale.calc_cost(preference, Y, np.zeros_like(Y))
            return cost + BARRED * situation.is_barred(get_gamma(problem, X, self._model.gamma))

        start = to_unit(problem, self._start.choose(situation, preference).x[None])
        rng = make_generator(self._seed, "bandit", self._n_learned)
        u, _ = minimise(calc_cost, start, rng, n=96, rounds=4)
        x = problem.unscale(2.0 * u - 1.0)
        mean, std = self._model.predict(h, x[None])
        return Proposal(
            x,
            mean[0],
            std[0],
            f"best in a world drawn after {self._n_learned} loadings of its own (Thompson sampling)",
        )

    def learn(self, h: Array, x: Array, Y: Array) -> BanditChoice:
        """Return the choice whose belief has seen the loading; an objective without a value teaches nothing."""
        Z = self._model.join(h[None], x[None])
        models = tuple(
            item.update(Z, Y[j : j + 1]) if np.isfinite(Y[j]) else item
            for j, item in enumerate(self._model.models)
        )
        model = FieldOutcome(
            self._model.problem, self._model.grid, self._model.encoder, self._model.gamma, models
        )
        return BanditChoice(
            model, self._scale, self._start, seed=self._seed, n_learned=self._n_learned + 1, fresh=False
        )
