"""The pages of all keys are those of the schemas, and name every key."""

from __future__ import annotations

from pathlib import Path

import pytest

from drakerock.config import make_json_schema
from drakerock.loading.scenario import Scenario
from drakerock.study.reference import make_reference
from drakerock.study.schema import StudyConfig

FOLDER = Path(__file__).parents[3] / "docs" / "reference"


@pytest.mark.parametrize(("kind", "schema"), [("scenario", Scenario), ("study", StudyConfig)])
def test_page_is_up_to_date_and_has_every_key(kind, schema):
    page = (FOLDER / f"{kind}.md").read_text(encoding="utf-8")
    assert page == make_reference(schema, kind), "python docs/make_reference.py"
    body = make_json_schema(schema, "")
    for part in (body, *body["$defs"].values()):
        for key in part.get("properties", {}):
            assert f"| `{key}` |" in page
