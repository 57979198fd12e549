"""What a strategy brings on a pile: three models, each seeing more of the pile than the one before."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from drakerock.autonomy.data import LoadingData
from drakerock.autonomy.encoding import PileEncoder
from drakerock.autonomy.entry import PileGrid, calc_entry_features
from drakerock.autonomy.regression import LandmarkRegressor, find_theta
from drakerock.exploration.kriging import Kriging
from drakerock.exploration.problem import Array, Problem
from drakerock.exploration.surrogate import Surrogate
from drakerock.loading.features import calc_pile_features
from drakerock.loading.field import HeightField
from drakerock.randomness import derive_seed, make_generator

# Codes of the height field that an outcome is taken to depend on besides the entry: the first of each kind.
_N_EVEN, _N_ODD = 4, 2
# A Kriging of so many loadings is searched for, and conditioned on, in seconds, and predicts in a tenth of one.
_SEARCHED, _CONDITIONED = 200, 800
_TAIL = 0.01


class OutcomeModel(Protocol):
    """Predicts the objectives of loadings."""

    def predict(self, H: Array, X: Array) -> tuple[Array, Array]:
        """Return expected objectives (m, k), natural senses, and the expectations' standard deviations (m, k).

        Args:
            H: (m, nx, ny) heights of the piles [m]; or (1, nx, ny), one pile for all.
            X: (m, d) design points.
        """


class BlindOutcome:
    """The exploration's surrogate: what a strategy brings on average over the piles of the study."""

    def __init__(self, surrogate: Surrogate) -> None:
        self._surrogate = surrogate

    def predict(self, H: Array, X: Array) -> tuple[Array, Array]:
        """Return expectations and standard deviations, see `OutcomeModel`; the pile plays no part."""
        mean, std = self._surrogate.predict(X, return_std=True)
        return mean, std


class FeatureOutcome:
    """Kriging over the design variables joined by the features of the pile (`drakerock.loading.features`)."""

    def __init__(self, data: LoadingData, grid: PileGrid, seed: int = 0) -> None:
        """Fit to loadings."""
        self._grid, self._problem = grid, data.problem
        whole = np.isfinite(data.features).all(axis=1)
        data = data.take(whole)
        self._centre, spread = data.features.mean(axis=0), data.features.std(axis=0)
        # Features that hardly differ between loadings tell nothing.
        self._kept = spread > 1e-6 * (1.0 + np.abs(self._centre))
        self._spread = np.where(self._kept, spread, 1.0)
        Z = self._join(data.features, data.X)
        rng = make_generator(seed, "features")
        drawn = rng.permutation(len(Z))
        self._models = []
        for j in range(data.Y.shape[1]):
            searched, conditioned = drawn[:_SEARCHED], drawn[:_CONDITIONED]
            y = tame(data.Y[:, j])
            bounds = np.stack([Z.min(axis=0) - 1e-6, Z.max(axis=0) + 1e-6])
            seed_j = derive_seed(seed, "features", j) % 2**31
            model = Kriging(bounds, n_starts=4, random_state=seed_j).fit(Z[searched], y[searched])
            if len(Z) > _SEARCHED and not model.constant_:
                found = Kriging(bounds, theta=model.theta_, lam=model.lam_, n_starts=1, random_state=seed_j)
                model = found.fit(Z[conditioned], y[conditioned])
            self._models.append(model)

    def predict(self, H: Array, X: Array) -> tuple[Array, Array]:
        """Return expectations and standard deviations, see `OutcomeModel`."""
        grid = self._grid
        rows = [
            list(
                vars(
                    calc_pile_features(HeightField(grid.x, grid.y, h, grid.cell), grid.front_height)
                ).values()
            )
            for h in H
        ]
        features = np.nan_to_num(np.array(rows), nan=0.0)
        Z = self._join(np.broadcast_to(features, (len(X), features.shape[1])), X)
        pairs = [model.predict(Z, return_std=True) for model in self._models]
        mean = np.column_stack([pair[0] for pair in pairs])
        return cut(self._problem, mean), np.column_stack([pair[1] for pair in pairs])

    def _join(self, features: Array, X: Array) -> Array:
        scaled = (features - self._centre) / self._spread
        return np.hstack([self._problem.scale(X), scaled[:, self._kept]])


class FieldOutcome:
    """Landmark regression over the design variables, the entry that they lead to and the codes of the height field."""

    def __init__(
        self,
        problem: Problem,
        grid: PileGrid,
        encoder: PileEncoder,
        gamma: float,
        models: tuple[LandmarkRegressor, ...] = (),
        skill: dict[str, float] | None = None,
    ) -> None:
        """Make it of fitted models, one per objective; `fit_field_outcome` fits them.

        Args:
            problem: variables and objectives.
            grid: the fields'.
            encoder: fitted.
            gamma: where the machine enters if that is no variable.
            models: over `join`.
            skill: by objective, 1 - squared error over that of the mean, of single loadings at held-out design points;
                at most 0: nothing was learned.
        """
        self.skill = skill or {}
        self.problem, self.grid, self.encoder, self.gamma, self.models = problem, grid, encoder, gamma, models

    def join(self, H: Array, X: Array) -> Array:
        """Return what the models see (m, q): a pile and its mirror image are the same to them.

        Arguments as of `predict`.
        """
        codes = self.encoder.encode(H) / self.encoder.scale_
        even, odd = codes[:, self.encoder.mirror_ > 0], codes[:, self.encoder.mirror_ < 0]
        codes = np.hstack([even[:, :_N_EVEN], np.abs(odd[:, :_N_ODD])])
        piles = np.broadcast_to(H, (len(X), *H.shape[1:]))
        entry, _ = calc_entry_features(self.grid, piles, get_gamma(self.problem, X, self.gamma))
        return np.hstack([self.problem.scale(X), entry, np.broadcast_to(codes, (len(X), codes.shape[1]))])

    def predict(self, H: Array, X: Array) -> tuple[Array, Array]:
        """Return expectations and standard deviations, see `OutcomeModel`."""
        Z = self.join(H, X)
        pairs = [model.predict_with_std(Z) for model in self.models]
        mean = np.column_stack([pair[0] for pair in pairs])
        return cut(self.problem, mean), np.column_stack([pair[1] for pair in pairs])


def fit_field_outcome(
    data: LoadingData, grid: PileGrid, encoder: PileEncoder, gamma: float, seed: int = 0
) -> FieldOutcome:
    """Return the model fitted to loadings, with its skill on held-out design points."""
    blank = FieldOutcome(data.problem, grid, encoder, gamma)
    Z = blank.join(data.before, data.X)
    models, skill = [], {}
    for j, name in enumerate(data.problem.objective_names):
        state = derive_seed(seed, "field", j) % 2**31
        y = tame(data.Y[:, j])
        theta = find_theta(Z, y, _SEARCHED, state)
        models.append(LandmarkRegressor(theta, random_state=state).fit(Z, y))
        missed, there = 0.0, 0.0
        for fit, test in data.iterate_folds(4, seed):
            held = LandmarkRegressor(theta, random_state=state).fit(Z[fit], y[fit])
            missed += float(np.sum((y[test] - held.predict(Z[test])) ** 2))
            there += float(np.sum((y[test] - y[fit].mean()) ** 2))
        skill[name] = 1.0 - missed / there if there > 0.0 else float("nan")
    return FieldOutcome(data.problem, grid, encoder, gamma, tuple(models), skill)


def tame(y: Array) -> Array:
    """Return responses (n,) without their outliers: what lies in the last hundredth at either end counts as its border.

    A loading that jams has a hundred times the damage of others; one of them would bend the regression for all.
    """
    return np.clip(y, *np.quantile(y, (_TAIL, 1.0 - _TAIL)))


def get_gamma(problem: Problem, X: Array, gamma: float) -> Array:
    """Return where each design point enters (m,): its variable gamma, or the given one where that is none."""
    names = problem.variable_names
    return X[:, names.index("gamma")] if "gamma" in names else np.full(len(X), gamma)


def cut(problem: Problem, Y: Array) -> Array:
    """Return objectives (m, k) without values that do not exist, such as negative masses."""
    return np.maximum(Y, [-np.inf if item.lowest is None else item.lowest for item in problem.objectives])
