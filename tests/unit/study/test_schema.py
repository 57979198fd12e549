import json

import numpy as np
import pytest
import yaml

from drakerock.config import make_json_schema
from drakerock.errors import InputError
from drakerock.study.objectives import get_objective
from drakerock.study.schema import StudyConfig, load_study


@pytest.fixture
def write(tmp_path):
    def write(name="study.yaml", **data):
        path = tmp_path / name
        path.write_text(yaml.safe_dump(data))
        return path

    return write


def test_an_empty_file_is_the_method(write):
    study = load_study(write())
    assert study.problem.variable_names == ("alpha", "beta", "gamma", "kappa")
    assert study.problem.objective_names == ("production", "damage", "debris")
    assert study.loadings == 20
    strategy = study.make_scenario(np.array([1.3, 0.85, 1.0, 0.6])).loading.strategy
    assert (strategy.alpha, strategy.beta, strategy.gamma, strategy.kappa) == (1.3, 0.85, 1.0, 0.6)


def test_scenario_file_and_differences_and_overrides(write):
    write("base.yaml", seed=4, pile={"rocks": 90, "emission_height": 1.8, "emission_reach": 1.5})
    path = write(scenario_file="base.yaml", scenario={"pile": {"rocks": 70}})
    study = load_study(path, ["scenario.site.drift_width=4.5", "loadings=3"])
    assert (study.scenario.seed, study.scenario.pile.rocks, study.scenario.pile.emission_reach) == (
        4,
        70,
        1.5,
    )
    assert (study.scenario.site.drift_width, study.loadings) == (4.5, 3)
    assert study.scenario_file is None


def test_differences_are_checked_together_with_the_file_they_differ_from(write):
    write("base.yaml", site={"void_depth": 2.0, "rear_layer": 0.0})
    path = write(scenario_file="base.yaml", scenario={"site": {"void_depth": 0.6}})
    assert load_study(path).scenario.site.void_depth == 0.6  # too little for the default's rear layer


def test_any_number_of_the_scenario_may_be_a_variable(write):
    variables = [
        {"name": "effort", "key": "machine.boom.effort", "low": 1e5, "high": 2e6, "unit": "N m"},
        {"name": "sweeps", "key": "dynamics.nonsmooth.iterations", "low": 5, "high": 50},
    ]
    scenario = load_study(write(variables=variables)).make_scenario(np.array([3e5, 7.6]))
    assert scenario.machine.boom.effort == 3e5
    assert scenario.dynamics.nonsmooth.iterations == 8
    assert scenario.loading.strategy.alpha == 1.1


def test_attempts_differ_in_seed_and_step_and_points_by_choice(write):
    study = load_study(write(scenario={"seed": 7}))
    x = np.array([1.0, 0.5, 0.5, 0.5])
    first, second, third = (study.make_scenario(x, "s0001", attempt) for attempt in range(3))
    assert first.seed == 7
    assert len({first.seed, second.seed, third.seed}) == 3
    assert third.dynamics.time_step == 0.25 * first.dynamics.time_step
    assert study.make_scenario(x, "s0002").seed == 7
    apart = load_study(write(scenario={"seed": 7}, independent_piles=True))
    assert apart.make_scenario(x, "s0001").seed != apart.make_scenario(x, "s0002").seed


def test_objectives_of_ones_own(write, tmp_path):
    (tmp_path / "mine.py").write_text(
        "from drakerock.exploration.problem import Objective\n"
        "from drakerock.study.objectives import register_objective\n"
        "@register_objective(Objective(name='reward', sense='max', unit='kg'))\n"
        "def calc_reward(outcome):\n    return outcome.bucket_mass_kg\n"
    )
    study = load_study(write(modules=["mine.py"], objectives=["reward", "damage"]))
    assert study.problem.objectives[0].sense == "max"
    assert get_objective("reward").function.__name__ == "calc_reward"


def test_what_is_left_of_a_neutral_study_is_what_results_depend_on(write):
    base = load_study(write())
    for same in ("executor.workers=7", "storage.keep=outcomes", "name=other", "exploration.sampling.n_samples=300",
                 "exploration.pareto.population=50"):  # fmt: skip
        assert load_study(write(), [same]).make_neutral() == base.make_neutral(), same
    for other in ("seed=1", "loadings=3", "scenario.seed=9", "failures.retries=0",
                  "exploration.sampling.batch_size=3", "objectives=[damage]"):  # fmt: skip
        assert load_study(write(), [other]).make_neutral() != base.make_neutral(), other


@pytest.mark.parametrize(
    ("data", "parts"),
    [
        ({"loadngs": 3}, ["study.yaml:1", "unknown key 'loadngs'", "did you mean 'loadings'?"]),
        ({"loadings": 0}, ["study.yaml:1", "loadings", "greater than or equal to 1"]),
        ({"scenario": {"pile": {"rokcs": 3}}}, ["study.yaml:3", "scenario.pile.rokcs", "'rocks'"]),
        ({"scenario_file": "none.yaml"}, ["none.yaml", "no such file"]),
        (
            {"objectives": ["prodction"]},
            ["study.yaml", "'prodction'", "did you mean 'production'?", "debris"],
        ),
        (
            {"variables": [{"name": "failure", "key": "loading.strategy.alpha", "low": 0.3, "high": 1}]},
            ["study.yaml: no variable or objective may be called 'failure'", "point, role"],
        ),
        (
            {"variables": [{"name": "damage_se", "key": "loading.strategy.alpha", "low": 0.3, "high": 1}]},
            ["study.yaml: no variable or objective may be called 'damage_se'", "belongs to 'damage'"],
        ),
        ({"modules": ["no.py"]}, ["study.yaml", "modules", "no.py", "cannot be imported"]),
        (
            {"variables": [{"name": "a", "key": "loading.strategy.alhpa", "low": 0.3, "high": 1}]},
            ["study.yaml:3", "variables.0.key", "'loading.strategy.alhpa'", "did you mean 'alpha'?"],
        ),
        (
            {"variables": [{"name": "a", "key": "machine.model", "low": 0, "high": 1}]},
            ["study.yaml:3", "variables.0.key", "'machine.model' is no number"],
        ),
        (
            {"variables": [{"name": "a", "key": "loading.strategy.alpha", "low": 0.0, "high": 1}]},
            ["study.yaml", "variables", "a = 0", "greater than or equal to 0.2"],
        ),
        (
            {
                "variables": [
                    {"name": n, "key": "loading.strategy.alpha", "low": 0.3, "high": 1} for n in "ab"
                ]
            },
            ["study.yaml", "one variable per scenario key", "loading.strategy.alpha"],
        ),
    ],
)
def test_errors_name_file_key_and_what_is_allowed(write, data, parts):
    with pytest.raises(InputError) as caught:
        load_study(write(**data))
    for part in parts:
        assert part in str(caught.value)


def test_json_schema_describes_the_keys():
    schema = json.loads(json.dumps(make_json_schema(StudyConfig, "study")))
    assert schema["additionalProperties"] is False
    assert {"variables", "objectives", "loadings", "executor", "storage"} <= set(schema["properties"])
    assert schema["$defs"]["StrategyConfig"]["properties"]["alpha"]["maximum"] == 2


def test_a_study_varies_the_parameters_of_a_part_of_ones_own(write):
    parts = {"controller": {"system": "examples/admittance.py:make_controller", "parameters": {"force": 1e5}}}
    variable = {
        "name": "force", "key": "loading.parts.controller.parameters.force", "low": 1e4, "high": 1e6
    }  # fmt: skip
    study = load_study(write(scenario={"loading": {"parts": parts}}, variables=[variable]))
    scenario = study.make_scenario(np.array([2e5]))
    assert scenario.loading.parts.controller.parameters == {"force": 2e5}
    variable["key"] = "loading.parts.controller.parameters.fource"
    with pytest.raises(
        InputError, match=r"no parameter loading.parts.controller.parameters.fource; it gives force"
    ):
        load_study(write(scenario={"loading": {"parts": parts}}, variables=[variable]))


CHOICES = [
    {"label": "default"},
    {"label": "two sizes", "set": {"rocks.gradation": [
        {"size_m": 0.2, "mass_fraction": 0.5}, {"size_m": 0.5, "mass_fraction": 0.5}]}},
]  # fmt: skip


def test_a_variable_may_choose_between_settings(write):
    study = load_study(write(variables=[
        {"name": "fines", "choices": CHOICES},
        {"name": "friction", "key": "rocks.friction", "low": 0.5, "high": 1.0},
    ]))  # fmt: skip
    assert (study.problem.low[0], study.problem.high[0]) == (0.0, 1.0)
    assert len(study.make_scenario(np.array([0.4, 0.7])).rocks.gradation) == 4
    second = study.make_scenario(np.array([1.0, 0.7])).rocks
    assert [item.size_m for item in second.gradation] == [0.2, 0.5]
    assert second.friction == 0.7
    assert study.variables[0].describe(0.9) == "two sizes"


@pytest.mark.parametrize(
    ("variable", "message"),
    [
        ({"name": "a", "choices": CHOICES, "key": "rocks.friction"}, "either key"),
        ({"name": "a", "low": 0, "high": 1}, "either key"),
        ({"name": "a", "choices": CHOICES, "high": 3}, "leave high out"),
        (
            {"name": "a", "choices": [CHOICES[0], {"label": "x", "set": {"rocks.frction": 1}}]},
            "rocks.frction",
        ),
        (
            {"name": "a", "choices": [CHOICES[0], {"label": "x", "set": {"rocks.friction": 9}}]},
            "a = 1 is not a possible",
        ),
    ],
)
def test_choices_that_make_no_scenario_are_refused(write, variable, message):
    with pytest.raises(InputError, match=message):
        load_study(write(variables=[variable]))


def test_a_design_of_one_at_a_time_says_how_many_points_it_has(write):
    sampling = {"design": "one_at_a_time", "n_validation": 0}
    with pytest.raises(InputError, match="has 9 points: n_samples: 9"):
        load_study(write(exploration={"sampling": sampling}))
    assert (
        load_study(
            write(exploration={"sampling": sampling | {"n_samples": 9}})
        ).exploration.sampling.n_samples
        == 9
    )
