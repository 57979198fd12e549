"""Running a study: the sampler asks, the executor runs, the store records.

The unit of work is a sequence at a point. The points of a sampling step are asked for once all points asked for
before have ended, but for the last few (`SamplingConfig.lag`), whose responses are left out even if they are there. So
they depend on responses only, not on workers or on who finished first, and workers need not wait for the slowest.
Validation points, which depend on nothing, fill what gaps there are.
"""

from __future__ import annotations

import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import floor
from pathlib import Path
from typing import Any

import numpy as np

from drakerock.errors import InputError, RunStopped
from drakerock.exploration.problem import Array
from drakerock.identity import get_versions
from drakerock.study.db import Point, Store
from drakerock.study.display import Display
from drakerock.study.executors import Executor, Losses, WorkerLost, make_executor
from drakerock.study.schema import StudyConfig
from drakerock.study.status import read_status
from drakerock.study.tables import export_tables, read_responses
from drakerock.study.work import Task, TaskResult, count_begun

RUN_SEQUENCE = "drakerock.loading.sequence:run_sequence"
_POLL = 0.5

Ask = Callable[[Store], Array]
"""Says which points (n, d) a study needs next, from what is stored; none: no more."""


def run_study(
    study: StudyConfig,
    folder: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    display: Display | None = None,
    work: str = RUN_SEQUENCE,
    ask: Ask | None = None,
) -> dict[str, Any]:
    """Run a study to its end, or go on with one that was interrupted; write the response tables.

    The first Ctrl-C lets the running cycles finish; the second, and SIGTERM, stop at once. Whatever stops it,
    the same call goes on, and ends with the same responses.

    Args:
        study: what to do.
        folder: the store; made if missing.
        workers, scheduler: instead of the study's executor settings.
        display: shows what goes on; None: nothing.
        work: the function that runs a sequence, as ``module:name``.
        ask: says where to sample next, instead of the study's sampler; called when all points so far have ended.

    Returns:
        The status at the end (`read_status`).

    Raises:
        InputError: the folder holds another study, cannot be written, or is in use.
        RunStopped: full disk, lost scheduler, workers that cannot work.
        KeyboardInterrupt: Ctrl-C, once the running cycles are finished or given up.
    """
    with Store.create(folder, study) as store:
        runner = _Runner(store, display, work, ask)
        try:
            runner.run(workers, scheduler)
        finally:
            status = read_status(store)
            if display:
                display.update(status)
    export_tables(folder)
    return status


class _Runner:
    """One run of a study."""

    def __init__(self, store: Store, display: Display | None, work: str, ask: Ask | None = None) -> None:
        self._store, self._study = store, store.study
        self._display, self._work = display, work
        self._ask_own = ask
        self._running: dict[str, _Sequence] = {}
        self._lost: deque[_Sequence] = deque()
        self._stop_file = store.folder / f".stop-{time.time_ns()}"
        self._changed = True

    def run(self, workers: int | None, scheduler: str | None) -> None:
        for old in self._store.folder.glob(".stop-*"):
            old.unlink(missing_ok=True)
        self._store.clean()
        ending, run = "failed", None
        executor: Executor | None = None
        try:
            with catch_signals(self._ask_to_stop):
                executor = make_executor(
                    self._study.executor, self._look, self._store.folder, workers, scheduler
                )
                self._say_start(executor)
                run = self._store.begin_run(executor.name, executor.n_workers)
                self._loop(executor)
            ending = "complete"
        except (KeyboardInterrupt, SystemExit):
            ending = "interrupted"
            raise
        except RunStopped as error:
            ending = f"stopped: {error}"
            raise
        finally:
            if executor:
                executor.close()
            self._stop_file.unlink(missing_ok=True)
            if run is not None:
                self._end(run, ending)

    def _end(self, run: int, ending: str) -> None:
        try:
            self._store.end_run(run, ending)
        except RunStopped:
            # A full disk cannot even take this; the reason that stopped the run is what counts.
            if ending == "complete":
                raise

    def _say_start(self, executor: Executor) -> None:
        if self._display:
            self._display.say(f"running on {executor.name}, {executor.n_workers} workers")
            if executor.dashboard:
                self._display.say(f"Dask dashboard: {executor.dashboard}")
            nonsmooth = self._study.scenario.dynamics.rocks == "nonsmooth"
            if executor.local and nonsmooth and self._work == RUN_SEQUENCE:
                from drakerock.rocks.engine.compiling import are_kernels_compiled, describe_compilation

                if not are_kernels_compiled():
                    self._display.say(describe_compilation())

    def _ask_to_stop(self) -> None:
        self._stop_file.touch()
        if self._display:
            self._display.say("finishing the running cycles; Ctrl-C again stops at once")

    def _loop(self, executor: Executor) -> None:
        waiting: list[Point] = []
        while True:
            stopping = self._stop_file.exists()
            # What there is to do changes only when a sequence ends.
            if self._changed and not stopping:
                self._changed = False
                begun = {*self._running, *(sequence.task.point for sequence in self._lost)}
                waiting = [point for point in self._plan() if point.name not in begun]
            while not stopping and len(self._running) < max(executor.n_workers, 1):
                if self._lost:
                    self._run(executor, self._lost.popleft())
                elif waiting:
                    self._submit(executor, waiting.pop(0))
                else:
                    break
            if self._running:
                for task, result in executor.wait(_POLL):
                    self._take(task, result)
                self._look()
            elif stopping:
                raise KeyboardInterrupt
            elif not waiting and not self._changed:
                return

    def _plan(self) -> list[Point]:
        """Return the points that are not finished, sample points first; ask the sampler for more if it is time."""
        store, study = self._store, self._study
        config = study.exploration.sampling
        validation = store.list_points("validation")
        if len(validation) < config.n_validation:
            from drakerock.exploration.sampling import make_validation_points  # takes long to import

            X = make_validation_points(study.problem, config, study.seed)
            store.add_points("validation", 0, X[len(validation) :])
            validation = store.list_points("validation")
        samples = store.list_points("sample")
        while len(samples) < config.n_samples:
            # One's own way of asking is told of all points, once all have ended.
            n_awaited = len(samples) if self._ask_own else config.count_awaited(len(samples))
            awaited = samples[:n_awaited]
            if not all(point.status in ("done", "failed") for point in awaited):
                break
            more = self._ask_own(store) if self._ask_own else self._ask(samples, {p.name for p in awaited})
            if not len(more):
                break
            store.add_points("sample", _next_batch(samples), more)
            samples = store.list_points("sample")
        # A study resumed with fewer points leaves the rest be.
        wanted = samples[: config.n_samples] + validation[: config.n_validation]
        return [point for point in wanted if point.status not in ("done", "failed")]

    def _ask(self, samples: list[Point], awaited: set[str]) -> Array:
        """Return the points of the next step, from the responses of the points `awaited` and the places of all."""
        from drakerock.exploration.sampling import make_sampler  # takes long to import

        config, n_samples = self._study.exploration.sampling, len(samples)
        sampler = make_sampler(self._study.problem, config, self._study.seed)
        if n_samples == 0:
            return sampler.ask(min(len(sampler.initial), config.n_samples))
        X = np.array([point.x for point in samples])
        sampler.tell(X, np.full((n_samples, len(self._study.problem.objectives)), np.nan))
        table = read_responses(self._store, "sample")
        told = np.isin(table.point, sorted(awaited))
        sampler.tell(table.X[told], table.Y[told], table.noise[told])
        # Of an initial design cut short by an earlier, smaller number of points, the rest comes first.
        left = len(sampler.initial) - n_samples
        return sampler.ask(min(left if left > 0 else config.batch_size, config.n_samples - n_samples))

    def _submit(self, executor: Executor, point: Point) -> None:
        attempt = max(point.attempt, 0) + (point.attempt_status == "failed")
        try:
            scenario = self._study.make_scenario(point.x, point.name, attempt)
        except InputError as error:
            # Ranges are checked at their ends only; a combination may still be impossible.
            self._store.begin_sequence(point.name, attempt, self._study.scenario)
            self._store.finish_sequence(point.name, attempt, "failed", str(error))
            self._changed = True
            return
        n_recorded = self._store.begin_sequence(point.name, attempt, scenario)
        task = Task(
            point.name, attempt, scenario, self._study.loadings,
            self._store.find_sequence_folder(point.name, attempt).resolve(), self._stop_file.resolve(),
            floor(self._study.failures.max_failed_share * self._study.loadings + 1e-9), self._work,
        )  # fmt: skip
        self._run(executor, _Sequence(task, n_recorded, self._study.failures.max_worker_deaths))

    def _run(self, executor: Executor, sequence: _Sequence) -> None:
        self._running[sequence.task.point] = sequence
        sequence.n_forgiven = 0
        executor.submit(sequence.task)

    def _look(self) -> None:
        """Record the cycles that have been finished since the last look, and show them."""
        for sequence in self._running.values():
            self._record(sequence)
        if self._display and self._display.is_due():
            self._display.update(read_status(self._store))

    def _record(self, sequence: _Sequence) -> None:
        task, now = sequence.task, time.monotonic()
        n = self._store.record_cycles(task.point, task.attempt, sequence.n_recorded, now - sequence.since)
        if n > sequence.n_recorded:
            sequence.n_recorded, sequence.since = n, now
            sequence.losses, sequence.n_forgiven = (
                Losses(sequence.losses.limit),
                max(count_begun(task) - 1, 0),
            )

    def _take(self, task: Task, result: TaskResult | WorkerLost) -> None:
        sequence = self._running.pop(task.point)
        self._record(sequence)
        if isinstance(result, WorkerLost):
            if result.deaths:
                self._store.add_event("worker lost", f"{task.point} attempt {task.attempt}")
                if self._display:
                    self._display.say(f"{task.point}: {result}")
            result.deaths = max(result.deaths - sequence.n_forgiven, 0)
            failure = sequence.losses.add(result)
            if failure is None:
                # Not at once: a worker is missing, and behind a running task it would wait for the others.
                self._lost.append(sequence)
                return
            result = failure
        self._changed = True
        if result.status == "disk":
            raise RunStopped(f"{task.folder}: {result.reason}")
        if result.versions != get_versions():
            raise RunStopped(
                f"a worker has other versions ({result.versions}) than the runner ({get_versions()})"
            )
        if result.status == "stopped":
            return
        if result.status == "done":
            self._store.finish_sequence(task.point, task.attempt, "done")
            return
        final = result.status == "impossible" or task.attempt >= self._study.failures.retries
        self._store.finish_sequence(
            task.point, task.attempt, "failed", result.reason, result.traceback, final=final
        )
        if self._display:
            self._display.say(f"{task.point} attempt {task.attempt + 1} failed: {result.reason}")


class _Sequence:
    """A sequence that has begun.

    Attributes:
        task: what was submitted.
        n_recorded, since: cycles recorded, and when the last was [s].
        losses: the workers lost since then.
        n_forgiven: workers lost since the submission, but before the last cycle was recorded.
    """

    def __init__(self, task: Task, n_recorded: int, max_deaths: int) -> None:
        self.task, self.n_recorded, self.n_forgiven = task, n_recorded, 0
        self.since = time.monotonic()
        self.losses = Losses(max_deaths)


def _next_batch(points: list[Point]) -> int:
    return max((point.batch for point in points), default=-1) + 1


@contextmanager
def catch_signals(ask_to_stop: Any) -> Iterator[None]:
    """First Ctrl-C: ask to stop; the second raises KeyboardInterrupt; SIGTERM raises SystemExit(143)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked = False

    def interrupt(_number: int, _frame: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True
        ask_to_stop()

    def terminate(_number: int, _frame: Any) -> None:
        raise SystemExit(143)

    before = signal.signal(signal.SIGINT, interrupt), signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before[0])
        signal.signal(signal.SIGTERM, before[1])
