"""Test problems with exactly known truth: responses, Sobol' indices and Pareto fronts.

They measure the exploration where the answer is known, in the tests and in `benchmarks/exploration.py`, and
let a user try a configuration before spending simulations on it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import quad

from drakerock.exploration.problem import Array, Objective, Problem, Variable
from drakerock.exploration.table import ResponseTable, average_loadings


@dataclass(frozen=True)
class KnownProblem:
    """A problem and its truth.

    Attributes:
        name: of the problem.
        problem: variables and objectives.
        evaluate: exact objectives (n, k) at points (n, d), natural senses.
        first, total: (k, d) exact Sobol' indices; None where no exact value is known.
        make_front: exact Pareto-optimal objectives (n, k) for a wanted n; None for a single objective.
    """

    name: str
    problem: Problem
    evaluate: Callable[[Array], Array]
    first: Array | None = None
    total: Array | None = None
    make_front: Callable[[int], Array] | None = None


def make_branin() -> KnownProblem:
    """Return Branin's function: two variables, one objective, least value 0.397887 at three points."""

    def evaluate(X: Array) -> Array:
        a, b = X[:, 0], X[:, 1]
        bowl = (b - 5.1 / (4 * np.pi**2) * a**2 + 5 / np.pi * a - 6) ** 2
        return (bowl + 10 * (1 - 1 / (8 * np.pi)) * np.cos(a) + 10)[:, None]

    return KnownProblem("Branin", _make_problem([(-5.0, 10.0), (0.0, 15.0)], 1), evaluate)


def make_ishigami(a: float = 7.0, b: float = 0.1) -> KnownProblem:
    """Return the Ishigami function: three variables, strong interaction, indices known in closed form."""

    def evaluate(X: Array) -> Array:
        s = np.sin(X)
        return (s[:, 0] + a * s[:, 1] ** 2 + b * X[:, 2] ** 4 * s[:, 0])[:, None]

    v1 = 0.5 * (1 + b * np.pi**4 / 5) ** 2
    v2 = a**2 / 8
    v13 = b**2 * np.pi**8 * 8 / 225
    first = np.array([[v1, v2, 0.0]]) / (v1 + v2 + v13)
    total = np.array([[v1 + v13, v2, v13]]) / (v1 + v2 + v13)
    return KnownProblem("Ishigami", _make_problem([(-np.pi, np.pi)] * 3, 1), evaluate, first, total)


def make_zdt(number: int, d: int = 6) -> KnownProblem:
    """Return ZDT1 (convex front), ZDT2 (hollow front) or ZDT3 (front in five pieces), two objectives."""
    shapes: dict[int, Callable[[Array, Array], Array]] = {
        1: lambda f, g: 1 - np.sqrt(f / g),
        2: lambda f, g: 1 - (f / g) ** 2,
        3: lambda f, g: 1 - np.sqrt(f / g) - f / g * np.sin(10 * np.pi * f),
    }
    shape = shapes[number]

    def evaluate(X: Array) -> Array:
        g = 1 + 9 * X[:, 1:].mean(axis=1)
        return np.stack([X[:, 0], g * shape(X[:, 0], g)], axis=1)

    def make_front(n: int) -> Array:
        # On the front g = 1; ZDT3's curve is cut to its falling records.
        f = np.linspace(0.0, 1.0, 20 * n)
        h = shape(f, np.ones_like(f))
        record = np.concatenate([[True], h[1:] < np.minimum.accumulate(h)[:-1]])
        front = np.stack([f, h], axis=1)[record]
        return front[np.linspace(0, len(front) - 1, n).astype(int)]

    return KnownProblem(f"ZDT{number}", _make_problem([(0.0, 1.0)] * d, 2), evaluate, make_front=make_front)


def make_dtlz2(d: int = 6) -> KnownProblem:
    """Return DTLZ2 with three objectives: the front is the unit sphere's positive part."""

    def evaluate(X: Array) -> Array:
        g = 1 + np.sum((X[:, 2:] - 0.5) ** 2, axis=1)
        a, b = X[:, 0] * np.pi / 2, X[:, 1] * np.pi / 2
        return np.stack([g * np.cos(a) * np.cos(b), g * np.cos(a) * np.sin(b), g * np.sin(a)], axis=1)

    def make_front(n: int) -> Array:
        # Fibonacci spiral: even over the sphere.
        i = np.arange(n) + 0.5
        z, angle = i / n, (i * 0.6180339887498949) % 1.0 * np.pi / 2
        r = np.sqrt(1 - z**2)
        return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)

    return KnownProblem("DTLZ2", _make_problem([(0.0, 1.0)] * d, 3), evaluate, make_front=make_front)


# Peak of each objective in scaled variables, width, and the values far from it and at it. Dominance is that
# of the distances to the peaks, so the Pareto set is the triangle between them.
_PEAKS = np.array([[0.3, 0.5, 0.6, 0.4], [-0.7, -0.3, 0.2, -0.5], [-0.2, 0.7, -0.6, 0.5]])
_WIDTH = np.array([0.45, 0.35, 0.3])
_FAR = np.array([40.0, 2.6, 2000.0])
_AT_PEAK = np.array([230.0, 0.1, 120.0])
_AUTOCORRELATION = 0.4


def make_noisy_loading() -> KnownProblem:
    """Return a four-variable, three-objective stand-in for rock loading with known front and indices.

    Objective j is far_j + (peak_j - far_j) exp(-width_j |u - c_j|^2) in scaled variables u. Each is monotone
    in the distance to its peak c_j, hence the Pareto set is the convex hull of the three peaks; each is a
    product over the variables, hence the Sobol' indices are products of one-dimensional integrals.
    `make_noisy_table` adds loadings with noise.
    """
    problem = Problem()

    def evaluate_scaled(U: Array) -> Array:
        distance = np.sum((U[:, None, :] - _PEAKS) ** 2, axis=2)
        return _FAR + (_AT_PEAK - _FAR) * np.exp(-_WIDTH * distance)

    def make_front(n: int) -> Array:
        steps = int(np.ceil((np.sqrt(8 * n + 1) - 1) / 2))
        weights = [(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]
        return evaluate_scaled(np.array(weights) / steps @ _PEAKS)

    first, total = np.empty_like(_PEAKS), np.empty_like(_PEAKS)
    for j, (peak, width) in enumerate(zip(_PEAKS, _WIDTH, strict=True)):
        # Squared mean over mean square of each factor; one minus it is the factor's share of variance.
        share = np.array([_mean(c, width) ** 2 / _mean(c, 2 * width) for c in peak])
        first[j] = (1 / share - 1) / (1 / share.prod() - 1)
        total[j] = (1 - share) / (1 - share.prod())
    return KnownProblem(
        "noisy loading", problem, lambda X: evaluate_scaled(problem.scale(X)), first, total, make_front
    )


def calc_loading_spread(X: Array) -> Array:
    """Return the standard deviation (n, 3) of a single loading of `make_noisy_loading` at X (n, 4).

    It grows with the objective itself, as the spread of real loadings does.
    """
    known = make_noisy_loading()
    return np.array([0.02, 0.03, 0.03]) * np.abs(_FAR - _AT_PEAK) + 0.06 * np.abs(known.evaluate(X))


def make_noisy_table(
    X: Array, rng: np.random.Generator, n_loadings: int = 20, n_validation: int = 0
) -> ResponseTable:
    """Return a response table of `make_noisy_loading`: sequences of autocorrelated noisy loadings, averaged.

    Args:
        X: (n, 4) points.
        rng: of the noise.
        n_loadings: loadings per point.
        n_validation: the last so many points are validation points.
    """
    known = make_noisy_loading()
    n = len(X)
    spread = calc_loading_spread(X)
    noise = rng.standard_normal((n_loadings, n, 3))
    for i in range(1, n_loadings):
        noise[i] = _AUTOCORRELATION * noise[i - 1] + np.sqrt(1 - _AUTOCORRELATION**2) * noise[i]
    Y = known.evaluate(X) + spread * noise  # (n_loadings, n, 3)
    role = ["sample"] * (n - n_validation) + ["validation"] * n_validation
    return average_loadings(
        known.problem,
        [f"p{i:03d}" for _ in range(n_loadings) for i in range(n)],
        np.repeat(np.arange(n_loadings), n),
        np.tile(X, (n_loadings, 1)),
        Y.reshape(-1, 3),
        role * n_loadings,
    )


def _mean(centre: float, width: float) -> float:
    """Return the mean of exp(-width (u - centre)^2) over u uniform in [-1, 1]."""
    return 0.5 * float(quad(lambda u: np.exp(-width * (u - centre) ** 2), -1.0, 1.0, epsabs=1e-13)[0])


def _make_problem(ranges: list[tuple[float, float]], k: int) -> Problem:
    return Problem(
        variables=tuple(
            Variable(name=f"x{i + 1}", low=low, high=high) for i, (low, high) in enumerate(ranges)
        ),
        objectives=tuple(Objective(name=f"f{j + 1}") for j in range(k)),
    )
