"""The report of an exploration: one self-contained HTML page, readable without network and on paper."""

from __future__ import annotations

import base64
import html
import json
from importlib.metadata import version
from itertools import combinations
from pathlib import Path
from statistics import NormalDist
from typing import Any
from urllib.parse import urlsplit

import jinja2
import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from drakerock.exploration.analysis import Exploration, summarize
from drakerock.exploration.problem import Array, format_number
from drakerock.files import make_folder, write_text
from drakerock.viewing.exploration_figures import make_figures, save_figures

_CAPTIONS = {
    "contours": """{name}: the surrogate over the first two variables inside each cell, the next two
        between cells; any further ones as at the knee.""",
    "pareto": """The Pareto front in each pair of objectives, coloured by the third. K is the knee; 1, 2 and 3
        are the reference strategies. Grey clouds are fronts of draws of the surrogate: where it may lie.""",
    "coverage": "Sample and validation points in each pair of variables.",
    "predicted": """Predicted against simulated. Bars are one standard deviation of the difference. No model
        gets below the noise floor, the validation points' own standard error.""",
    "sensitivity": """Sobol' indices on the surrogate with intervals: what a variable explains alone (first
        order) and with its interactions (total).""",
    "convergence": """Left: hypervolume of the front during the search; each draw of the surrogate has its own
        best points, so their band tends to lie above. Right: what more sample points brought.""",
    "confirmation": "Front points simulated again, against what the surrogate said.",
}
# Versions of what the numbers depend on.
_PACKAGES = ("drakerock", "numpy", "scipy", "scikit-learn", "pymoo", "openturns", "SALib")


def write_report(exploration: Exploration, out: Path, title: str = "Exploration") -> list[Path]:
    """Write `report.html`, `summary.json`, `pareto.csv` and `figures/*.png|pdf` into the folder `out`.

    Returns the paths, the report first. Equal explorations give equal bytes.
    """
    make_folder(out)
    pictures = save_figures(make_figures(exploration), out / "figures")
    images = {path.stem: path.read_bytes() for path in pictures if path.suffix == ".png"}
    report, summary, pareto = out / "report.html", out / "summary.json", out / "pareto.csv"
    write_text(report, make_report(exploration, images, title))
    write_text(summary, json.dumps(summarize(exploration), indent=2) + "\n")
    write_text(pareto, _make_csv(exploration))
    return [report, summary, pareto, *pictures]


def make_report(exploration: Exploration, images: dict[str, bytes], title: str) -> str:
    """Return the report as HTML text, scripts and images (PNG, by the names of `make_figures`) inlined."""
    table, problem = exploration.table, exploration.table.problem
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("drakerock.viewing", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = _format
    environment.filters["pm"] = _format_spread
    environment.filters["link"] = _find_link
    failures = [i for i in range(len(table)) if table.n_failed[i] or table.failure[i]]
    return environment.get_template("report.html.jinja").render(
        title=title,
        e=exploration,
        problem=problem,
        summary=summarize(exploration),
        figures={name: base64.b64encode(image).decode() for name, image in images.items()},
        captions={name: _caption(name) for name in images},
        explorer=_make_explorer(exploration) if len(problem.objectives) > 1 else None,
        plotlyjs=get_plotlyjs() if len(problem.objectives) > 1 else "",
        points=_embed(_list_points(exploration)),
        front=_embed(_list_front(exploration)),
        failures=failures,
        provenance=json.dumps(dict(table.provenance), indent=2, ensure_ascii=False)
        if table.provenance
        else "",
        settings=json.dumps(exploration.config.model_dump(mode="json"), indent=2),
        versions={name: version(name) for name in _PACKAGES},
    )


def _make_explorer(exploration: Exploration) -> str:
    """Return the interactive projections as HTML; `customdata` is a point's place in the embedded list."""
    problem, front = exploration.table.problem, exploration.front
    k = len(problem.objectives)
    pairs = list(combinations(range(k), 2))[:6]
    columns = min(3, len(pairs))
    rows = -(-len(pairs) // columns)
    figure = make_subplots(rows, columns, horizontal_spacing=0.09, vertical_spacing=0.16)
    points = _list_points(exploration)
    groups = {
        "simulated": (
            "simulated",
            {"symbol": "x-thin", "size": 6, "line": {"width": 1, "color": "#9aa1a8"}},
        ),
        "confirmed": ("confirmed", {"symbol": "square-open", "size": 10, "color": "#1b2a41"}),
        "reference": ("reference strategy", {"symbol": "diamond-open", "size": 11, "color": "#b5400b"}),
        "front": ("Pareto front (predicted)", {"symbol": "circle", "size": 7}),
    }
    for index, (x, y) in enumerate(pairs):
        row, column = divmod(index, columns)
        rest = [i for i in range(k) if i not in (x, y)]
        for kind, (label, style) in groups.items():
            members = [
                i for i, point in enumerate(points) if point["kind"] == kind and None not in point["y"]
            ]
            if not members:
                continue
            marker: dict[str, Any] = dict(style)
            if kind == "front":
                shade = rest[0] if rest else x
                marker |= {
                    "color": front.Y[:, shade].tolist(),
                    "colorscale": "Cividis",
                    "line": {"width": 0.5, "color": "#1b2a41"},
                }
                if rest:
                    plane = figure.get_subplot(row + 1, column + 1)
                    low, high = plane.xaxis.domain
                    marker["colorbar"] = {
                        "orientation": "h",
                        "thickness": 9,
                        "len": high - low,
                        "x": (low + high) / 2,
                        "xanchor": "center",
                        "y": plane.yaxis.domain[1] + 0.01,
                        "yanchor": "bottom",
                        "title": {
                            "text": html.escape(problem.objectives[shade].label),
                            "side": "top",
                            "font": {"size": 11},
                        },
                        "tickfont": {"size": 10},
                    }
            figure.add_trace(
                go.Scatter(
                    x=[points[i]["y"][x] for i in members],
                    y=[points[i]["y"][y] for i in members],
                    customdata=members,
                    mode="markers",
                    marker=marker,
                    name=label,
                    legendgroup=kind,
                    showlegend=index == 0,
                    hovertemplate="%{x:.4g}, %{y:.4g}<extra>" + label + "</extra>",
                ),
                row + 1,
                column + 1,
            )
        figure.add_trace(
            go.Scatter(
                x=[None], y=[None], mode="markers", hoverinfo="skip", showlegend=False, name="shown point",
                marker={"symbol": "circle-open", "size": 17, "color": "#b5400b", "line": {"width": 3}},
            ),
            row + 1, column + 1,
        )  # fmt: skip
        place = {"row": row + 1, "col": column + 1}
        # plotly pushes an axis title clear of tick labels only where they meet: an annotation stays put.
        figure.add_annotation(
            text=html.escape(problem.objectives[x].label),
            xref="x domain",
            yref="y domain",
            x=0.5,
            y=0.0,
            yshift=-40,
            showarrow=False,
            font={"size": 14},
            **place,
        )
        figure.update_yaxes(title_text=html.escape(problem.objectives[y].label), title_standoff=4, **place)
    figure.update_layout(
        template="plotly_white",
        height=430 * rows,
        margin={"l": 55, "r": 15, "t": 70, "b": 85},
        legend={"orientation": "h", "y": -0.17 / rows, "x": 0.5, "xanchor": "center", "yanchor": "top"},
        font={"size": 12},
        hovermode="closest",
    )
    buttons = [["zoom2d", "pan2d", "resetScale2d", "toImage"]]
    page: str = figure.to_html(
        full_html=False,
        include_plotlyjs=False,
        div_id="explorer",
        config={"displaylogo": False, "responsive": True, "modeBarButtons": buttons},
    )
    return page


def _list_points(exploration: Exploration) -> list[dict[str, Any]]:
    """Return everything that can be pointed at: design point, objectives, spread, replay."""
    table, front = exploration.table, exploration.front

    def entry(
        kind: str, name: str, x: Array, y: Array, std: Array, p: float | None, replay: str
    ) -> dict[str, Any]:
        return {
            "kind": kind,
            "name": name,
            "x": [round(float(v), 6) for v in x],
            "y": [_significant(v) for v in y],
            "std": [_significant(v) for v in std],
            "p": p,
            "replay": _find_link(replay),
        }

    points = []
    for i in range(len(front)):
        p = float(front.uncertainty.p_optimal[i]) if front.uncertainty else None
        points.append(entry("front", f"front point {i}", front.X[i], front.Y[i], front.std[i], p, ""))
    for i in range(len(table)):
        name = f"{table.role[i]} {table.point[i]}"
        points.append(entry("simulated", name, table.X[i], table.Y[i], table.noise[i], None, table.replay[i]))
    for name, (x, y, std) in exploration.references.items():
        points.append(entry("reference", f"{name} (predicted)", x, y, std, None, ""))
    if exploration.confirmation is not None:
        c = exploration.confirmation
        for i, x in enumerate(c.X):
            points.append(
                entry("confirmed", f"confirmed point {i}", x, c.simulated[i], c.simulated_se[i], None, "")
            )
    return points


def _list_front(exploration: Exploration) -> dict[str, Any]:
    """Return what the page's own choice of a strategy needs: regrets, names and units."""
    problem = exploration.table.problem
    return {
        "regret": [[round(float(v), 9) for v in row] for row in exploration.front.calc_regret()],
        "variables": [
            {"name": v.name, "label": v.label, "unit": "" if v.unit == "-" else v.unit}
            for v in problem.variables
        ],
        "objectives": [
            {
                "name": o.name,
                "unit": "" if o.unit == "-" else o.unit,
                "sign": o.sign,
                "best": _significant(best),
                "worst": _significant(worst),
                "fit": judgement.grade.name.lower(),
            }
            for o, best, worst, judgement in zip(
                problem.objectives,
                exploration.front.ideal,
                exploration.front.nadir,
                exploration.verdict.judgements,
                strict=True,
            )
        ],
        # Of a bound that is to hold with 90 %, in standard deviations.
        "margin": round(NormalDist().inv_cdf(0.9), 6),
    }


def _make_csv(exploration: Exploration) -> str:
    problem, front = exploration.table.problem, exploration.front
    header = [
        *problem.variable_names,
        *problem.objective_names,
        *(f"{name}_std" for name in problem.objective_names),
    ]
    columns = [front.X, front.Y, front.std]
    if front.uncertainty:
        header.append("p_optimal")
        columns.append(front.uncertainty.p_optimal[:, None])
    rows = [",".join(f"{v:.9g}" for v in row) for row in np.hstack(columns)]
    return "\n".join([",".join(header), *rows]) + "\n"


def _caption(name: str) -> str:
    kind, _, rest = name.partition("_")
    return " ".join(_CAPTIONS[kind].format(name=rest).split())


def _embed(data: Any) -> str:
    """Return JSON that can stand inside a script element whatever texts it holds."""
    return json.dumps(data, allow_nan=False).replace("<", "\\u003c")


def _find_link(address: str) -> str:
    """Return the address of a replay if a page may open it: a path, or one of the web; "" otherwise."""
    try:
        return address if urlsplit(address.strip()).scheme in ("", "http", "https", "file") else ""
    except ValueError:
        return ""


def _significant(value: float) -> float | None:
    return float(f"{value:.6g}") if np.isfinite(value) else None


def _format(value: float | None, digits: int = 3) -> str:
    """Return a number for a table; a dash where there is none."""
    return "–" if value is None or not np.isfinite(value) else format_number(value, digits)


def _format_spread(value: float | None, spread: float | None) -> str:
    """Return value ± spread; only the value where no spread is known."""
    known = spread is not None and np.isfinite(spread)
    return _format(value, 4) + (f" ± {_format(spread, 2)}" if known else "")
