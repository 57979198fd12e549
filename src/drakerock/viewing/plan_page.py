"""The page with a slider for each variable of the strategy; `drakerock.study.preview_server` answers it."""

from __future__ import annotations

import json

import jinja2

from drakerock.loading.config import StrategyConfig
from drakerock.loading.field import HeightField


def make_plan_page(field: HeightField, start: StrategyConfig) -> str:
    """Return the page as HTML text; it fetches ``plan?alpha=...`` from where it came from.

    Args:
        field: the pile from above.
        start: where the sliders stand first.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("drakerock.viewing", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    schema = StrategyConfig.model_json_schema()["properties"]
    variables = [
        {
            "name": name,
            "low": part["minimum"],
            "high": part["maximum"],
            "value": getattr(start, name),
            "meaning": part["description"],
        }
        for name, part in schema.items()
    ]
    pile = {
        "x": field.x.round(3).tolist(),
        "y": field.y.round(3).tolist(),
        "h": field.h.round(3).tolist(),
        "cell": field.cell,
    }
    return environment.get_template("plan_page.html.jinja").render(variables=variables, pile=json.dumps(pile))
