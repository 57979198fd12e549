"""Contract: models that learn from loadings tell what is true in a world whose truth is known.

Caught: regression with one correlation length for all inputs, worse than a surrogate that does not see the pile; a
front that is all but a point, on which a hair of an objective decided.
"""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from drakerock.autonomy import model as loader_model
from drakerock.autonomy.encoding import PileEncoder
from drakerock.autonomy.entry import calc_entry_features, calc_profiles, choose_slices
from drakerock.autonomy.model import CHOICES, LoaderModel
from drakerock.autonomy.outcome_models import BlindOutcome, fit_field_outcome
from drakerock.autonomy.preference import Preference
from drakerock.autonomy.regression import LandmarkRegressor, find_theta
from drakerock.errors import InputError
from drakerock.loading.config import StrategyConfig
from drakerock.loading.field import HeightField, calc_pile_profile
from drakerock.loading.planning import choose_entry_slice
from tests.unit.autonomy.synthetic import CELL, HALF_ROOM, World, X, Y, make_data


@pytest.fixture(scope="module")
def unseen():
    """Loadings of another seed: no pile of theirs was learned from."""
    return make_data(20, 3, seed=5)


def calc_error(model, data):
    """Return the rms error of each objective over its standard deviation."""
    predicted = [model.predict(data.before[i][None], data.X[i][None])[0][0] for i in range(len(data))]
    return np.sqrt(np.mean((np.array(predicted) - data.Y) ** 2, axis=0)) / data.Y.std(axis=0)


def test_profiles_of_many_fields_are_those_of_each(model, loadings):
    H = loadings.before[::17]
    fronts, masses, slopes = calc_profiles(model.grid, H)
    for h, front, mass, slope in zip(H, fronts, masses, slopes, strict=True):
        profile = calc_pile_profile(HeightField(X, Y, h, CELL), 0.15)
        for one, two in ((front, profile.x_front), (mass, profile.x_mass), (slope, profile.slope)):
            assert np.allclose(one, two, equal_nan=True)


def test_slices_are_the_planner_s(model, loadings):
    H = loadings.before[::29]
    for gamma in (0.0, 0.31, 0.5, 0.77, 1.0):
        chosen = choose_slices(model.grid, calc_profiles(model.grid, H)[1], np.full(len(H), gamma))
        for h, j in zip(H, chosen, strict=True):
            profile = calc_pile_profile(HeightField(X, Y, h, CELL), 0.15)
            assert j == choose_entry_slice(profile, gamma, HALF_ROOM)


def test_an_empty_floor_has_an_entry_in_the_middle(model):
    features, y = calc_entry_features(model.grid, np.zeros((1, len(X), len(Y))), np.array([0.3]))
    assert np.isfinite(features).all()
    assert abs(y[0]) <= 0.5 * CELL


def test_codes_of_a_mirror_image_change_sign_where_they_are_odd(loadings):
    encoder = PileEncoder().fit(loadings.before)
    h = loadings.before[3:9]
    assert np.allclose(encoder.encode(h[:, :, ::-1]), encoder.encode(h) * encoder.mirror_, atol=1e-9)


def test_codes_describe_a_pile_better_the_more_there_are(loadings):
    few, many = PileEncoder(2, 1).fit(loadings.before), PileEncoder(20, 10).fit(loadings.before)
    left = [
        np.sqrt(np.mean((e.decode(e.encode(loadings.before)) - loadings.before) ** 2)) for e in (few, many)
    ]
    assert left[1] < 0.5 * left[0]
    assert many.decode(many.encode(loadings.before)).min() >= 0.0


def test_regression_with_std_covers_the_truth():
    inside, noise = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        Z = rng.uniform(-1, 1, (400, 2))
        truth = np.sin(3 * Z[:, 0]) + 0.5 * Z[:, 1]
        y = truth[:300] + 0.1 * rng.standard_normal(300)
        theta = find_theta(Z[:300], y, 100, seed)
        model = LandmarkRegressor(theta).fit(Z[:300], y)
        mean, std = model.predict_with_std(Z[300:])
        assert np.std(mean - truth[300:]) < 0.05
        inside.append(np.mean(np.abs(mean - truth[300:]) < 2 * std))
        noise.append(model.noise_)
    assert 0.85 < np.mean(inside) <= 1.0
    assert np.mean(noise) == pytest.approx(0.1, abs=0.01)


def test_update_is_bayes_rule():
    """As conditioning in one go, with the variances held: the order of what is learned does not matter."""
    rng = np.random.default_rng(3)
    Z, y = rng.normal(size=(40, 2)), rng.normal(size=40)
    model = LandmarkRegressor(np.ones(2), 20).fit(Z[:20], y[:20])
    one = model.update(Z[20:], y[20:])
    two = model
    for i in reversed(range(20, 40)):
        two = two.update(Z[i : i + 1], y[i : i + 1])
    assert np.allclose(one.weights_, two.weights_, atol=1e-8)
    assert np.allclose(one.covariance_, two.covariance_, atol=1e-8)
    phi, noise = model.transform(Z[20:]), (model.noise_ / model.scale_) ** 2
    precision = np.linalg.inv(model.covariance_) + phi.T @ phi / noise
    assert np.allclose(one.covariance_, np.linalg.inv(precision), rtol=1e-4, atol=1e-8)


def test_draws_scatter_as_the_posterior():
    rng = np.random.default_rng(4)
    Z = rng.normal(size=(60, 2))
    model = LandmarkRegressor(np.ones(2), 30).fit(Z, rng.normal(size=60))
    draws = np.array([model.draw(Z[:5], np.random.default_rng(k)) for k in range(500)])
    mean, std = model.predict_with_std(Z[:5])
    assert np.allclose(draws.mean(axis=0), mean, atol=4 * std.max() / np.sqrt(500))
    assert np.allclose(draws.std(axis=0), std, rtol=0.15)


def test_who_sees_the_pile_predicts_better(model, unseen):
    blind = calc_error(BlindOutcome(model.surrogate), unseen)
    assert calc_error(model.feature_outcome, unseen)[0] < 0.5 * blind[0]
    assert calc_error(model.field_outcome, unseen)[0] < 0.5 * blind[0]


def test_skill_on_held_out_points_is_that_on_unseen_ones(model, unseen):
    error = calc_error(model.field_outcome, unseen)
    for value, missed in zip(model.field_outcome.skill.values(), error, strict=True):
        assert value == pytest.approx(1.0 - missed**2, abs=0.15)


def test_loadings_of_noise_have_no_skill(model, loadings):
    noise = replace(loadings, Y=np.random.default_rng(0).normal(size=loadings.Y.shape))
    outcome = fit_field_outcome(noise.take(np.arange(120)), model.grid, model.encoder, 0.5)
    assert max(outcome.skill.values()) < 0.15


def test_a_pile_and_its_mirror_image_have_the_same_outcome(model, unseen):
    for i in range(0, len(unseen), 7):
        h, x = unseen.before[i][None], unseen.X[i][None]
        assert np.allclose(
            model.field_outcome.predict(h, x)[0], model.field_outcome.predict(h[:, :, ::-1], x)[0]
        )


def test_the_pile_after_is_better_known_than_that_it_stays_and_as_well_as_is_said(model, unseen):
    rows = [i for i in range(len(unseen)) if np.isfinite(unseen.following[i]).all()]
    error, stays, inside = 0.0, 0.0, []
    for i in rows:
        mean, std = model.pile_model.predict_field(unseen.before[i], unseen.X[i])
        there = unseen.before[i] > 0.1
        error += np.sum((mean - unseen.following[i]) ** 2)
        stays += np.sum((unseen.before[i] - unseen.following[i]) ** 2)
        inside.append(np.mean(np.abs(mean - unseen.following[i])[there] < 1.64 * std[there]))
    assert error < 0.6 * stays
    assert model.pile_model.skill == pytest.approx(1.0 - error / stays, abs=0.2)
    assert 0.8 < np.mean(inside) < 0.98  # 90 % are wanted


def test_drawn_piles_scatter_about_the_expected_one(model, unseen):
    h, x = unseen.before[0], unseen.X[0]
    mean, std = model.pile_model.predict_field(h, x)
    X400 = np.repeat(x[None], 400, axis=0)
    drawn = model.pile_model.draw(h[None], X400, np.random.default_rng(1))
    high = mean > 0.8  # where the floor cuts nothing off
    codes_only = np.sqrt(np.maximum(std**2 - model.encoder.residual_**2, 0.0))
    assert np.allclose(drawn.mean(axis=0)[high], mean[high], atol=0.08)
    assert np.allclose(drawn.std(axis=0)[high], codes_only[high], atol=0.05)


def test_too_few_loadings_for_a_model_of_the_pile_are_refused(model):
    from drakerock.autonomy.pile_model import PileModel

    data = make_data(4, 2)
    with pytest.raises(InputError, match="at least 10 loadings"):
        PileModel(data, model.grid, PileEncoder().fit(data.before), 0.5)


def test_novelty_knows_its_own_and_not_the_others(model):
    world = World(77)
    own = [model.novelty.calc(world.make_pile()) for _ in range(40)]
    assert np.mean(np.array(own) <= 1.0) > 0.9
    steep = np.minimum(3.0 * np.maximum(X[:, None] + 2.0, 0.0), 5.0) * np.ones(len(Y))
    rough = world.make_pile() + np.where(np.indices((len(X), len(Y))).sum(axis=0) % 2, 0.6, 0.0)
    assert model.novelty.calc(steep) > 1.0
    assert model.novelty.calc(rough) > 1.0
    assert model.novelty.calc(np.zeros((len(X), len(Y)))) > 1.0


PARTS = (
    "surrogate",
    "front",
    "encoder",
    "hazard_limits",
    "novelty",
    "feature_outcome",
    "field_outcome",
    "pile_model",
)


@pytest.fixture(scope="module")
def few():
    return make_data(n_points=14, n_loadings=3)


@pytest.fixture(scope="module")
def cache(few, tmp_path_factory):
    """Where a model has kept all that it has learned."""
    cache = tmp_path_factory.mktemp("cache")
    learned = LoaderModel(few, cache=cache)
    for name in PARTS:
        getattr(learned, name)
    assert sorted(path.stem for path in learned.folder.iterdir()) == sorted(PARTS)
    return cache


def test_what_is_kept_advises_the_same_and_is_not_learned_again(few, cache, tmp_path, monkeypatch):
    """To the last bit: who learned and who reads see the same arrays."""
    fresh, kept = LoaderModel(few, cache=tmp_path), LoaderModel(few, cache=cache)
    wanted = Preference((("production", 0.6), ("damage", 0.4)))
    field = few.get_field(5)
    chosen = {}
    for name in CHOICES:
        choice = fresh.make_choice(name, StrategyConfig())
        chosen[name] = choice.choose(fresh.look_at(field, few.scenario), wanted).x
    novelty = [fresh.novelty.calc(h) for h in few.before]
    for function in (
        "fit_surrogate",
        "pareto_front",
        "fit_field_outcome",
        "FeatureOutcome",
        "PileModel",
        "Novelty",
    ):
        monkeypatch.setattr(loader_model, function, lambda *_args, **_kwargs: pytest.fail("learned again"))
    for name in CHOICES:
        choice = kept.make_choice(name, StrategyConfig())
        np.testing.assert_array_equal(
            choice.choose(kept.look_at(field, few.scenario), wanted).x, chosen[name], err_msg=name
        )
    assert [kept.novelty.calc(h) for h in few.before] == novelty


def test_other_data_and_another_seed_have_folders_of_their_own(few, cache):
    one = LoaderModel(few, cache=cache).folder
    assert LoaderModel(few, cache=cache).folder == one
    assert LoaderModel(few, seed=1, cache=cache).folder != one
    assert LoaderModel(few.take(np.arange(len(few)) > 0), cache=cache).folder != one
    assert LoaderModel(replace(few, following=few.following + 0.01), cache=cache).folder != one
    steeper = few.scenario.replace(**{"rocks.friction": 0.7})
    assert LoaderModel(replace(few, scenario=steeper), cache=cache).folder != one


def test_a_damaged_file_is_learned_and_kept_anew(few, cache, tmp_path):
    place = shutil.copytree(cache, tmp_path / "cache")
    model = LoaderModel(few, cache=place)
    path = model.folder / "surrogate.joblib"
    path.write_bytes(path.read_bytes()[:100])
    X = few.X[:3]
    np.testing.assert_array_equal(
        model.surrogate.predict(X), LoaderModel(few, cache=cache).surrogate.predict(X)
    )
    assert path.stat().st_size > 100
