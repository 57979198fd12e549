"""A packed study goes on elsewhere as it would have here; what is damaged or foreign is refused."""

import io
import json
import shutil
import tarfile

import pytest

import study_work
from drakerock.errors import InputError
from drakerock.files import read_json
from drakerock.study.db import Store
from drakerock.study.packing import MANIFEST, pack_study, unpack_study
from drakerock.study.runner import run_study
from drakerock.study.schema import StudyConfig
from drakerock.study.status import read_status
from drakerock.study.verify import verify_store

STUDY = StudyConfig.model_validate(
    {
        "name": "trial",
        "seed": 3,
        "loadings": 3,
        "executor": {"kind": "serial"},
        "exploration": {
            "sampling": {"n_initial": 4, "n_corners": 0, "n_samples": 7, "n_validation": 1, "batch_size": 2}
        },
    }
)
WORK = "study_work:run"


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(study_work, "DURATION", 0.0)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "store"
    run_study(STUDY, folder, work=WORK)
    return folder


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """A study that was stopped in the middle of a sequence."""
    folder, n = tmp_path_factory.mktemp("part") / "store", 0
    run = study_work.run

    def stop_in_the_ninth_loading(*args, progress, **kwargs):
        def count(loading, stage, time):
            nonlocal n
            n += stage == "approach"
            if n == 9:
                raise KeyboardInterrupt
            progress(loading, stage, time)

        return run(*args, progress=count, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_work, "run", stop_in_the_ninth_loading)
        with pytest.raises(KeyboardInterrupt):
            run_study(STUDY, folder, work=WORK)
    return folder


@pytest.fixture
def packed(interrupted, tmp_path):
    return pack_study(interrupted, tmp_path / "study.tar.xz")


def rewrite(path, change):
    """Write an archive anew, its members as `change` (of a dict of name: bytes) leaves them."""
    with tarfile.open(path) as archive:
        members = {entry.name: archive.extractfile(entry).read() for entry in archive}
    change(members)
    with tarfile.open(path, "w:xz") as archive:
        for name, data in members.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))


@pytest.mark.parametrize(("everything", "plans"), [(False, True), (True, True), (False, False)])
def test_a_packed_study_goes_on_bit_for_bit(interrupted, finished, tmp_path, everything, plans):
    path = pack_study(interrupted, tmp_path / "study.tar.xz", everything=everything, plans=plans)
    folder = unpack_study(path, tmp_path / "elsewhere" / "store")
    with Store.open(folder) as store:
        assert read_status(store)["cycles"]["recorded"] == 8
        assert verify_store(store) == []
    assert bool(list(folder.rglob("signals.bin"))) == everything
    assert bool(list(folder.rglob("plan.json"))) == plans
    run_study(STUDY, folder, work=WORK)
    for name in ("responses.csv", "responses.parquet", "height_fields.parquet"):
        assert (folder / name).read_bytes() == (finished / name).read_bytes()
    with Store.open(folder) as store:
        assert verify_store(store) == []  # nor is the pile that was carried an orphan


def test_the_pile_of_the_next_loading_is_carried_for_open_sequences_only(packed, tmp_path):
    folder = unpack_study(packed, tmp_path / "store")
    assert [path.relative_to(folder).as_posix() for path in folder.rglob("pile_next.npz")] == [
        "points/s0003/attempt_0/loading_01/pile_next.npz"
    ]


def test_a_running_study_is_not_packed(interrupted, tmp_path):
    with (
        Store.create(interrupted, STUDY),
        pytest.raises(InputError, match="another process is running this study"),
    ):
        pack_study(interrupted, tmp_path / "study.tar.xz")
    assert not list(tmp_path.iterdir())


def test_a_study_that_lacks_a_file_is_not_packed(interrupted, tmp_path):
    folder = shutil.copytree(interrupted, tmp_path / "copy")
    (folder / "points/s0001/attempt_0/loading_01/outcome.json").unlink()
    with pytest.raises(InputError, match=r"loading_01/outcome\.json: is recorded but not there"):
        pack_study(folder, tmp_path / "study.tar.xz")
    assert [path.name for path in tmp_path.iterdir()] == ["copy"]


def test_it_is_unpacked_into_an_empty_folder_only(packed, tmp_path):
    place = tmp_path / "used"
    place.mkdir()
    (place / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="not an empty folder"):
        unpack_study(packed, place)
    assert (place / "mine.txt").read_text() == "mine"


def change_outcome(members):
    name = next(name for name in members if name.endswith("outcome.json"))
    members[name] = members[name].replace(b"1", b"2")


def set_version(members):
    members[MANIFEST] = json.dumps(json.loads(members[MANIFEST]) | {"version": 99}).encode()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (change_outcome, "damaged: points/.*outcome.json is not as it was packed"),
        (lambda members: members.pop("study.db"), "1 files are missing, study.db is the first"),
        (lambda members: members.pop(MANIFEST), "not a packed study"),
        (lambda members: members.update({"notes.txt": b"x"}), "notes.txt: not a file of a packed study"),
        (set_version, r"newer version \(99"),
        (lambda members: members.update({MANIFEST: b"[]"}), "not a packed study"),
        (lambda members: members.update({MANIFEST: b"{"}), "not a readable packed study"),
    ],
)
def test_what_is_damaged_or_foreign_is_refused_whole(packed, tmp_path, change, message):
    rewrite(packed, change)
    with pytest.raises(InputError, match=message):
        unpack_study(packed, tmp_path / "store")
    assert [path.name for path in tmp_path.iterdir()] == [packed.name]


def test_a_cut_file_and_none_are_refused(packed, tmp_path):
    packed.write_bytes(packed.read_bytes()[:500])
    with pytest.raises(InputError, match="not a readable packed study"):
        unpack_study(packed, tmp_path / "store")
    with pytest.raises(InputError, match="no such file"):
        unpack_study(tmp_path / "nothing.tar.xz", tmp_path / "store")


def test_the_same_study_packs_to_the_same_bytes(interrupted, packed, tmp_path):
    assert pack_study(interrupted, tmp_path / "again.tar.xz").read_bytes() == packed.read_bytes()
    assert read_json(interrupted / "study.json")["name"] == "trial"
