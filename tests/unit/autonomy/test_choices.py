"""Contract of the choices, on each of them; decisions that are safe whatever the choice says.

Caught: a front that is all but a point, on which the penalty of a hazard no longer counted.
"""

import numpy as np
import pytest

from drakerock.autonomy.choices import BARRED, minimise
from drakerock.autonomy.decision import decide
from drakerock.autonomy.model import CHOICES, LoaderModel
from drakerock.autonomy.preference import Preference, make_preference
from drakerock.errors import InputError
from drakerock.exploration.problem import Problem
from drakerock.loading.config import StrategyConfig
from drakerock.loading.field import HeightField
from tests.unit.autonomy.synthetic import CELL, SCENARIO, World, X, Y

MOST = Preference((("production", 1.0),))
NAMES = list(CHOICES)


@pytest.fixture(scope="module")
def choices(model):
    return {name: model.make_choice(name, StrategyConfig()) for name in NAMES}


def look(model, h):
    return model.look_at(HeightField(X, Y, h, CELL), SCENARIO)


def run(model, choice, seed, n_piles=4, n_loadings=3):
    """Return the expected production of loadings on unseen piles (n,)."""
    world, total = World(seed), []
    for _ in range(n_piles):
        h = world.make_pile()
        for _ in range(n_loadings):
            x = choice.choose(look(model, h), MOST).x
            total.append(world.expect(h, x)[0])
            came, _, following = world.load(h, x)
            choice, h = choice.learn(h, x, came), following
    return np.array(total)


@pytest.mark.parametrize("name", NAMES)
def test_a_proposal_is_inside_the_ranges_and_the_same_again(model, choices, name):
    situation, choice = look(model, World(8).make_pile()), choices[name]
    one, two = choice.choose(situation, MOST), choice.choose(situation, MOST)
    assert np.all((one.x >= model.problem.low) & (one.x <= model.problem.high))
    assert np.array_equal(one.x, two.x)
    assert np.all(one.std >= 0.0)
    assert one.reason
    assert choice.name == name


@pytest.mark.parametrize("name", ["features", "field", "look_ahead"])
def test_another_preference_is_another_strategy(model, choices, name):
    situation = look(model, World(8).make_pile())
    careful = Preference((("damage", 1.0),))
    one, two = (choices[name].choose(situation, wanted) for wanted in (MOST, careful))
    world = World(8)
    h = situation.field.h
    assert world.expect(h, two.x)[1] < world.expect(h, one.x)[1]


@pytest.mark.parametrize("name", ["features", "field", "look_ahead"])
def test_who_looks_at_the_pile_loads_more_than_the_best_fixed_strategy(model, choices, name):
    fixed, seeing = (run(model, choices[which], seed=31) for which in ("best_fixed", name))
    assert seeing.mean() > fixed.mean() + 15.0
    assert seeing.mean() > 860.0  # of at most 900


def test_looking_ahead_leaves_the_better_pile(model):
    """In the model's own eyes: its three steps cost no more than those of who takes each for itself."""
    greedy, far = (model.make_choice("look_ahead", StrategyConfig(), depth) for depth in (1, 3))
    gain = []
    for seed in range(4):
        situation = look(model, World(seed + 50).make_pile())
        x1, x3 = (choice.choose(situation, MOST).x for choice in (greedy, far))
        follow = [np.repeat(x[None], 1, axis=0) for x in (x1, x3)]
        best = [
            min(far._follow(situation.field.h, [first, second, second], MOST)[0] for second in follow)
            for first in follow
        ]
        gain.append(best[0] - best[1])
    assert np.mean(gain) > -0.01


def test_the_bandit_learns_at_a_site_that_differs_from_the_study(model, choices):
    """Where production is half for low beta, which the study did not know."""

    class Site(World):
        def expect(self, h, x):
            came = super().expect(h, x)
            came[0] *= 1.0 - 0.5 * (x[1] < 0.6)
            return came

    choice, site, betas, total = choices["bandit"], Site(12), [], []
    for _ in range(30):
        h = site.make_pile()
        x = choice.choose(look(model, h), MOST).x
        betas.append(x[1])
        total.append(site.expect(h, x)[0])
        choice = choice.learn(h, x, site.load(h, x)[0])
    assert min(total[:6]) < 500.0  # it tried what the study advises
    assert np.mean(total[-10:]) > 850.0  # of 885 at beta 0.6
    assert np.mean(np.array(betas[-10:]) >= 0.6) >= 0.9


def test_an_unknown_choice_names_those_there_are(model):
    with pytest.raises(InputError, match="unknown choice 'best'; there are fixed, best_fixed"):
        model.make_choice("best", StrategyConfig())


def test_search_finds_the_minimum_and_keeps_the_best_tried():
    u, cost = minimise(
        lambda U: np.sum((U - [0.2, 0.9, 1.0]) ** 2, axis=1), np.full((1, 3), 0.5),
        np.random.default_rng(0), n=64, rounds=8,
    )  # fmt: skip
    assert np.allclose(u, [0.2, 0.9, 1.0], atol=0.05)
    assert cost == pytest.approx(np.sum((u - [0.2, 0.9, 1.0]) ** 2))


# Preference


@pytest.mark.parametrize(
    ("weights", "bounds", "message"),
    [
        (None, ["debris<=100", "debris>=500"], "debris>=500 and debris<=100 contradict each other"),
        ("speed=1", [], "unknown objective 'speed'"),
        ("production=-1", [], "not negative"),
        (None, ["debris"], "expected objective<=number"),
    ],
)
def test_bad_preferences_are_one_clear_error(weights, bounds, message):
    with pytest.raises(InputError, match=message):
        make_preference(Problem(), weights, bounds)


def test_costs_weigh_as_the_front_is_weighed(model):
    """Of the front's own points, the least cost is where `choose_strategy` goes, up to the scale's least spread."""
    front, scale = model.front, model.scale
    cost = scale.calc_cost(MOST, front.Y, front.std)
    assert front.Y[np.argmin(cost), 0] == front.Y[:, 0].max()
    broken = Preference((("production", 1.0),), make_preference(model.problem, None, ["debris<=1"]).bounds)
    assert np.all(scale.calc_cost(broken, front.Y, front.std) > cost + 1.0)
    assert cost.max() < BARRED / 10


# Decisions


def make_decision(model, choice, h, **kwargs):
    return decide(model.problem, choice, model.robust, look(model, h), MOST, StrategyConfig(), **kwargs)


def test_a_pile_unlike_the_training_set_falls_back_and_says_so(model, choices):
    steep = np.minimum(3.0 * np.maximum(X[:, None] + 2.0, 0.0), 5.0) * np.ones(len(Y))
    decision = make_decision(model, choices["field"], steep)
    assert decision.fell_back
    assert "unlike those learned from" in decision.reasons[0]
    assert decision.x == tuple(model.robust.choose(look(model, steep), MOST).x)
    assert tuple(decision.x) in {tuple(x) for x in model.data.X}
    # One that does not look at the pile is not misled by it.
    assert not make_decision(model, choices["best_fixed"], steep).fell_back


def test_debris_in_the_way_is_cleaned_once_and_then_avoided(model, choices):
    h = World(8).make_pile()
    j = len(Y) // 2 - 3
    h[2:4, j] += 0.6
    first = make_decision(model, choices["best_fixed"], h)
    assert first.action == "clean"
    assert first.reasons[0].startswith("clean first: debris in the way")
    assert make_decision(model, choices["best_fixed"], h, cleaned=True).action == "load"


def test_a_barred_entry_moves_to_the_nearest_free_one(model, choices):
    h = World(8).make_pile()
    plain = make_decision(model, choices["best_fixed"], h)
    y = look(model, h).find_entry(plain.strategy["gamma"])
    j = int(np.argmin(np.abs(Y - y)))
    # Debris that cleaning does not reach, seen from the entry and its neighbours only.
    side = 1 if y > 0 else -1
    h[1, j + side * 3 if 0 <= j + side * 3 < len(Y) else j] += 0.6
    moved = make_decision(model, choices["best_fixed"], h, cleaned=True)
    situation = look(model, h)
    assert not situation.is_barred(np.array([moved.strategy["gamma"]]))[0]
    if situation.is_barred(np.array([plain.strategy["gamma"]]))[0]:
        assert "entered at gamma" in moved.reasons[0]
        assert "debris in the way" in moved.reasons[0]
    assert situation.hazards


@pytest.mark.parametrize("name", ["features", "field", "look_ahead", "bandit"])
def test_who_searches_takes_no_barred_entry(model, choices, name):
    h = World(8).make_pile()
    h[1, len(Y) // 2 + 4] += 0.6
    situation = look(model, h)
    assert 0.0 < situation.is_barred(situation.gammas).mean() < 1.0
    x = choices[name].choose(situation, MOST).x
    assert not situation.is_barred(x[2:3])[0]


def test_an_empty_drift_stops(model, choices):
    decision = make_decision(model, choices["field"], np.zeros((len(X), len(Y))))
    assert decision.action == "stop"
    assert "cannot be entered" in decision.reasons[0]


# What does not fit


def test_a_study_of_other_variables_is_refused(loadings):
    from dataclasses import replace

    from drakerock.exploration.problem import Variable

    problem = Problem(variables=(*loadings.problem.variables[:3], Variable(name="speed", low=0.0, high=1.0)))
    with pytest.raises(
        InputError, match="the study varies speed; an autonomous loader chooses among alpha, beta"
    ):
        LoaderModel(replace(loadings, problem=problem))


def test_a_variable_that_is_called_like_a_strategy_s_and_is_none_is_refused(loadings):
    from dataclasses import replace

    keys = (
        "loading.strategy.alpha",
        "loading.planning.v_x_max",
        "loading.strategy.gamma",
        "loading.strategy.kappa",
    )
    with pytest.raises(InputError, match=r"the study varies beta \(loading\.planning\.v_x_max\)"):
        LoaderModel(replace(loadings, keys=keys))


def test_attempts_at_one_point_are_sequences_of_their_own(loadings):
    """Caught: a point that was tried twice has two loadings of each number, which a table of points refuses."""
    from dataclasses import replace

    twice = replace(loadings, attempt=loadings.loading // 2, loading=loadings.loading % 2)
    assert len(LoaderModel(twice).surrogate.models_[0].y_train_) == 2 * 60


def test_a_stored_scenario_has_the_same_machine(model):
    model.check_fits(SCENARIO.resolve())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"machine.expected.payload": 9000.0}, "another machine"),
        ({"site.drift_width": 6.0}, "learned with site.drift_width = 6.5, the scenario has 6"),
        ({"loading.sensing.cell": 0.26}, "learned with loading.sensing.cell = 0.5"),
    ],
)
def test_a_scenario_that_the_model_does_not_fit_is_refused(model, changes, message):
    with pytest.raises(InputError, match=message):
        model.check_fits(SCENARIO.replace(**changes))


def test_what_else_differs_is_told(model):
    assert model.list_differences(SCENARIO) == []
    assert model.list_differences(SCENARIO.replace(**{"loading.planning.v_x_max": 1.0})) == [
        "loading.planning"
    ]


def test_a_field_on_another_grid_is_refused(model):
    with pytest.raises(InputError, match="a height field of 5 x 4 cells"):
        model.look_at(HeightField(X[:5], Y[:4], np.zeros((5, 4)), CELL), SCENARIO)
