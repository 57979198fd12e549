"""The folder of a loading: one run's at a time, nothing stale in it, nothing of others removed."""

from __future__ import annotations

import pytest

from drakerock.errors import InputError
from drakerock.study.job_folder import LOCK, use_folder


def enter(folder, *, force=False, sequence=False):
    with use_folder(folder, force=force, sequence=sequence):
        pass


def test_used_folder_is_refused_and_force_removes_what_a_loading_wrote(tmp_path):
    mine = tmp_path / "notes.txt"
    for path in (mine, tmp_path / "outcome.json", tmp_path / "figure_side.png", tmp_path / "replay.html"):
        path.write_text("x")
    with pytest.raises(
        InputError, match=r"an earlier loading is there \(outcome.json\); take another folder, or force"
    ):
        enter(tmp_path)
    assert len(list(tmp_path.iterdir())) == 4
    with use_folder(tmp_path, force=True, sequence=False):
        assert {path.name for path in tmp_path.iterdir()} == {"notes.txt", LOCK}
    assert list(tmp_path.iterdir()) == [mine]


def test_folder_is_one_runs_at_a_time(tmp_path):
    with (
        use_folder(tmp_path, force=False, sequence=True),
        pytest.raises(InputError, match="another run is working there"),
    ):
        enter(tmp_path, sequence=True)
    enter(tmp_path, sequence=True)


def test_sequence_goes_on_in_its_folder_and_a_loading_does_not_enter_it(tmp_path):
    (tmp_path / "loading_00").mkdir()
    enter(tmp_path, sequence=True)
    with pytest.raises(InputError, match="a sequence of 1 loadings is there"):
        enter(tmp_path, force=True)
