"""A scan's keys from their own file, and the survey of a small heap against the heap itself."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh

from drakerock.errors import InputError
from drakerock.loading.scenario import load_scenario
from drakerock.npz import load_arrays
from drakerock.rocks.state import save_pile
from drakerock.rocks.surveying.cloud import read_cloud
from drakerock.study.survey import make_scan_overrides, write_survey


def test_alignment_in_its_own_file(tmp_path):
    path = tmp_path / "align.yaml"
    path.write_text("unit: mm\nrotation_deg: [0, 0, 90]\n")
    scenario = load_scenario(
        overrides=["pile.rocks=300", *make_scan_overrides(tmp_path / "a scan.ply", path)]
    )
    scan = scenario.pile.scan
    assert scan is not None
    assert (scan.file, scan.unit, scan.rotation_deg) == (str(tmp_path / "a scan.ply"), "mm", (0, 0, 90))
    # A scan stands instead of what else the scenario says of its pile's origin.
    assert scenario.pile.rocks is None
    path.write_text("untis: mm\n")
    with pytest.raises(InputError, match="did you mean 'unit'"):
        make_scan_overrides(tmp_path / "a.ply", path)
    with pytest.raises(InputError, match="stands instead of"):
        load_scenario(overrides=["pile.rocks=300", 'pile.scan={"file": "a.ply"}'])


def test_a_surveyed_heap_is_the_heap(tmp_path, heap):
    save_pile(heap, tmp_path / "heap.npz")
    scenario = load_scenario(overrides=[f"pile.source={json.dumps(str(tmp_path / 'heap.npz'))}"])
    summary, paths = write_survey(scenario, tmp_path / "out", lambda *_args, **_keys: None)
    names = {path.name for path in paths}
    assert {"cloud.ply", "height.npz", "true_height.npz", "rocks.ply", "survey.json"} <= names
    assert len(read_cloud(tmp_path / "out" / "cloud.ply")) == summary["points"]
    rocks = trimesh.load(tmp_path / "out" / "rocks.ply")
    assert rocks.bounds[1][2] == pytest.approx(heap.p_WRs[:, 2].max() + 0.15, abs=0.08)
    _, field = load_arrays(tmp_path / "out" / "true_height.npz", "drakerock-height-field", 1)
    x, y = np.meshgrid(field["x"], field["y"], indexing="ij")
    high = field["h"] > 0.4
    assert high.any()
    # The heap is at x -1.6 to -0.9, y -0.6 to 0.6.
    assert (np.abs(x[high] + 1.25) < 0.6).all()
    assert (np.abs(y[high]) < 0.8).all()
