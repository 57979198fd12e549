"""The exploration against problems with known truth, with stated tolerances, and what follows from a fit."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from drakerock.errors import InputError
from drakerock.exploration.config import ParetoConfig, SamplingConfig, SensitivityConfig
from drakerock.exploration.confirmation import Confirmation, confirm_points
from drakerock.exploration.pareto import pareto_front
from drakerock.exploration.problem import Objective, Problem, Variable
from drakerock.exploration.problems import (
    calc_loading_spread,
    make_branin,
    make_dtlz2,
    make_ishigami,
    make_noisy_loading,
    make_noisy_table,
    make_zdt,
)
from drakerock.exploration.sampling import (
    make_initial_design,
    make_sampler,
    make_validation_points,
)
from drakerock.exploration.sensitivity import calc_sensitivity
from drakerock.exploration.surrogate import Surrogate, calc_ranges, fit_surrogate
from drakerock.exploration.validation import validate


def fit_known(known, n):
    X = make_initial_design(known.problem, SamplingConfig(n_initial=n, n_corners=0), 1)
    Y = known.evaluate(X)
    surrogate = Surrogate(known.problem).fit(X, Y)
    Z = known.problem.unscale(np.random.default_rng(5).uniform(-1, 1, (2000, X.shape[1])))
    error = surrogate.predict(Z) - known.evaluate(Z)
    return surrogate, np.sqrt(np.mean(error**2, axis=0)) / calc_ranges(Y)


@pytest.mark.parametrize(
    ("known", "n", "tolerance"),
    [
        (make_branin(), 40, 0.005),
        (make_ishigami(), 200, 0.02),
        (make_zdt(1), 100, 0.02),
        (make_zdt(2), 100, 0.01),
        (make_dtlz2(), 150, 0.02),
        (make_noisy_loading(), 100, 0.005),
    ],
    ids=lambda v: getattr(v, "name", ""),
)
def test_surrogate_accuracy_on_noise_free_problems(known, n, tolerance):
    assert fit_known(known, n)[1].max() < tolerance


@pytest.mark.parametrize(
    ("known", "n"), [(make_ishigami(), 150), (make_noisy_loading(), 100)], ids=["ish", "load"]
)
def test_sobol_indices_against_the_exact_ones(known, n):
    surrogate, _ = fit_known(known, n)
    indices = calc_sensitivity(surrogate.predict, known.problem, SensitivityConfig(n_base=4096))
    for j, s in enumerate(indices):
        assert s.first == pytest.approx(known.first[j], abs=0.03)
        assert s.total == pytest.approx(known.total[j], abs=0.03)
        assert s.ranking == tuple(np.array(known.problem.variable_names)[np.argsort(-known.total[j])])


def test_intervals_of_the_indices_hold_the_truth():
    known = make_ishigami()
    inside = []
    for seed in range(10):
        s = calc_sensitivity(known.evaluate, known.problem, SensitivityConfig(n_base=512), seed)[0]
        inside.append(np.abs(s.first - known.first[0]) <= s.first_half)
        inside.append(np.abs(s.total - known.total[0]) <= s.total_half)
    assert 0.8 < np.mean(inside) <= 1.0


def test_exact_indices_agree_with_brute_force():
    """The closed forms of the noisy loading problem against a large sample of the exact function."""
    known = make_noisy_loading()
    for j, s in enumerate(calc_sensitivity(known.evaluate, known.problem, SensitivityConfig(n_base=2**13))):
        assert s.first == pytest.approx(known.first[j], abs=0.015)
        assert s.total == pytest.approx(known.total[j], abs=0.015)


def test_constant_response_has_no_sensitivities():
    problem = Problem(variables=(Variable(name="a", low=0, high=1), Variable(name="b", low=0, high=1)),
                      objectives=(Objective(name="f"),))  # fmt: skip
    s = calc_sensitivity(lambda X: np.full((len(X), 1), 3.0), problem)[0]
    assert np.all(s.first == 0.0)
    assert np.all(s.total == 0.0)


@pytest.fixture(scope="module")
def campaign():
    """The campaign of section 6 on the noisy problem: initial design, sequential batches, validation."""
    known, config = make_noisy_loading(), SamplingConfig(batch_size=16)
    sampler = make_sampler(known.problem, config, seed=2)
    X = sampler.ask(40)
    while True:
        table = make_noisy_table(X, np.random.default_rng(3))
        sampler.tell(table.X, table.Y, table.noise)
        if len(X) >= config.n_samples:
            break
        X = np.vstack([X, sampler.ask(min(16, config.n_samples - len(X)))])
    V = make_validation_points(known.problem, config, 2)
    return make_noisy_table(np.vstack([X, V]), np.random.default_rng(3), n_validation=40)


@pytest.fixture(scope="module")
def fitted(campaign):
    return fit_surrogate(campaign)


class TestNoisyCampaign:
    known = make_noisy_loading()

    def test_standard_errors_are_the_truth(self, campaign):
        # sequences of 20 with rho = 0.4: the mean's variance is inflated by tau = 2.17
        tau = 1 + 2 * np.sum((1 - np.arange(1, 20) / 20) * 0.4 ** np.arange(1, 20))
        truth = calc_loading_spread(campaign.X) * np.sqrt(tau / 20)
        assert np.median(campaign.noise / truth) == pytest.approx(1.0, abs=0.05)

    def test_error_is_near_the_noise_floor_and_intervals_cover(self, campaign, fitted):
        for accuracy in validate(fitted, campaign):
            assert accuracy.validation_nrmse < 1.5 * accuracy.noise_floor
            assert 0.01 < accuracy.noise_floor < 0.05
            assert accuracy.coverage[2] >= 0.85
            assert accuracy.coverage[0] < accuracy.coverage[1] <= accuracy.coverage[2]
            assert accuracy.loo_nrmse < 0.05

    def test_surrogate_is_better_than_the_noise_it_saw(self, campaign, fitted):
        """Against the noise-free truth, the error is well below the standard error of the points."""
        Z = self.known.problem.unscale(np.random.default_rng(9).uniform(-1, 1, (2000, 4)))
        mean, std = fitted.predict(Z, return_std=True)
        truth = self.known.evaluate(Z)
        rms = np.sqrt(np.mean((mean - truth) ** 2, axis=0))
        assert np.all(rms < 0.6 * np.sqrt(np.mean(campaign.noise**2, axis=0)))
        within = np.mean(np.abs(mean - truth) < 1.96 * std, axis=0)
        assert np.all(within > 0.8)

    def test_front_is_near_the_exact_one(self, fitted):
        front = pareto_front(fitted, config=ParetoConfig(n_draws=0))
        exact = self.known.make_front(2000)
        scale = np.ptp(exact, axis=0)
        true = self.known.evaluate(front.X)  # what the strategies found are really worth
        assert cdist(true / scale, exact / scale).min(axis=1).mean() < 0.05
        assert cdist(exact / scale, true / scale).min(axis=1).mean() < 0.06

    def test_confirmation_agrees_where_the_surrogate_is_right(self, fitted):
        front = pareto_front(fitted, config=ParetoConfig(population=60, evaluations=3000, n_draws=0))
        rng = np.random.default_rng(8)

        def simulate(x):
            table = make_noisy_table(x[None], rng)
            return table.Y[0], table.noise[0]

        result = confirm_points(fitted, front.X[:15], simulate)
        # One sequence knows its own autocorrelation badly, so its standard error is rough.
        assert np.mean(np.abs(result.z) < 3.0) > 0.85
        wrong = confirm_points(fitted, front.X[:15], lambda x: (simulate(x)[0] * 1.3, simulate(x)[1]))
        assert np.mean(np.abs(wrong.z) < 3.0) < 0.5

    def test_validation_refuses_another_table(self, campaign, fitted):
        with pytest.raises(InputError, match="not fitted"):
            validate(fitted, campaign.take(list(range(50))))


def test_confirmation_keeps_failures_and_round_trips():
    known = make_noisy_loading()
    X = known.problem.unscale(np.random.default_rng(0).uniform(-1, 1, (40, 4)))
    surrogate = Surrogate(known.problem).fit(X, known.evaluate(X))

    def simulate(x):
        if x[0] > 1.0:
            raise RuntimeError("solver gave up")
        return known.evaluate(x[None])[0], np.full(3, np.nan)

    result = confirm_points(surrogate, np.array([[1.5, 0.5, 0.5, 0.5], [0.5, 0.5, 0.5, 0.5]]), simulate)
    assert result.failure == ("RuntimeError: solver gave up", "")
    assert np.isnan(result.simulated[0]).all()
    assert np.isfinite(result.z[1]).all()
    back = Confirmation.from_rows(known.problem, result.to_rows())
    assert np.array_equal(back.simulated, result.simulated, equal_nan=True)
    with pytest.raises(InputError, match="not the rows"):
        Confirmation.from_rows(known.problem, [{"alpha": 1.0}])


def test_sequential_sampling_goes_where_the_response_changes():
    """A response that is flat but for one corner: LOLA-Voronoi and error sampling go there."""
    problem = Problem(
        variables=(Variable(name="a", low=0, high=1), Variable(name="b", low=0, high=1)),
        objectives=(Objective(name="f"),),
    )

    def evaluate(X):
        return np.exp(-30 * ((X[:, 0] - 0.8) ** 2 + (X[:, 1] - 0.75) ** 2))[:, None]

    near = {}
    for method in ("space_filling", "lola_voronoi", "error"):
        sampler = make_sampler(problem, SamplingConfig(n_initial=12, n_corners=4, methods=(method,)), 1)
        X = sampler.ask(16)
        for _ in range(6):
            sampler.tell(X, evaluate(X))
            X = np.vstack([X, sampler.ask(4)])
        near[method] = np.mean(np.hypot(X[16:, 0] - 0.8, X[16:, 1] - 0.75) < 0.3)
    assert near["lola_voronoi"] > 1.3 * near["space_filling"]
    assert near["error"] > 1.3 * near["space_filling"]


def test_hypervolume_infill_reaches_the_front_sooner():
    known = make_zdt(1, 4)
    gap = {}
    for method in ("space_filling", "hypervolume"):
        sampler = make_sampler(known.problem, SamplingConfig(n_initial=20, n_corners=0, methods=(method,)), 1)
        X = sampler.ask(20)
        for _ in range(5):
            sampler.tell(X, known.evaluate(X))
            X = np.vstack([X, sampler.ask(6)])
        exact = known.make_front(200)
        gap[method] = cdist(exact, known.evaluate(X)).min(axis=1).mean()
    assert gap["hypervolume"] < 0.3 * gap["space_filling"]


class TestDesign:
    problem = make_noisy_loading().problem

    def test_initial_design_is_a_latin_hypercube_with_all_corners(self):
        U = self.problem.scale(make_initial_design(self.problem, SamplingConfig(), 4))
        assert U.shape == (40, 4)
        strata = np.sort(np.floor((U[:24] + 1) / 2 * 24).astype(int), axis=0)
        assert np.array_equal(strata, np.tile(np.arange(24)[:, None], (1, 4)))
        assert len(np.unique(U[24:], axis=0)) == 16
        assert np.all(np.abs(U[24:]) == 1.0)

    def test_spacing_is_optimised(self):
        """The least distance is larger than that of any of 50 random hypercubes."""
        from scipy.stats import qmc

        U = self.problem.scale(make_initial_design(self.problem, SamplingConfig(n_corners=0), 4))
        best = max(
            (cdist(R, R) + 9 * np.eye(24)).min()
            for R in (2 * qmc.LatinHypercube(4, rng=i).random(24) - 1 for i in range(50))
        )
        assert (cdist(U, U) + 9 * np.eye(24)).min() > best

    def test_too_many_corners_are_thinned(self):
        problem = Problem(
            variables=tuple(Variable(name=f"x{i}", low=0, high=1) for i in range(10)),
            objectives=(Objective(name="f"),),
        )
        U = problem.scale(make_initial_design(problem, SamplingConfig(), 0))[24:]
        assert len(np.unique(U, axis=0)) == 16
        # Spread: any two differ in at least three variables.
        assert (cdist(U, U, "hamming") * 10 + 10 * np.eye(16)).min() >= 3

    def test_validation_points_are_apart(self):
        a = make_validation_points(self.problem, SamplingConfig(), 1)
        assert a.shape == (40, 4)
        assert np.array_equal(a, make_validation_points(self.problem, SamplingConfig(n_initial=50), 1))
        assert not np.array_equal(a, make_validation_points(self.problem, SamplingConfig(), 2))

    def test_empty_design_is_refused(self):
        with pytest.raises(InputError, match="both 0"):
            make_initial_design(self.problem, SamplingConfig(n_initial=0, n_corners=0), 0)
