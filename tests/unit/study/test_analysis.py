import json
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import drakerock
from drakerock.cli import app
from drakerock.errors import InputError
from drakerock.exploration.config import ExplorationConfig, ParetoConfig, SensitivityConfig, SurrogateConfig
from drakerock.exploration.pareto import pareto_front
from drakerock.exploration.problems import make_noisy_loading, make_noisy_table
from drakerock.exploration.surrogate import Surrogate
from drakerock.exploration.table import ResponseTable
from drakerock.study import analysis
from drakerock.study.analysis import run_confirm, run_report, run_strategy
from drakerock.viewing import report
from report_helpers import save_confirmation

KNOWN = make_noisy_loading()
QUICK = ExplorationConfig(
    surrogate=SurrogateConfig(n_starts=4),
    pareto=ParetoConfig(population=60, evaluations=3000, n_draws=0),
    sensitivity=SensitivityConfig(n_base=64),
    n_confirm=4,
)


def evaluate(x):
    return KNOWN.evaluate(x[None])[0], np.array([3.0, 0.03, 20.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    rng = np.random.default_rng(0)
    X = KNOWN.problem.unscale(rng.uniform(-1, 1, (70, 4)))
    make_noisy_table(X, rng, n_validation=10).save(folder / "responses.csv")
    study = {"name": "trial", "seed": 5, "exploration": QUICK.model_dump(mode="json")}
    (folder / "study.json").write_text(json.dumps(study))
    return folder


def remember(function):
    """Return a function that calls `function` once for each choice of arguments, but for what to tell the progress."""
    known = {}

    def call(*args):
        args = [arg for arg in args if not callable(arg)]
        key = tuple(id(arg) if isinstance(arg, Surrogate) else pickle.dumps(arg) for arg in args)
        if key not in known:
            known[key] = function(*args)
        return known[key]

    return call


@pytest.fixture(scope="module", autouse=True)
def fitted_once():
    """The study of `folder` is fitted, judged and searched once, whoever asks."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("fit_surrogate", "calc_learning_curve", "pareto_front"):
            patch.setattr(analysis, name, remember(getattr(analysis, name)))
        yield


@pytest.fixture
def run(monkeypatch):
    class Known:
        def __init__(self, folder, **options):
            self.evaluate = evaluate

        def run(self, X):
            assert X.shape == (3, 4)

    monkeypatch.setattr("drakerock.study.resimulation.Resimulation", Known)
    return lambda *words: CliRunner().invoke(app, [str(word) for word in words])


def test_strategy_as_text_and_json(folder, run):
    words = ("strategy", folder, "--weights", "production=0.6,damage=0.2,debris=0.2")
    text, data = run(*words), run(*words, "--json")
    assert text.exit_code == data.exit_code == 0
    parsed = json.loads(data.stdout)
    assert parsed["objectives"]["production"] > 100.0
    assert f"{parsed['strategy']['alpha']:.3f}" in text.stdout
    expected = run_strategy(folder, {"production": 0.6, "damage": 0.2, "debris": 0.2})
    assert parsed == json.loads(json.dumps(expected.to_dict()))


def test_bounds_and_knee(folder, run):
    bounded = json.loads(
        run("strategy", folder, "--bound", "debris<=500", "--weights", "production=1", "--json").stdout
    )
    free = json.loads(run("strategy", folder, "--weights", "production=1", "--json").stdout)
    assert bounded["objectives"]["debris"] <= 500.0 < free["objectives"]["debris"]
    assert bounded["objectives"]["production"] < free["objectives"]["production"]
    assert bounded["bounds"]["debris<=500"] >= 0.9
    assert bounded["verdict"]["fit"] in ("good", "rough")
    best = json.loads(
        run("strategy", folder, "--best", "production", "--bound", "debris<=500", "--json").stdout
    )
    assert best["strategy"] == bounded["strategy"]
    assert best["chosen_by"] == "best production, within debris<=500"
    surer = json.loads(
        run(
            "strategy",
            folder,
            "--best",
            "production",
            "--bound",
            "debris<=500",
            "--probability",
            "0.99",
            "--json",
        ).stdout
    )
    assert surer["bounds"]["debris<=500"] >= 0.99
    both = json.loads(run("strategy", folder, "--bounds", "debris<=600,damage<=1.2", "--json").stdout)
    assert both["objectives"]["debris"] <= 600.0
    assert both["objectives"]["damage"] <= 1.2
    knee = json.loads(run("strategy", folder, "--knee", "--json").stdout)
    assert knee == json.loads(run("strategy", folder, "--json").stdout)
    assert knee["chosen_by"] == "knee point"


def test_a_table_alone_will_do(folder, tmp_path, monkeypatch):
    """The settings are the defaults; here they are but looked at, as they take long."""
    given = []

    def use_quick(name, quick):
        function = getattr(analysis, name)

        def call(*args):
            given.extend(arg for arg in args if isinstance(arg, type(quick)))
            return function(*(quick if isinstance(arg, type(quick)) else arg for arg in args))

        monkeypatch.setattr(analysis, name, call)

    use_quick("fit_surrogate", QUICK.surrogate)
    use_quick("pareto_front", QUICK.pareto)
    path = tmp_path / "points.csv"
    path.write_bytes((folder / "responses.csv").read_bytes())
    assert run_strategy(path, "production=1").y[0] > 190.0
    assert given == [SurrogateConfig(), ParetoConfig()]


def test_confirm_then_report(folder, run, monkeypatch):
    monkeypatch.setattr(report, "save_figures", save_confirmation)
    result = run("study", "confirm", folder, "--points", "3")
    assert result.exit_code == 0, result.output
    assert result.stdout.count("point ") == 3
    assert "predicted" in result.stdout
    rows = json.loads((folder / "confirmation.json").read_text())
    truth = KNOWN.evaluate(np.array([[rows[0][name] for name in KNOWN.problem.variable_names]]))[0]
    assert rows[0]["production_simulated"] == pytest.approx(truth[0])
    assert "report.html" in result.stdout, "the report shows the confirmation at once"
    page = (folder / "report" / "report.html").read_text(encoding="utf-8")
    assert "<title>Exploration of trial</title>" in page
    assert "Front points simulated again" in page
    assert (folder / "report" / "figures" / "confirmation.pdf").exists()


def test_confirm_takes_the_settings_number_and_keeps_failures(folder):
    def fail(x):
        raise ValueError("out of memory")

    confirmation = run_confirm(folder, fail)
    assert confirmation.failure == ("ValueError: out of memory",) * 4
    run_confirm(folder, evaluate)
    with pytest.raises(InputError, match="at least one"):
        run_confirm(folder, evaluate, 0)


def test_errors_name_file_and_key(tmp_path, folder):
    with pytest.raises(InputError, match="no such file or folder"):
        run_report(tmp_path / "nothing")
    for name in ("responses.csv",):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    with pytest.raises(InputError, match="unknown objective 'speed'"):
        run_strategy(tmp_path, "speed=1")
    with pytest.raises(InputError, match="'damage' has two"):
        run_strategy(tmp_path, "damage=1,damage=2")
    with pytest.raises(InputError, match="cannot be read: File name too long"):
        run_strategy("x" * 5000)
    with pytest.raises(InputError, match=r"no strategy satisfies production>=900 \(90 % sure\)"):
        run_strategy(folder, bounds=["production>=900"])
    with pytest.raises(InputError, match=r"probability of the bounds is 1\.5; at least 0\.5, below 1"):
        run_strategy(folder, bounds=["production>=900"], probability=1.5)
    with pytest.raises(InputError, match="unknown objective 'speed'"):
        run_strategy(folder, best="speed")
    with pytest.raises(InputError, match="exclude each other"):
        run_strategy(folder, "damage=1", best="damage")
    (tmp_path / "study.json").write_text(json.dumps({"exploration": {"pareto": {"population": 1}}}))
    with pytest.raises(InputError, match=r"study\.json: exploration\.pareto\.population"):
        run_strategy(tmp_path)
    (tmp_path / "study.json").write_text(json.dumps({"seed": "x"}))
    with pytest.raises(InputError, match="seed must be an integer"):
        run_strategy(tmp_path)
    (tmp_path / "study.json").write_text(json.dumps({"exploration": QUICK.model_dump(mode="json")}))
    (tmp_path / "confirmation.json").write_text("[{}]")
    with pytest.raises(InputError, match=r"confirmation\.json"):
        run_report(tmp_path)


def test_knee_and_weights_exclude_each_other(folder, run):
    result = run("strategy", folder, "--knee", "--weights", "production=1")
    assert isinstance(result.exception, InputError)


def test_public_names():
    from drakerock.exploration import pareto, strategy, surrogate

    assert drakerock.Surrogate is surrogate.Surrogate
    assert drakerock.pareto_front is pareto.pareto_front
    assert drakerock.choose_strategy is strategy.choose_strategy


@pytest.fixture(scope="module")
def reported(folder, tmp_path_factory):
    place = shutil.copytree(folder, tmp_path_factory.mktemp("reported") / "study")
    run_report(place)
    return place


def test_a_report_keeps_the_surrogate_and_a_strategy_takes_it(reported, tmp_path, monkeypatch):
    place = shutil.copytree(reported, tmp_path / "study")
    before = run_strategy(place).to_dict()
    monkeypatch.setattr(analysis, "fit_surrogate", lambda *_: pytest.fail("fitted again"))
    monkeypatch.setattr(analysis, "pareto_front", pareto_front)
    assert run_strategy(place).to_dict() == before


@pytest.mark.parametrize("stale", ["another seed", "another response", "damaged"])
def test_a_surrogate_of_something_else_is_not_taken(reported, tmp_path, monkeypatch, stale):
    place = shutil.copytree(reported, tmp_path / "study")
    if stale == "another seed":
        study = json.loads((place / "study.json").read_text())
        (place / "study.json").write_text(json.dumps(study | {"seed": 6}))
    elif stale == "another response":
        table = ResponseTable.load(place)
        replace(table, Y=table.Y * 1.01).save(place / "responses.csv")
    else:
        (place / analysis.SURROGATE).write_text("{}")
    fits = []
    fit = analysis.fit_surrogate
    monkeypatch.setattr(analysis, "fit_surrogate", lambda *args: fits.append(args) or fit(*args))
    run_strategy(place)
    assert len(fits) == 1


def test_the_shipped_study_answers_without_a_source_and_a_fit(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(analysis, "fit_surrogate", lambda *_: pytest.fail("fitted"))
    result = run("strategy", "--weights", "production=0.6,damage=0.2,debris=0.2", "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert list(told["strategy"]) == ["alpha", "beta", "gamma", "kappa"]
    # A loaded LHD of 21 t brings hundreds of kilograms a second, not tens or thousands.
    assert 200.0 < told["objectives"]["production"] < 1500.0
    assert set(told["verdict"]["objectives"]) == {"production", "damage", "debris"}
