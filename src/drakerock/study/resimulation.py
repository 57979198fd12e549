"""Design points of a study simulated anew, beside the study: several at once, resumable."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drakerock.errors import InputError, RunStopped
from drakerock.exploration.noise import calc_autocorrelation, calc_means, calc_standard_error
from drakerock.exploration.problem import Array
from drakerock.files import make_folder
from drakerock.identity import get_versions
from drakerock.loading.folder import OUTCOME
from drakerock.study.db import Store, calc_inputs_hash, read_outcome
from drakerock.study.executors import Executor, Losses, WorkerLost, make_executor
from drakerock.study.objectives import get_objective
from drakerock.study.runner import RUN_SEQUENCE, catch_signals
from drakerock.study.tables import read_loadings
from drakerock.study.work import Task, TaskResult, run_task

_POLL = 0.5


class Resimulation:
    """Simulates points as the study does, one sequence each, in ``DIR/confirmation/HASH`` (of its inputs).

    What is there already is not simulated again; an interrupted sequence goes on from its last loading.

    Args:
        folder: of the study.
        workers, scheduler: instead of the study's executor settings.
        say: is told what goes on.
        work: the function that runs a sequence, as ``module:name``.

    Raises:
        InputError: there is no study in that folder.
    """

    def __init__(
        self,
        folder: str | Path,
        *,
        workers: int | None = None,
        scheduler: str | None = None,
        say: Callable[[str], None] = lambda _text: None,
        work: str = RUN_SEQUENCE,
    ) -> None:
        self._folder = Path(folder)
        with Store.open(self._folder) as store:
            self._study, loadings = store.study, read_loadings(store)
        self._objectives = [get_objective(name) for name in self._study.objectives]
        # A single sequence knows its autocorrelation badly: that of the study's own sequences is taken.
        self._rho = []
        for item in self._objectives:
            sequences: dict[tuple[str, int], list[float]] = {}
            for row in loadings.select(["point", "attempt", item.objective.name]).to_pylist():
                value = row[item.objective.name]
                key = (row["point"], row["attempt"])
                sequences.setdefault(key, []).append(np.nan if value is None else value)
            self._rho.append(calc_autocorrelation(sequences.values()))
        self._workers, self._scheduler, self._say, self._work = workers, scheduler, say, work
        self._place = self._folder / "confirmation"
        self._stop_file = self._place / f".stop-{time.time_ns()}"
        self._failures: dict[Path, str] = {}

    def run(self, X: Array) -> None:
        """Simulate points X (n, d) on the executor. The first Ctrl-C lets the running cycles finish.

        Raises:
            InputError, RunStopped, KeyboardInterrupt: as `run_study`.
        """
        tasks = []
        for x in X:
            with suppress(InputError):  # a combination that makes no scenario fails in `evaluate`
                task = self._make_task(x)
                if not self._is_complete(task):
                    tasks.append(task)
        if not tasks:
            return
        make_folder(self._place)
        executor: Executor | None = None
        try:
            with catch_signals(self._ask_to_stop):
                executor = make_executor(
                    self._study.executor, lambda: None, self._folder, self._workers, self._scheduler
                )
                self._say(f"running on {executor.name}, {executor.n_workers} workers")
                limit = self._study.failures.max_worker_deaths
                self._loop(executor, deque(_Waiting(task, Losses(limit)) for task in tasks))
        finally:
            if executor:
                executor.close()
            self._stop_file.unlink(missing_ok=True)

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Return mean responses and standard errors (k,) at a point (d,), simulated here if `run` has not.

        NaN stands for an objective without a value in any loading.

        Raises:
            RuntimeError: the simulation failed.
        """
        task = self._make_task(x)
        if task.folder not in self._failures and not self._is_complete(task):
            result = run_task(task)
            if result.status != "done":
                self._failures[task.folder] = result.reason
        if task.folder in self._failures:
            raise RuntimeError(self._failures[task.folder])
        outcomes = [read_outcome(path) for path in sorted(task.folder.glob("loading_*/outcome.json"))]
        Y = np.array(
            [
                [
                    np.nan if outcome.status == "failed" else item.evaluate(outcome)
                    for item in self._objectives
                ]
                for outcome in outcomes
            ],
            dtype=float,
        )
        if all(outcome.status == "failed" for outcome in outcomes):
            raise RuntimeError(next(outcome.reason for outcome in outcomes))
        errors = [calc_standard_error(y, rho) for y, rho in zip(Y.T, self._rho, strict=True)]
        return calc_means(Y), np.array(errors)

    def _make_task(self, x: Array) -> Task:
        scenario = self._study.make_scenario(x, "confirmation", 0)
        loadings = self._study.loadings
        place = (self._place / calc_inputs_hash(scenario, loadings)).resolve()
        # However many loadings fail, the others count.
        return Task(
            "confirmation", 0, scenario, loadings, place, self._stop_file.resolve(), loadings, self._work
        )

    def _is_complete(self, task: Task) -> bool:
        """Return whether a sequence has ended: all loadings, or the last with a failure."""
        paths = [task.folder / f"loading_{k:02d}" / OUTCOME for k in range(task.n_loadings)]
        there = [path for path in paths if path.exists()]
        return bool(there) and (len(there) == task.n_loadings or read_outcome(there[-1]).status == "failed")

    def _ask_to_stop(self) -> None:
        self._stop_file.touch()
        self._say("finishing the running cycles; Ctrl-C again stops at once")

    def _loop(self, executor: Executor, waiting: deque[_Waiting]) -> None:
        running: dict[Path, _Waiting] = {}
        total, ended = len(waiting), 0
        while waiting or running:
            while waiting and len(running) < max(executor.n_workers, 1) and not self._stop_file.exists():
                item = waiting.popleft()
                running[item.task.folder] = item
                executor.submit(item.task)
            if not running:
                break
            for task, result in executor.wait(_POLL):
                item = running.pop(task.folder)
                if isinstance(result, WorkerLost):
                    self._say(str(result))
                    failure = item.losses.add(result)
                    if failure is None:
                        waiting.appendleft(item)
                        continue
                    result = failure
                if result.status == "stopped":
                    continue
                ended += 1
                self._take(task, result)
                self._say(f"{ended} of {total} points simulated")
        if self._stop_file.exists():
            raise KeyboardInterrupt

    def _take(self, task: Task, result: TaskResult) -> None:
        if result.status == "disk":
            raise RunStopped(f"{task.folder}: {result.reason}")
        if result.versions != get_versions():
            raise RunStopped(
                f"a worker has other versions ({result.versions}) than the runner ({get_versions()})"
            )
        if result.status != "done":
            self._failures[task.folder] = result.reason


@dataclass
class _Waiting:
    task: Task
    losses: Losses
