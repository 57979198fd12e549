"""A Gaussian process over few landmarks, linear in its weights: its cost does not grow with the number of loadings.

    y = mean + scale (phi(z) . w) + noise,    phi(z) = [1, z, K_LL^(-1/2) k(z, landmarks)]

with the kernel of `drakerock.exploration.kriging`, k(u, v) = exp(-sum_j theta_j (u_j - v_j)^2), at rows drawn at
random (Nystrom features, Williams & Seeger 2001; scikit-learn's `Nystroem`). theta comes from the likelihood of a
Kriging of a part of the rows, the variances of weights and noise from that of all (scikit-learn's `BayesianRidge`).
"""

from __future__ import annotations

from typing import Self

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.kernel_approximation import Nystroem
from sklearn.linear_model import BayesianRidge

from drakerock.exploration.kriging import Kriging
from drakerock.exploration.problem import Array
from drakerock.randomness import make_generator


class LandmarkRegressor(RegressorMixin, BaseEstimator):
    """One response over inputs (n, d) of any units.

    Args:
        theta: (d,) weights of the kernel, of inputs in standard deviations.
        n_landmarks: at most so many.
        random_state: seed of the landmarks.

    Attributes after `fit`:
        weights_, covariance_: (D,), (D, D) posterior of w.
        noise_: standard deviation of a single response about its expectation, in y's unit.
    """

    def __init__(self, theta: Array, n_landmarks: int = 300, random_state: int = 0) -> None:
        self.theta = theta
        self.n_landmarks = n_landmarks
        self.random_state = random_state

    def fit(self, Z: Array, y: Array) -> Self:
        """Fit to inputs Z (n, d) and responses y (n,), n >= 2."""
        self.centre_, self.spread_ = calc_scaling(Z)
        self.kernel_ = Nystroem(
            kernel="rbf",
            gamma=1.0,
            n_components=min(self.n_landmarks, len(Z)),
            random_state=self.random_state,
        ).fit(self._scale(Z) * np.sqrt(self.theta))
        self.mean_, self.scale_ = float(y.mean()), float(y.std()) or 1.0
        model = BayesianRidge(fit_intercept=False).fit(self.transform(Z), (y - self.mean_) / self.scale_)
        self.weights_, self.covariance_ = model.coef_, model.sigma_
        self.noise_ = self.scale_ / float(np.sqrt(model.alpha_))
        return self

    def transform(self, Z: Array) -> Array:
        """Return the features phi (n, D)."""
        U = self._scale(Z)
        return np.hstack([np.ones((len(U), 1)), U, self.kernel_.transform(U * np.sqrt(self.theta))])

    def predict(self, Z: Array) -> Array:
        """Return the expected response (n,)."""
        return self.mean_ + self.scale_ * (self.transform(Z) @ self.weights_)

    def predict_with_std(self, Z: Array) -> tuple[Array, Array]:
        """Return the expected response (n,) and its own standard deviation (n,), without the noise."""
        features = self.transform(Z)
        variance = np.einsum("ij,ij->i", features @ self.covariance_, features)
        mean = self.mean_ + self.scale_ * (features @ self.weights_)
        return mean, self.scale_ * np.sqrt(np.maximum(variance, 0.0))

    def update(self, Z: Array, y: Array) -> Self:
        """Return the regression that has seen further responses y (m,) at Z (m, d) as well, by Bayes' rule."""
        features = self.transform(Z)
        noise = (self.noise_ / self.scale_) ** 2
        seen = features @ self.covariance_
        gain = np.linalg.solve(seen @ features.T + noise * np.eye(len(features)), seen).T
        weights = self.weights_ + gain @ ((y - self.mean_) / self.scale_ - features @ self.weights_)
        return self._replace(weights, self.covariance_ - gain @ seen)

    def doubt(self, factor: float) -> Self:
        """Return the same regression, its weights' standard deviations times a factor."""
        return self._replace(self.weights_, factor**2 * self.covariance_)

    def draw(self, Z: Array, rng: np.random.Generator) -> Array:
        """Return one draw of the expected response (n,) from the posterior, the same function at all Z."""
        values, vectors = np.linalg.eigh(self.covariance_)
        draw = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
        return self.mean_ + self.scale_ * (self.transform(Z) @ (self.weights_ + draw))

    def _scale(self, Z: Array) -> Array:
        return (Z - self.centre_) / self.spread_

    def _replace(self, weights: Array, covariance: Array) -> Self:
        new = type(self)(**self.get_params(deep=False))
        new.__dict__ |= self.__dict__ | {"weights_": weights, "covariance_": covariance}
        return new


def calc_scaling(Z: Array) -> tuple[Array, Array]:
    """Return means and standard deviations (d,) of inputs (n, d); 1 for those that hardly vary."""
    centre, spread = Z.mean(axis=0), Z.std(axis=0)
    return centre, np.where(spread > 1e-9 * (1.0 + np.abs(centre)), spread, 1.0)


def find_theta(Z: Array, y: Array, most: int, seed: int) -> Array:
    """Return the kernel's weights (d,) of greatest likelihood, by a Kriging of at most `most` rows drawn at random.

    Args:
        Z, y: inputs (n, d) and responses (n,).
        most: rows looked at.
        seed: of the draw and the search.
    """
    centre, spread = calc_scaling(Z)
    rows = make_generator(seed, "rows").permutation(len(Z))[:most]
    U = ((Z - centre) / spread)[rows]
    # The Kriging's own scaling to [-1, 1] is then none.
    bounds = np.stack([-np.ones(Z.shape[1]), np.ones(Z.shape[1])])
    return np.asarray(Kriging(bounds, n_starts=4, random_state=seed % 2**31).fit(U, y[rows]).theta_)
