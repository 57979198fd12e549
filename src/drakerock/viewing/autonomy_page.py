"""A sequence of autonomous loadings as one HTML page: what was seen, what was chosen and why, what came of it."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from drakerock.errors import InputError
from drakerock.files import read_json, write_text
from drakerock.loading.field import HeightField
from drakerock.loading.folder import OUTCOME, PLAN, REPLAY
from drakerock.loading.plan import DigPlan
from drakerock.loading.plan_file import load_plan

DECISION = "decision.json"
PAGE = "autoload.html"


def write_autonomy_page(folder: str | Path) -> Path:
    """Write `autoload.html` of a sequence's folder; the page opens without a network.

    Raises:
        InputError: no autonomous loading there, or files that cannot be read.
    """
    folder = Path(folder)
    places = [path.parent for path in sorted(folder.glob(f"loading_*/{DECISION}"))]
    if not places:
        raise InputError(f"{folder}: no autonomous loading is there; `drakerock autoload` makes some")
    about = read_json(folder / "autoload.json") if (folder / "autoload.json").exists() else {}
    loadings = [_read_loading(place) for place in places]
    names = list(dict.fromkeys(name for item in loadings for name in item["came"]))
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("drakerock.viewing", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["number"] = _format
    text = environment.get_template("autonomy.html.jinja").render(
        title=f"Autonomous loading: {folder.resolve().name}",
        about=about,
        loadings=loadings,
        objectives=names,
        means=_average(loadings, names),
        data=json.dumps([{**item, "scan": ""} for item in loadings]).replace("<", "\\u003c"),
    )
    path = folder / PAGE
    write_text(path, text)
    return path


def _read_loading(place: Path) -> dict[str, Any]:
    """Return what a loading's row shows."""
    decision = read_json(place / DECISION, "a readable decision")
    outcome = read_json(place / OUTCOME, "a readable outcome") if (place / OUTCOME).exists() else None
    replay = f"{place.name}/{REPLAY}" if (place / REPLAY).exists() else ""
    scan = ""
    if (place / PLAN).exists():
        plan, field = load_plan(place / PLAN)
        scan = base64.b64encode(draw_scan(field, plan if isinstance(plan, DigPlan) else None)).decode()
    failed = outcome is not None and outcome.get("status") == "failed"
    objectives = {} if outcome is None or failed else outcome["objectives"]
    predicted = decision.get("predicted") or {}
    return {
        "name": place.name,
        "number": decision.get("number", 0) + 1,
        "choice": decision["choice"],
        "fell_back": decision["fell_back"],
        "preference": decision["preference"],
        "strategy": decision["strategy"],
        "reasons": decision["reasons"],
        "hazards": decision["hazards"],
        "novelty": decision["novelty"],
        "cleaned_kg": decision.get("cleaned_kg"),
        "predicted": predicted,
        "came": {name: objectives.get(name) for name in dict.fromkeys([*predicted, *objectives])},
        "ended": "" if outcome is None else outcome["reason"],
        "failed": failed,
        "events": [] if outcome is None else [item["event"] for item in outcome.get("events") or ()],
        "replay": replay,
        "scan": scan,
    }


def draw_scan(field: HeightField, plan: DigPlan | None) -> bytes:
    """Return a height field from above as PNG, with the entry and the depth of the planned push."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.3, 2.2), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    half = 0.5 * field.cell
    extent = (field.x[0] - half, field.x[-1] + half, field.y[0] - half, field.y[-1] + half)
    image = axes.imshow(field.h.T, origin="lower", extent=extent, cmap="cividis", vmin=0.0, aspect="equal")
    figure.colorbar(image, ax=axes, shrink=0.8, label="height [m]")
    pile = np.flatnonzero((field.h > 0.15).any(axis=1))
    left = float(field.x[pile[0]]) if len(pile) else float(field.x[0])
    if plan is not None:
        start, end = float(plan.waypoint_x[0]), float(plan.waypoint_x[1])
        left = min(left, start)
        axes.plot([start - 1.0, max(end, start + 0.2)], [plan.y, plan.y], color="#d2600a", lw=2)
        axes.plot(max(end, start + 0.2), plan.y, ">", color="#d2600a", ms=6)
    axes.set_xlim(left - 1.5, extent[1])
    axes.set_xlabel("x [m]", fontsize=8)
    axes.set_ylabel("y [m]", fontsize=8)
    axes.tick_params(labelsize=7)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _average(loadings: list[dict[str, Any]], names: list[str]) -> dict[str, dict[str, float | None]]:
    """Return by objective the mean of what came, of what was predicted, and the rms error of the latter."""
    means: dict[str, dict[str, float | None]] = {}
    for name in names:
        came = np.array([_get(item["came"].get(name)) for item in loadings])
        told = np.array([_get((item["predicted"].get(name) or {}).get("mean")) for item in loadings])
        both = np.isfinite(came) & np.isfinite(told)
        means[name] = {
            "came": float(np.mean(came[np.isfinite(came)])) if np.isfinite(came).any() else None,
            "predicted": float(np.mean(told[both])) if both.any() else None,
            "rms_error": float(np.sqrt(np.mean((came - told)[both] ** 2))) if both.any() else None,
        }
    return means


def _get(value: float | None) -> float:
    return float("nan") if value is None else value


def _format(value: float | None, digits: int = 3) -> str:
    from drakerock.exploration.problem import format_number

    return "–" if value is None else format_number(value, digits)
