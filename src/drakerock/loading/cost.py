"""What a loading costs the process that runs it, for planning campaigns: CPU time, wall time, memory."""

from __future__ import annotations

import json
import resource
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

from drakerock.files import read_json, write_text
from drakerock.loading.folder import COST


@dataclass(frozen=True)
class LoadingCost:
    """The cost of a loading, refill included. No part of its results: it differs between runs.

    Attributes:
        cpu_time_s: of the process, all threads [s].
        wall_time_s: [s].
        memory_MB: the most that the process has held since it began [MB].
    """

    cpu_time_s: float
    wall_time_s: float
    memory_MB: float

    def save(self, folder: Path) -> None:
        """Write it into a loading's folder.

        Raises:
            InputError: the folder cannot be written.
        """
        write_text(folder / COST, json.dumps(asdict(self)) + "\n")

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """Return what `save` wrote; None if there is nothing.

        Raises:
            InputError: it cannot be read.
        """
        path = folder / COST
        return cls(**read_json(path, "a readable cost")) if path.exists() else None


class Meter:
    """Measures from its making on."""

    def __init__(self) -> None:
        self._cpu, self._wall = time.process_time(), time.perf_counter()

    def read(self) -> LoadingCost:
        """Return the cost until now."""
        # Linux gives kilobytes, macOS bytes.
        unit = 1e6 if sys.platform == "darwin" else 1e3
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
        return LoadingCost(time.process_time() - self._cpu, time.perf_counter() - self._wall, memory)
