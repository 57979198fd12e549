"""The tables of a study: responses, a row per finished point, and loadings, a row per cycle."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from drakerock.errors import InputError
from drakerock.exploration.problem import Array
from drakerock.exploration.table import ResponseTable, average_loadings
from drakerock.loading.folder import HEIGHT_FIELDS
from drakerock.loading.outcome import CycleOutcome
from drakerock.study.db import STUDY, Store
from drakerock.study.objectives import get_objective
from drakerock.study.replays import find_replay


def read_responses(store: Store, role: str | None = None) -> ResponseTable:
    """Return the response table of the points that are done or marked as failed, one row per point.

    Responses are means over the sequence of the attempt that counts; failed cycles are left out, and
    a point marked as failed has none.

    Raises:
        InputError: an objective's function failed.
    """
    problem = store.study.problem
    objectives = [get_objective(name) for name in store.study.objectives]
    names: list[str] = []
    loadings: list[float] = []
    X: list[Array] = []
    Y: list[list[float]] = []
    roles: list[str] = []
    failures: list[str] = []
    failed: list[bool] = []
    replays: list[str] = []
    rows: dict[tuple[str, int], list[tuple[int, str, str, str]]] = {}
    for point, attempt, *rest in store.db.execute(
        "SELECT point, attempt, loading, status, reason, outcome FROM cycles ORDER BY loading"
    ):
        rows.setdefault((point, attempt), []).append(tuple(rest))
    reasons = dict(store.db.execute("SELECT point, reason FROM points"))
    for point in store.list_points(role):
        if point.status not in ("done", "failed"):
            continue
        cycles = rows.get((point.name, point.attempt), [])
        replay = find_replay(store, point.name, point.attempt)
        for loading, status, reason, outcome in cycles or [(0, "failed", "", "")]:
            lost = point.status == "failed" or status == "failed"
            names.append(point.name)
            loadings.append(loading)
            X.append(point.x)
            Y.append(
                [np.nan] * len(objectives)
                if lost
                else [item.evaluate(CycleOutcome.from_json(outcome)) for item in objectives]
            )
            failed.append(lost)
            roles.append(point.role)
            replays.append(replay)
            failures.append(reasons[point.name] if point.status == "failed" else reason)
    if not names:
        d, k = len(problem.variables), len(problem.objectives)
        return ResponseTable(problem, np.empty((0, d)), np.empty((0, k)))
    provenance = json.loads((store.folder / STUDY).read_text(encoding="utf-8"))
    return average_loadings(
        problem,
        names,
        loadings,
        np.array(X),
        np.array(Y),
        roles,
        failures,
        replays,
        failed=failed,
        provenance=provenance,
    )


def read_loadings(store: Store) -> pa.Table:
    """Return one row per recorded cycle, of all attempts: point, variables, objectives, outcome, cost."""
    problem, columns = store.study.problem, {}
    points = {point.name: point for point in store.list_points()}
    rows = store.db.execute(
        "SELECT c.point, c.attempt, c.loading, c.status, c.reason, c.outcome, c.seconds, c.cpu_seconds, s.inputs_hash "
        "FROM cycles c JOIN sequences s ON s.point = c.point AND s.attempt = c.attempt "
        "JOIN points p ON p.point = c.point ORDER BY p.role, c.point, c.attempt, c.loading"
    ).fetchall()
    outcomes = [_flatten(json.loads(row[5])) for row in rows]
    columns["point"] = [row[0] for row in rows]
    columns["role"] = [points[row[0]].role for row in rows]
    for j, name in enumerate(("attempt", "loading", "status", "reason"), start=1):
        columns[name] = [row[j] for row in rows]
    for j, name in enumerate(problem.variable_names):
        columns[name] = [float(points[row[0]].x[j]) for row in rows]
    for item in [get_objective(name) for name in store.study.objectives]:
        values = [
            np.nan if row[3] == "failed" else item.evaluate(CycleOutcome.from_json(row[5])) for row in rows
        ]
        columns[item.objective.name] = pa.array(values, pa.float64(), from_pandas=True)
    for name in dict.fromkeys(name for outcome in outcomes for name in outcome if name not in columns):
        columns[name] = [outcome.get(name) for outcome in outcomes]
    for j, name in enumerate(("seconds", "cpu_seconds", "inputs_hash"), start=6):
        columns[name] = [row[j] for row in rows]
    return pa.table(columns)


def _flatten(outcome: dict[str, Any]) -> dict[str, Any]:
    """Return the numbers and words of an outcome, those in groups as ``group_name``; lists are left out."""
    flat: dict[str, Any] = {}
    for name, value in outcome.items():
        if name in ("objectives", "phi1", "phi2", "phi3", "strategy", "files", "versions"):
            continue  # in columns of their own, or the same for all
        prefix = "" if name == "mining" else f"{name}_"  # the numbers of mining have names of their own
        items = (
            {f"{prefix}{key}": item for key, item in value.items()}
            if isinstance(value, dict)
            else {name: value}
        )
        flat |= {key: item for key, item in items.items() if not isinstance(item, dict | list)}
    return flat


def read_height_fields(store: Store) -> pa.Table:
    """Return one row per loading that has height fields: what was sensed before it, what lay after it.

    Columns: point, attempt, loading; ``h_before``, ``h_after``: heights [m] as lists, row by row of the grid (nx, ny);
    ``nx``, ``ny``, ``cell`` [m]; the features of the pile before (`PileFeatures`). Cell (i, j) is centred at x =
    -cell (nx - 1 - i + 0.5), y = cell (j - (ny - 1) / 2) where the sensor is one of ours.

    Raises:
        InputError: a file that cannot be read.
    """
    from drakerock.loading.features import calc_pile_features
    from drakerock.loading.field_file import load_height_fields

    front_height = store.study.scenario.loading.sensing.front_height
    rows: list[dict[str, Any]] = []
    for point, attempt, loading in store.db.execute(
        "SELECT point, attempt, loading FROM cycles ORDER BY point, attempt, loading"
    ).fetchall():
        path = store.find_sequence_folder(point, attempt) / f"loading_{loading:02d}" / HEIGHT_FIELDS
        if not path.exists():
            continue
        before, after = load_height_fields(path)
        nx, ny = before.h.shape
        rows.append(
            {"point": point, "attempt": attempt, "loading": loading, "nx": nx, "ny": ny, "cell": before.cell}
            | asdict(calc_pile_features(before, front_height))
            | {
                f"h_{name}": np.float32(field.h).ravel()
                for name, field in (("before", before), ("after", after))
            }
        )
    return pa.Table.from_pylist(rows)


def export_tables(
    folder: str | Path, formats: Sequence[str] = ("csv", "parquet"), *, fields: bool = True
) -> list[Path]:
    """Write `responses` (a row per finished point) and `loadings` (a row per cycle); return the paths.

    As Parquet also `height_fields` (a row per loading that has them), unless `fields` is false: each loading has a file
    of them to be read.

    Raises:
        InputError: no store there; not one of the formats csv and parquet; the folder cannot be written.
    """
    with Store.open(folder) as store:
        responses = read_responses(store)
        tables = {"loadings": read_loadings(store)}
        if fields and "parquet" in formats:
            tables["height_fields"] = read_height_fields(store)
    paths = []
    for suffix in formats:
        if suffix not in ("csv", "parquet"):
            raise InputError(f"format {suffix}: csv or parquet")
        for name in ("responses", "loadings", "height_fields"):
            if name == "height_fields" and (suffix == "csv" or not len(tables.get(name, ()))):
                continue
            path = Path(folder) / f"{name}.{suffix}"
            partial = path.with_name(f".partial-{path.name}")
            try:
                if name == "responses":
                    responses.save(partial)
                elif suffix == "csv":
                    pyarrow.csv.write_csv(tables[name], partial)
                else:
                    pyarrow.parquet.write_table(tables[name], partial, compression="zstd")
                partial.replace(path)
            except OSError as error:
                raise InputError(f"{path}: cannot be written: {error}") from None
            paths.append(path)
    return paths
