"""From a stored study that varies one thing at a time to its chart."""

from __future__ import annotations

import json

import pytest

import study_work
from drakerock.config import parse_config
from drakerock.errors import InputError
from drakerock.study.runner import run_study
from drakerock.study.schema import StudyConfig
from drakerock.study.tornado import run_tornado

TEXT = """
loadings: 2
executor: {kind: serial}
variables:
  - {name: alpha, key: loading.strategy.alpha, low: 0.5, high: 1.5}
  - name: depth
    choices: [{label: deep, set: {loading.strategy.beta: 0.1}}, {label: shallow, set: {loading.strategy.beta: 0.9}}]
exploration: {sampling: {design: one_at_a_time, centre: {depth: 0}, n_samples: 4, n_validation: 0}}
"""


def test_a_stored_study_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(study_work, "DURATION", 0.0)
    run_study(parse_config(TEXT, StudyConfig), tmp_path / "store", work="study_work:run")
    rows, paths = run_tornado(tmp_path / "store")
    assert [path.name for path in paths] == ["tornado.json", "tornado.png"]
    assert json.loads(paths[0].read_text()) == json.loads(json.dumps(rows))
    assert paths[1].stat().st_size > 10_000
    found = {(row["variable"], row["objective"]): row for row in rows}
    # The stand-in's production is 100 alpha + 30 beta, and noise of 3.
    low, high = found["alpha", "production"]["changes"]
    assert low == pytest.approx(-50, abs=15)
    assert high == pytest.approx(50, abs=15)
    assert found["depth", "production"]["values"] == ["deep", "shallow"]


def test_another_design_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(study_work, "DURATION", 0.0)
    text = "loadings: 1\nexecutor: {kind: serial}\nexploration: {sampling: {n_samples: 3, n_validation: 0}}"
    run_study(parse_config(text, StudyConfig), tmp_path / "store", work="study_work:run")
    with pytest.raises(InputError, match="needs one_at_a_time"):
        run_tornado(tmp_path / "store")
