import json
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.gaussian_process.kernels import RBF
from sklearn.utils.estimator_checks import check_estimator

from drakerock.errors import InputError
from drakerock.exploration.config import SurrogateConfig
from drakerock.exploration.kriging import Kriging, PowerExponential, calc_correlation
from drakerock.exploration.problem import Objective, Problem, Variable
from drakerock.exploration.problems import make_branin, make_ishigami, make_noisy_loading, make_noisy_table
from drakerock.exploration.surrogate import Surrogate, fit_surrogate

RNG = np.random.default_rng


def make_data(known, n, seed=0, noise=0.0):
    rng = RNG(seed)
    X = known.problem.unscale(rng.uniform(-1, 1, (n, len(known.problem.variables))))
    Y = known.evaluate(X)
    return X, Y + noise * Y.std(axis=0) * rng.standard_normal(Y.shape)


def get_bounds(known):
    return np.stack([known.problem.low, known.problem.high])


def test_prediction_solves_the_method_s_equations():
    """The model against section 6 written out: psi, (Psi + lambda I) w = y, centred y, inputs in [-1, 1]."""
    known = make_branin()
    X, Y = make_data(known, 25)
    y = Y[:, 0]
    theta, lam = np.array([0.7, 1.9]), 1e-3
    for p in (2.0, 1.5):
        model = Kriging(get_bounds(known), p=p, theta=theta, lam=lam).fit(X, y)
        u = 2 * (X - [-5, 0]) / [15, 15] - 1
        psi = np.array([[np.exp(-np.sum(theta * np.abs(a - b) ** p)) for a in u] for b in u])
        w = np.linalg.solve(psi + lam * np.eye(25), y - y.mean())
        Z = np.array([[0.3, 4.0], [9.0, 14.0]])
        uz = 2 * (Z - [-5, 0]) / [15, 15] - 1
        psi_z = [[np.exp(-np.sum(theta * np.abs(z - a) ** p)) for a in u] for z in uz]
        expected = y.mean() + np.array(psi_z) @ w
        assert model.predict(Z) == pytest.approx(expected, rel=1e-7)
        assert model.weights_ == pytest.approx(w, rel=1e-5)


def test_log_likelihood_is_that_of_the_gaussian_process():
    known = make_branin()
    X, Y = make_data(known, 20)
    noise = np.linspace(0.5, 3.0, 20)
    model = Kriging(get_bounds(known)).fit(X, Y[:, 0], noise)
    K = model.sigma2_ * (
        calc_correlation(model.U_train_, model.U_train_, model.theta_, 2.0) + model.lam_ * np.eye(20)
    )
    K += np.diag(noise**2)
    e = Y[:, 0] - Y[:, 0].mean()
    expected = -0.5 * (e @ np.linalg.solve(K, e) + np.linalg.slogdet(K)[1] + 20 * np.log(2 * np.pi))
    assert model.log_likelihood_ == pytest.approx(expected, abs=1e-4)


def test_optimum_is_one_of_the_likelihood():
    """No step along any hyperparameter improves it, and far more starts find nothing better."""
    known = make_ishigami()
    X, Y = make_data(known, 80, noise=0.05)
    model = Kriging(get_bounds(known)).fit(X, Y[:, 0])
    for j in range(3):
        for factor in (0.8, 1.25):
            theta = model.theta_.copy()
            theta[j] *= factor
            other = Kriging(get_bounds(known), theta=theta).fit(X, Y[:, 0])
            assert other.log_likelihood_ < model.log_likelihood_
    thorough = Kriging(get_bounds(known), n_starts=128).fit(X, Y[:, 0])
    assert thorough.log_likelihood_ == pytest.approx(model.log_likelihood_, abs=1e-2)


def test_p_equal_2_is_scikit_learn_s_rbf():
    X, theta = RNG(0).uniform(-1, 1, (12, 3)), np.array([0.3, 1.0, 4.0])
    ours, rbf = PowerExponential(theta), RBF(1 / np.sqrt(2 * theta))
    assert ours(X) == pytest.approx(rbf(X), abs=1e-12)


@pytest.mark.parametrize("p", [2.0, 1.3, (2.0, 1.0, 1.7)])
def test_kernel_gradient_against_finite_differences(p):
    X = RNG(0).uniform(-1, 1, (9, 3))
    kernel = PowerExponential(np.array([0.3, 1.0, 4.0]), p)
    _, gradient = kernel(X, eval_gradient=True)
    for j in range(3):
        step = np.zeros(3)
        step[j] = 1e-6
        up, down = kernel.clone_with_theta(kernel.theta + step), kernel.clone_with_theta(kernel.theta - step)
        assert gradient[:, :, j] == pytest.approx((up(X) - down(X)) / 2e-6, abs=1e-8)


def test_leave_one_out_is_what_leaving_out_gives():
    known = make_branin()
    X, Y = make_data(known, 20, noise=0.05)
    y, noise = Y[:, 0], np.linspace(1, 5, 20)
    full = Kriging(get_bounds(known)).fit(X, y, noise)
    mean, std = full.leave_one_out()
    for i in (0, 7, 19):
        keep = np.arange(20) != i
        K = full.sigma2_ * calc_correlation(full.U_train_, full.U_train_, full.theta_, 2.0)
        C = K + np.diag(full.lam_ * full.sigma2_ + noise**2)
        gain = np.linalg.solve(C[np.ix_(keep, keep)], K[keep, i])
        assert mean[i] == pytest.approx(full.trend_ + gain @ (y[keep] - full.trend_), rel=1e-6)
        assert std[i] ** 2 == pytest.approx(C[i, i] - gain @ K[keep, i], rel=1e-5)


def test_known_noise_is_used_point_by_point():
    """Twenty exact points and one wild one: knowing that it is wild saves the fit."""
    X = np.linspace(-1, 1, 21)[:, None]
    y = np.sin(3 * X[:, 0])
    y[10] += 3.0
    noise = np.full(21, 1e-3)
    noise[10] = 3.0
    naive = Kriging(np.array([[-1.0], [1.0]])).fit(X, y)
    wise = Kriging(np.array([[-1.0], [1.0]])).fit(X, y, noise)
    Z = np.linspace(-1, 1, 101)[:, None]
    assert np.abs(wise.predict(Z) - np.sin(3 * Z[:, 0])).max() < 0.01
    assert np.abs(naive.predict(Z) - np.sin(3 * Z[:, 0])).max() > 0.2


def test_draws_have_the_predicted_mean_and_spread():
    known = make_branin()
    X, Y = make_data(known, 15)
    model = Kriging(get_bounds(known)).fit(X, Y[:, 0])
    Z = make_data(known, 6, seed=9)[0]
    mean, std = model.predict(Z, return_std=True)
    draws = model.draw(Z, 4000, RNG(0))
    assert draws.mean(axis=0) == pytest.approx(mean, abs=5 * std.max() / np.sqrt(4000))
    assert draws.std(axis=0) == pytest.approx(std, rel=0.08)


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 10**6), st.integers(8, 30), st.integers(1, 3))
def test_prediction_does_not_depend_on_units(seed, n, d):
    rng = RNG(seed)
    X = rng.uniform(-1, 1, (n, d))
    y = np.sin(2 * X).sum(axis=1) + 0.1 * rng.standard_normal(n)
    bounds = np.array([[-1.0] * d, [1.0] * d])
    theta = np.full(d, 0.8)
    first = Kriging(bounds, theta=theta, lam=1e-2).fit(X, y).predict(X)
    second = Kriging(bounds * 50 + 7, theta=theta, lam=1e-2).fit(X * 50 + 7, y * 1e4 - 3).predict(X * 50 + 7)
    assert second == pytest.approx(first * 1e4 - 3, rel=1e-6, abs=1e-2)


def test_batches_predict_like_single_points():
    known = make_noisy_loading()
    X, Y = make_data(known, 60)
    model = Surrogate(known.problem).fit(X, Y)
    Z = make_data(known, 1100, seed=1)[0]
    mean, std = model.predict(Z, return_std=True)
    assert mean.shape == std.shape == (1100, 3)
    for i in (0, 511, 512, 1099):
        one, one_std = model.predict(Z[i : i + 1], return_std=True)
        assert mean[i] == pytest.approx(one[0], rel=1e-9)
        assert std[i] == pytest.approx(one_std[0], rel=1e-6, abs=1e-9)


def test_same_data_same_fit_bit_for_bit():
    known = make_noisy_loading()
    X, Y = make_data(known, 40)
    a, b = Surrogate(known.problem, seed=4).fit(X, Y), Surrogate(known.problem, seed=4).fit(X, Y)
    assert np.array_equal(a.predict(X), b.predict(X))


def test_kriging_keeps_scikit_learn_s_rules():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_estimator(Kriging(n_starts=2))


@pytest.mark.parametrize("make", [make_branin, make_ishigami, make_noisy_loading])
def test_agreement_with_smt(make):
    """Issue's tolerances: predictions within 1e-3 of the range, free log-likelihoods within 0.5."""
    smt = pytest.importorskip("smt.surrogate_models")
    known = make()
    d = len(known.problem.variables)
    X, Y = make_data(known, 25 * d, noise=0.03)
    y = Y[:, 0]
    other = smt.KRG(
        theta0=[1.0] * d,
        theta_bounds=[1e-6, 100.0],
        eval_noise=True,
        noise0=[1e-2],
        noise_bounds=[1e-9, 10.0],
        n_start=40,
        print_global=False,
        poly="constant",
        corr="squar_exp",
        nugget=0.0,
    )
    other.set_training_values(X, y)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        other.train()
    n, parameters = len(y), other.optimal_par
    half = (known.problem.high - known.problem.low) / 2
    theta = other.optimal_theta * (half / other.X_scale) ** 2
    trend = np.squeeze(parameters["beta"]) * np.squeeze(other.y_std) + np.squeeze(other.y_mean)
    imposed = Kriging(
        get_bounds(known), theta=theta, lam=float(np.squeeze(other.optimal_noise)), trend=float(trend)
    )
    imposed.fit(X, y)
    Z = make_data(known, 400, seed=99)[0]
    assert np.abs(imposed.predict(Z) - other.predict_values(Z)[:, 0]).max() < 1e-3 * np.ptp(y)
    sigma2 = float(np.squeeze(parameters["sigma2"]))
    theirs = -0.5 * n * (np.log(2 * np.pi * sigma2) + 1) - np.log(np.diag(parameters["C"])).sum()
    assert imposed.log_likelihood_ == pytest.approx(theirs, abs=1e-3)
    free = Kriging(get_bounds(known), trend="likelihood").fit(X, y)
    assert free.log_likelihood_ == pytest.approx(theirs, abs=0.5)


def make_problem(d, k=1):
    return Problem(
        variables=tuple(Variable(name=f"x{i}", low=-1, high=1) for i in range(d)),
        objectives=tuple(Objective(name=f"f{i}") for i in range(k)),
    )


def test_theta_finds_the_inactive_variable():
    X = RNG(0).uniform(-1, 1, (60, 3))
    y = np.sin(4 * X[:, 0]) + X[:, 2]
    theta = Surrogate(make_problem(3)).fit(X, y).models_[0].theta_
    assert theta[0] > 100 * theta[1]
    assert theta[0] > theta[2]


class TestDegenerate:
    def test_too_few_points(self):
        X = RNG(0).uniform(-1, 1, (5, 4))
        with pytest.raises(
            InputError, match="'f0' has a response at 5 distinct points; 4 variables need at least 6"
        ):
            Surrogate(make_problem(4)).fit(X, X[:, 0])

    def test_duplicates_do_not_count_as_points(self):
        X = np.repeat(RNG(0).uniform(-1, 1, (3, 2)), 5, axis=0)
        with pytest.raises(InputError, match="3 distinct points"):
            Surrogate(make_problem(2)).fit(X, X[:, 0])

    def test_constant_response(self):
        X = RNG(0).uniform(-1, 1, (12, 2))
        mean, std = Surrogate(make_problem(2)).fit(X, np.full(12, 7.5)).predict(X, return_std=True)
        assert np.all(mean == 7.5)
        assert np.all(std == 0.0)

    def test_duplicate_points_with_different_responses(self):
        X = np.repeat(RNG(0).uniform(-1, 1, (10, 2)), 3, axis=0)
        y = X.sum(axis=1) + 0.1 * RNG(1).standard_normal(30)
        model = Surrogate(make_problem(2)).fit(X, y)
        assert np.abs(model.predict(X)[:, 0] - X.sum(axis=1)).max() < 0.15

    def test_duplicate_points_without_noise(self):
        X = np.repeat(RNG(0).uniform(-1, 1, (10, 2)), 2, axis=0)
        model = Surrogate(make_problem(2)).fit(X, X.sum(axis=1), np.zeros(20))
        assert model.predict(X)[:, 0] == pytest.approx(X.sum(axis=1), abs=1e-3)

    def test_missing_responses_leave_out_their_points_only_for_that_objective(self):
        X = RNG(0).uniform(-1, 1, (20, 2))
        Y = np.stack([X.sum(axis=1), X[:, 0] ** 2], axis=1)
        Y[:6, 1] = np.nan
        model = Surrogate(make_problem(2, 2)).fit(X, Y)
        assert [len(m.y_train_) for m in model.models_] == [20, 14]

    def test_nan_variables(self):
        with pytest.raises(InputError, match="finite"):
            Surrogate(make_problem(1)).fit(np.full((9, 1), np.nan), np.ones(9))

    def test_ten_variables_one_objective(self):
        X = RNG(0).uniform(-1, 1, (120, 10))
        y = X[:, 0] ** 2 + X[:, 3]
        model = Surrogate(make_problem(10)).fit(X, y)
        Z = RNG(1).uniform(-1, 1, (200, 10))
        assert np.sqrt(np.mean((model.predict(Z)[:, 0] - Z[:, 0] ** 2 - Z[:, 3]) ** 2)) / np.ptp(y) < 0.03

    def test_partly_known_noise_takes_the_mean_of_the_known(self):
        known = make_noisy_loading()
        X, Y = make_data(known, 30)
        noise = np.abs(0.01 * Y)
        noise[::3] = np.nan
        model = Surrogate(known.problem).fit(X, Y, noise).models_[0]
        assert model.noise_[0] == pytest.approx(np.sqrt(np.nanmean(noise[:, 0] ** 2)))

    def test_wrong_shapes_and_exponents(self):
        X = RNG(0).uniform(-1, 1, (9, 2))
        with pytest.raises(InputError, match=r"expected X \(n, 2\)"):
            Surrogate(make_problem(2)).fit(X[:, :1], X[:, 0])
        with pytest.raises(InputError, match="p must be one number or 2"):
            Surrogate(make_problem(2), SurrogateConfig(p=(2.0, 1.0, 1.0))).fit(X, X[:, 0])
        with pytest.raises(ValueError, match="p must be in"):
            Kriging(p=2.5).fit(X, X[:, 0])


def test_validation_points_take_no_part():
    known = make_noisy_loading()
    X = make_data(known, 50)[0]
    table = make_noisy_table(X, RNG(0), n_validation=10)
    model = fit_surrogate(table).models_[0]
    assert len(model.y_train_) == 40
    assert np.array_equal(model.y_train_, table.Y[:40, 0])


@pytest.mark.parametrize("trend", ["mean", "likelihood"])
def test_a_stored_surrogate_predicts_the_same_bit_for_bit(tmp_path, trend):
    known = make_noisy_loading()
    X, Y = make_data(known, 30, noise=0.1)
    Y[3, 1] = np.nan
    Y[:, 2] = 7.0
    noise = np.full(Y.shape, 0.05)
    noise[4] = np.nan
    fitted = Surrogate(known.problem, SurrogateConfig(trend=trend), 5).fit(X, Y, noise)
    fitted.save(tmp_path / "surrogate.json")
    stored = Surrogate.load(tmp_path / "surrogate.json")
    places = make_data(known, 200, seed=1)[0]
    for mine, its in zip(
        fitted.predict(places, return_std=True), stored.predict(places, return_std=True), strict=True
    ):
        np.testing.assert_array_equal(mine, its)
    np.testing.assert_array_equal(fitted.draw(places[:9], 3, RNG(0)), stored.draw(places[:9], 3, RNG(0)))
    assert (stored.problem_, stored.config, stored.seed) == (fitted.problem_, fitted.config, fitted.seed)


def _drop_model(data):
    del data["models"]["damage"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_drop_model, "'damage' is missing"),
        (lambda data: data["X"].pop(), "shapes|expected X"),
        (lambda data: data["X"].__setitem__(0, ["one", 2, 3, 4]), "could not convert"),
        (lambda data: data["models"]["debris"].update(theta=[1.0, 2.0]), "theta must be 4 numbers"),
        (lambda data: data["models"]["debris"].update(lam=None), "not a readable surrogate"),
        (lambda data: data["models"]["debris"].update(variance=-1.0), "not a readable surrogate"),
        (lambda data: data["problem"]["variables"][0].update(low=3.0), "not a readable surrogate"),
    ],
)
def test_what_is_no_surrogate_is_refused(tmp_path, change, message):
    known = make_noisy_loading()
    path = tmp_path / "surrogate.json"
    Surrogate(known.problem).fit(*make_data(known, 12, noise=0.1)).save(path)
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=message):
        Surrogate.load(path)
