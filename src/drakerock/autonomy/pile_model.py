"""The pile after: a height field and a strategy in, the height field of the next loading out, with how sure that is."""

from __future__ import annotations

import numpy as np

from drakerock.autonomy.data import LoadingData
from drakerock.autonomy.encoding import PileEncoder
from drakerock.autonomy.entry import PileGrid, calc_entry_features
from drakerock.autonomy.outcome_models import get_gamma
from drakerock.autonomy.regression import LandmarkRegressor
from drakerock.errors import InputError
from drakerock.exploration.problem import Array
from drakerock.randomness import derive_seed

# The change of a pile is smooth in what it depends on: correlation length, in standard deviations of all inputs.
_LENGTH = 2.0
_N_LANDMARKS = 150


class PileModel:
    """From the pile before a loading to the pile before the next one: load taken out, cleaned, refilled.

    Each code of the field is a landmark regression over codes, entry and strategy. What the regressions miss is
    taken for normal noise, correlated between codes, whose covariance is that of the errors on held-out design points:
    so the uncertainty is calibrated on loadings that were not fitted to.

    Attributes:
        noise: (p, p) covariance of the codes' errors on held-out points [m^2].
        skill: 1 - squared error over that of "the pile stays as it is", on held-out points, over all cells; below 0:
            worse than that.
    """

    def __init__(
        self, data: LoadingData, grid: PileGrid, encoder: PileEncoder, gamma: float, seed: int = 0
    ) -> None:
        """Fit to the loadings that another one followed.

        Raises:
            InputError: fewer than ten of them, or all at one design point.
        """
        self._grid, self._encoder, self._gamma, self._problem = grid, encoder, gamma, data.problem
        self._seed = seed
        data = data.take(np.isfinite(data.following).all(axis=(1, 2)))
        if len(data) < 10 or len(np.unique(data.point)) < 2:
            raise InputError(
                f"a model of the pile after needs at least 10 loadings of several points with one after them; "
                f"there are {len(data)}"
            )
        errors = np.zeros((len(data), len(encoder.scale_)))
        squared = np.zeros(2)
        for train, test in data.iterate_folds(4, seed):
            models = self._fit(data.take(train))
            held = data.take(test)
            codes = self._predict(models, held.before, held.X)
            errors[test] = encoder.encode(held.following) - codes
            squared += [
                np.sum((encoder.decode(codes) - held.following) ** 2),
                np.sum((held.before - held.following) ** 2),
            ]
        # Mirror images are as likely: even and odd codes have no covariance.
        same = np.equal.outer(encoder.mirror_, encoder.mirror_)
        self.noise = np.where(same, errors.T @ errors / len(errors), 0.0)
        self._root = np.linalg.cholesky(self.noise + 1e-12 * np.eye(len(self.noise)))
        self.skill = float(1.0 - squared[0] / max(squared[1], 1e-12))
        self._models = self._fit(data)

    def predict(self, H: Array, X: Array) -> Array:
        """Return the expected codes (m, p) of the piles after; arguments as of `OutcomeModel.predict`."""
        return self._predict(self._models, H, X)

    def draw(self, H: Array, X: Array, rng: np.random.Generator) -> Array:
        """Return one possible pile after (m, nx, ny) [m] of each loading."""
        codes = self.predict(H, X)
        return self._encoder.decode(codes + rng.standard_normal(codes.shape) @ self._root.T)

    def predict_field(self, h: Array, x: Array) -> tuple[Array, Array]:
        """Return the expected pile after (nx, ny) and its standard deviation (nx, ny) [m] of one loading.

        Args:
            h: (nx, ny) heights before [m].
            x: (d,) design point.
        """
        mean = self._encoder.decode(self.predict(h[None], x[None]))[0]
        basis = self._encoder.decode(self.predict(h[None], x[None]) + self._root.T) - mean
        return mean, np.sqrt(np.sum(basis**2, axis=0) + self._encoder.residual_**2)

    def _fit(self, data: LoadingData) -> list[LandmarkRegressor]:
        # Both a loading and its mirror image.
        H = np.concatenate([data.before, data.before[:, :, ::-1]])
        after = np.concatenate([data.following, data.following[:, :, ::-1]])
        X = np.vstack([data.X, data.X])
        Z = self._join(H, X)
        theta = np.full(Z.shape[1], 0.5 / (_LENGTH**2 * Z.shape[1]))
        change = self._encoder.encode(after) - self._encoder.encode(H)
        return [
            LandmarkRegressor(theta, _N_LANDMARKS, derive_seed(self._seed, "pile", j) % 2**31).fit(
                Z, change[:, j]
            )
            for j in range(change.shape[1])
        ]

    def _predict(self, models: list[LandmarkRegressor], H: Array, X: Array) -> Array:
        Z = self._join(H, X)
        return self._encoder.encode(H) + np.column_stack([model.predict(Z) for model in models])

    def _join(self, H: Array, X: Array) -> Array:
        piles = np.broadcast_to(H, (len(X), *H.shape[1:]))
        entry, y = calc_entry_features(self._grid, piles, get_gamma(self._problem, X, self._gamma))
        codes = self._encoder.encode(H) / self._encoder.scale_
        scaled = self._problem.scale(X)
        # How much is taken, and from where: the product carries the side.
        sided = y[:, None] * np.hstack([np.ones((len(X), 1)), scaled])
        return np.hstack([scaled, entry, sided, np.broadcast_to(codes, (len(X), codes.shape[1]))])
