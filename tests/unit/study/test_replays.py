"""Replays of a study's loadings: made on demand, found by the table, linked from the report's folder."""

import pytest

import study_work
from drakerock.config import parse_config
from drakerock.errors import InputError
from drakerock.study.db import Store
from drakerock.study.replays import link_replays, write_study_replays
from drakerock.study.runner import run_study
from drakerock.study.schema import StudyConfig
from drakerock.study.tables import read_responses
from drakerock.study.verify import verify_store
from tests.cycle_files import make_recording, write_cycle

TEXT = """
loadings: 2
executor: {kind: serial}
exploration: {sampling: {n_initial: 2, n_corners: 0, n_samples: 2, n_validation: 1, batch_size: 1}}
"""


@pytest.fixture
def store(tmp_path, monkeypatch, plan, heap, shapes):
    """A study of which one point's loadings have recordings."""
    monkeypatch.setattr(study_work, "DURATION", 0.0)
    run_study(parse_config(TEXT, StudyConfig), tmp_path / "study", work="study_work:run")
    for number in range(2):
        place = tmp_path / f"study/points/s0001/attempt_0/loading_0{number}"
        outcome = (place / "outcome.json").read_text()
        write_cycle(place, plan, make_recording(heap, shapes))
        (place / "outcome.json").write_text(outcome)
    return tmp_path / "study"


def test_replays_are_made_once_and_lead_to_each_other(store):
    pages = write_study_replays(store)
    places = [f"points/s0001/attempt_0/loading_0{number}/replay.html" for number in range(2)]
    assert [page.relative_to(store).as_posix() for page in pages] == places
    assert "../loading_01/replay.html" in pages[0].read_text()
    before = [page.stat().st_mtime_ns for page in pages]
    assert write_study_replays(store) == pages
    assert [page.stat().st_mtime_ns for page in pages] == before
    with Store.open(store) as open_store:
        table = read_responses(open_store)
        assert not [fault for fault in verify_store(open_store) if fault.path.endswith("replay.html")]
    assert dict(zip(table.point, table.replay, strict=True))["s0001"] == places[0]
    linked = link_replays(table, store, store / "report")
    assert dict(zip(linked.point, linked.replay, strict=True))["s0001"] == f"../{places[0]}"
    assert (store / "report" / f"../{places[0]}").resolve().is_file()
    assert sum(bool(address) for address in linked.replay) == 1


def test_addresses_that_are_no_files_there_stay(store, tmp_path):
    with Store.open(store) as open_store:
        table = read_responses(open_store)
    assert set(table.replay) == {""}
    assert link_replays(table, store, tmp_path).replay == table.replay


def test_a_study_without_recordings_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(study_work, "DURATION", 0.0)
    study = parse_config(TEXT, StudyConfig, ["storage.keep=outcomes"])
    run_study(study, tmp_path / "study", work="study_work:run")
    with pytest.raises(InputError, match=r"storage\.keep"):
        write_study_replays(tmp_path / "study")
