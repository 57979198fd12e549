"""Where sequences run: in this process, in processes of this machine, on a Dask cluster, on Slurm.

An executor is given tasks and says which have ended. It has no influence on the results.
"""

from __future__ import annotations

import logging
import os
import signal
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drakerock.errors import DrakerockError, InputError, RunStopped
from drakerock.study.main_guard import check_main_guard
from drakerock.study.schema import ExecutorConfig, SlurmConfig
from drakerock.study.work import Task, TaskResult, count_begun, mark_waiting, run_task
from drakerock.study.worker_setup import silence_closing

# One thread each: the simulation is sequential, and there is a process for every core.
THREADS = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
# Dask looks at what its workers do a hundred times a second, at its event loops fifty times, at their memory ten times:
# together a tenth of a core for each worker that is busy with a single task for minutes.
# A scheduler of ours never tries the task of a dead worker on others by itself: the runner does that, and counts.
SCHEDULER = {"distributed.scheduler.allowed-failures": 0}
DASK = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.admin.system-monitor.interval": "5s",
}


class WorkerLost(DrakerockError):
    """The worker of a task died: killed, out of memory, its machine gone.

    Attributes:
        deaths: workers that died while they ran the task; 0 if it was only waiting for the worker.
    """

    def __init__(self, message: str, deaths: int = 1) -> None:
        super().__init__(message)
        self.deaths = deaths


# A sequence that has lost so many times more workers while it only waited for them has failed, too: they die before
# they begin.
WAITING_FACTOR = 10


@dataclass
class Losses:
    """The workers that a sequence has lost on end.

    Attributes:
        limit: so many that died while they ran it make it fail.
        deaths: that died while they ran it.
        waits: that died while it waited for them.
    """

    limit: int
    deaths: int = 0
    waits: int = 0

    def add(self, lost: WorkerLost) -> TaskResult | None:
        """Count a loss; return the sequence's failure if it is one too many."""
        self.deaths += lost.deaths
        self.waits += lost.deaths == 0
        if self.deaths >= self.limit:
            return TaskResult("failed", f"{lost}, {self.deaths} times on end")
        if self.waits >= WAITING_FACTOR * self.limit:
            return TaskResult("failed", f"{lost}, {self.waits} times before it began")
        return None


Ended = tuple[Task, TaskResult | WorkerLost]


class Executor(ABC):
    """Runs tasks.

    Attributes:
        name: for people.
        dashboard: address of the Dask dashboard; "" if there is none.
        local: its workers are other processes of this machine.
    """

    name: str
    dashboard: str = ""
    local: bool = False

    @property
    @abstractmethod
    def n_workers(self) -> int:
        """Workers there are; as many tasks are worth submitting."""

    @abstractmethod
    def submit(self, task: Task) -> None:
        """Take in a task."""

    @abstractmethod
    def wait(self, timeout: float) -> list[Ended]:
        """Return the tasks that have ended, waiting for one at most `timeout` [s].

        Raises:
            RunStopped: the workers cannot be reached or cannot work.
        """

    @abstractmethod
    def close(self) -> None:
        """Give up the workers, at once, whatever they do."""


class SerialExecutor(Executor):
    """Runs tasks in this process, one at a time, within `wait`."""

    name = "this process"

    def __init__(self, tick: Callable[[], None]) -> None:
        self._tick = tick
        self._tasks: deque[Task] = deque()

    @property
    def n_workers(self) -> int:
        """One."""
        return 1

    def submit(self, task: Task) -> None:
        """Take in a task."""
        self._tasks.append(task)

    def wait(self, timeout: float) -> list[Ended]:
        """Run the next task to its end."""
        if not self._tasks:
            return []
        task = self._tasks.popleft()
        return [(task, run_task(task, self._tick))]

    def close(self) -> None:
        """Nothing to give up."""


class DaskExecutor(Executor):
    """Runs tasks on a Dask cluster.

    Args:
        name: for people.
        client: a `distributed.Client`.
        cluster: the cluster to close at the end; None for one that others own.
        wanted: local workers to be kept up; 0: that is the cluster's own business.
    """

    def __init__(self, name: str, client: Any, cluster: Any = None, wanted: int = 0) -> None:
        self.name = name
        self.dashboard = client.dashboard_link or ""
        self._client, self._cluster = client, cluster
        self._futures: dict[Any, Task] = {}
        self._n_workers, self._counted = 0, -1e9
        self._wanted = wanted
        self.local = wanted > 0

    @property
    def n_workers(self) -> int:
        """Worker processes that are there now; asked of the scheduler every few seconds."""
        if time.monotonic() - self._counted > 2.0:
            # A scheduler that is gone shows in the futures.
            with suppress(OSError, TimeoutError, RuntimeError):
                self._n_workers = len(self._client.nthreads())
            self._replace_lost()
            self._counted = time.monotonic()
        return self._n_workers

    def _replace_lost(self) -> None:
        """Have new workers started for those that Dask has given up, as it does with one that starts too slowly."""
        if self._wanted:
            nannies = list(self._cluster.workers.values())
            ended = sum(str(nanny.status) in ("Status.closed", "Status.failed") for nanny in nannies)
            if len(nannies) - ended < self._wanted:
                self._cluster.scale(self._wanted + ended)

    def submit(self, task: Task) -> None:
        """Take in a task."""
        mark_waiting(task)
        self._futures[self._client.submit(run_task, task, pure=False, retries=0)] = task

    def wait(self, timeout: float) -> list[Ended]:
        """Return the tasks that have ended."""
        from distributed import CancelledError, wait
        from distributed.client import FuturesCancelledError

        if not self._futures:
            time.sleep(timeout)
            return []
        try:
            wait(list(self._futures), timeout=timeout, return_when="FIRST_COMPLETED")
        except TimeoutError:
            pass
        except (CancelledError, FuturesCancelledError, OSError, RuntimeError):
            raise RunStopped("the scheduler was lost") from None
        return [self._end(future) for future in list(self._futures) if future.done()]

    def _end(self, future: Any) -> Ended:
        from distributed import CancelledError, KilledWorker
        from distributed.client import FutureCancelledError

        try:
            result = future.result(timeout=30)
        except KilledWorker:
            task = self._futures.pop(future)
            # A scheduler of others may have tried it on several workers before it gave up.
            return task, WorkerLost("the worker died (killed, or out of memory)", count_begun(task))
        except (CancelledError, FutureCancelledError, OSError, TimeoutError):
            raise RunStopped("the scheduler was lost") from None
        except Exception as error:  # whatever Dask meets; what the work meets is in its result
            raise RunStopped(f"the workers cannot run the work: {type(error).__name__}: {error}") from None
        return self._futures.pop(future), result

    def close(self) -> None:
        """Close the client and the cluster that is ours, killing its workers."""
        if self._cluster is not None:
            # Asked to end, a worker would first wait for what it runs.
            for nanny in getattr(self._cluster, "workers", {}).values():
                process = getattr(getattr(nanny, "process", None), "pid", None)
                if process:
                    with suppress(ProcessLookupError):
                        os.kill(process, signal.SIGKILL)
        # What is gone already needs no closing.
        with suppress(OSError, TimeoutError, RuntimeError):
            self._client.close(timeout=5)
            if self._cluster is not None:
                self._cluster.close(timeout=10)


def make_executor(
    config: ExecutorConfig, tick: Callable[[], None], folder: Path, workers: int | None, scheduler: str | None
) -> Executor:
    """Start the executor that a study asks for.

    Args:
        config: the study's.
        tick: called by the serial executor as things proceed.
        folder: the study's, where Slurm jobs log to.
        workers, scheduler: instead of the configuration's, if not None.

    Raises:
        InputError: no scheduler at that address, or dask-jobqueue is not installed.
    """
    scheduler = scheduler or config.scheduler
    workers = workers or config.workers
    if scheduler:
        return _connect(scheduler)
    if config.kind == "serial":
        return SerialExecutor(tick)
    if config.kind == "slurm":
        cluster = make_slurm_cluster(config.slurm, folder)
        cluster.scale(jobs=workers or 10)
        return _use("Slurm", cluster)
    return _start_local(workers or count_cores(), config.memory_limit)


def count_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0))


def make_slurm_cluster(config: SlurmConfig, folder: Path) -> Any:
    """Return a `dask_jobqueue.SLURMCluster` of one-core jobs; its `job_script()` is what each job runs.

    Raises:
        InputError: dask-jobqueue is not installed.
    """
    try:
        import dask
        from dask_jobqueue import SLURMCluster
    except ImportError:
        raise InputError("executor.kind: slurm needs dask-jobqueue; install drakerock[slurm]") from None

    with dask.config.set(SCHEDULER):
        return SLURMCluster(
            cores=1,
            processes=1,
            memory=config.memory,
            queue=config.queue,
            account=config.account,
            walltime=config.walltime,
            job_name="drakerock",
            log_directory=str((folder / "slurm").resolve()),
            job_extra_directives=list(config.directives),
            job_script_prologue=[
                *(f"export {name}={value}" for name, value in THREADS.items()),
                *(
                    f"export DASK_{key.upper().replace('.', '__').replace('-', '_')}={value}"
                    for key, value in DASK.items()
                ),
                *config.prologue,
            ],
            scheduler_options={"dashboard_address": ":0"},
        )


def _connect(address: str) -> DaskExecutor:
    from distributed import Client

    try:
        client = Client(address, timeout=10, name="drakerock")
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(f"{address}: no Dask scheduler there: {error}") from None
    return DaskExecutor(f"Dask scheduler {address}", client)


def _start_local(workers: int, memory_limit: str) -> DaskExecutor:
    check_main_guard()
    import dask
    from distributed import LocalCluster

    silence_closing()
    with dask.config.set(DASK | SCHEDULER):
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            memory_limit=memory_limit,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            env=THREADS,
            config=DASK,  # of workers that are started later, too
            preload=["drakerock.study.worker_setup"],
            silence_logs=logging.CRITICAL,
        )
    return _use("this machine", cluster, workers)


def _use(name: str, cluster: Any, wanted: int = 0) -> DaskExecutor:
    from distributed import Client

    return DaskExecutor(name, Client(cluster, name="drakerock"), cluster, wanted)
