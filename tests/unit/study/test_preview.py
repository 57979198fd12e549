"""The preview of a strategy: its plan, a prediction with its verdict, and a page that shows both."""

import json
import threading
import urllib.error
import urllib.request

import numpy as np
import pytest

from drakerock.errors import InputError
from drakerock.exploration.problem import Problem
from drakerock.exploration.problems import make_noisy_table
from drakerock.loading.config import StrategyConfig
from drakerock.loading.field import HeightField
from drakerock.loading.plan import NoPlan
from drakerock.loading.plan_file import load_plan, save_plan
from drakerock.loading.scenario import Scenario
from drakerock.loading.sensing import make_grid
from drakerock.study.preview import Preview
from drakerock.study.preview_server import make_server
from tests.browsers import act, visit


@pytest.fixture(scope="module")
def slope(tmp_path_factory):
    """A plan.json that holds the height field of a plane of 40 degrees."""
    scenario = Scenario()
    x, y = make_grid(scenario.site, 0.26, 10.0)
    h = np.clip(np.tan(np.radians(40.0)) * (x + 4.0), 0.0, 3.0)[:, None] * np.ones(len(y))
    path = tmp_path_factory.mktemp("slope") / "plan.json"
    save_plan(NoPlan("only a field"), HeightField(x, y, h, 0.26), path)
    return path


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    problem, rng = Problem(), np.random.default_rng(0)
    path = tmp_path_factory.mktemp("table") / "responses.csv"
    make_noisy_table(problem.unscale(rng.uniform(-1, 1, (50, 4))), rng, n_validation=10).save(path)
    return path


@pytest.fixture(scope="module")
def preview(slope, table):
    return Preview(Scenario(), slope, table)


def test_the_plan_cuts_the_wanted_volume_and_can_be_executed(preview, tmp_path):
    shown = preview.describe(StrategyConfig(alpha=0.8, beta=0.5))
    data = json.loads(json.dumps(shown.to_dict()))["plan"]
    assert data["volume_m3"] == pytest.approx(data["volume_wanted_m3"], rel=0.01)
    assert data["slope_deg"] == pytest.approx(40.0, abs=4.0)
    text = shown.to_text()
    assert f"{data['volume_m3']:.2f} of {data['volume_wanted_m3']:.2f} m3" in text
    paths = shown.save(tmp_path)
    assert [path.name for path in paths] == ["plan.json", "plan.png"]
    assert np.array_equal(load_plan(paths[0])[0].x, shown.plan.x)


def test_a_fuller_bucket_is_pushed_deeper(preview):
    depths = [
        preview.describe(StrategyConfig(alpha=alpha)).to_dict()["plan"]["depth_m"]
        for alpha in (0.4, 0.8, 1.2)
    ]
    assert depths == sorted(depths)
    assert depths[0] < depths[-1]


def test_the_prediction_is_the_surrogate_s_with_its_verdict(preview):
    predicted = preview.describe(StrategyConfig(alpha=1.3, beta=0.85, gamma=1.0, kappa=0.6)).to_dict()[
        "predicted"
    ]
    assert predicted["strategy"] == {"alpha": 1.3, "beta": 0.85, "gamma": 1.0, "kappa": 0.6}
    assert predicted["objectives"]["production"] > 0.0
    assert predicted["verdict"]["fit"] in ("good", "rough", "unfit")


def test_no_pile_is_no_plan(tmp_path):
    x, y = make_grid(Scenario().site, 0.26, 10.0)
    path = tmp_path / "plan.json"
    save_plan(NoPlan("nothing there"), HeightField(x, y, np.zeros((len(x), len(y))), 0.26), path)
    shown = Preview(Scenario(), path).describe(StrategyConfig())
    assert shown.to_dict()["plan"] is None
    assert "holds any pile" in shown.to_text()


def test_a_source_that_is_none_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"heights\.txt: a pile \(\.npz\) or a plan \(\.json\)"):
        Preview(Scenario(), tmp_path / "heights.txt")


def test_a_study_of_other_variables_is_refused(slope, tmp_path):
    problem = Problem.model_validate({"variables": [{"name": "speed", "low": 0, "high": 1}]})
    X = np.linspace(0.0, 1.0, 12)[:, None]
    rows = "\n".join(f"p{i},sample,{x[0]},{x[0]},1,{x[0]}" for i, x in enumerate(X))
    (tmp_path / "responses.csv").write_text("point,role,speed,production,damage,debris\n" + rows + "\n")
    (tmp_path / "study.json").write_text(json.dumps({"problem": problem.model_dump(mode="json")}))
    preview = Preview(Scenario(), slope, tmp_path)
    with pytest.raises(InputError, match="a point needs exactly speed; got nothing"):
        preview.describe(StrategyConfig())


@pytest.fixture
def address(preview):
    with make_server(preview) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()
        thread.join()


def fetch(address):
    with urllib.request.urlopen(address, timeout=20) as response:
        return response.read().decode()


def test_the_server_answers_plans_and_refuses_the_rest(address, preview):
    data = json.loads(fetch(f"{address}plan?alpha=0.8&beta=0.5"))
    assert data == json.loads(json.dumps(preview.describe(StrategyConfig(alpha=0.8, beta=0.5)).to_dict()))
    for query in ("plan?alpha=9", "plan?alpha=x", "plan?speed=1"):
        with pytest.raises(urllib.error.HTTPError) as error:
            fetch(address + query)
        assert error.value.code == 400
        assert json.loads(error.value.read())["error"]
    with pytest.raises(urllib.error.HTTPError, match="404"):
        fetch(f"{address}other")


LOOK = """(async () => {
  while (busy) await new Promise((done) => setTimeout(done, 20));
  const text = (id) => document.getElementById(id).textContent;
  const rows = (id) => Object.fromEntries(
    [...document.querySelectorAll(`#${id} tr`)].map((r) => [...r.cells].map((c) => c.textContent)));
  return { numbers: rows("numbers"), predicted: rows("predicted"), verdict: text("verdict"), message: text("message"),
    circles: document.querySelectorAll("circle").length,
    values: [...document.querySelectorAll("#sliders b")].map((b) => Number(b.textContent)),
    swept: document.querySelectorAll("#side polygon").length, cells: document.querySelectorAll("#top rect").length };
})()"""


def slide(name, value):
    return act(f"#sliders input[name={name}]", "input", value)


def test_the_page_shows_the_plan_and_its_sliders_act(address, preview):
    strategies = {
        "first": preview.scenario.loading.strategy,
        "moved": StrategyConfig(alpha=0.5, beta=0.9, gamma=0.2, kappa=0.4),
        "greedy": StrategyConfig(alpha=2.0, beta=0.0, gamma=0.2, kappa=0.4),
    }
    steps = {
        "first": "",
        "moved": "".join(slide(name, value) for name, value in strategies["moved"].model_dump().items()),
        "greedy": slide("alpha", 2.0) + slide("beta", 0.0),
    }
    seen = visit(address, steps, LOOK, ready="document.body.dataset.shown")
    assert seen["faults"] == []
    for name, strategy in strategies.items():
        data, shown = preview.describe(strategy).to_dict(), seen[name]
        plan, predicted = data["plan"], data["predicted"]
        assert shown["values"] == pytest.approx(list(strategy.model_dump().values()), abs=0.006)
        assert (
            shown["numbers"]["cut / wanted"] == f"{plan['volume_m3']:.2f} / {plan['volume_wanted_m3']:.2f} m³"
        )
        assert shown["numbers"]["push"] == f"{plan['depth_m']:.2f} m"
        assert shown["numbers"]["slope at the entry"] == f"{plan['slope_deg']:.0f}°"
        assert bool(shown["message"]) == (not plan["volume_reached"])
        assert predicted["verdict"]["title"] in shown["verdict"]
        for objective, value in predicted["objectives"].items():
            if value is None:
                assert shown["predicted"][objective] == "not known"
            else:
                assert float(shown["predicted"][objective].split(" ± ")[0]) == pytest.approx(value, rel=1e-3)
        assert (shown["circles"], shown["swept"]) == (5, 2)
        assert shown["cells"] > 100
