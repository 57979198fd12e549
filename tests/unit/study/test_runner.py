"""The runner and the store with the stand-in simulation, in this process."""

import json
import shutil
import subprocess

import numpy as np
import pyarrow.parquet as pq
import pytest

import study_work
from drakerock.config import parse_config
from drakerock.errors import InputError, RunStopped
from drakerock.exploration.table import ResponseTable
from drakerock.loading.field_file import load_height_fields
from drakerock.study import db
from drakerock.study.db import Store
from drakerock.study.executors import make_slurm_cluster
from drakerock.study.resimulation import Resimulation
from drakerock.study.runner import _Runner, run_study
from drakerock.study.schema import SlurmConfig, StudyConfig
from drakerock.study.status import read_status
from drakerock.study.tables import export_tables
from drakerock.study.verify import verify_store

WORK = "study_work:run"
TEXT = """
name: trial
seed: 3
loadings: 4
executor: {kind: serial}
exploration:
  sampling: {n_initial: 6, n_corners: 4, n_samples: 16, n_validation: 3, batch_size: 3}
"""


def make_study(*overrides):
    return parse_config(TEXT, StudyConfig, overrides)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(study_work, "DURATION", 0.0)


@pytest.fixture
def behave(monkeypatch):
    return lambda mode: monkeypatch.setattr(study_work, "MODE", mode)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study") / "store"
    run_study(make_study(), folder, work=WORK)
    return folder


@pytest.fixture
def copy(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "copy")


def test_a_study_runs_to_its_end(finished):
    with Store.open(finished) as store:
        status, points = read_status(store), store.list_points()
        assert verify_store(store) == []
    assert status["complete"]
    assert status["points"] == {"total": 19, "done": 19, "failed": 0, "running": 0, "to_do": 0}
    assert status["cycles"] == {"total": 76, "recorded": 76, "failed": 0}
    assert status["last_run"]["ending"] == "complete"
    assert [p.batch for p in points if p.role == "sample"] == 10 * [0] + 3 * [1] + 3 * [2]


def test_the_table_is_the_means_of_the_outcomes(finished):
    table = ResponseTable.load(finished)
    assert (table.role.count("sample"), table.role.count("validation")) == (16, 3)
    assert set(table.n_loadings) == {4}
    i = table.point.index("s0005")
    values = [
        json.loads((finished / f"points/s0005/attempt_0/loading_{k:02d}/outcome.json").read_text())[
            "objectives"
        ]
        for k in range(4)
    ]
    for j, name in enumerate(table.problem.objective_names):
        assert table.Y[i, j] == pytest.approx(np.mean([value[name] for value in values]))
    assert np.isfinite(table.noise).all()
    assert table.provenance["name"] == "trial"
    loadings = pq.read_table(finished / "loadings.parquet")
    assert loadings.num_rows == 76
    assert len(set(loadings["inputs_hash"].to_pylist())) == 19
    assert {"bucket_mass_kg", "rocks_awake_mean", "cpu_seconds"} <= set(loadings.column_names)


def test_the_height_fields_of_every_loading_are_a_table(finished):
    table = pq.read_table(finished / "height_fields.parquet")
    assert table.num_rows == 76
    row = table.slice(30, 1).to_pylist()[0]
    before, after = load_height_fields(
        finished / f"points/{row['point']}/attempt_0/loading_{row['loading']:02d}/height_fields.npz"
    )
    assert np.allclose(np.reshape(row["h_before"], (row["nx"], row["ny"])), before.h)
    assert np.allclose(np.reshape(row["h_after"], (row["nx"], row["ny"])), after.h)
    assert row["front_mean_m"] < -1.0


def test_costs_are_in_the_status(finished):
    with Store.open(finished) as store:
        status = read_status(store)
    # The stand-in says that each loading took a second.
    assert status["cpu_hours_used"] == pytest.approx(76 / 3600)
    assert status["cpu_hours_left"] == 0.0
    assert status["worker_memory_max_MB"] == 500.0
    assert status["loadings_per_hour"] > 0.0


def test_a_step_does_not_wait_for_the_last_points_and_does_without_their_responses(tmp_path):
    """Whether they have ended or not: the points asked for are the same."""
    study = make_study("exploration.sampling.n_validation=0", "loadings=1")
    run_study(study, tmp_path / "whole", work=WORK)
    with Store.open(tmp_path / "whole") as store:
        whole = [point.x for point in store.list_points()]
        batches = [point.batch for point in store.list_points()]
    assert batches == 10 * [0] + 3 * [1] + 3 * [2]
    for n_ended in (7, 8, 9):
        with Store.create(tmp_path / f"part{n_ended}", study) as store:
            store.add_points("sample", 0, np.array(whole[:10]))
            for number in range(n_ended):
                name = f"s{number + 1:04d}"
                store.begin_sequence(name, 0, study.make_scenario(whole[number]))
                place = store.find_sequence_folder(name, 0)
                study_work.run(study.make_scenario(whole[number]), 1, place)
                store.record_cycles(name, 0, 0, None)
                store.finish_sequence(name, 0, "done")
            asked = _Runner(store, None, WORK)._plan()
        assert [point.name for point in asked] == [f"s{n:04d}" for n in range(n_ended + 1, 14)]
        assert np.array_equal([point.x for point in asked[-3:]], whole[10:13])


def test_running_again_changes_nothing(copy):
    before = (copy / "responses.parquet").read_bytes()
    times = {path: path.stat().st_mtime_ns for path in copy.rglob("outcome.json")}
    run_study(make_study(), copy, work=WORK)
    assert (copy / "responses.parquet").read_bytes() == before
    assert times == {path: path.stat().st_mtime_ns for path in copy.rglob("outcome.json")}


def test_finished_cycles_that_the_database_lacks_are_not_simulated_again(copy):
    before = (copy / "responses.parquet").read_bytes()
    times = {path: path.stat().st_mtime_ns for path in copy.rglob("outcome.json")}
    with Store.create(copy, make_study()) as store, store.transaction() as db:
        db.execute("DELETE FROM cycles WHERE point = 's0004'")
        db.execute("UPDATE sequences SET status = 'running' WHERE point = 's0004'")
        db.execute("UPDATE points SET status = 'running' WHERE point = 's0004'")
    run_study(make_study(), copy, work=WORK)
    assert (copy / "responses.parquet").read_bytes() == before
    assert times == {path: path.stat().st_mtime_ns for path in copy.rglob("outcome.json")}


def test_a_study_can_grow_but_not_change(copy):
    with pytest.raises(InputError, match=r"holds another study \(different: loadings\)"):
        run_study(make_study("loadings=5"), copy, work=WORK)
    more = ("exploration.sampling.n_samples=19", "exploration.sampling.n_validation=5")
    status = run_study(make_study(*more), copy, work=WORK)
    assert status["points"]["done"] == 24
    old, new = ResponseTable.load(copy).select("sample"), ResponseTable.load(copy)
    assert np.array_equal(old.X[:16], new.select("sample").X[:16])


def test_a_study_whose_files_or_program_changed_is_another(tmp_path, monkeypatch):
    model = tmp_path / "machine.sdf"
    model.write_text("<sdf/>")
    known = "scenario.loading.performance.tau_c=1e5"
    study = make_study(f"scenario.machine.model={model}", known)
    Store.create(tmp_path / "store", study).close()
    Store.create(tmp_path / "store", study).close()
    same = shutil.copy(model, tmp_path / "copy.sdf")
    Store.create(tmp_path / "store", make_study(f"scenario.machine.model={same}", known)).close()
    with monkeypatch.context() as patch:
        patch.setattr(db, "RESULTS_REVISION", db.RESULTS_REVISION + 1)
        with pytest.raises(InputError, match=r"another study \(different: results revision\)"):
            Store.create(tmp_path / "store", study)
    model.write_text("<sdf></sdf>")
    with pytest.raises(InputError, match=r"another study \(different: scenario\.machine\.model\)"):
        Store.create(tmp_path / "store", study)


def test_a_store_of_an_earlier_version_can_be_read_not_resumed(copy):
    with Store.create(copy, make_study()) as store, store.transaction() as connection:
        connection.execute("DELETE FROM meta")
        connection.execute("PRAGMA user_version = 1")
    with Store.open(copy) as store:
        assert read_status(store)["complete"]
        assert verify_store(store) == []
    with pytest.raises(InputError, match="made by an earlier version"):
        Store.create(copy, make_study())


def test_grown_and_whole_are_the_same(tmp_path, copy):
    more = ("exploration.sampling.n_samples=19", "exploration.sampling.n_validation=5")
    run_study(make_study(*more), copy, work=WORK)
    run_study(make_study(*more), tmp_path / "whole", work=WORK)
    assert (tmp_path / "whole" / "responses.csv").read_bytes() == (copy / "responses.csv").read_bytes()


def test_inputs_that_changed_are_simulated_anew(copy, monkeypatch):
    with Store.create(copy, make_study()) as store, store.transaction() as db:
        db.execute("UPDATE sequences SET status = 'running', inputs_hash = 'old' WHERE point = 's0004'")
        db.execute("UPDATE points SET status = 'running' WHERE point = 's0004'")
    path = copy / "points/s0004/attempt_0/loading_00/outcome.json"
    old = path.stat().st_mtime_ns
    run_study(make_study(), copy, work=WORK)
    assert path.stat().st_mtime_ns > old
    with Store.open(copy) as store:
        assert verify_store(store) == []


@pytest.mark.parametrize(
    ("harm", "kind"),
    [
        (lambda p: p.unlink(), "missing"),
        (lambda p: p.write_bytes(b"x" + p.read_bytes()[1:]), "damaged"),
        (lambda p: (p.parent / "more.txt").write_text("x"), "orphan"),
        (
            lambda p: (p.parents[1] / "loading_09").mkdir() or (p.parents[1] / "loading_09/x").write_text(""),
            "orphan",
        ),
    ],
)
def test_verify_finds_what_is_wrong(copy, harm, kind):
    harm(copy / "points/s0002/attempt_0/loading_01/signals.bin")
    with Store.open(copy) as store:
        (fault,) = verify_store(store)
    assert fault.kind == kind
    assert fault.path.startswith("points/s0002/attempt_0/loading_0")


def test_verify_finds_a_database_that_says_something_else(copy):
    with Store.create(copy, make_study()) as store, store.transaction() as db:
        db.execute("UPDATE cycles SET outcome = json_set(outcome, '$.energy_J', 2) WHERE point = 's0001' "
                   "AND loading = 0")  # fmt: skip
    with Store.open(copy) as store:
        assert [fault.kind for fault in verify_store(store)] == ["mismatch"]


def test_keeping_outcomes_only(tmp_path):
    run_study(make_study("storage.keep=outcomes"), tmp_path / "store", work=WORK)
    with Store.open(tmp_path / "store") as store:
        assert verify_store(store) == []
    names = {path.name for path in (tmp_path / "store/points").rglob("*") if path.is_file()}
    assert names <= {"outcome.json", "plan.json", "height_fields.npz", "attempt_0.lock"}


def test_failures_are_retried_with_another_seed_and_step(tmp_path, behave):
    behave("fail")
    status = run_study(make_study(), tmp_path / "store", work=WORK)
    assert status["points"]["done"] == 19
    failed = {item["point"] for item in status["failures"]}
    table = ResponseTable.load(tmp_path / "store")
    assert failed == {name for name, x in zip(table.point, table.X, strict=True) if x[0] > 1.5}
    assert np.isfinite(table.Y).all()
    with Store.open(tmp_path / "store") as store:
        rows = store.db.execute(
            "SELECT point, attempt, seed, status, reason FROM sequences WHERE point = ? ORDER BY attempt",
            (min(failed),),
        ).fetchall()
        assert verify_store(store) == []
    assert [row[3] for row in rows] == ["failed", "done"]
    assert rows[0][2] != rows[1][2]
    assert "made to fail" in rows[0][4]
    assert not (tmp_path / "store/points" / min(failed) / "attempt_0/loading_02").exists()


def test_some_failed_cycles_can_be_allowed(tmp_path, behave):
    behave("fail")
    status = run_study(make_study("failures.max_failed_share=0.8"), tmp_path / "store", work=WORK)
    assert status["points"]["done"] == 19
    table = ResponseTable.load(tmp_path / "store")
    assert set(table.n_loadings) == {2, 4}
    assert sum(table.n_failed) == status["cycles"]["failed"] == int((table.X[:, 0] > 1.5).sum())
    assert np.isfinite(table.Y).all()


@pytest.mark.parametrize(("mode", "attempts"), [("raise", 3), ("impossible", 1)])
def test_points_that_always_fail_are_marked_not_dropped(tmp_path, behave, mode, attempts):
    behave(mode)
    status = run_study(make_study(), tmp_path / "store", work=WORK)
    assert status["complete"]
    marked = {item["point"] for item in status["points_failed"]}
    assert all("made" in item["reason"] for item in status["points_failed"])
    table = ResponseTable.load(tmp_path / "store")
    assert len(table) == 19
    lost = table.X[:, 0] > 1.5
    assert lost.any()
    assert marked == {name for name, gone in zip(table.point, lost, strict=True) if gone}
    assert np.isnan(table.Y[lost]).all()
    assert np.isfinite(table.Y[~lost]).all()
    assert all("made" in text for text, gone in zip(table.failure, lost, strict=True) if gone)
    with Store.open(tmp_path / "store") as store:
        (n,) = store.db.execute("SELECT COUNT(*) FROM sequences WHERE point = ?", (min(marked),)).fetchone()
        (trace,) = store.db.execute(
            "SELECT traceback FROM sequences WHERE point = ? AND attempt = 0", (min(marked),)
        ).fetchone()
        assert verify_store(store) == []
    assert n == attempts
    assert "study_work.py" in trace


def test_a_full_disk_of_a_worker_stops_the_run_and_is_no_failure(tmp_path, behave):
    behave("disk")
    with pytest.raises(RunStopped, match="No space left"):
        run_study(make_study(), tmp_path / "store", work=WORK)
    with Store.open(tmp_path / "store") as store:
        status = read_status(store)
        assert status["failures"] == []
        assert "No space left" in status["last_run"]["ending"]
    behave("")
    status = run_study(make_study(), tmp_path / "store", work=WORK)
    assert status["points"]["done"] == 19


def test_finished_sequences_without_their_database_are_not_run_over(tmp_path):
    with Store.create(tmp_path, make_study()):
        pass
    (tmp_path / "points").mkdir(exist_ok=True)
    (tmp_path / "study.db").unlink()
    with pytest.raises(InputError, match=r"study\.db is missing: put it back"):
        Store.create(tmp_path, make_study())
    assert not (tmp_path / "study.db").exists()


def test_two_runs_at_once_are_refused(tmp_path):
    study = make_study()
    with Store.create(tmp_path / "store", study), pytest.raises(InputError, match="another process"):
        run_study(study, tmp_path / "store", work=WORK)


def test_a_study_of_machine_and_control_parameters(tmp_path):
    variables = (
        "variables=[{name: floor, key: loading.control.speed_floor, low: 0.05, high: 0.3}, "
        "{name: rate, key: machine.boom.velocity, low: 0.3, high: 1.0, unit: rad/s}]"
    )
    study = make_study(variables, "objectives=[production, specific_energy]")
    run_study(study, tmp_path / "store", work=WORK)
    table = ResponseTable.load(tmp_path / "store")
    assert table.problem.variable_names == ("floor", "rate")
    assert table.problem.objective_names == ("production", "specific_energy")
    assert table.Y[:, 1] == pytest.approx(1e-3)
    seen = json.loads((tmp_path / "store/study.json").read_text())["problem"]
    assert seen["variables"][1]["unit"] == "rad/s"


def test_confirmation_simulates_as_the_study_does(finished, copy):
    table = ResponseTable.load(copy)
    mean, se = Resimulation(copy, work=WORK).evaluate(table.X[3])
    assert mean == pytest.approx(table.Y[3])
    assert se == pytest.approx(table.noise[3], rel=0.3)


def test_confirmation_runs_all_points_first_and_none_twice(copy, monkeypatch, tmp_path):
    X = ResponseTable.load(copy).X[:3]
    monkeypatch.setattr(study_work, "LOG", str(tmp_path / "log"))
    said = []
    again = Resimulation(copy, work=WORK, say=said.append)
    again.run(X)
    assert said == ["running on this process, 1 workers"] + [f"{k} of 3 points simulated" for k in (1, 2, 3)]
    means = [again.evaluate(x)[0] for x in X]
    Resimulation(copy, work=WORK).run(X)
    assert (tmp_path / "log").read_text().count("finish") == 12
    assert means == pytest.approx(np.array([Resimulation(copy, work=WORK).evaluate(x)[0] for x in X]))


@pytest.mark.parametrize(("mode", "reason"), [("raise", "made to fail"), ("fail", "solver failure")])
def test_confirmation_keeps_failures(copy, behave, mode, reason):
    table = ResponseTable.load(copy)
    high, low = table.X[table.X[:, 0] > 1.5][0], table.X[table.X[:, 0] < 1.5][0]
    behave(mode)
    again = Resimulation(copy, work=WORK)
    again.run(np.array([high, low]))
    assert np.isfinite(again.evaluate(low)[0]).all()
    if mode == "raise":
        with pytest.raises(RuntimeError, match=reason):
            again.evaluate(high)
    else:  # the loading before the failed one counts
        assert np.isfinite(again.evaluate(high)[0]).all()


def test_confirmation_stopped_by_a_full_disk(copy, behave):
    X = ResponseTable.load(copy).X
    behave("disk")
    with pytest.raises(RunStopped, match="No space left"):
        Resimulation(copy, work=WORK).run(X[X[:, 0] > 1.5][:1])


def test_export_names_its_formats(copy):
    with pytest.raises(InputError, match="csv or parquet"):
        export_tables(copy, ["xml"])


def test_no_store_no_status(tmp_path):
    with pytest.raises(InputError, match="no study here"):
        Store.open(tmp_path)
    (tmp_path / "study.json").write_text("{}")
    (tmp_path / "study.db").write_bytes(b"not a database, but some bytes" * 100)
    with pytest.raises(InputError, match=r"study\.json: not a readable study"):
        Store.open(tmp_path)


def test_a_full_disk_of_the_store_loses_nothing(tmp_path):
    """SQLite at its page limit fails as on a full disk: what was begun is rolled back, what was done stays."""
    study = make_study()
    with Store.create(tmp_path / "store", study) as store:
        store.add_points("sample", 0, np.full((3, 4), 0.5))
        (pages,) = store.db.execute("PRAGMA page_count").fetchone()
        store.db.execute(f"PRAGMA max_page_count = {pages}")
        with pytest.raises(RunStopped, match="full"):
            store.add_points("validation", 0, np.full((2000, 4), 0.5))
        assert len(store.list_points()) == 3
        store.db.execute("PRAGMA max_page_count = 100000")
        store.add_points("validation", 0, np.full((20, 4), 0.5))
        assert len(store.list_points()) == 23


def test_slurm_job_script(tmp_path):
    config = SlurmConfig(
        queue="compute", account="mine", walltime="12:00:00", memory="3GB",
        directives=("--constraint=avx2",), prologue=("module load python",),
    )  # fmt: skip
    with make_slurm_cluster(config, tmp_path) as cluster:
        assert cluster.scheduler.allowed_failures == 0  # the runner tries again, and counts
        script = cluster.job_script()
    for line in (
        "#SBATCH -p compute", "#SBATCH -A mine", "#SBATCH -n 1", "#SBATCH --cpus-per-task=1", "#SBATCH -t 12:00:00",
        "#SBATCH --constraint=avx2", "export OMP_NUM_THREADS=1", "module load python",
    ):  # fmt: skip
        assert line in script
    assert "--nthreads 1" in script
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)


def test_worker_versions_must_agree(tmp_path, monkeypatch):
    import drakerock.study.runner as runner

    real = runner.get_versions()
    monkeypatch.setattr(runner, "get_versions", lambda: real | {"drake": "0.0"})
    with pytest.raises(RunStopped, match="other versions"):
        run_study(make_study(), tmp_path / "store", work=WORK)
