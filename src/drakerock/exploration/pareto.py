"""The Pareto front on the surrogate (method section 6): NSGA-II, hypervolume, constraints, uncertainty.

With five objectives and more nearly every point is non-dominated, and NSGA-II finds little but the ends of the front;
the search then goes on with NSGA-III (Deb & Jain 2014), which keeps the best point along each of many directions.

Plain dominance on a surrogate is misled by its smallest errors: a point whose production is predicted a
millionth higher would stand on the front however much worse the rest is. The front is therefore the set of
properly efficient points (Geoffrion 1968) with bounded trade-off: a gain must not cost more than M times as
much in the other objectives, all in ranges of the objectives over the design space. With y the objectives
over their ranges this is plain dominance of A y, A = I + (1 1^T - I) / M. The default M = 50 takes away what
gains less than 2 % of one range at the cost of all of another: about what a surrogate can tell apart.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pymoo.algorithms.moo.nsga2 import NSGA2
from pymoo.algorithms.moo.nsga3 import NSGA3
from pymoo.core.callback import Callback
from pymoo.core.problem import Problem as PymooProblem
from pymoo.optimize import minimize
from pymoo.util.nds.non_dominated_sorting import NonDominatedSorting
from scipy.spatial.distance import cdist

from drakerock.errors import InputError
from drakerock.exploration.config import Bound, ParetoConfig
from drakerock.exploration.hypervolume import calc_hypervolume_share, make_directions
from drakerock.exploration.problem import Array, Problem
from drakerock.randomness import derive_seed, make_generator

Indices = NDArray[np.int_]
# From so many objectives on, three quarters of the search are NSGA-III.
MANY_OBJECTIVES = 5


def parse_bound(text: str, problem: Problem, probability: float | None = None) -> Bound:
    """Read a bound such as ``debris<=500``, which is to hold with a probability (None: the default of `Bound`).

    Raises:
        InputError: not of that form, unknown objective.
    """
    match = re.fullmatch(r"\s*(\w+)\s*(<=|>=)\s*([-+.\deE]+)\s*", text)
    try:
        value = float(match[3]) if match else float("nan")
    except ValueError:
        match = None
    if match is None or not np.isfinite(value):
        raise InputError(
            f"bound '{text}': expected objective<=number or objective>=number, such as debris<=500"
        )
    problem.get_objective(match[1])
    if probability is not None and not 0.5 <= probability < 1.0:
        raise InputError(f"probability of the bounds is {probability:g}; at least 0.5, below 1")
    given = {} if probability is None else {"probability": probability}
    return Bound(objective=match[1], relation="<=" if match[2] == "<=" else ">=", value=value, **given)


class Model(Protocol):
    """What a front is searched on: a fitted `Surrogate`, or anything that predicts like one."""

    problem_: Problem

    def predict(self, X: ArrayLike, return_std: bool = False) -> Any:
        """Return objectives (n, k) in natural senses, and their standard deviations if asked."""


@dataclass(frozen=True)
class FrontUncertainty:
    """What the surrogate's own uncertainty does to the front.

    Attributes:
        p_optimal: (n,) share of the draws in which a front point is not dominated by any other candidate.
        hypervolumes: (n_draws,) hypervolume of each draw's own front, same reference point as the front's.
        fronts: one array (m_i, k) per draw: its non-dominated objectives, natural senses.
    """

    p_optimal: Array
    hypervolumes: Array
    fronts: tuple[Array, ...]


@dataclass(frozen=True)
class ParetoFront:
    """The Pareto-optimal points of a surrogate.

    Attributes:
        problem: variables and objectives.
        X: (n, d) design points, sorted by the first objective, best first.
        Y: (n, k) predicted objectives, natural senses.
        std: (n, k) standard deviations of the prediction.
        ideal, nadir: (k,) best and worst value of each objective on the front, natural senses.
        reference: (k,) reference point of the hypervolume, natural senses.
        evaluations: (g,) evaluations after each generation.
        hypervolume: (g,) hypervolume after each generation, as a share of the box from ideal to reference of
            the final front.
        bounds: limits that were imposed.
        uncertainty: by resampling the surrogate; None if not asked for.
    """

    problem: Problem
    X: Array
    Y: Array
    std: Array
    ideal: Array
    nadir: Array
    reference: Array
    evaluations: Array
    hypervolume: Array
    bounds: tuple[Bound, ...] = ()
    uncertainty: FrontUncertainty | None = None

    def __len__(self) -> int:
        return len(self.X)

    def calc_regret(self) -> Array:
        """Return (n, k): 0 at the best, 1 at the worst value of each objective on the front."""
        spread = self.nadir - self.ideal
        return (self.Y - self.ideal) / np.where(spread == 0.0, 1.0, spread)


def pareto_front(
    surrogate: Model,
    bounds: Sequence[Bound] = (),
    config: ParetoConfig | None = None,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> ParetoFront:
    """Search the Pareto front of a surrogate inside the variables' ranges by NSGA-II, or NSGA-III.

    Args:
        surrogate: a fitted `Surrogate`, or any `Model`.
        bounds: limits on objectives, in addition to those of the configuration.
        config: population, evaluations, draws.
        seed: seed of the study.
        progress: called with the share of the search that is done.

    Raises:
        InputError: no point satisfies the bounds; the message says what can be reached.
    """
    config = config or ParetoConfig()
    problem = surrogate.problem_
    limits = (*config.bounds, *bounds)
    signs = problem.signs
    for bound in limits:
        problem.get_objective(bound.objective)
    cone = _make_cone(surrogate, problem, config.max_trade_off, seed)
    search = _Search(surrogate, problem, limits, cone)
    history = _History(config.evaluations, progress)
    results = _run_search(search, config, seed, history)
    found = [np.atleast_2d(result.X) for result in results if result.X is not None]
    if not found:
        raise InputError(_describe_infeasible(surrogate, problem, limits, results[-1]))
    X = problem.unscale(np.vstack(found))
    Y, std = surrogate.predict(X, return_std=True)
    keep = calc_non_dominated(Y @ cone.T)
    keep = keep[np.argsort((Y * signs)[keep, 0], kind="stable")]
    X, Y, std = X[keep], Y[keep], std[keep]
    best, worst = (Y * signs).min(axis=0), (Y * signs).max(axis=0)
    spread = np.where(worst > best, worst - best, 1.0)
    reference = worst + 0.1 * spread
    # Back from the cone's coordinates to minimised objectives.
    inverse = np.linalg.inv(cone).T * signs
    volumes = [calc_hypervolume_share(C @ inverse, best, reference) for C in history.fronts]
    front = ParetoFront(
        problem,
        X,
        Y,
        std,
        ideal=best * signs,
        nadir=worst * signs,
        reference=reference * signs,
        evaluations=np.array(history.evaluations, dtype=float),
        hypervolume=np.array(volumes),
        bounds=limits,
    )
    if config.n_draws and hasattr(surrogate, "draw"):
        pool = problem.unscale(history.sample_pool(make_generator(seed, "front pool")))
        front = _add_uncertainty(front, surrogate, pool, cone, config.n_draws, seed)
    return front


def calc_non_dominated(F: ArrayLike) -> Indices:
    """Return the indices of the rows of F (n, k), all minimised, that no other row dominates.

    Of equal rows, the first is kept.
    """
    _, first = np.unique(np.asarray(F, dtype=float), axis=0, return_index=True)
    first = np.sort(first)
    best = NonDominatedSorting().do(np.asarray(F, dtype=float)[first], only_non_dominated_front=True)
    return np.sort(first[best])


def select_spread(front: ParetoFront, n: int, first: Sequence[int] = ()) -> Indices:
    """Return indices of n front points that spread over the front, for re-simulation.

    Begins with `first` (the knee, say) and the best point of every objective, then takes in turn the point
    farthest, in normalised objectives, from those taken.
    """
    regret = front.calc_regret()
    chosen = list(dict.fromkeys(map(int, first)))[:n]
    for best in map(int, regret.argmin(axis=0)):
        # One point may be the best of two objectives, or next to it.
        if len(chosen) < n and (not chosen or cdist(regret[[best]], regret[chosen]).min() > 0.05):
            chosen.append(best)
    while len(chosen) < min(n, len(front)):
        distance = cdist(regret, regret[chosen]).min(axis=1)
        chosen.append(int(np.argmax(distance)))
    return np.array(chosen, dtype=int)


class _Search(PymooProblem):  # type: ignore[misc]
    """The surrogate as pymoo sees it: objectives in the coordinates of the trade-off cone, over [-1, 1]^d."""

    def __init__(self, surrogate: Model, problem: Problem, bounds: Sequence[Bound], cone: Array) -> None:
        d, k = len(problem.variables), len(problem.objectives)
        super().__init__(n_var=d, n_obj=k, n_ieq_constr=len(bounds), xl=-np.ones(d), xu=np.ones(d))
        self._surrogate, self._problem, self._bounds, self._cone = surrogate, problem, bounds, cone

    def _evaluate(self, x: Array, out: dict[str, Array], *args: Any, **kwargs: Any) -> None:
        X = self._problem.unscale(x)
        if not self._bounds:
            out["F"] = self._surrogate.predict(X) @ self._cone.T
            return
        Y, std = self._surrogate.predict(X, return_std=True)
        out["F"] = Y @ self._cone.T
        out["G"] = np.column_stack([bound.calc_violation(self._problem, Y, std) for bound in self._bounds])


def _run_search(search: _Search, config: ParetoConfig, seed: int, history: _History) -> list[Any]:
    """Return pymoo's results; the optima of all of them together are candidates for the front."""
    k, many = search.n_obj, search.n_obj >= MANY_OBJECTIVES
    evaluations = config.evaluations // 4 if many else config.evaluations
    pymoo_seed = derive_seed(seed, "nsga2") % 2**32
    algorithm = NSGA2(pop_size=config.population)
    first = minimize(search, algorithm, ("n_eval", evaluations), seed=pymoo_seed, callback=history)
    if not many:
        return [first]
    # The axes, then directions between them; Sobol' points are balanced in powers of two.
    n = max(config.population - k, 1)
    between = make_directions(k, 2 ** int(np.ceil(np.log2(n))), make_generator(seed, "front directions"))[:n]
    directions = np.vstack([np.eye(k), between / between.sum(axis=1, keepdims=True)])
    algorithm = NSGA3(directions, pop_size=max(config.population, n + k), sampling=first.pop.get("X"))
    history.begin_phase()
    left = ("n_eval", config.evaluations - evaluations)
    second = minimize(search, algorithm, left, seed=pymoo_seed, callback=history)
    # NSGA-III counts the nearest point to each direction as its optimum; the rest of its population is as good.
    if second.X is not None:
        second.X = _get_feasible(second.pop).get("X")
    return [first, second]


def _get_feasible(population: Any) -> Any:
    return population[population.get("feasible").ravel().astype(bool)]


class _History(Callback):  # type: ignore[misc]
    """Per generation: number of evaluations, the non-dominated objectives, and some of the population."""

    def __init__(self, total: int, progress: Callable[[float], None] | None) -> None:
        super().__init__()
        self._total, self._progress = total, progress
        self._before = 0
        self.evaluations: list[int] = []
        self.fronts: list[Array] = []
        self._populations: list[Array] = []

    def begin_phase(self) -> None:
        """Begin another search that counts its evaluations from zero."""
        self._before = self.evaluations[-1]

    def update(self, algorithm: Any) -> None:
        self.evaluations.append(self._before + int(algorithm.evaluator.n_eval))
        if self._progress:
            self._progress(min(self.evaluations[-1] / self._total, 1.0))
        population = _get_feasible(algorithm.pop)
        optimum = population if isinstance(algorithm, NSGA3) else _get_feasible(algorithm.opt)
        self.fronts.append(optimum.get("F"))
        self._populations.append(population.get("X"))

    def sample_pool(self, rng: np.random.Generator) -> Array:
        """Return points tried on the way (at most 700): what might have been optimal instead."""
        pool = np.unique(np.vstack(self._populations), axis=0)
        return pool[rng.permutation(len(pool))[:700]]


def _make_cone(surrogate: Model, problem: Problem, max_trade_off: float | None, seed: int) -> Array:
    """Return C (k, k): plain dominance of C y, y natural objectives, is dominance with bounded trade-off."""
    k = len(problem.objectives)
    U = make_generator(seed, "ranges").uniform(-1.0, 1.0, (1000, len(problem.variables)))
    ranges = np.ptp(surrogate.predict(problem.unscale(U)), axis=0)
    slope = 0.0 if max_trade_off is None else 1.0 / max_trade_off
    cone = np.eye(k) + slope * (np.ones((k, k)) - np.eye(k))
    return cone * problem.signs / np.where(ranges > 0.0, ranges, 1.0)


def _add_uncertainty(
    front: ParetoFront, surrogate: Any, pool: Array, cone: Array, n_draws: int, seed: int
) -> ParetoFront:
    signs = front.problem.signs
    candidates = np.vstack([front.X, pool])
    draws = surrogate.draw(candidates, n_draws, make_generator(seed, "front draws"))
    ideal, reference = front.ideal * signs, front.reference * signs
    counts = np.zeros(len(front))
    volumes, fronts = [], []
    for Y in draws:
        # A bound is a statement about the prediction: the candidates satisfy it, their draws need not.
        best = calc_non_dominated(Y @ cone.T)
        counts[best[best < len(front)]] += 1
        volumes.append(calc_hypervolume_share(Y[best] * signs, ideal, reference))
        fronts.append(Y[best])
    uncertainty = FrontUncertainty(counts / n_draws, np.array(volumes), tuple(fronts))
    return replace(front, uncertainty=uncertainty)


def _describe_infeasible(surrogate: Model, problem: Problem, bounds: Sequence[Bound], result: Any) -> str:
    X = problem.unscale(np.atleast_2d(result.pop.get("X")))
    Y = surrogate.predict(X)
    reached = []
    for bound in bounds:
        i, objective = problem.get_objective(bound.objective)
        value = Y[:, i].min() if bound.relation == "<=" else Y[:, i].max()
        unit = "" if objective.unit == "-" else f" {objective.unit}"
        reached.append(f"{bound.objective} {value:.4g}{unit}")
    wanted = ", ".join(f"{bound} ({100 * bound.probability:g} % sure)" for bound in bounds)
    return f"no strategy satisfies {wanted} on the surrogate; the nearest tried reach {', '.join(reached)}"
