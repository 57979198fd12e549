"""Regression Kriging of one response (method section 6).

    phi_hat(x) = m + sum_i w_i psi_i(x),   psi_i(x) = exp(-sum_j theta_j |u_j - u_ij|^p_j),
    (Psi + lambda I + D) w = y - m

with u the inputs scaled to [-1, 1], m the mean of y (the method's centring), theta and lambda by maximum
likelihood with p fixed, and D the known noise variances over sigma^2 (zero when none are known). This is a
Gaussian process with covariance sigma^2 (Psi + lambda I) + diag(se^2); scikit-learn computes its likelihood.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.stats import qmc
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import (
    ConstantKernel,
    Hyperparameter,
    Kernel,
    NormalizedKernelMixin,
    StationaryKernelMixin,
    WhiteKernel,
)
from sklearn.utils.validation import check_is_fitted, validate_data

from drakerock.exploration.problem import Array

# Search ranges of the maximum likelihood. In inputs scaled to [-1, 1] a theta of 1e-4 is a flat response and
# one of 1e2 a correlation length of 4 % of the range; sigma^2 is relative to the variance of y.
THETA_BOUNDS = (1e-4, 1e2)
LAMBDA_BOUNDS = (1e-9, 1e1)
_SIGMA2_BOUNDS = (1e-4, 1e6)
# Rows predicted at a time: the correlation block of a chunk stays in the processor's cache.
_CHUNK = 512


class PowerExponential(StationaryKernelMixin, NormalizedKernelMixin, Kernel):
    """psi(u, v) = exp(-sum_j theta_j |u_j - v_j|^p_j) as a scikit-learn kernel; p is fixed, not learned.

    scikit-learn has this kernel for p = 2 only (`RBF`, theta = 1 / (2 l^2)); here theta is the method's.
    """

    def __init__(
        self, weights: ArrayLike, p: ArrayLike = 2.0, weights_bounds: tuple[float, float] | str = THETA_BOUNDS
    ) -> None:
        # scikit-learn calls all log-hyperparameters `theta`; the method's theta is `weights` here.
        self.weights = weights
        self.p = p
        self.weights_bounds = weights_bounds

    @property
    def hyperparameter_weights(self) -> Hyperparameter:
        """The learned theta_j, declared to scikit-learn (searched in the logarithm)."""
        return Hyperparameter("weights", "numeric", self.weights_bounds, len(np.atleast_1d(self.weights)))

    def __call__(
        self, X: ArrayLike, Y: ArrayLike | None = None, eval_gradient: bool = False
    ) -> Array | tuple[Array, Array]:
        """Return the correlations (n, m) and, if asked, their gradient (n, n, d) to log theta."""
        X = np.asarray(X, dtype=float)
        theta = np.atleast_1d(np.asarray(self.weights, dtype=float))
        if not eval_gradient:
            return calc_correlation(X, X if Y is None else np.asarray(Y, dtype=float), theta, self.p)
        step = np.abs(X[:, None, :] - X[None, :, :])
        powers = np.broadcast_to(np.asarray(self.p, dtype=float), theta.shape)
        # Squaring is far faster than the general power, and most fits are with p = 2.
        terms = theta * (step**2 if (powers == 2.0).all() else step**powers)
        K = np.exp(-terms.sum(axis=2))
        if self.hyperparameter_weights.fixed:
            return K, np.empty((*K.shape, 0))
        return K, -terms * K[:, :, None]


def calc_correlation(U: Array, V: Array, theta: Array, p: ArrayLike) -> Array:
    """Return exp(-sum_j theta_j |u_j - v_j|^p_j), (n, m), for scaled inputs (n, d) and (m, d)."""
    powers = np.broadcast_to(np.asarray(p, dtype=float), theta.shape)
    if (powers == 2.0).all():
        A, B = U * np.sqrt(theta), V * np.sqrt(theta)
        S = A @ (-2.0 * B.T)
        S += np.sum(A**2, axis=1)[:, None]
        S += np.sum(B**2, axis=1)
        np.maximum(S, 0.0, out=S)  # the expanded square may come out at -1e-16
    else:
        S = np.zeros((len(U), len(V)))
        for j, (weight, power) in enumerate(zip(theta, powers, strict=True)):
            S += weight * np.abs(U[:, j, None] - V[:, j]) ** power
    np.negative(S, out=S)
    return np.exp(S, out=S)


class Kriging(RegressorMixin, BaseEstimator):
    """Regression Kriging of one response (method section 6), a scikit-learn estimator.

    Args:
        bounds: (2, d) lower and upper ends of the inputs' ranges, mapped to [-1, 1]; None: those of the data.
        p: exponent(s) in (0, 2], one for all inputs or (d,).
        theta: (d,) imposed weights; None: maximum likelihood.
        lam: imposed regularisation lambda; None: maximum likelihood.
        variance: imposed process variance over that of y; None: maximum likelihood.
        trend: "mean": the mean of y, the method's centring; "likelihood": the constant of greatest likelihood
            (generalised least squares, ordinary Kriging); a number: imposed, in the unit of y.
        n_starts: starting points screened by their likelihood; the best quarter of them is optimised.
        random_state: seed of the starting points.

    Attributes after `fit`:
        theta_: (d,) weights in the method's scaling. lam_: lambda. sigma2_: process variance [y^2].
        variance_: the same over the variance of y, as it was found.
        trend_: constant trend m. weights_: (n,) the w_i. log_likelihood_: at the optimum, of y in its unit.
        lower_, upper_: (d,) the ranges used for scaling. U_train_: (n, d) scaled inputs. y_train_: (n,).
        constant_: True when y does not vary; the prediction is then that value with zero spread.
    """

    def __init__(
        self,
        bounds: ArrayLike | None = None,
        p: ArrayLike = 2.0,
        theta: ArrayLike | None = None,
        lam: float | None = None,
        variance: float | None = None,
        trend: float | Literal["mean", "likelihood"] = "mean",
        n_starts: int = 16,
        random_state: int = 0,
    ) -> None:
        self.bounds = bounds
        self.p = p
        self.theta = theta
        self.lam = lam
        self.variance = variance
        self.trend = trend
        self.n_starts = n_starts
        self.random_state = random_state

    def fit(self, X: ArrayLike, y: ArrayLike, noise: ArrayLike | None = None) -> Self:
        """Fit to points X (n, d) and responses y (n,).

        Args:
            X: points in their own units.
            y: responses.
            noise: (n,) known standard errors of y, in its unit; None: unknown, all noise goes into lambda.

        Raises:
            ValueError: NaN or infinite values, fewer than two points, wrong shapes, p outside (0, 2].
        """
        checked = validate_data(self, X, y, dtype=float, ensure_min_samples=2, y_numeric=True)
        points, y = np.asarray(checked[0], dtype=float), np.asarray(checked[1], dtype=float)
        n, d = points.shape
        powers = np.asarray(self.p, dtype=float)
        if np.any(powers <= 0.0) or np.any(powers > 2.0):
            raise ValueError(f"p must be in (0, 2], got {self.p!r}")
        self.lower_, self.upper_ = self._find_ranges(points)
        self.U_train_, self.y_train_ = self._scale(points), y
        self.trend_ = float(y.mean()) if isinstance(self.trend, str) else float(self.trend)
        scale = float(y.std()) or abs(float(y[0]) - self.trend_)
        self.noise_ = np.zeros(n) if noise is None else np.asarray(noise, dtype=float)
        if self.noise_.shape != (n,) or not np.all(self.noise_ >= 0.0):
            raise ValueError(f"noise must be {n} standard errors >= 0")
        # Also where squares would vanish.
        self.constant_ = scale <= max(1e-12 * float(np.abs(y).max()), 1e-100)
        if self.constant_:
            self.theta_ = np.full(d, THETA_BOUNDS[0]) if self.theta is None else np.asarray(self.theta, float)
            self.lam_, self.variance_, self.sigma2_ = float(self.lam or 0.0), 0.0, 0.0
            self.log_likelihood_ = float("nan")
            self.weights_ = np.zeros(n)
            return self

        gp = self._fit_process(self._make_kernel(d), self._search, scale)
        if self.trend == "likelihood":
            # Ascent by turns, the trend for given theta and lambda and back, to the joint maximum.
            for _ in range(50):
                ones = cho_solve((gp.L_, True), np.ones(n))
                step = float(ones @ (y - self.trend_) / ones.sum())
                self.trend_ += step
                gp = self._fit_process(gp.kernel_, _climb, scale)
                if abs(step) <= 1e-4 * scale:
                    break
        kernel = gp.kernel_.get_params()
        self.theta_ = np.atleast_1d(np.asarray(kernel["k2__k1__weights"], dtype=float))
        self.lam_ = float(kernel["k2__k2__noise_level"])
        self.variance_ = float(kernel["k1__constant_value"])
        self.sigma2_ = self.variance_ * scale**2
        self.log_likelihood_ = float(gp.log_marginal_likelihood_value_) - n * float(np.log(scale))
        # In units of sigma^2: factor of Psi + lambda I + D and the method's weights w.
        self.factor_ = gp.L_ * (scale / np.sqrt(self.sigma2_))
        self.weights_ = cho_solve((self.factor_, True), y - self.trend_)
        return self

    def predict(self, X: ArrayLike, return_std: bool = False) -> Any:
        """Return the predicted mean (n,) and, with `return_std`, its standard deviation (n,).

        The standard deviation is that of the noise-free response phi(x), not of a new observation of it.
        """
        check_is_fitted(self)
        U = self._scale(validate_data(self, X, dtype=float, reset=False))
        mean = np.empty(len(U))
        std = np.zeros(len(U))
        for i in range(0, len(U), _CHUNK):
            block = slice(i, i + _CHUNK)
            k = calc_correlation(U[block], self.U_train_, self.theta_, self.p)
            mean[block] = k @ self.weights_
            if return_std and not self.constant_:
                v = solve_triangular(self.factor_, k.T, lower=True, overwrite_b=True, check_finite=False)
                std[block] = np.sqrt(self.sigma2_ * np.maximum(1.0 - np.sum(v**2, axis=0), 0.0))
        mean += self.trend_
        return (mean, std) if return_std else mean

    def draw(self, X: ArrayLike, n_draws: int, rng: np.random.Generator) -> Array:
        """Return joint draws (n_draws, n) of the noise-free response at X (n, d) from the posterior."""
        check_is_fitted(self)
        U = self._scale(np.asarray(X, dtype=float))
        z = rng.standard_normal((len(U), n_draws))
        if self.constant_:
            return np.full((n_draws, len(U)), self.trend_)
        k = calc_correlation(U, self.U_train_, self.theta_, self.p)
        v = solve_triangular(self.factor_, k.T, lower=True, check_finite=False)
        covariance = calc_correlation(U, U, self.theta_, self.p) - v.T @ v
        # Symmetric square root: close points make the covariance singular, where Cholesky would fail.
        values, vectors = np.linalg.eigh(covariance)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        return (self.trend_ + (k @ self.weights_)[:, None] + np.sqrt(self.sigma2_) * (root @ z)).T

    def leave_one_out(self) -> tuple[Array, Array]:
        """Return leave-one-out mean (n,) and standard deviation (n,) of each *observed* y, in closed form.

        theta, lambda and trend stay those of the full fit (Dubrule 1983): with C = Psi + lambda I + D,
        y_i - mean_i = w_i / [C^-1]_ii and var_i = sigma^2 / [C^-1]_ii.
        """
        check_is_fitted(self)
        if self.constant_:
            return self.y_train_.copy(), np.zeros(len(self.y_train_))
        inverse_root = solve_triangular(self.factor_, np.eye(len(self.y_train_)), lower=True)
        diagonal = np.sum(inverse_root**2, axis=0)
        return self.y_train_ - self.weights_ / diagonal, np.sqrt(self.sigma2_ / diagonal)

    def _fit_process(self, kernel: Kernel, optimizer: Any, scale: float) -> Any:
        gp = GaussianProcessRegressor(
            kernel,
            # The jitter keeps duplicate points without noise positive definite when lambda is imposed as 0.
            alpha=(self.noise_ / scale) ** 2 + 1e-13,
            optimizer=optimizer,
        )
        with warnings.catch_warnings():
            # A theta or lambda at its bound is an answer (inactive input, no noise), no failure to converge.
            warnings.simplefilter("ignore", ConvergenceWarning)
            return gp.fit(self.U_train_, (self.y_train_ - self.trend_) / scale)

    def _find_ranges(self, X: Array) -> tuple[Array, Array]:
        if self.bounds is None:
            lower, upper = X.min(axis=0), X.max(axis=0)
            return lower, np.where(upper > lower, upper, lower + 1.0)
        bounds = np.asarray(self.bounds, dtype=float)
        if bounds.shape != (2, X.shape[1]) or not np.all(bounds[0] < bounds[1]):
            raise ValueError(f"bounds must be (2, {X.shape[1]}), lower below upper")
        return bounds[0], bounds[1]

    def _scale(self, X: Array) -> Array:
        return 2.0 * (X - self.lower_) / (self.upper_ - self.lower_) - 1.0

    def _make_kernel(self, d: int) -> Kernel:
        theta = np.ones(d) if self.theta is None else np.asarray(self.theta, dtype=float)
        if theta.shape != (d,) or not np.all(theta > 0.0):
            raise ValueError(f"theta must be {d} numbers > 0")
        correlation = PowerExponential(theta, self.p, THETA_BOUNDS if self.theta is None else "fixed")
        # The logarithm of an imposed lambda of zero does not exist; 1e-300 is zero in the sum.
        white = WhiteKernel(
            1e-3 if self.lam is None else max(self.lam, 1e-300),
            LAMBDA_BOUNDS if self.lam is None else "fixed",
        )
        constant = ConstantKernel(
            1.0 if self.variance is None else self.variance,
            _SIGMA2_BOUNDS if self.variance is None else "fixed",
        )
        return constant * (correlation + white)

    def _search(self, objective: Callable[..., Any], start: Array, bounds: Array) -> tuple[Array, float]:
        """Maximise the likelihood from the best of several starts; scikit-learn's optimizer interface."""
        rng = np.random.default_rng(self.random_state)
        sobol = qmc.Sobol(len(start), rng=rng).random_base2(int(np.ceil(np.log2(self.n_starts))))
        # sigma^2 near the variance of y and lambda well below 1 are where optima lie.
        inner = np.log([(0.3, 30.0)] + [(1e-2, 10.0)] * (len(start) - 1))
        if self.lam is None:
            inner[-1] = np.log([1e-6, 0.3])
        starts = np.vstack([start, inner[:, 0] + sobol * (inner[:, 1] - inner[:, 0])])
        values = np.array([objective(s, eval_gradient=False) for s in starts])
        best = np.argsort(values, kind="stable")[: max(1, self.n_starts // 4)]
        results = [_climb(objective, starts[i], bounds) for i in best]
        return min(results, key=lambda result: result[1])


def _climb(objective: Callable[..., Any], start: Array, bounds: Array) -> tuple[Array, float]:
    result = minimize(objective, start, jac=True, bounds=bounds, method="L-BFGS-B")
    return result.x, float(result.fun)
