"""Writes docs/reference: a page of every key of scenario and study files, from the schemas."""

from __future__ import annotations

from pathlib import Path

from drakerock.loading.scenario import Scenario
from drakerock.study.reference import make_reference
from drakerock.study.schema import StudyConfig

KINDS = {"scenario": Scenario, "study": StudyConfig}


def main() -> None:
    """Write the pages beside this file."""
    folder = Path(__file__).with_name("reference")
    for kind, schema in KINDS.items():
        (folder / f"{kind}.md").write_text(make_reference(schema, kind), encoding="utf-8")
        print(f"wrote {folder / kind}.md")


if __name__ == "__main__":
    main()
