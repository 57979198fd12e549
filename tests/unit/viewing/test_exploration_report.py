import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from drakerock.exploration.analysis import explore
from drakerock.exploration.config import (
    Bound,
    ExplorationConfig,
    ParetoConfig,
    SensitivityConfig,
    SurrogateConfig,
)
from drakerock.exploration.confirmation import confirm_points
from drakerock.exploration.problem import Objective, Problem, Variable
from drakerock.exploration.problems import make_noisy_loading, make_noisy_table
from drakerock.exploration.strategy import choose_strategy
from drakerock.exploration.table import ResponseTable
from drakerock.viewing.exploration_figures import (
    draw_front,
    draw_literally,
    draw_nested_contours,
    make_figures,
)
from drakerock.viewing.report import make_report, write_report
from tests.browsers import act, visit

QUICK = ExplorationConfig(
    surrogate=SurrogateConfig(n_starts=4),
    pareto=ParetoConfig(population=40, evaluations=1600, n_draws=8),
    sensitivity=SensitivityConfig(n_base=64),
)
KNOWN = make_noisy_loading()


def explore_noisy():
    rng = np.random.default_rng(0)
    X = KNOWN.problem.unscale(rng.uniform(-1, 1, (60, 4)))
    table = make_noisy_table(X, rng, n_loadings=6, n_validation=12)
    table = replace(
        table,
        replay=("replays/p000.html",) + ("",) * 59,
        n_failed=(1,) + (0,) * 59,
        failure=("stuck </script><b>at 3 s",) + ("",) * 59,
        provenance={"name": "trial", "scenario_hash": "0123abcd"},
    )
    exploration = explore(table, QUICK)

    def simulate(x):
        if x[0] > 1.5:
            raise RuntimeError("no")
        return KNOWN.evaluate(x[None])[0], np.ones(3)

    return replace(
        exploration, confirmation=confirm_points(exploration.surrogate, exploration.front.X[:4], simulate)
    )


@pytest.fixture(scope="module")
def exploration():
    return explore_noisy()


@pytest.fixture(scope="module")
def figures_of_pyplot():
    """The figures that pyplot knows, before and after the report is written."""
    return []


@pytest.fixture(scope="module")
def written(exploration, figures_of_pyplot, tmp_path_factory):
    figures_of_pyplot.append(pyplot.get_fignums())
    paths = write_report(exploration, tmp_path_factory.mktemp("report"), "Trial <1>")
    figures_of_pyplot.append(pyplot.get_fignums())
    return paths


class Links(HTMLParser):
    """Collects everything a page would fetch, and its texts outside scripts."""

    def __init__(self, page):
        super().__init__()
        self.links, self.text, self._open = [], [], []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self._open.append(tag)
        values = dict(attrs)
        self.links += [values[key] for key in ("src", "href") if key in values]

    def handle_endtag(self, tag):
        while self._open and self._open.pop() != tag:
            pass

    def handle_data(self, data):
        if not {"script", "style"} & set(self._open):
            self.text.append(data)


def test_report_needs_nothing_but_itself(written):
    page = Links(written[0].read_text(encoding="utf-8"))
    outside = [link for link in page.links if not link.startswith(("data:", "#"))]
    assert outside == ["replays/p000.html"], "the one link outside is the replay of a point"
    images = [link for link in page.links if link.startswith("data:image/png")]
    assert len(images) == 9  # three maps, front, coverage, predicted, sensitivity, convergence, confirmation


def test_report_tells_the_numbers(written, exploration):
    text = " ".join(" ".join(Links(written[0].read_text(encoding="utf-8")).text).split())
    knee = exploration.strategies["knee"]
    assert "Trial <1>" in text
    assert exploration.verdict.title in text
    assert exploration.verdict.judgements[1].to_text() in text
    assert f"{knee.x[0]:.3f}" in text
    assert f"{knee.y[0]:.4g}" in text
    assert "stuck </script><b>at 3 s" in text, "reasons of failures are shown as they are, and are no HTML"
    assert "0123abcd" in text
    assert "RuntimeError: no" in text or all(exploration.confirmation.X[:, 0] <= 1.5)
    assert "48 + 12" in text
    assert "360" in text  # loadings
    for name in KNOWN.problem.objective_names:
        assert name in text
    assert "nan" not in text.lower().split()


def test_summary_and_front_are_the_exploration_s(written, exploration):
    summary = json.loads(written[1].read_text())
    assert summary["points"] == {"sample": 48, "validation": 12}
    assert summary["loadings"] == {"run": 360, "failed": 1}
    assert summary["strategies"]["knee"]["strategy"]["alpha"] == pytest.approx(
        exploration.strategies["knee"].x[0]
    )
    data = np.genfromtxt(written[2], delimiter=",", names=True)
    assert data["production"] == pytest.approx(exploration.front.Y[:, 0], rel=1e-6)
    assert data["p_optimal"] == pytest.approx(exploration.front.uncertainty.p_optimal)


def test_every_figure_is_there_as_png_and_pdf(written):
    names = {path.name for path in written[3:]}
    stems = {"contours_production", "contours_damage", "contours_debris", "pareto", "coverage", "predicted",
             "sensitivity", "convergence", "confirmation"}  # fmt: skip
    assert names == {f"{stem}.{suffix}" for stem in stems for suffix in ("png", "pdf")}
    for path in written[3:]:
        assert path.read_bytes()[:4] in (b"\x89PNG", b"%PDF")


def test_equal_explorations_give_equal_bytes(exploration, written, tmp_path):
    again = write_report(exploration, tmp_path, "Trial <1>")
    for first, second in zip(written, again, strict=True):
        assert first.read_bytes() == second.read_bytes(), first.name


# What the page shows: the strategy beside the sliders, the front points within the bounds, what is drawn.
LOOK = """({
  index: Number(document.getElementById("shown").dataset.index),
  name: document.getElementById("shown-name").textContent,
  rows: Object.fromEntries(
    [...document.querySelectorAll("#shown tr")].map((r) => [...r.cells].map((c) => c.textContent))),
  inside: document.getElementById("inside").textContent,
  weights: [...document.querySelectorAll("#weights label")].map((l) => l.lastElementChild.textContent),
  bounds: [...document.querySelectorAll("#bounds label")].map((l) => l.lastElementChild.textContent),
  projections: document.querySelectorAll("#explorer .cartesianlayer .subplot").length,
  pictures: [...document.images].filter((i) => i.naturalWidth > 100).length,
  links: [...document.querySelectorAll("nav a")].filter((a) => !document.querySelector(a.getAttribute("href"))).length,
})"""


def slide(box, j, value):
    return act(f"#{box} label:nth-child({j + 1}) input", "input", value)


@pytest.fixture(scope="module")
def seen(written):
    """What a visit of the page shows."""
    steps = {
        "first": "",
        "production": slide("weights", 0, 1.0) + slide("weights", 1, 0.0) + slide("weights", 2, 0.0),
        "uneven": slide("weights", 0, 0.6) + slide("weights", 1, 0.2) + slide("weights", 2, 0.2),
        "bounded": slide("bounds", 2, 0.3),
        "impossible": "".join(slide("bounds", j, 0.0) for j in range(3)),
        "clicked": "plot.emit('plotly_click', {points: [{customdata: points.findIndex((p) => p.replay)}]})",
    }
    return visit(written[0], steps, LOOK)


def test_page_opens_without_faults(seen, exploration):
    assert seen["faults"] == []
    assert seen["first"]["projections"] == 3
    assert seen["first"]["pictures"] >= 8
    assert seen["first"]["links"] == 0, "the page's own links lead somewhere"


@pytest.mark.parametrize(
    ("step", "weights", "bound"),
    [
        ("first", (1.0, 1.0, 1.0), None),
        ("production", (1.0, 0.0, 0.0), None),
        ("uneven", (0.6, 0.2, 0.2), None),
        ("bounded", (0.6, 0.2, 0.2), 0.3),
    ],
)
def test_sliders_choose_as_choose_strategy_does(seen, exploration, step, weights, bound):
    front, problem, bounds = exploration.front, KNOWN.problem, []
    if bound is not None:
        value = float(f"{front.ideal[2] + bound * (front.nadir[2] - front.ideal[2]):.3g}")
        bounds = [Bound(objective="debris", relation="<=", value=value)]
        assert float(seen[step]["bounds"][2]) == value
    chosen = choose_strategy(front, dict(zip(problem.objective_names, weights, strict=True)), bounds)
    assert seen[step]["index"] == chosen.index
    assert [float(text) for text in seen[step]["weights"]] == pytest.approx(
        np.array(weights) / sum(weights), abs=0.006
    )
    for variable, x in zip(problem.variables, chosen.x, strict=True):
        assert float(seen[step]["rows"][f"{variable.name} ({variable.label})"]) == pytest.approx(x, abs=6e-4)
    for objective, y in zip(problem.objectives, chosen.y, strict=True):
        assert float(seen[step]["rows"][objective.name].split(" ± ")[0]) == pytest.approx(y, rel=6e-4)


def test_bounds_that_nothing_keeps_are_said(seen):
    assert "No front point keeps these bounds" in seen["impossible"]["inside"]
    assert re.fullmatch(r"\d+ of \d+ front points keep the bounds\.", seen["bounded"]["inside"])


def test_a_point_that_is_clicked_is_shown_with_its_replay(seen, exploration):
    assert seen["clicked"]["name"] == f"sample {exploration.table.point[0]}"
    assert seen["clicked"]["rows"]["replay"] == "open"
    shown = float(seen["clicked"]["rows"]["production"].split(" ± ")[0])
    assert shown == pytest.approx(exploration.table.Y[0, 0], rel=6e-4)


@pytest.mark.parametrize(("d", "k"), [(1, 1), (2, 1), (3, 4), (10, 2)])
def test_other_numbers_of_variables_and_objectives(d, k):
    problem = Problem(
        variables=tuple(Variable(name=f"x{i}", low=-1, high=1) for i in range(d)),
        objectives=tuple(Objective(name=f"f{i}") for i in range(k)),
    )
    X = np.random.default_rng(0).uniform(-1, 1, (40, d))
    Y = np.stack([((X - 0.5 * np.cos(i)) ** 2).sum(axis=1) for i in range(k)], axis=1)
    exploration = explore(ResponseTable(problem, X, Y), QUICK)
    figures = make_figures(exploration)
    for figure in figures.values():
        figure.draw_without_rendering()
    page = make_report(exploration, dict.fromkeys(figures, b""), "small")
    assert ("pareto" in figures) == (k > 1)
    assert exploration.references == {}
    assert "leave-one-out NRMSE" in page


def test_constant_and_missing_responses():
    X = KNOWN.problem.unscale(np.random.default_rng(0).uniform(-1, 1, (30, 4)))
    Y = KNOWN.evaluate(X)
    Y[:, 1] = 0.0
    Y[:4, 2] = np.nan
    exploration = explore(ResponseTable(KNOWN.problem, X, Y), QUICK)
    figures = make_figures(exploration)
    for figure in figures.values():
        figure.draw_without_rendering()
    page = make_report(exploration, dict.fromkeys(figures, b""), "odd")
    assert "No failures" in page
    assert exploration.sensitivity[1].total.max() == 0.0


def test_nested_contours_show_the_right_cell():
    """A response that depends on the outer variables only is flat in each cell and ordered between them."""
    figure = Figure()
    ax = figure.add_subplot()
    drawn = []

    def predict(X):
        drawn.append(X.copy())
        return np.column_stack([10 * X[:, 2] + X[:, 3], X[:, 0], X[:, 0]])

    draw_nested_contours(ax, predict, KNOWN.problem, 0, np.full(4, 0.5), n_outer=3, n_inner=7)
    assert len(drawn) == 9
    X = np.concatenate(drawn)
    assert X[:, 0].min() == pytest.approx(0.2)
    assert X[:, 0].max() == pytest.approx(2.0)
    assert sorted(np.unique(X[:, 2])) == pytest.approx([0.0, 0.5, 1.0])
    # Within a cell alpha runs along x and beta along y.
    first = drawn[0].reshape(7, 7, 4)
    assert np.ptp(first[0, :, 0]) > 0
    assert np.ptp(first[0, :, 1]) == 0
    assert [t.get_text() for t in ax.get_xticklabels()] == ["0", "0.5", "1"]
    assert "α 0.2 to 2" in ax.get_xlabel()


def test_front_projection_shows_natural_values(exploration):
    figure = Figure()
    ax = figure.add_subplot()
    draw_front(ax, exploration.front, (0, 2))
    offsets = np.vstack([c.get_offsets() for c in ax.collections if c.get_label() == "front"])
    assert np.array_equal(np.asarray(offsets), exploration.front.Y[:, [0, 2]])
    assert ax.get_xlabel() == "production [kg/s]"
    assert offsets[:, 0].min() > 0


def test_maps_read_in_grey():
    """Lightness of the colour map rises evenly from its first to its last colour."""
    from matplotlib import colormaps

    from drakerock.viewing.exploration_figures import COLORMAP

    rgb = colormaps[COLORMAP](np.linspace(0, 1, 64))[:, :3]
    luminance = rgb @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(luminance) > 0)
    assert np.ptp(luminance) > 0.6


def test_figures_leave_no_global_state(written, figures_of_pyplot):
    before, after = figures_of_pyplot
    assert after == before


def render(text, **options):
    figure = Figure(figsize=(2, 0.4))
    canvas = FigureCanvasAgg(figure)
    figure.text(0.05, 0.4, text, **options)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


@settings(deadline=None, max_examples=60)
@given(st.text("$\\{}_^%a b", max_size=12))
def test_any_text_is_drawn_as_it_is(text):
    assert np.array_equal(render(draw_literally(text)), render(text, parse_math=False))


def test_units_and_symbols_are_drawn_and_written_as_they_are():
    """Formulas, broken formulas and HTML in units and symbols are texts in the figures and on the page."""
    odd = ["$_{$", "<b>kg</b>", r"\$x$^$", "$a$ & $b"]
    problem = Problem(
        variables=tuple(Variable(name=f"x{i}", symbol=odd[i], low=-1, high=1, unit=odd[i]) for i in range(4)),
        objectives=tuple(Objective(name=f"f{i}", unit=odd[i], meaning=odd[i]) for i in range(3)),
    )
    X = np.random.default_rng(0).uniform(-1, 1, (40, 4))
    Y = np.stack([((X - 0.5 * np.cos(i)) ** 2).sum(axis=1) for i in range(3)], axis=1)
    links = ("javascript:alert(1)", "http://[", "replays/1.html") + ("",) * 37
    table = ResponseTable(problem, X, Y, replay=links, role=("sample",) * 30 + ("validation",) * 10)
    exploration = explore(table, QUICK)
    exploration = replace(
        exploration,
        confirmation=confirm_points(
            exploration.surrogate, exploration.front.X[:2], lambda x: (np.zeros(3), np.ones(3))
        ),
    )
    figures = make_figures(exploration)
    for figure in figures.values():
        figure.draw_without_rendering()
    assert figures["predicted"].axes[0].get_xlabel() == draw_literally("simulated f0 [$_{$]")
    page = make_report(exploration, dict.fromkeys(figures, b""), "odd $_{$ <i>")
    parsed = Links(page)
    assert [link for link in parsed.links if not link.startswith(("data:", "#"))] == ["replays/1.html"]
    text = " ".join(" ".join(parsed.text).split())
    assert all(symbol in text for symbol in odd)
    explorer = json.loads('"' + re.search(r'"text":"(f1 [^"]*)"', page)[1] + '"')
    assert explorer == "f1 [&lt;b&gt;kg&lt;/b&gt;]", "plotly reads its texts as HTML"


def test_eight_objectives_have_a_report():
    problem = Problem(
        variables=tuple(Variable(name=f"x{i}", low=-1, high=1) for i in range(3)),
        objectives=tuple(Objective(name=f"f{i}") for i in range(8)),
    )
    X = np.random.default_rng(0).uniform(-1, 1, (30, 3))
    Y = np.stack([((X - 0.5 * np.cos(i)) ** 2).sum(axis=1) for i in range(8)], axis=1)
    stages = []
    exploration = explore(
        ResponseTable(problem, X, Y), QUICK, progress=lambda stage, share: stages.append(stage)
    )
    assert list(dict.fromkeys(stages)) == [
        "fitting",
        "validating",
        "searching the front",
        "ranking variables",
    ]
    names = ["pareto", "coverage", "predicted", "sensitivity", "convergence"]
    images = dict.fromkeys([*names, *(f"contours_f{i}" for i in range(8))], b"")
    assert "best f7" in make_report(exploration, images, "eight")
