import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import cdist

from drakerock.errors import InputError
from drakerock.exploration.config import Bound, ParetoConfig
from drakerock.exploration.hypervolume import calc_hypervolume_share, make_directions
from drakerock.exploration.pareto import (
    calc_non_dominated,
    pareto_front,
    parse_bound,
    select_spread,
)
from drakerock.exploration.problem import Objective, Problem, Variable
from drakerock.exploration.problems import make_dtlz2, make_noisy_loading, make_zdt
from drakerock.exploration.sampling import _scalarize
from drakerock.exploration.surrogate import Surrogate

QUICK = ParetoConfig(population=100, evaluations=8000, n_draws=0)
# Half of the default's search.
HALF = ParetoConfig(evaluations=20_000, n_draws=0)


class Exact:
    """The truth in a surrogate's place, so that only the search is tested."""

    def __init__(self, known):
        self.problem_, self._evaluate = known.problem, known.evaluate

    def predict(self, X, return_std=False):
        Y = self._evaluate(np.asarray(X))
        return (Y, np.zeros_like(Y)) if return_std else Y


def calc_distances(front, known):
    """Mean distance found -> exact and exact -> found, in shares of the exact front's ranges."""
    exact = known.make_front(2000)
    scale = np.ptp(exact, axis=0)
    gap = cdist(front.Y / scale, exact / scale)
    return gap.min(axis=1).mean(), gap.min(axis=0).mean()


@pytest.mark.parametrize(
    ("known", "config", "tolerance"),
    [
        (make_zdt(1), HALF, (0.005, 0.005)),
        # The trade-off bound takes the flat tip of the hollow front, f1 < 0.2 or so, for its end.
        (make_zdt(2), HALF, (0.005, 0.01)),
        (make_zdt(3), HALF, (0.005, 0.01)),
        (make_dtlz2(), HALF, (0.03, 0.05)),
        (make_noisy_loading(), ParetoConfig(n_draws=0), (0.03, 0.04)),
    ],
    ids=lambda v: getattr(v, "name", ""),
)
def test_front_is_the_known_one(known, config, tolerance):
    front = pareto_front(Exact(known), config=config, seed=1)
    to_exact, to_found = calc_distances(front, known)
    assert to_exact < tolerance[0]
    assert to_found < tolerance[1]
    assert front.evaluations[-1] == pytest.approx(config.evaluations, rel=0.02)
    # Converged: the last quarter of the search adds next to nothing.
    assert front.hypervolume[-1] == pytest.approx(front.hypervolume[-len(front.hypervolume) // 4], rel=0.01)
    assert front.hypervolume[-1] > 1.02 * front.hypervolume[0]


def test_front_is_a_function_of_the_seed():
    known = make_zdt(1)
    config = ParetoConfig(population=40, evaluations=1600, n_draws=0)
    a, b, c = (pareto_front(Exact(known), config=config, seed=s) for s in (1, 1, 2))
    assert np.array_equal(a.X, b.X)
    assert not np.array_equal(a.X, c.X)


@settings(deadline=None)
@given(arrays(float, st.tuples(st.integers(1, 40), st.integers(1, 4)), elements=st.integers(0, 5).map(float)))
def test_non_dominated_by_definition(F):
    kept = calc_non_dominated(F)
    for i, f in enumerate(F):
        dominated = np.any(np.all(f >= F, axis=1) & np.any(f > F, axis=1))
        if i in kept:
            assert not dominated
        else:
            assert dominated or any(np.array_equal(f, F[j]) for j in kept)
    assert len(np.unique(F[kept], axis=0)) == len(kept)


def test_tiny_surrogate_errors_make_no_false_front():
    """f1 = x1 with errors of a millionth: with plain dominance walls of bad points stand at its best end."""
    exact = make_zdt(1)

    class Nearly(Exact):
        def predict(self, X, return_std=False):
            Y = exact.evaluate(np.asarray(X))
            Y[:, 0] += 1e-6 * np.sin(40 * np.asarray(X)[:, 1:]).sum(axis=1)
            return (Y, 0 * Y) if return_std else Y

    def calc_worst(max_trade_off):
        config = ParetoConfig(population=100, evaluations=15_000, n_draws=0, max_trade_off=max_trade_off)
        front = pareto_front(Nearly(exact), config=config)
        return cdist(exact.evaluate(front.X), exact.make_front(1000)).min(axis=1).max()

    assert calc_worst(50.0) < 0.05
    assert calc_worst(None) > 0.3


def test_trade_off_bound_is_geoffrion_s():
    """No kept point pays more than M times its gain against another."""
    known = make_dtlz2()
    config = ParetoConfig(population=60, evaluations=3000, n_draws=0, max_trade_off=5.0)
    front = pareto_front(Exact(known), config=config)
    scale = np.ptp(known.evaluate(np.random.default_rng(0).uniform(0, 1, (5000, 6))), axis=0)
    y = front.Y / scale
    for i, a in enumerate(y):
        for j, b in enumerate(y):
            if i == j:
                continue
            gain, loss = np.maximum(b - a, 0).sum(), np.maximum(a - b, 0).max()
            assert gain > loss / 5.0 * 0.85, "ranges are sampled, hence the margin"


def test_hypervolume_against_a_box():
    """One point of a two-objective front fills its box to the reference; the share is one."""
    problem = Problem(
        variables=(Variable(name="x", low=0, high=1),),
        objectives=(Objective(name="a"), Objective(name="b", sense="max")),
    )

    class Line:
        problem_ = problem

        def predict(self, X, return_std=False):
            Y = np.column_stack([X, X])  # a wants x small, b wants it large: the whole line is optimal
            return (Y, 0 * Y) if return_std else Y

    front = pareto_front(Line(), config=QUICK)
    assert front.ideal == pytest.approx([0.0, 1.0], abs=1e-3)
    assert front.nadir == pytest.approx([1.0, 0.0], abs=1e-3)
    # Staircase under the line f1 + f2 = 1 in a box of side 1.1: (0.5 + 0.21) / 1.21.
    assert front.hypervolume[-1] == pytest.approx(0.71 / 1.21, abs=0.01)


def test_scalarisation_is_the_hypervolume():
    """The sampler's mean over directions equals the exact hypervolume (Deng & Zhang 2019)."""
    from math import gamma, pi

    from pymoo.indicators.hv import HV

    for k in (1, 2, 3):
        F = np.random.default_rng(k).uniform(0, 1, (12, k))
        directions = make_directions(k, 2**15, np.random.default_rng(0))
        mean = _scalarize(1.1 - F, directions).max(axis=0).mean()
        ball = pi ** (k / 2) / (2**k * gamma(k / 2 + 1))
        assert ball * mean == pytest.approx(float(HV(ref_point=np.full(k, 1.1))(F)), rel=0.01)


class TestBounds:
    known = make_noisy_loading()

    def test_front_keeps_them(self):
        free = pareto_front(Exact(self.known), config=QUICK)
        limit = Bound(objective="debris", relation="<=", value=600.0)
        bound = pareto_front(Exact(self.known), [limit], QUICK)
        assert free.Y[:, 2].max() > 1000.0
        assert bound.Y[:, 2].max() <= 600.0
        # What remains is as good as the free front's part inside: the bound costs nothing there.
        inside = free.Y[free.Y[:, 2] <= 600.0]
        assert bound.Y[:, 0].max() > inside[:, 0].max() - 3.0

    def test_unreachable_says_what_is(self):
        with pytest.raises(InputError, match=r"no strategy satisfies production>=500 .* production 2\d\d"):
            pareto_front(
                Exact(self.known), [Bound(objective="production", relation=">=", value=500.0)], QUICK
            )

    def test_parsing(self):
        bound = parse_bound(" debris <= 5e2", self.known.problem)
        assert (bound.objective, bound.relation, bound.value) == ("debris", "<=", 500.0)
        assert parse_bound("production>=-1.5", self.known.problem).value == -1.5
        for text in ("debris<500", "debris<=1e999", "debris<=", "debris<=many", "<=3", "debris<=-"):
            with pytest.raises(InputError, match="expected objective<=number"):
                parse_bound(text, self.known.problem)
        with pytest.raises(
            InputError, match="unknown objective 'dust'; there are: production, damage, debris"
        ):
            parse_bound("dust<=1", self.known.problem)


def test_one_objective_gives_one_point():
    problem = Problem(
        variables=tuple(Variable(name=f"x{i}", low=-1, high=2) for i in range(3)),
        objectives=(Objective(name="f", sense="max"),),
    )
    X = problem.unscale(np.random.default_rng(0).uniform(-1, 1, (80, 3)))
    surrogate = Surrogate(problem).fit(X, -np.sum((X - 0.5) ** 2, axis=1))
    front = pareto_front(surrogate, config=ParetoConfig(population=60, evaluations=6000))
    assert len(front) == 1
    assert front.X[0] == pytest.approx([0.5] * 3, abs=0.02)
    assert front.uncertainty is not None


def test_resampling_is_sure_of_exact_data_and_unsure_of_noise():
    known = make_noisy_loading()
    X = known.problem.unscale(np.random.default_rng(0).uniform(-1, 1, (80, 4)))
    Y = known.evaluate(X)
    config = ParetoConfig(population=60, evaluations=6000, n_draws=40)
    noisy = Y + 0.1 * Y.std(axis=0) * np.random.default_rng(1).standard_normal(Y.shape)
    exact, front = (pareto_front(Surrogate(known.problem).fit(X, data), config=config) for data in (Y, noisy))
    assert front.uncertainty.hypervolumes.std() > 3 * exact.uncertainty.hypervolumes.std()
    assert np.all((front.uncertainty.p_optimal >= 0) & (front.uncertainty.p_optimal <= 1))
    # The best production of all is optimal in more draws than the typical front point.
    assert front.uncertainty.p_optimal[0] > np.median(front.uncertainty.p_optimal)
    assert len(front.uncertainty.fronts) == 40


def test_spread_points_are_spread():
    front = pareto_front(Exact(make_dtlz2()), config=QUICK)
    chosen = select_spread(front, 12, first=[40])
    assert chosen[0] == 40
    assert len(set(chosen)) == 12
    regret = front.calc_regret()
    gaps = cdist(regret[chosen], regret[chosen]) + 9 * np.eye(12)
    rng = np.random.default_rng(0)
    subsets = [regret[rng.choice(len(front), 12, replace=False)] for _ in range(50)]
    assert gaps.min() > 2 * np.median([(cdist(r, r) + 9 * np.eye(12)).min() for r in subsets])
    assert len(select_spread(front, 10_000)) == len(front)


def make_sphere(k):
    """DTLZ2 with k objectives and k + 2 variables, in a surrogate's place."""
    problem = Problem(
        variables=tuple(Variable(name=f"x{i}", low=0, high=1) for i in range(k + 2)),
        objectives=tuple(Objective(name=f"f{i}") for i in range(k)),
    )

    class Sphere:
        problem_ = problem

        def predict(self, X, return_std=False):
            angles = np.asarray(X)[:, : k - 1] * np.pi / 2
            radius = 1 + np.sum((np.asarray(X)[:, k - 1 :] - 0.5) ** 2, axis=1)
            Y = np.tile(radius[:, None], (1, k))
            Y[:, :-1] *= np.cumprod(np.cos(angles), axis=1)[:, ::-1]
            Y[:, 1:] *= np.sin(angles)[:, ::-1]
            return (Y, np.zeros_like(Y)) if return_std else Y

    return Sphere()


@pytest.mark.parametrize("k", [5, 8])
def test_many_objectives_reach_the_front_and_its_ends(k):
    config = ParetoConfig(population=200, evaluations=16_000, n_draws=0, max_trade_off=1000.0)
    shares = []
    front = pareto_front(make_sphere(k), config=config, progress=shares.append)
    distance = np.abs(np.linalg.norm(front.Y, axis=1) - 1.0)
    assert np.median(distance) < 0.05
    assert len(front) > 150
    assert front.ideal == pytest.approx(np.zeros(k), abs=0.05)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert list(front.evaluations) == sorted(front.evaluations)
    assert front.evaluations[-1] == pytest.approx(16_000, rel=0.03)


@pytest.mark.parametrize("k", [6, 7])
def test_hypervolume_of_many_objectives_is_near_the_exact_one(k):
    from pymoo.indicators.hv import HV

    rng = np.random.default_rng(k)
    F = np.abs(rng.standard_normal((40, k)))
    F *= np.geomspace(1e-3, 1e3, k) / np.linalg.norm(F, axis=1)[:, None]
    best, reference = F.min(axis=0), F.max(axis=0) + 0.1 * np.ptp(F, axis=0)
    scaled = (F - best) / (reference - best)
    exact = float(HV(ref_point=np.ones(k))(scaled))
    assert calc_hypervolume_share(F, best, reference) == pytest.approx(exact, rel=0.02)
    assert calc_hypervolume_share(F[:0], best, reference) == 0.0


def test_bounds_hold_with_many_objectives():
    sphere, config = make_sphere(6), ParetoConfig(population=60, evaluations=4000, n_draws=0)
    front = pareto_front(sphere, [Bound(objective="f0", relation="<=", value=0.3)], config)
    assert front.Y[:, 0].max() <= 0.3
    with pytest.raises(InputError, match="no strategy satisfies f0>=3"):
        pareto_front(sphere, [Bound(objective="f0", relation=">=", value=3.0)], config)
