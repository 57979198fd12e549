"""The autonomous loader from the study to the page, on a pile of sixty rocks.

Contract: the preference is an input of the Diagram, the chosen strategy is what is planned and what the outcome tells;
a sequence that was interrupted ends as one that was not; what is not safe stands still, and is told.
"""

import asyncio
import json

import numpy as np
import pytest
import yaml
from pydrake.common.value import Value

from drakerock.autonomy.loader import AutonomousLoader
from drakerock.autonomy.model import load_model
from drakerock.autonomy.preference import Preference
from drakerock.autonomy.sequence import Adviser, run_autonomous
from drakerock.errors import InputError
from drakerock.loading.config import StrategyConfig
from drakerock.loading.cycle import run_cycle
from drakerock.loading.outcome import CycleOutcome
from drakerock.loading.plan import DigPlan, NoPlan
from drakerock.loading.plan_file import load_plan
from drakerock.loading.planning import make_dig_plan
from drakerock.loading.station import make_station
from drakerock.rocks.state import load_pile
from drakerock.study.jobs import get_pile
from drakerock.viewing.autonomy_page import write_autonomy_page
from tests.autonomy_study import make_study

PRODUCTION, DAMAGE = Preference((("production", 1.0),)), Preference((("damage", 1.0),))


@pytest.fixture(scope="module")
def scenario(small_scenario):
    return small_scenario.replace(**{"dynamics.rocks": "nonsmooth"})


@pytest.fixture(scope="module")
def study(scenario, tmp_path_factory):
    return make_study(scenario, tmp_path_factory.mktemp("autonomy") / "study")


@pytest.fixture(scope="module")
def model(study):
    return load_model(study)


@pytest.fixture(scope="module")
def scenario_file(scenario, tmp_path_factory):
    path = tmp_path_factory.mktemp("scenario") / "scenario.yaml"
    path.write_text(yaml.safe_dump(scenario.model_dump(mode="json")))
    return path


def make_autonomous_station(scenario, model, name="best_fixed", pile=None, **kwargs):
    choice = model.make_choice(name, scenario.loading.strategy)
    return make_station(
        scenario,
        get_pile(scenario) if pile is None else pile,
        planner=lambda view: AutonomousLoader(model, choice, scenario, view.digger, **kwargs),
        visible=False,
    )


def look(station, context, preference=None):
    """Return the decision and the plan for a preference at the Diagram's port."""
    if preference is not None:
        station.diagram.GetInputPort("preference").FixValue(context, Value[object](preference))
    field = station.initialize(context)
    planner = station.planner.GetMyContextFromRoot(context)
    decision = station.planner.GetOutputPort("decision").Eval(planner)
    return decision, station.diagram.GetOutputPort("plan").Eval(context), field


def test_the_preference_is_an_input_that_may_change(scenario, model):
    station = make_autonomous_station(scenario, model, preference=PRODUCTION)
    context = station.diagram.CreateDefaultContext()
    default, plan, field = look(station, context)  # nothing at the port: what it was made with
    careful, other, _ = look(station, context, DAMAGE)
    again, plan_again, _ = look(station, context, PRODUCTION)
    assert default.preference == "production=1"
    assert careful.preference == "damage=1"
    assert again.strategy == default.strategy
    assert np.array_equal(plan_again.x, plan.x)
    assert careful.strategy["gamma"] < default.strategy["gamma"] or careful.strategy != default.strategy
    assert isinstance(other, DigPlan)
    assert station.read_strategy(context) == pytest.approx(default.strategy)
    # The plan is the planner's own for the chosen strategy.
    loading = scenario.loading
    expected = make_dig_plan(
        field, StrategyConfig(**default.strategy), station.digger, loading.planning, loading.sensing,
        scenario.site.drift_width, loading.control.speed_floor,
    )  # fmt: skip
    assert np.array_equal(plan.x, expected.x)
    assert plan.volume_wanted == expected.volume_wanted


def test_a_preference_that_changes_while_the_machine_digs_leaves_the_plan(scenario, model):
    station = make_autonomous_station(scenario, model)
    context = station.diagram.CreateDefaultContext()
    _, plan, _ = look(station, context, PRODUCTION)
    station.diagram.GetInputPort("preference").FixValue(context, Value[object](DAMAGE))
    station.planner.ExecuteInitializationEvents(station.planner.GetMyMutableContextFromRoot(context))
    assert np.array_equal(station.diagram.GetOutputPort("plan").Eval(context).x, plan.x)


def test_bounds_that_nothing_keeps_leave_the_machine_where_it_stands(scenario, model):
    from drakerock.autonomy.preference import make_preference

    station = make_autonomous_station(scenario, model)
    wanted = make_preference(model.problem, None, ["production>=1e6"])
    decision, plan, _ = look(station, station.diagram.CreateDefaultContext(), wanted)
    assert decision.action == "stop"
    assert isinstance(plan, NoPlan)
    assert "no strategy of the front satisfies production>=1e+06" in plan.reason


def test_a_choice_that_dies_leaves_the_machine_where_it_stands(scenario, model):
    class Broken:
        name, sees_pile = "broken", False

        def choose(self, situation, preference):
            return 1 / 0

    station = make_station(
        scenario, get_pile(scenario), planner=lambda view: AutonomousLoader(model, Broken(), scenario, view.digger),
        visible=False,
    )  # fmt: skip
    decision, plan, _ = look(station, station.diagram.CreateDefaultContext())
    assert decision.action == "stop"
    assert plan.reason == "no strategy could be chosen: ZeroDivisionError: division by zero"
    outcome = run_cycle(scenario, station.rocks.pile, station=station).outcome
    assert outcome.reason.startswith("no candidate slice: no strategy could be chosen")
    assert outcome.bucket_mass_kg == 0.0


@pytest.fixture(scope="module")
def loaded(scenario, model, study, tmp_path_factory):
    """Two loadings in one go, the preference changing between them."""
    folder = tmp_path_factory.mktemp("straight")
    told = []
    outcomes = run_autonomous(
        scenario, Adviser(model, str(study), "bandit"), lambda n: (PRODUCTION, DAMAGE)[n], 2, folder,
        decided=lambda n, decision: told.append((n, decision)),
    )  # fmt: skip
    return folder, outcomes, told


def read(place):
    return json.loads((place / "decision.json").read_text()), CycleOutcome.from_json(
        (place / "outcome.json").read_text()
    )


def test_each_loading_tells_its_decision_and_its_outcome(loaded, scenario):
    folder, outcomes, told = loaded
    assert [n for n, _ in told] == [0, 1]
    for number, (outcome, wanted) in enumerate(zip(outcomes, ("production=1", "damage=1"), strict=True)):
        place = folder / f"loading_{number:02d}"
        decision, stored = read(place)
        assert decision["preference"] == wanted
        assert decision["reasons"]
        assert stored.strategy == pytest.approx(decision["strategy"])
        assert outcome.strategy == stored.strategy
        plan, _ = load_plan(place / "plan.json")
        assert plan.volume_wanted == pytest.approx(
            decision["strategy"]["alpha"] * plan.volume_wanted / stored.strategy["alpha"]
        )
    assert outcomes[0].strategy != scenario.loading.strategy.model_dump()


def test_an_interrupted_sequence_ends_with_the_same_bits(scenario, model, study, loaded, tmp_path):
    class Stop(Exception):
        pass

    def stop_in_the_second(number, stage, time):
        if number == 1 and time > 1.0:
            raise Stop

    adviser = Adviser(load_model(study), str(study), "bandit")
    with pytest.raises(Stop):
        run_autonomous(
            scenario, adviser, lambda n: (PRODUCTION, DAMAGE)[n], 2, tmp_path, progress=stop_in_the_second
        )
    outcomes = run_autonomous(scenario, adviser, lambda n: (PRODUCTION, DAMAGE)[n], 2, tmp_path)
    for number, (one, two) in enumerate(zip(outcomes, loaded[1], strict=True)):
        assert one.phi1 == two.phi1
        place = f"loading_{number:02d}"
        assert read(tmp_path / place)[0] == read(loaded[0] / place)[0]
    last = "loading_01/pile_next.npz"
    assert np.array_equal(load_pile(tmp_path / last).p_WRs, load_pile(loaded[0] / last).p_WRs)


def test_a_folder_of_another_adviser_is_refused(scenario, model, study, loaded):
    with pytest.raises(InputError, match=r"autoload\.json: this sequence was begun with another choice"):
        run_autonomous(scenario, Adviser(model, str(study), "fixed"), lambda _: PRODUCTION, 2, loaded[0])


def test_a_failed_loading_is_recorded_and_the_last(scenario, model, study, tmp_path):
    def fail(number, stage, time):
        if stage not in ("refill", "sense") and time > 1.0:
            raise RuntimeError("the solver failed to converge")

    outcomes = run_autonomous(
        scenario, Adviser(model, str(study), "best_fixed"), lambda _: PRODUCTION, 3, tmp_path, progress=fail
    )
    assert [item.status for item in outcomes] == ["failed"]
    assert "solver failure" in outcomes[0].reason
    assert read(tmp_path / "loading_00")[0]["action"] == "load"
    assert not (tmp_path / "loading_01").exists()
    page = write_autonomy_page(tmp_path).read_text()
    assert '<span class="mark">failed</span>' in page


def test_a_pile_that_cannot_be_entered_is_one_clear_error(scenario, model, study, tmp_path):
    empty = tmp_path / "empty.npz"
    from drakerock.rocks.state import save_pile

    pile = get_pile(scenario)
    save_pile(pile.select(pile.p_WRs[:, 0] > 0.2), empty)
    with pytest.raises(InputError, match="loading 1: the pile cannot be entered"):
        run_autonomous(
            scenario.replace(**{"pile.source": str(empty)}), Adviser(model, str(study), "best_fixed"),
            lambda _: PRODUCTION, 2, tmp_path / "out",
        )  # fmt: skip
    assert not (tmp_path / "out" / "loading_00" / "outcome.json").exists()


def test_a_planner_that_does_not_choose_leaves_the_scenario_s_strategy(scenario):
    station = make_station(scenario, get_pile(scenario), visible=False)
    context = station.diagram.CreateDefaultContext()
    station.initialize(context)
    assert station.read_strategy(context) == scenario.loading.strategy.model_dump()
    assert not station.diagram.HasInputPort("preference")


def test_a_scenario_names_the_loader(scenario, study):
    part = {
        "system": "drakerock.autonomy.loader:make_loader",
        "parameters": {"model": str(study), "choice": "best_fixed", "weights": "damage=1"},
    }
    named = scenario.replace(**{"loading.parts.planner": part})
    result = run_cycle(named, get_pile(named))
    assert result.outcome.status == "done"
    assert result.outcome.strategy != scenario.loading.strategy.model_dump()
    other = named.replace(
        **{"loading.parts.planner.parameters": part["parameters"] | {"learned_from": "0" * 16}}
    )
    with pytest.raises(InputError, match="holds other loadings by now"):
        make_station(other, get_pile(named))


# The command


def test_the_command_loads_tells_and_goes_on(run_command, scenario_file, study, tmp_path):
    out = tmp_path / "auto"
    words = (
        "autoload", scenario_file, "--model", study, "--choice", "field", "--weights", "production=0.7,damage=0.3",
        "--out", out, "--no-replay",
    )  # fmt: skip
    code, shown, said = run_command(*words, "--cycles", 1)
    assert code == 0
    assert "1 loadings by field" in shown
    assert "learned from 36 loadings at 9 points" in said
    assert "explained of what single loadings at other points differ by: production" in said
    assert "loading 1: alpha" in said
    # Sixty rocks are no slope of the study: it says so, and the robust strategy stands in.
    assert "unlike those learned from" in said
    code, shown, said = run_command(*words, "--cycles", 2, "--then", "2:damage=1", "--json")
    summary = json.loads(shown)
    assert code == 0
    assert summary["loadings"] == 2
    assert [item["preference"] for item in summary["decisions"]] == ["production=0.7,damage=0.3", "damage=1"]
    assert summary["fell_back"] == 2
    assert (out / "autoload.html").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "model: the folder of a study to learn from is needed"),
        (["--model", "nowhere"], "study.json: no such file"),
        (["--model", "STUDY", "--choice", "best"], "choice best: one of fixed, best_fixed"),
        (["--model", "STUDY", "--bound", "debris<=1", "--bound", "debris>=9"], "contradict each other"),
        (["--model", "STUDY", "--bound", "production>=1e6"], "no strategy of the front satisfies"),
        (["--model", "STUDY", "--weights", "speed=1"], "unknown objective 'speed'"),
        (["--model", "STUDY", "--then", "damage=1"], "then damage=1: a loading's number and weights"),
        (["--model", "STUDY", "--set", "machine.expected.payload=9000"], "another machine"),
        (["--model", "STUDY", "--set", "site.drift_width=4.5"], "learned with site.drift_width = 3.9"),
    ],
)
def test_bad_input_is_one_message(run_command, scenario_file, study, tmp_path, words, message):
    words = [str(study) if word == "STUDY" else word for word in words]
    code, _, said = run_command("autoload", scenario_file, "--out", tmp_path / "out", *words)
    assert code == 2
    assert message in said.replace("\n", " ")
    assert not (tmp_path / "out" / "loading_00").exists()


# The page


def test_the_page_in_a_browser(loaded):
    pytest.importorskip("choreographer", reason="no browser's driver: pip install 'drakerock[film]'")
    from drakerock.viewing.browser import open_page

    folder, outcomes, _ = loaded
    page_file = write_autonomy_page(folder)

    async def visit():
        async with open_page(page_file, 1100, 800) as page:
            rows = await page.evaluate(
                "[...document.querySelectorAll('article')].map(a => [a.id, a.querySelector('.reasons').textContent, "
                "a.querySelector('img').naturalWidth, a.textContent])"
            )
            means = await page.evaluate(
                "Object.fromEntries([...document.querySelectorAll('#means tr')].slice(1).map(r => "
                "[r.cells[0].textContent, r.cells[1].textContent]))"
            )
            await page.resize(420, 800)
            width = await page.evaluate("document.documentElement.scrollWidth")
            return rows, means, width, page.faults

    rows, means, width, faults = asyncio.run(visit())
    assert faults == []
    assert width <= 420
    assert [row[0] for row in rows] == ["loading_00", "loading_01"]
    for row, place in zip(rows, sorted(folder.glob("loading_*")), strict=True):
        decision, outcome = read(place)
        assert all(reason in row[1] for reason in decision["reasons"])
        assert row[2] > 200
        assert outcome.reason in row[3]
        assert f"alpha {decision['strategy']['alpha']:.2f}" in row[3]
    came = np.mean([outcome.objectives["production"] for outcome in outcomes])
    assert float(means["production"]) == pytest.approx(came, rel=1e-3, abs=0.01)


def test_a_folder_without_autonomous_loadings_is_refused(tmp_path):
    with pytest.raises(InputError, match="no autonomous loading is there"):
        write_autonomy_page(tmp_path)
