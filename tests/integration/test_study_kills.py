"""A study that is killed at random moments ends as one that was never interrupted.

The simulation is the stand-in of `study_work`; everything else is real: the command, its processes, its signals.
"""

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits

import study_work
from drakerock.config import parse_config
from drakerock.study.db import Store
from drakerock.study.runner import run_study
from drakerock.study.schema import StudyConfig
from drakerock.study.status import read_status
from drakerock.study.verify import verify_store

TESTS = Path(__file__).resolve().parents[1]
STUDY = """
name: trial
seed: 3
loadings: 4
exploration:
  sampling: {n_initial: 6, n_corners: 4, n_samples: 19, n_validation: 5, batch_size: 3}
  surrogate: {n_starts: 1}
"""
SERIAL = "executor: {kind: serial}\n"
N_CYCLES = 96


def make_environment(log, **values):
    return os.environ | {
        "PYTHONPATH": os.pathsep.join([str(TESTS), *sys.path]),
        "STUDY_WORK_LOG": str(log),
        "STUDY_WORK_SECONDS": "0.05",
        "OMP_NUM_THREADS": "1",
    } | values  # fmt: skip


class Place:
    """A folder with the study, and the command run in it."""

    def __init__(self, folder):
        self.folder = folder
        self.out = folder / "out"
        self.log = folder / "log.txt"
        (folder / "study.yaml").write_text(STUDY)

    def start(self, *args, **values):
        command = [
            sys.executable,
            str(TESTS / "study_command.py"),
            "study",
            "run",
            "study.yaml",
            "--out",
            "out",
            *args,
        ]
        # A session of its own, as a terminal would make: Ctrl-C goes to the whole process group.
        return subprocess.Popen(
            command, cwd=self.folder, env=make_environment(self.log, **values), start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def finish(self, process, code=0, timeout=120, quiet=True):
        out, err = process.communicate(timeout=timeout)
        assert process.returncode == code, (process.returncode, out, err)
        assert not quiet or "Traceback" not in out + err, err
        return out, err

    def run(self, *args, **values):
        return self.finish(self.start(*args, **values))

    def run_here(self):
        """Run the study in this process, which has imported everything, to its end."""
        with pytest.MonkeyPatch.context() as patch, threadpool_limits(1):
            patch.setattr(study_work, "LOG", str(self.log))
            patch.setattr(study_work, "DURATION", 0.0)
            run_study(parse_config(STUDY + SERIAL, StudyConfig), self.out, work="study_work:run")

    def count(self, word):
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return Counter(line.split()[1] for line in lines if line.startswith(word))

    def wait_for(self, n, word="finish", timeout=60):
        """Wait until so many cycles have been started or finished."""
        deadline = time.monotonic() + timeout
        while self.count(word).total() < n:
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def check(self, reference, n_interruptions, workers=1):
        """The same table bit for bit, a sound store, no finished cycle run twice."""
        for name in ("responses.csv", "responses.parquet"):
            assert (self.out / name).read_bytes() == (reference / name).read_bytes()
        with Store.open(self.out) as store:
            status = read_status(store)
            assert verify_store(store) == []
        assert status["complete"]
        assert status["cycles"] == {"total": N_CYCLES, "recorded": N_CYCLES, "failed": 0}
        assert status["failures"] == []
        finished, started = self.count("finish"), self.count("start")
        assert max(finished.values()) == 1
        assert len(started) == N_CYCLES
        lost = started.total() - N_CYCLES
        assert lost <= n_interruptions * workers, (lost, n_interruptions)
        return lost


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The store of an uninterrupted run in one process."""
    place = Place(tmp_path_factory.mktemp("reference"))
    place.run_here()
    assert place.check(place.out, 0) == 0
    return place.out


@pytest.fixture
def place(tmp_path):
    return Place(tmp_path)


def find_workers(process):
    """Return the Dask workers of a run: its children that are no resource trackers."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rsplit(")", 1)[1].split()
            command = (path.parent / "cmdline").read_bytes()
        except OSError:
            continue
        if int(fields[1]) == process.pid and b"spawn_main" in command:
            found.append(int(path.parent.name))
    return found


def kill_main_often(place, reference, n_kills, seed, longest):
    (place.folder / "study.yaml").write_text(STUDY + SERIAL)
    result = subprocess.run(
        [sys.executable, "-W", "ignore", str(TESTS / "study_killer.py"), "study.yaml", "out", str(n_kills),
         str(seed), str(longest)],
        cwd=place.folder, env=make_environment(place.log, STUDY_WORK_SECONDS="0.01"), capture_output=True,
        text=True, check=False, timeout=900,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    lost = place.check(reference, report["kills"])
    print(f"main process killed {report['kills']} times: {lost} unfinished cycles run again")
    return report["kills"]


def test_kill_9_of_the_main_process_at_any_moment(place, reference):
    assert kill_main_often(place, reference, n_kills=60, seed=1, longest=0.25) >= 30


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_kill_9_of_the_main_process_hundreds_of_times(place, reference, seed):
    kill_main_often(place, reference, n_kills=100, seed=seed, longest=0.12)


def kill_workers(place, reference, n_kills, seed):
    rng = random.Random(seed)
    process = place.start(
        "--workers", "2", "--set", "failures.max_worker_deaths=1000", STUDY_WORK_SECONDS="0.3"
    )
    place.wait_for(2)
    kills = 0
    while process.poll() is None and kills < n_kills:
        before, begun = place.count("start").total(), time.monotonic()
        # Mostly at work, sometimes while they start; killing these only would keep the study from its end.
        while (
            rng.random() < 0.99 and place.count("start").total() == before and time.monotonic() - begun < 20
        ):
            time.sleep(0.02)
        workers = find_workers(process)
        if workers:
            try:
                os.kill(rng.choice(workers), signal.SIGKILL)
                kills += 1
            except ProcessLookupError:
                pass
        time.sleep(rng.uniform(0.0, 0.6))
    place.finish(process)
    lost = place.check(reference, kills)
    print(f"workers killed {kills} times: {lost} unfinished cycles run again")
    return kills


def test_kill_9_of_workers(place, reference):
    assert kill_workers(place, reference, n_kills=3, seed=2) == 3


@pytest.mark.slow
def test_kill_9_of_workers_many_times(place, reference):
    assert kill_workers(place, reference, n_kills=30, seed=3) >= 20


def interrupt_often(place, reference, n, seed):
    """Kill, terminate and interrupt main and workers at random until the study is complete."""
    rng = random.Random(seed)
    done, interruptions = Counter(), 0
    while True:
        process = place.start("--workers", "2", "--set", "failures.max_worker_deaths=1000")
        if interruptions >= n:
            place.finish(process)
            break
        before = place.count("start").total()
        deadline = time.monotonic() + 30
        # Half of the time at work, the other half at any moment, start and end included.
        if rng.random() < 0.5:
            while (
                place.count("start").total() == before
                and process.poll() is None
                and time.monotonic() < deadline
            ):
                time.sleep(0.01)
            time.sleep(rng.uniform(0.0, 0.5))
        else:
            time.sleep(rng.uniform(0.0, 8.0))
        kind = rng.choice(["kill main", "SIGTERM", "Ctrl-C", "Ctrl-C twice", "kill group"])
        if process.poll() is None:
            try:
                interrupt(process, kind)
                done[kind] += 1
                interruptions += 1
            except ProcessLookupError:
                pass
        process.communicate(timeout=60)
        codes = {"kill main": -9, "kill group": -9, "SIGTERM": 143, "Ctrl-C": 130, "Ctrl-C twice": 130}
        # A signal may come before Python can handle it, or when all is done.
        assert process.returncode in (codes[kind], 0, -signal.SIGTERM, -signal.SIGINT, 1), (
            kind,
            process.returncode,
        )
        if process.returncode == 0 and place.count("finish").total() == N_CYCLES:
            break
    lost = place.check(reference, interruptions, workers=2)
    print(f"interrupted {dict(done)}: {lost} unfinished cycles run again")
    return done


def interrupt(process, kind):
    if kind == "kill main":
        process.kill()
    elif kind == "kill group":
        os.killpg(process.pid, signal.SIGKILL)
    elif kind == "SIGTERM":
        process.terminate()
    else:
        os.killpg(process.pid, signal.SIGINT)
        if kind == "Ctrl-C twice":
            time.sleep(0.05)
            os.killpg(process.pid, signal.SIGINT)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_every_interruption_at_random(place, reference, seed):
    assert interrupt_often(place, reference, n=12, seed=seed).total() >= 3


def test_ctrl_c_once_lets_the_running_cycles_finish(place, reference):
    process = place.start("--workers", "2", STUDY_WORK_SECONDS="0.4")
    place.wait_for(3)
    os.killpg(process.pid, signal.SIGINT)
    _, err = place.finish(process, code=130)
    assert "finishing the running cycles" in err
    assert place.count("start") == place.count("finish")
    with Store.open(place.out) as store:
        status = read_status(store)
    assert not status["running"]
    assert status["last_run"]["ending"] == "interrupted"
    assert status["cycles"]["recorded"] == place.count("finish").total() < N_CYCLES
    place.run_here()
    assert place.check(reference, 0) == 0


@pytest.mark.slow
@pytest.mark.parametrize(("signals", "code"), [([signal.SIGINT] * 2, 130), ([signal.SIGTERM], 143)])
def test_ctrl_c_twice_and_sigterm_stop_at_once(place, signals, code):
    process = place.start("--workers", "2", STUDY_WORK_SECONDS="30")
    place.wait_for(2, "start")
    workers = find_workers(process)
    assert len(workers) == 2
    begun = time.monotonic()
    for number in signals:
        os.killpg(process.pid, number) if number == signal.SIGINT else process.terminate()
        time.sleep(0.3)
    place.finish(process, code=code)
    assert time.monotonic() - begun < 15
    assert not [pid for pid in workers if Path(f"/proc/{pid}").exists()]


@pytest.mark.slow
def test_workers_end_with_a_killed_main_process(place):
    process = place.start("--workers", "2", STUDY_WORK_SECONDS="30")
    place.wait_for(2, "start")
    workers = find_workers(process)
    process.kill()
    process.communicate()
    deadline = time.monotonic() + 10
    while any(Path(f"/proc/{pid}").exists() for pid in workers):
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "setting"), [("die", []), ("memory", ["--set", "executor.memory_limit=1.2GB"])]
)
def test_a_point_that_kills_its_worker_is_marked(place, mode, setting):
    """Killed at each attempt, or out of memory: the point is marked, the others are done."""
    place.run(
        "--workers", "2", "--set", "failures.retries=0", "--set", "failures.max_worker_deaths=2",
        "--set", "exploration.sampling.n_samples=8", "--set", "exploration.sampling.n_validation=0", *setting,
        STUDY_WORK_MODE=mode,
    )  # fmt: skip
    with Store.open(place.out) as store:
        status, points = read_status(store), store.list_points()
        assert verify_store(store) == []
    bad = {p.name for p in points if p.x[0] > 1.5}
    assert bad
    assert {item["point"] for item in status["points_failed"]} == bad
    assert all("worker died" in item["reason"] for item in status["points_failed"])
    assert status["worker_deaths"] == 2 * len(bad)
    assert status["points"]["done"] == 8 - len(bad)


def start_cluster(folder, name, *args, **values):
    process = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_" + name, *args],
        cwd=folder, env=make_environment(folder / "log.txt", **values), stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    for line in process.stderr:
        found = re.search(r"(?:Scheduler at|Registered to): +(tcp://\S+)", line)
        if found:
            return process, found[1]
    raise AssertionError(f"dask {name} did not start")


def stop(process):
    process.kill()
    process.communicate()


@pytest.mark.slow
def test_a_point_that_kills_its_worker_on_a_scheduler_of_others(place):
    """Dask tries its task on four workers by itself, and then calls it off: that is the end of it."""
    scheduler, address = start_cluster(place.folder, "scheduler", "--port", "0", "--no-dashboard")
    worker, _ = start_cluster(place.folder, "worker", address, "--nthreads", "1", STUDY_WORK_MODE="die")
    place.run(
        "--scheduler", address, "--set", "failures.retries=0", "--set", "failures.max_worker_deaths=3",
        "--set", "exploration.sampling.n_samples=8", "--set", "exploration.sampling.n_validation=0",
    )  # fmt: skip
    stop(worker)
    stop(scheduler)
    with Store.open(place.out) as store:
        status, points = read_status(store), store.list_points()
    bad = {p.name for p in points if p.x[0] > 1.5}
    assert {item["point"] for item in status["points_failed"]} == bad
    assert status["points"]["done"] == 8 - len(bad)
    starts = place.count("start")
    assert {starts[f"{name}/attempt_0/loading_01"] for name in bad} == {4}


@pytest.mark.slow
def test_a_lost_scheduler(place, reference):
    """On a cluster of others: the scheduler dies, the run says so; with a new one it goes on."""
    scheduler, address = start_cluster(place.folder, "scheduler", "--port", "0", "--no-dashboard")
    worker, _ = start_cluster(
        place.folder, "worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"
    )
    process = place.start("--scheduler", address, STUDY_WORK_SECONDS="0.2")
    place.wait_for(3)
    stop(scheduler)
    _, err = place.finish(process, code=1, quiet=False)  # Dask logs its own vain attempts to connect again
    assert "stopped: the scheduler was lost" in err
    assert "the same command goes on" in err
    stop(worker)
    scheduler, address = start_cluster(place.folder, "scheduler", "--port", "0", "--no-dashboard")
    worker, _ = start_cluster(
        place.folder, "worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"
    )
    place.run("--scheduler", address)
    stop(worker)
    stop(scheduler)
    place.check(reference, 1)


def test_no_scheduler_at_that_address(place, run_command, monkeypatch):
    monkeypatch.chdir(place.folder)
    code, _, err = run_command(
        "study", "run", "study.yaml", "--out", "out", "--scheduler", "tcp://127.0.0.1:1"
    )
    assert code == 2
    assert "no Dask scheduler there" in err


def test_a_full_disk(place, reference):
    """A file system of its own, too small: the run stops with the reason; with more room it goes on."""
    place.out.mkdir()
    script = TESTS / "study_on_small_disk.py"
    result = subprocess.run(
        ["unshare", "-rm", sys.executable, script, "study.yaml", place.out, "700k", "50m"], cwd=place.folder,
        env=make_environment(place.log, STUDY_WORK_SECONDS="0", STUDY_WORK_BYTES="20000"),
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    if result.returncode == 77 or "unshare" in result.stderr:
        pytest.skip(f"no file system of one's own here: {result.stderr.strip()}")
    assert re.search(r"No space left|disk is full", result.stderr), result.stderr
    assert "Traceback" not in result.stderr
    ended = re.search(r"ended with (-?\d+) (-?\d+)", result.stdout)
    assert ended, result.stderr
    assert int(ended[1]) != 0
    assert int(ended[2]) == 0, result.stderr
    place.out = place.folder / "kept"
    assert place.check(reference, 1) <= 1
