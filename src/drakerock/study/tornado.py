"""The tornado chart of a stored study whose points vary one thing at a time."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from drakerock.errors import InputError
from drakerock.exploration.one_at_a_time import calc_effects
from drakerock.files import make_folder, write_text
from drakerock.study.db import Store
from drakerock.study.tables import read_responses


def run_tornado(folder: str | Path, out: str | Path | None = None) -> tuple[list[dict[str, Any]], list[Path]]:
    """Write tornado.png and tornado.json of a study; also of one that is still running.

    Args:
        folder: the study's.
        out: folder to write into; None: the study's.

    Returns:
        One row per block, variable and objective, and the paths written.

    Raises:
        InputError: no study there, or one of another design.
    """
    from drakerock.viewing.tornado import write_tornado

    with Store.open(folder) as store:
        study, table = store.study, read_responses(store, "sample")
    sampling = study.exploration.sampling
    if sampling.design != "one_at_a_time":
        raise InputError(
            f"{folder}: exploration.sampling.design is {sampling.design}; a tornado chart needs one_at_a_time"
        )
    effects = calc_effects(table, sampling)
    variables = {v.name: v for v in study.variables}
    blocked = sampling.block

    def describe(name: str, value: float) -> str:
        return variables[name].describe(value)

    def describe_block(value: float) -> str:
        return f"{blocked}: {describe(blocked, value)}" if blocked else ""

    place = Path(out) if out else Path(folder)
    make_folder(place)
    rows = []
    for effect in effects:
        row = asdict(effect) | {
            "block": describe_block(effect.block),
            "values": [describe(effect.variable, value) for value in effect.values],
        }
        for name in ("changes", "errors"):
            row[name] = [value if np.isfinite(value) else None for value in row[name]]
        row["centre"] = effect.centre if np.isfinite(effect.centre) else None
        rows.append(row)
    paths = [place / "tornado.json", place / "tornado.png"]
    write_text(paths[0], json.dumps(rows, indent=1, allow_nan=False) + "\n")
    write_tornado(effects, table.problem.objectives, describe, describe_block, paths[1])
    return rows, paths
