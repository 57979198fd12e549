"""The unit of work of a study: one sequence of loadings at one point, on whatever worker."""

from __future__ import annotations

import errno
import fcntl
import importlib
import os
import socket
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

from drakerock.errors import InputError
from drakerock.identity import get_versions
from drakerock.loading.folder import OUTCOME
from drakerock.loading.outcome import CycleOutcome
from drakerock.loading.scenario import Scenario
from drakerock.memory import freeze_imports
from drakerock.study.db import read_outcome

_DISK_TROUBLE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)


class Work(Protocol):
    """What a sequence is run by: `drakerock.loading.sequence.run_sequence`, or one with its contract."""

    def __call__(
        self,
        scenario: Scenario,
        n_loadings: int,
        folder: Path,
        *,
        progress: Callable[[int, str, float], None] | None = None,
    ) -> list[CycleOutcome]:
        """Run `n_loadings` of `scenario` in `folder`, or what is left of them."""
        ...


@dataclass(frozen=True)
class Task:
    """One sequence to run.

    Attributes:
        point, attempt: which one.
        scenario: with the point's values, seed and time step.
        n_loadings: how many loadings.
        folder: where its files go; a file system that all workers and the runner share.
        stop_file: while it exists, no new loading is begun.
        max_failed: a sequence that lacks more of its loadings, failed or not run, has failed.
        work: the function that runs it, as ``module:name`` (workers import it).
    """

    point: str
    attempt: int
    scenario: Scenario
    n_loadings: int
    folder: Path
    stop_file: Path
    max_failed: int
    work: str


@dataclass(frozen=True)
class TaskResult:
    """How a task ended; its outcomes are in its folder.

    Attributes:
        status: "done"; "failed" (to be tried again); "impossible" (an error that another attempt will not
            cure); "stopped" (asked to); "disk" (full, or not to be written).
        reason, traceback: of a failure.
        versions: of the worker.
    """

    status: Literal["done", "failed", "impossible", "stopped", "disk"]
    reason: str = ""
    traceback: str = ""
    versions: dict[str, str] = field(default_factory=get_versions)


class _Stop(Exception):
    pass


def run_task(task: Task, tick: Callable[[], None] | None = None) -> TaskResult:
    """Run a sequence, or what is left of it. Never raises but for an interruption.

    Args:
        task: what to do.
        tick: called as things proceed, by the serial executor.
    """
    begun = -1

    def progress(loading: int, _stage: str, _time: float) -> None:
        nonlocal begun
        if loading != begun:
            begun = loading
            if task.stop_file.exists():
                raise _Stop
        if tick:
            tick()

    try:
        task.folder.parent.mkdir(parents=True, exist_ok=True)
        with _hold(task):
            work = find_work(task.work)
            freeze_imports()
            work(task.scenario, task.n_loadings, task.folder, progress=progress)
        n_good, failure = _count_good(task)
    except _Stop:
        return TaskResult("stopped")
    except Exception as error:  # whatever a simulation dies of is a result
        text = "".join(traceback.format_exception(error))
        reason = f"{type(error).__name__}: {error}"
        if is_disk_trouble(error):
            return TaskResult("disk", reason, text)
        return TaskResult("impossible" if isinstance(error, InputError) else "failed", reason, text)
    if n_good < task.n_loadings - task.max_failed:
        return TaskResult(
            "failed", f"{n_good} of {task.n_loadings} loadings done: {failure or 'no more were run'}"
        )
    return TaskResult("done")


def find_work(name: str) -> Work:
    """Return the function of a ``module:name``."""
    module, _, function = name.partition(":")
    return getattr(importlib.import_module(module), function)


def is_disk_trouble(error: BaseException | None) -> bool:
    """Return whether an error comes from a disk that is full or cannot be written."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in _DISK_TROUBLE:
            return True
        error = error.__cause__ or error.__context__
    return False


def _count_good(task: Task) -> tuple[int, str]:
    """Return how many loadings of a task are done, and the first one's reason that failed, "" if none did."""
    n_good, failure = 0, ""
    for number in range(task.n_loadings):
        path = task.folder / f"loading_{number:02d}" / OUTCOME
        if not path.exists():
            break
        outcome = read_outcome(path)
        if outcome.status == "failed":
            failure = failure or outcome.reason
        else:
            n_good += 1
    return n_good, failure


def mark_waiting(task: Task) -> None:
    """Note that a task has not begun; `run_task` notes each time that it has."""
    with suppress(OSError):  # trouble with the disk is for the worker to tell
        _find_lock(task).parent.mkdir(parents=True, exist_ok=True)
        _find_lock(task).write_text("")


def count_begun(task: Task) -> int:
    """Return how often a task has begun since `mark_waiting`: more than once where a scheduler has tried it again."""
    try:
        return len(_find_lock(task).read_text().splitlines())
    except OSError:
        return 1


def _find_lock(task: Task) -> Path:
    """Return the file that a worker holds while it runs the task, and that says which workers did."""
    return task.folder.with_suffix(".lock")


@contextmanager
def _hold(task: Task) -> Iterator[None]:
    """Hold the sequence's folder: a worker that has lost its runner may still be busy in it."""
    with open(_find_lock(task), "a") as lock:
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if task.stop_file.exists():
                    raise _Stop from None
                time.sleep(0.2)
        lock.write(f"{socket.gethostname()} {os.getpid()}\n")
        lock.flush()
        yield
