"""The tables of a study: responses, a row per finished point, and loadings, a row per cycle."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from drakerock.errors import InputError
from drakerock.exploration.problem import Array
from drakerock.exploration.table import ResponseTable, average_loadings
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
        "SELECT c.point, c.attempt, c.loading, c.status, c.reason, c.outcome, c.seconds, s.inputs_hash "
        "FROM cycles c JOIN sequences s ON s.point = c.point AND s.attempt = c.attempt "
        "JOIN points p ON p.point = c.point ORDER BY p.role, c.point, c.attempt, c.loading"
    ).fetchall()
    outcomes = [json.loads(row[5]) for row in rows]
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
    for name in ("bucket_mass_kg", "bucket_rocks", "weighed_mass_kg", "loading_time_s", "energy_J",
                 "peak_push_force_N", "mean_push_force_N", "sim_time_s", "steps", "seed",
                 "scenario_hash", "wall_time_s"):  # fmt: skip
        columns[name] = [outcome[name] for outcome in outcomes]
    for name in ("total", "awake_mean", "awake_max"):
        columns[f"rocks_{name}"] = [outcome["rocks"].get(name) for outcome in outcomes]
    columns["seconds"] = [row[6] for row in rows]
    columns["inputs_hash"] = [row[7] for row in rows]
    return pa.table(columns)


def export_tables(folder: str | Path, formats: Sequence[str] = ("csv", "parquet")) -> list[Path]:
    """Write `responses` (a row per finished point) and `loadings` (a row per cycle); return the paths.

    Raises:
        InputError: no store there; not one of the formats csv and parquet; the folder cannot be written.
    """
    with Store.open(folder) as store:
        responses, loadings = read_responses(store), read_loadings(store)
    paths = []
    for suffix in formats:
        if suffix not in ("csv", "parquet"):
            raise InputError(f"format {suffix}: csv or parquet")
        for name in ("responses", "loadings"):
            path = Path(folder) / f"{name}.{suffix}"
            partial = path.with_name(f".partial-{path.name}")
            try:
                if name == "responses":
                    responses.save(partial)
                elif suffix == "csv":
                    pyarrow.csv.write_csv(loadings, partial)
                else:
                    pyarrow.parquet.write_table(loadings, partial)
                partial.replace(path)
            except OSError as error:
                raise InputError(f"{path}: cannot be written: {error}") from None
            paths.append(path)
    return paths
