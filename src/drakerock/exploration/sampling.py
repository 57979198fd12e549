"""Where to simulate next (method section 6): initial design, sequential samplers, validation points.

A sampler knows nothing of simulations, workers or stores. It is told points and responses and asked for more:

    sampler = make_sampler(problem, config, seed)
    sampler.tell(X, Y)          # Y in natural senses; a row of NaN: failed, or asked for and still running
    X_new = sampler.ask(8)      # (8, d), in the variables' units

What `ask` returns is a pure function of (problem, config, seed, the set of rows told): a campaign that was
interrupted tells the stored rows to a new sampler and goes on bit for bit, in whatever order they finished.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import openturns as ot
from numpy.typing import ArrayLike
from openturns.experimental import LOLAVoronoi
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist
from scipy.stats import qmc

from drakerock.errors import InputError
from drakerock.exploration.config import ParetoConfig, SamplingConfig
from drakerock.exploration.hypervolume import make_directions, measure_lengths
from drakerock.exploration.kriging import Kriging, calc_correlation
from drakerock.exploration.one_at_a_time import make_one_at_a_time
from drakerock.exploration.pareto import calc_non_dominated, pareto_front
from drakerock.exploration.problem import Array, Problem
from drakerock.exploration.surrogate import Surrogate, calc_ranges
from drakerock.randomness import derive_seed, make_generator


def make_initial_design(problem: Problem, config: SamplingConfig, seed: int) -> Array:
    """Return the initial design (n, d): Latin hypercube with optimised spacing, then corner points.

    The hypercube minimises the phi_p criterion (p = 50, close to the largest minimal distance) by simulated
    annealing. With more corners than `n_corners`, a spread-out subset of them is taken. With the design
    ``one_at_a_time`` it is `make_one_at_a_time`'s.
    """
    if config.design == "one_at_a_time":
        return make_one_at_a_time(problem, config)
    d = len(problem.variables)
    parts = []
    if config.n_initial >= 2:
        with _seed_openturns(derive_seed(seed, "initial design")):
            cube = ot.LHSExperiment(_make_uniform(d), config.n_initial)
            cube.setAlwaysShuffle(True)
            parts.append(np.array(ot.SimulatedAnnealingLHS(cube, ot.SpaceFillingPhiP(50)).generate()))
    elif config.n_initial == 1:
        parts.append(np.zeros((1, d)))
    if config.n_corners:
        parts.append(_make_corners(d, config.n_corners, make_generator(seed, "corners")))
    if not parts:
        raise InputError("sampling: n_initial and n_corners are both 0; the initial design needs points")
    return problem.unscale(np.vstack(parts))


def make_validation_points(problem: Problem, config: SamplingConfig, seed: int) -> Array:
    """Return the validation points (n_validation, d): independent uniform draws, apart from all samples."""
    rng = make_generator(seed, "validation")
    return problem.unscale(rng.uniform(-1.0, 1.0, (config.n_validation, len(problem.variables))))


class Sampler(ABC):
    """Ask and tell. A subclass proposes points once the initial design has been told.

    Args:
        problem: variables and objectives.
        config: sizes and methods.
        seed: seed of the study.
    """

    def __init__(self, problem: Problem, config: SamplingConfig | None = None, seed: int = 0) -> None:
        self.problem = problem
        self.config = config or SamplingConfig()
        self.seed = seed
        self.initial = make_initial_design(problem, self.config, seed)
        self._told: dict[bytes, tuple[Array, Array, Array]] = {}

    def tell(self, X: ArrayLike, Y: ArrayLike, noise: ArrayLike | None = None) -> None:
        """Take in points X (n, d) with responses Y (n, k) in natural senses and standard errors (n, k).

        NaN in Y: no response (failed, or still running); the point's place counts, its response does not.
        Telling a point again replaces what was told of it.
        """
        d, k = len(self.problem.variables), len(self.problem.objectives)
        X = np.asarray(X, dtype=float).reshape(-1, d)
        Y = np.asarray(Y, dtype=float)
        if Y.size != len(X) * k:
            raise InputError(f"sampler: {len(X)} points need {len(X)} rows of {k} responses, got {Y.shape}")
        Y = Y.reshape(len(X), k)
        noise = np.full(Y.shape, np.nan) if noise is None else np.asarray(noise, dtype=float).reshape(Y.shape)
        if not np.isfinite(X).all():
            raise InputError("sampler: the design variables of every point must be finite numbers")
        for x, y, e in zip(X, Y, noise, strict=True):
            self._told[(x + 0.0).tobytes()] = (x.copy(), y.copy(), e.copy())

    def ask(self, n: int) -> Array:
        """Return the next n points (n, d), in the variables' units; none of them has been told.

        As long as points of the initial design have not been told, they come first.
        """
        if n < 1:
            raise InputError(f"sampler: asked for {n} points; ask for at least one")
        rest = [x for x in self.initial if (x + 0.0).tobytes() not in self._told]
        if rest:
            missing = n - len(rest)
            head = np.array(rest[:n])
            return head if missing <= 0 else np.vstack([head, self._fill(self._get_told()[0], head, missing)])
        X, Y, noise = self._get_told()
        U = self.problem.scale(X)
        return self.problem.unscale(self._propose(U, Y, noise, n))

    def _fill(self, X: Array, head: Array, n: int) -> Array:
        """Spread points among those told and those just given, where a method has no responses to go by."""
        U = self.problem.scale(np.vstack([X, head]))
        return self.problem.unscale(_spread(self._make_candidates(len(X)), U, n))

    def _get_told(self) -> tuple[Array, Array, Array]:
        """Return X, Y, noise in an order that does not depend on the order of telling."""
        d, k = len(self.problem.variables), len(self.problem.objectives)
        rows = sorted(self._told.values(), key=lambda row: tuple(row[0]))
        if not rows:
            return np.empty((0, d)), np.empty((0, k)), np.empty((0, k))
        X, Y, noise = (np.array(part) for part in zip(*rows, strict=True))
        return X, Y, noise

    def _make_candidates(self, n_told: int) -> Array:
        """Return scrambled Sobol' points (n_candidates, d) in [-1, 1], new at every step."""
        rng = make_generator(self.seed, "candidates", type(self).__name__, n_told)
        return 2.0 * _sobol(len(self.problem.variables), self.config.n_candidates, rng) - 1.0

    def _fit(self, U: Array, Y: Array, noise: Array) -> Surrogate | None:
        """Return the surrogate of what was told, or None while there are too few responses for one."""
        complete = np.isfinite(Y).all(axis=1)
        if len(np.unique(U[complete], axis=0)) < U.shape[1] + 2:
            return None
        surrogate = Surrogate(self.problem, self.config.surrogate, self.seed)
        return surrogate.fit(self.problem.unscale(U[complete]), Y[complete], noise[complete])

    @abstractmethod
    def _propose(self, U: Array, Y: Array, noise: Array, n: int) -> Array:
        """Return n points (n, d) in [-1, 1] from the told points (m, d) in [-1, 1] and their responses."""


class SpaceFillingSampler(Sampler):
    """Each point as far from all others as can be, whatever the responses."""

    def _propose(self, U: Array, Y: Array, noise: Array, n: int) -> Array:
        return _spread(self._make_candidates(len(U)), U, n)


class LolaVoronoiSampler(Sampler):
    """LOLA-Voronoi (Crombecq et al. 2011; OpenTURNS): local non-linearity times Voronoi volume.

    The score is the mean over the objectives, each divided by its range. A point without a response takes the
    responses of its nearest neighbour that has some: its place counts, and no non-linearity is made up.
    """

    def _propose(self, U: Array, Y: Array, noise: Array, n: int) -> Array:
        d = U.shape[1]
        good = np.isfinite(Y).all(axis=1)
        # A neighbourhood has 2 d points; with less there is no gradient to compare with.
        if good.sum() < 2 * d + 2:
            return _spread(self._make_candidates(len(U)), U, n)
        y = Y / calc_ranges(Y[good])
        if not good.all():
            nearest = np.argmin(cdist(U[~good], U[good]), axis=1)
            y[~good] = y[good][nearest]
        with _seed_openturns(derive_seed(self.seed, "lola-voronoi", len(U))):
            algorithm = LOLAVoronoi(U, y, _make_uniform(d))
            proposed = np.clip(np.array(algorithm.generate(min(n, len(U)))), -1.0, 1.0)
        # One new point per told point and batch is what the method can give.
        rest = _spread(self._make_candidates(len(U)), np.vstack([U, proposed]), n - len(proposed))
        return np.vstack([proposed, rest])


class ErrorSampler(Sampler):
    """Where the surrogate is wrong: around the sample points with the largest leave-one-out error.

    The squared leave-one-out error of each point, less the point's own noise variance, in ranges of the
    objective and summed over the objectives, is given to the point's Voronoi cell (CV-Voronoi, Xu et al.
    2014); the new point is the candidate in the worst cell farthest from all points, one per cell and batch.
    """

    def _propose(self, U: Array, Y: Array, noise: Array, n: int) -> Array:
        candidates = self._make_candidates(len(U))
        surrogate = self._fit(U, Y, noise)
        if surrogate is None:
            return _spread(candidates, U, n)
        good = np.isfinite(Y).all(axis=1)
        ranges = calc_ranges(Y[good])
        error = np.zeros(int(good.sum()))
        for j, model in enumerate(surrogate.models_):
            mean, _ = model.leave_one_out()
            known = model.noise_**2 + model.lam_ * model.sigma2_
            error += np.maximum((Y[good, j] - mean) ** 2 - known, 0.0) / ranges[j] ** 2
        places, cell_points = U, U[good]
        chosen: list[Array] = []
        cells = np.argmin(cdist(candidates, cell_points), axis=1)
        for cell in np.argsort(-error, kind="stable"):
            inside = candidates[cells == cell]
            if len(inside) == 0 or len(chosen) == n:
                continue
            new = _spread(inside, places, 1)
            chosen.append(new[0])
            places = np.vstack([places, new])
        if len(chosen) < n:
            chosen.extend(_spread(candidates, places, n - len(chosen)))
        return np.array(chosen)


class VarianceSampler(Sampler):
    """Where the surrogate is least sure: largest predictive variance, summed over the objectives in ranges.

    Within a batch the variance is updated for each point taken; it does not need that point's response.
    """

    def _propose(self, U: Array, Y: Array, noise: Array, n: int) -> Array:
        candidates = self._make_candidates(len(U))
        surrogate = self._fit(U, Y, noise)
        if surrogate is None:
            return _spread(candidates, U, n)
        ranges = calc_ranges(Y)
        # Running points have no response yet, but what they will tell must not be asked for twice.
        silent = U[~np.isfinite(Y).all(axis=1)]
        updates = [_VarianceUpdate(model, candidates, silent) for model in surrogate.models_]
        taken: list[int] = []
        for _ in range(n):
            score = sum(
                (update.variance / r**2 for update, r in zip(updates, ranges, strict=True)),
                np.zeros(len(candidates)),
            )
            score[taken] = -np.inf
            best = int(np.argmax(score))
            taken.append(best)
            for update in updates:
                update.add(best)
        return candidates[taken]


class _VarianceUpdate:
    """Predictive variance at candidates, conditioned on more and more of them (rank-one downdates)."""

    def __init__(self, model: Kriging, candidates: Array, silent: Array) -> None:
        self._model, self._points = model, np.vstack([candidates, silent])
        self._n = len(candidates)
        k = calc_correlation(self._points, model.U_train_, model.theta_, model.p)
        if model.constant_:
            self._v = np.zeros((len(self._points), 0))
        else:
            self._v = solve_triangular(model.factor_, k.T, lower=True).T
        self._relative = np.maximum(1.0 - np.sum(self._v**2, axis=1), 0.0)
        for i in range(self._n, len(self._points)):
            self.add(i)

    @property
    def variance(self) -> Array:
        return self._model.sigma2_ * self._relative[: self._n]

    def add(self, i: int) -> None:
        model = self._model
        noise = model.lam_ + (np.mean(model.noise_**2) / model.sigma2_ if model.sigma2_ else 0.0)
        c = calc_correlation(self._points, self._points[i : i + 1], model.theta_, model.p)[:, 0]
        c -= self._v @ self._v[i]
        column = c / np.sqrt(max(c[i] + noise, 1e-12))
        self._v = np.column_stack([self._v, column])
        self._relative = np.maximum(self._relative - column**2, 0.0)


class HypervolumeSampler(Sampler):
    """Where the Pareto front may grow: expected improvement of the dominated hypervolume.

    The hypervolume is a mean over directions (see `hypervolume`); the improvement by a draw from the surrogate at
    a candidate follows with the same directions. Within a batch the predicted mean of each point taken counts as
    its response (Kriging believer).
    """

    n_directions = 256
    n_draws = 32

    def _propose(self, U: Array, Y: Array, noise: Array, n: int) -> Array:
        candidates = self._make_candidates(len(U))
        surrogate = self._fit(U, Y, noise)
        if surrogate is None:
            return _spread(candidates, U, n)
        good = np.isfinite(Y).all(axis=1)
        signs, ranges = self.problem.signs, calc_ranges(Y[good])
        # Half of the candidates stand near the present front, where most improvements are.
        rng = make_generator(self.seed, "hypervolume", len(U))
        best = U[good][calc_non_dominated(Y[good] * signs)]
        half = len(candidates) // 2
        near = best[rng.integers(len(best), size=half)] + 0.15 * rng.standard_normal((half, U.shape[1]))
        candidates[:half] = np.clip(near, -1.0, 1.0)
        mean, std = surrogate.predict(self.problem.unscale(candidates), return_std=True)
        k = len(signs)
        # Noisy responses would make the front look better than it is: the surrogate's means stand for them.
        front = surrogate.predict(self.problem.unscale(U[good])) * signs / ranges
        f, s = mean * signs / ranges, std / ranges
        # 10 % of the range beyond the worst response, so that the ends of the front count too.
        reference = (Y[good] * signs / ranges).max(axis=0) + 0.1
        directions = make_directions(k, self.n_directions, rng)
        normal = qmc.MultivariateNormalQMC(np.zeros(k), rng=rng).random(self.n_draws)
        lengths = np.array(
            [_scalarize(reference - f - s * z, directions) for z in normal]
        )  # (draws, cand., dir.)
        reached = _scalarize(reference - front, directions).max(axis=0)
        taken: list[int] = []
        for _ in range(n):
            score = np.maximum(lengths - reached, 0.0).mean(axis=(0, 2))
            score[taken] = -np.inf
            i = int(np.argmax(score))
            if not score[i] > 0.0:
                break
            taken.append(i)
            reached = np.maximum(reached, _scalarize(reference - f[i : i + 1], directions)[0])
        chosen = candidates[taken]
        if len(chosen) < n:
            chosen = np.vstack([chosen, _spread(candidates, np.vstack([U, chosen]), n - len(chosen))])
        return chosen


class FrontSampler(Sampler):
    """Local refinement: points of the surrogate's Pareto front, each as far from all others as can be."""

    def _propose(self, U: Array, Y: Array, noise: Array, n: int) -> Array:
        surrogate = self._fit(U, Y, noise)
        if surrogate is None:
            return _spread(self._make_candidates(len(U)), U, n)
        config = ParetoConfig(population=100, evaluations=5000, n_draws=0)
        front = pareto_front(surrogate, config=config, seed=derive_seed(self.seed, "front", len(U)))
        candidates = self.problem.scale(front.X)
        chosen = _spread(candidates, U, min(n, len(candidates)))
        if len(chosen) < n:
            rest = _spread(self._make_candidates(len(U)), np.vstack([U, chosen]), n - len(chosen))
            chosen = np.vstack([chosen, rest])
        return chosen


class AlternatingSampler(Sampler):
    """The methods of the configuration in turn, one per batch; how many points are told says whose turn."""

    def _propose(self, U: Array, Y: Array, noise: Array, n: int) -> Array:
        methods = self.config.methods
        turn = max(len(U) - len(self.initial), 0) // self.config.batch_size
        sampler = SAMPLERS[methods[turn % len(methods)]](self.problem, self.config, self.seed)
        return sampler._propose(U, Y, noise, n)


SAMPLERS: dict[str, type[Sampler]] = {
    "space_filling": SpaceFillingSampler,
    "lola_voronoi": LolaVoronoiSampler,
    "error": ErrorSampler,
    "variance": VarianceSampler,
    "hypervolume": HypervolumeSampler,
    "front": FrontSampler,
}


def make_sampler(problem: Problem, config: SamplingConfig | None = None, seed: int = 0) -> Sampler:
    """Return the sampler that a configuration asks for."""
    config = config or SamplingConfig()
    kind = AlternatingSampler if len(config.methods) > 1 else SAMPLERS[config.methods[0]]
    return kind(problem, config, seed)


def _make_corners(d: int, n: int, rng: np.random.Generator) -> Array:
    if 2**d <= n:
        return np.array([[1.0 if i >> j & 1 else -1.0 for j in range(d)] for i in range(2**d)])
    # Too many corners to list: spread a subset of random ones, the first opposite pair given.
    pool = np.unique(np.sign(rng.uniform(-1.0, 1.0, (64 * n, d))), axis=0)
    first = -np.ones((1, d))
    return np.vstack([first, _spread(pool, first, n - 1)])


def _spread(candidates: Array, occupied: Array, n: int) -> Array:
    """Return n of the candidates, each in turn the one farthest from all points before it."""
    # With nothing there yet, begin in the middle.
    distance = cdist(candidates, occupied).min(axis=1) if len(occupied) else -np.sum(candidates**2, axis=1)
    taken: list[int] = []
    for _ in range(min(n, len(candidates))):
        i = int(np.argmax(distance))
        taken.append(i)
        gap = cdist(candidates, candidates[i : i + 1])[:, 0]
        distance = gap if not len(occupied) and len(taken) == 1 else np.minimum(distance, gap)
    return candidates[taken]


def _sobol(d: int, n: int, rng: np.random.Generator) -> Array:
    # Sobol' points are balanced in powers of two; take that many and cut.
    return qmc.Sobol(d, rng=rng).random_base2(int(np.ceil(np.log2(n))))[:n]


def _scalarize(gain: Array, directions: Array) -> Array:
    """Return min_j ((gain_j)+ / v_j)^k, (n, n_directions), for gains (n, k) over the reference point."""
    return measure_lengths(gain, directions) ** gain.shape[1]


def _make_uniform(d: int) -> ot.Distribution:
    return ot.JointDistribution([ot.Uniform(-1.0, 1.0)] * d)


@contextmanager
def _seed_openturns(seed: int) -> Iterator[None]:
    """Seed OpenTURNS and have it average scores; its generator and settings are global, so put them back."""
    state = ot.RandomGenerator.GetState()
    key = "LOLAVoronoi-NonLinearityAggregationMethod"
    method = ot.ResourceMap.Get(key)
    ot.RandomGenerator.SetSeed(seed % 2**32)
    ot.ResourceMap.Set(key, "Average")
    try:
        yield
    finally:
        ot.RandomGenerator.SetState(state)
        ot.ResourceMap.Set(key, method)
