"""Fitting parameters to measured curves: surrogate of the curves, posterior of the parameters, where to simulate next.

The simulated curves of n points are columns of numbers, each divided by what the measurement's noise and the scatter of
single simulations leave of it, so that a part of a curve where chance rules does not hide one that tells something.
Their principal components hold nearly all of what the parameters change; each score z_k(x) gets a regression Kriging
of its own (`surrogate`). A measurement has scores z_k, too, and with uniform priors in the ranges

    log p(x) = -1/2 sum_k [ (z_k - z^_k(x))^2 / v_k(x) + log v_k(x) ],
    v_k = f (n_k^2 + lambda_k sigma_k^2) + s_k^2(x)

with n the noise of the measurement in the score, lambda sigma^2 the scatter of one simulation, which a measurement has
as well, and s^2 the surrogate's own uncertainty. f >= 1 is the mean squared misfit at the best point where that is more
than 1: a model that misses the measurement claims no narrow intervals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import qmc

from drakerock.errors import InputError
from drakerock.exploration.config import SamplingConfig
from drakerock.exploration.kriging import Kriging
from drakerock.exploration.problem import Array, Problem
from drakerock.exploration.sampling import make_sampler
from drakerock.randomness import derive_seed

# Principal components hold so much of the curves' variance, and there are at most so many.
EXPLAINED, MAX_COMPONENTS = 0.995, 6
# Draws of the posterior; rounds in which their box closes in on it; draws that must count.
LOG2_DRAWS, MAX_ROUNDS, LEAST_EFFECTIVE = 13, 6, 400.0
# How far below the best, in log p, the box that is looked at reaches.
DEPTH = 12.0
# An interval wider than this share of the prior's own is no knowledge; parameters that correlate so much are known
# together only; an interval whose end is so near its range's end may go on beyond [share of the range].
UNKNOWN_SHARE, CORRELATED, NEAR_END = 0.6, 0.95, 0.01
# The next points are spread over so much more than the posterior's box.
WIDENING = 1.5


@dataclass(frozen=True, eq=False)
class Calibration:
    """What measured curves say about the parameters.

    Attributes:
        problem: the parameters and their ranges.
        draws, weights: (m, d) points and their posterior probabilities (m,), summing to 1.
        best: (d,) the point of the highest posterior probability.
        low, high: (d,) central intervals of probability `confidence`.
        confidence: of the intervals.
        correlation: (d, d) of the posterior.
        misfit: f, the mean squared misfit of the scores at the best point over what noise and scatter explain.
        predicted: (m,) the curves, in line, that the surrogate gives at the best point, in the measurement's units.
        warnings: what is not identified, or not explained.
    """

    problem: Problem
    draws: Array
    weights: Array
    best: Array
    low: Array
    high: Array
    confidence: float
    correlation: Array
    misfit: float
    predicted: Array
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return estimates, intervals, correlations and warnings as plain data."""
        names = self.problem.variable_names
        median = [_calc_quantile(column, self.weights, 0.5) for column in self.draws.T]
        parameters = {
            v.name: {
                "best": float(self.best[i]), "median": median[i], "low": float(self.low[i]),
                "high": float(self.high[i]), "range": [v.low, v.high], "unit": v.unit,
            }
            for i, v in enumerate(self.problem.variables)
        }  # fmt: skip
        pairs = {
            f"{a}, {b}": float(self.correlation[i, j])
            for i, a in enumerate(names) for j, b in enumerate(names) if i < j
        }  # fmt: skip
        return {
            "confidence": self.confidence,
            "parameters": parameters,
            "correlations": pairs,
            "misfit": self.misfit,
            "warnings": list(self.warnings),
        }


def calibrate(
    problem: Problem,
    X: Array,
    F: Array,
    measured: Array,
    noise: Array,
    confidence: float = 0.95,
    seed: int = 0,
) -> Calibration:
    """Fit the parameters to a measurement.

    Args:
        problem: the parameters and their ranges.
        X: (n, d) simulated points.
        F: (n, m) their curves, in line.
        measured: (m,) the measured ones.
        noise: (m,) standard deviations of the measured values.
        confidence: probability of the intervals.
        seed: of the surrogate's and the posterior's draws.

    Raises:
        InputError: too few simulations.
    """
    n, d = X.shape
    if n < 2 * d + 2:
        raise InputError(f"calibration: {n} simulations for {d} parameters; at least {2 * d + 2} are needed")
    unit = np.hypot(noise, _estimate_scatter(X, F))
    scaled, target = F / unit, measured / unit
    mean = scaled.mean(axis=0)
    _, singular, axes = np.linalg.svd(scaled - mean, full_matrices=False)
    share = np.cumsum(singular**2) / max(float(np.sum(singular**2)), 1e-300)
    k = min(int(np.searchsorted(share, EXPLAINED)) + 1, MAX_COMPONENTS, max(n // 4, 1))
    axes = axes[:k]
    scores, wanted = (scaled - mean) @ axes.T, (target - mean) @ axes.T
    bounds = np.array([problem.low, problem.high])
    models = [Kriging(bounds=bounds, random_state=derive_seed(seed, "scores", j) % 2**31).fit(X, z)
              for j, z in enumerate(scores.T)]  # fmt: skip
    noise2 = np.sum((axes * (noise / unit)) ** 2, axis=1)
    chance = noise2 + np.array([model.lam_ * model.sigma2_ for model in models])

    def predict(points: Array) -> tuple[Array, Array]:
        pairs = [model.predict(points, return_std=True) for model in models]
        return np.column_stack([a for a, _ in pairs]), np.column_stack([b for _, b in pairs])

    def calc_log(points: Array, factor: float) -> Array:
        centre, std = predict(points)
        variance = factor * chance + std**2
        return -0.5 * np.sum((wanted - centre) ** 2 / variance + np.log(variance), axis=1)

    draws, logs, best = _search(calc_log, problem, 1.0, seed)
    centre, std = predict(best[None])
    explained = chance + std[0] ** 2
    misfit = float(np.mean((wanted - centre[0]) ** 2 / explained))
    if misfit > 1.0:
        draws, logs, best = _search(calc_log, problem, misfit, seed)
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    tail = 0.5 * (1.0 - confidence)
    low, high = (np.array([_calc_quantile(c, weights, q) for c in draws.T]) for q in (tail, 1.0 - tail))
    middle = weights @ draws
    covariance = (draws - middle).T @ (weights[:, None] * (draws - middle))
    spread = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    correlation = covariance / np.outer(spread, spread)
    predicted = (mean + predict(best[None])[0][0] @ axes) * unit
    warnings = _judge(problem, low, high, confidence, correlation, misfit)
    return Calibration(
        problem, draws, weights, best, low, high, confidence, correlation, misfit, predicted, tuple(warnings)
    )


def _estimate_scatter(X: Array, F: Array) -> Array:
    """Return by how much single simulations scatter (m,): what a parabola in each parameter does not foresee of them.

    Each simulation is foreseen by the parabola through all others (leave-one-out residuals).
    """
    n, d = X.shape
    low, width = X.min(axis=0), np.maximum(np.ptp(X, axis=0), 1e-300)
    scaled = 2.0 * (X - low) / width - 1.0
    terms = [np.ones((n, 1)), scaled]
    if n >= 3 * (2 * d + 1):
        terms.append(scaled**2)
    basis, _ = np.linalg.qr(np.hstack(terms))
    leverage = np.minimum(np.sum(basis**2, axis=1), 1.0 - 1.0 / n)
    left = (F - basis @ (basis.T @ F)) / (1.0 - leverage)[:, None]
    return np.asarray(np.sqrt(np.mean(left**2, axis=0)))


def _search(calc_log: Any, problem: Problem, factor: float, seed: int) -> tuple[Array, Array, Array]:
    """Return draws (m, d) that cover the posterior evenly, their log probabilities, and the best of all."""
    low, high = problem.low, problem.high
    for number in range(MAX_ROUNDS):
        rng = np.random.default_rng(derive_seed(seed, "posterior", number))
        draws = low + qmc.Sobol(len(low), rng=rng).random_base2(LOG2_DRAWS) * (high - low)
        logs = calc_log(draws, factor)
        weights = np.exp(logs - logs.max())
        if weights.sum() ** 2 / np.sum(weights**2) >= LEAST_EFFECTIVE:
            break
        near = draws[logs > logs.max() - DEPTH]
        margin = 0.02 * (high - low) + 0.1 * np.ptp(near, axis=0)
        low = np.maximum(near.min(axis=0) - margin, problem.low)
        high = np.minimum(near.max(axis=0) + margin, problem.high)
    return draws, logs, draws[int(np.argmax(logs))]


def _judge(
    problem: Problem, low: Array, high: Array, confidence: float, correlation: Array, misfit: float
) -> list[str]:
    warnings = []
    for i, v in enumerate(problem.variables):
        width = v.high - v.low
        if high[i] - low[i] > UNKNOWN_SHARE * confidence * width:
            warnings.append(
                f"{v.name} is not identified: its interval [{low[i]:.4g}, {high[i]:.4g}] is nearly its whole range; "
                "these measurements hardly depend on it"
            )
        elif low[i] < v.low + NEAR_END * width or high[i] > v.high - NEAR_END * width:
            warnings.append(f"{v.name}: the interval reaches the end of its range; widen the range")
    for i, v in enumerate(problem.variables):
        for j in range(i):
            if abs(correlation[i, j]) > CORRELATED:
                warnings.append(
                    f"{problem.variables[j].name} and {v.name} are known together only (correlation "
                    f"{correlation[i, j]:.2f}): fix one, or measure something else besides"
                )
    if misfit > 4.0:
        warnings.append(
            f"the model misses the measurement: even the best point differs by {np.sqrt(misfit):.1f} times what noise "
            "and scatter explain; the intervals are widened by that"
        )
    return warnings


def propose_points(calibration: Calibration, n: int, seed: int) -> Array:
    """Return where to simulate next (n, d): a Latin hypercube over the posterior and some more, by our own sampler."""
    problem, names = calibration.problem, calibration.problem.variables
    heavy = calibration.weights > 1e-4 * calibration.weights.max()
    low, high = calibration.draws[heavy].min(axis=0), calibration.draws[heavy].max(axis=0)
    half = 0.5 * WIDENING * np.maximum(high - low, 0.02 * (problem.high - problem.low))
    middle = 0.5 * (low + high)
    low, high = np.maximum(middle - half, problem.low), np.minimum(middle + half, problem.high)
    near = problem.replace(
        variables=tuple(
            v.replace(low=float(a), high=float(b)) for v, a, b in zip(names, low, high, strict=True)
        )
    )
    return make_sampler(near, SamplingConfig(n_initial=n, n_corners=0), seed).ask(n)


def _calc_quantile(values: Array, weights: Array, q: float) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order]) - 0.5 * weights[order]
    return float(np.interp(q, total, values[order]))
