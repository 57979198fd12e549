"""A stored loading cycle, read from its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drakerock.errors import InputError
from drakerock.files import read_json
from drakerock.loading.field import HeightField
from drakerock.loading.folder import OUTCOME, PLAN, RECORDING, SCENARIO, SIGNALS
from drakerock.loading.plan import DigPlan
from drakerock.loading.plan_file import load_plan
from drakerock.loading.recording import Recording, load_recording
from drakerock.loading.signal_table import load_signals

Array = NDArray[np.float64]

WAYPOINTS = ("s0", "s1", "s2", "s3", "s4")


@dataclass(frozen=True, eq=False)
class StoredCycle:
    """A cycle's stored files, read.

    Attributes:
        folder: where they are.
        outcome: outcome.json.
        scenario: scenario.json, the resolved configuration.
        plan: the dig plan; None if there was none.
        field: the height field it was made from.
        signals: columns (k,) of all steps.
        recording: the frames.
    """

    folder: Path
    outcome: dict[str, Any]
    scenario: dict[str, Any]
    plan: DigPlan | None
    field: HeightField
    signals: dict[str, Array]
    recording: Recording


def load_cycle(folder: str | Path) -> StoredCycle:
    """Read what `drakerock load` wrote.

    Raises:
        InputError: it is no folder of a finished loading; a file is missing or cannot be read.
    """
    folder = Path(folder)
    if not (folder / OUTCOME).is_file():
        raise InputError(
            f"{folder}: no finished loading here ({OUTCOME} is missing); make one with `drakerock load`"
        )
    plan, field = load_plan(folder / PLAN)
    signals, _ = load_signals(folder / SIGNALS)
    return StoredCycle(
        folder,
        _read_object(folder / OUTCOME),
        _read_object(folder / SCENARIO),
        plan if isinstance(plan, DigPlan) else None,
        field,
        signals,
        load_recording(folder / RECORDING),
    )


def _read_object(path: Path) -> dict[str, Any]:
    data = read_json(path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a JSON object")
    return data
