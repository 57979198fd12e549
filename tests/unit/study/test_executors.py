"""Contract: a sequence is blamed for the workers that died while they ran it, and for no others.

Caught: a sequence that kills its worker killed a dozen on a scheduler that tries again by itself; one that only waited
was blamed for the next death; a script without a main guard started the study again in every worker.
"""

import subprocess
import sys
from types import SimpleNamespace

import pytest
from distributed import KilledWorker

from drakerock.config import parse_config
from drakerock.loading.scenario import Scenario
from drakerock.study import runner
from drakerock.study.db import Store
from drakerock.study.executors import DaskExecutor, Executor, Losses, WorkerLost
from drakerock.study.main_guard import check_main_guard
from drakerock.study.runner import run_study
from drakerock.study.schema import StudyConfig
from drakerock.study.work import Task, count_begun, mark_waiting, run_task


def make_task(folder, stop_file):
    return Task("s0001", 0, Scenario(), 1, folder, stop_file, 1, "study_work:run")


class Killed:
    """The future of a task whose workers died, as a scheduler ends it."""

    def __init__(self, allowed_failures):
        self.allowed_failures = allowed_failures

    def result(self, timeout):
        raise KilledWorker("run_task", None, self.allowed_failures)


@pytest.mark.parametrize("deaths", [0, 1, 4])
def test_deaths_are_those_while_it_ran(tmp_path, deaths):
    future = Killed(3)
    client = SimpleNamespace(dashboard_link="", submit=lambda *_args, **_options: future)
    executor = DaskExecutor("a test", client)
    task = make_task(tmp_path / "point" / "attempt_0", tmp_path / "stop")
    executor.submit(task)
    (tmp_path / "stop").touch()
    for _ in range(deaths):
        assert run_task(task).status == "stopped"
    found, lost = executor._end(future)
    assert found is task
    assert lost.deaths == deaths
    mark_waiting(task)
    assert count_begun(task) == 0


def test_losses_have_a_limit_each():
    losses = Losses(limit=3)
    assert losses.add(WorkerLost("gone")) is None
    assert losses.add(WorkerLost("gone", 0)) is None
    assert losses.add(WorkerLost("gone")) is None
    assert losses.add(WorkerLost("gone")).reason == "gone, 3 times on end"
    assert Losses(limit=3).add(WorkerLost("gone", 4)).reason == "gone, 4 times on end"
    losses = Losses(limit=1)
    assert [losses.add(WorkerLost("gone", 0)) for _ in range(9)] == 9 * [None]
    assert losses.add(WorkerLost("gone", 0)).reason == "gone, 10 times before it began"


class FewWorkers(Executor):
    """Runs tasks in this process; some lose their worker, and then there is one less for a while."""

    name = "a test"

    def __init__(self, wanted, is_lost):
        self.wanted, self.n, self.is_lost, self.tasks, self.submitted = wanted, wanted, is_lost, [], []

    @property
    def n_workers(self):
        return self.n

    def submit(self, task):
        assert len(self.tasks) < max(self.n, 1), "more tasks than workers"
        self.tasks.append(task)
        self.submitted.append(task.point)

    def wait(self, timeout):
        self.n = self.wanted
        task = self.tasks.pop(0)
        deaths = self.is_lost(task, self.submitted.count(task.point))
        if deaths is None:
            return [(task, run_task(task))]
        self.n = len(self.tasks)
        return [(task, WorkerLost("the worker died", deaths))]

    def close(self):
        pass


@pytest.mark.parametrize(
    ("is_lost", "done", "times"),
    [
        (lambda task, n: 1 if task.point == "s0001" and n < 3 else None, True, 3),
        (lambda task, n: 1 if task.point == "s0001" else None, False, 3),
        (lambda task, n: 4 if task.point == "s0001" else None, False, 1),
        (lambda task, n: 0 if task.point == "s0001" and n < 20 else None, True, 20),
        (lambda task, n: 0 if task.point == "s0001" else None, False, 30),
    ],
)
def test_a_sequence_that_lost_its_worker_waits_for_another(tmp_path, monkeypatch, is_lost, done, times):
    text = """
        loadings: 1
        failures: {retries: 0}
        exploration: {sampling: {n_initial: 4, n_corners: 0, n_samples: 4, n_validation: 0}}
    """
    executor = FewWorkers(2, is_lost)
    monkeypatch.setattr("study_work.DURATION", 0.0)
    monkeypatch.setattr(runner, "make_executor", lambda *_: executor)
    status = run_study(parse_config(text, StudyConfig), tmp_path / "store", work="study_work:run")
    assert status["points"]["failed"] == (0 if done else 1)
    assert status["complete"]
    assert executor.submitted.count("s0001") == times
    with Store.open(tmp_path / "store") as store:
        assert sum(point.status == "done" for point in store.list_points()) == (4 if done else 3)


SCRIPT = """
from drakerock.study.main_guard import check_main_guard

def start():
    check_main_guard()

{call}
print("started")
"""


@pytest.mark.parametrize(
    ("call", "guarded"),
    [
        ("start()", False),
        ("for _ in range(1):\n    start()", False),
        ('if __name__ == "__main__":\n    start()', True),
    ],
)
def test_a_script_without_main_guard_is_told(tmp_path, call, guarded):
    path = tmp_path / "script.py"
    path.write_text(SCRIPT.format(call=call))
    done = subprocess.run([sys.executable, str(path)], capture_output=True, text=True, check=False)
    assert (done.stdout == "started\n") == guarded
    message = f'{path}:{7 if call == "start()" else 8}: put this under `if __name__ == "__main__":`'
    assert (message in done.stderr) == (not guarded)


def test_without_a_script_there_is_nothing_to_guard():
    check_main_guard()
    code = "from drakerock.study.main_guard import check_main_guard as check; check()"
    subprocess.run([sys.executable, "-c", code], check=True)
