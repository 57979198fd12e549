"""The response table: one row per design point, what every part of the exploration works on.

Columns of the file (CSV or Parquet), as written by `drakerock study export`:

| column | meaning |
|---|---|
| point | identifier of the point |
| role | `sample` (fitted) or `validation` (only ever compared with) |
| one per variable | the design point |
| one per objective | mean over the sequence, in the natural sense (production positive); empty: no response |
| `<objective>_se` | standard error of that mean; optional |
| n_loadings, n_failed | loadings run and failed; optional |
| failure | reason of the first failure; optional |
| replay | path or address of a replay page; optional |

A file with a column `loading` has one row per loading instead; its rows are averaged per point here, with
standard errors that know about the autocorrelation along a sequence (`noise.py`).
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from pydantic import ValidationError

from drakerock.errors import InputError
from drakerock.exploration.noise import calc_autocorrelation, calc_standard_error
from drakerock.exploration.problem import Array, Problem

ROLES = ("sample", "validation")
_METADATA_KEY = b"drakerock"


@dataclass(frozen=True)
class ResponseTable:
    """Points and responses of a problem.

    Attributes:
        problem: variables and objectives.
        X: (n, d) points, in the variables' units.
        Y: (n, k) mean responses in their natural sense and unit; NaN where there is none.
        noise: (n, k) standard errors of Y; NaN where unknown.
        point: (n,) identifiers.
        role: (n,) "sample" or "validation".
        n_loadings, n_failed: (n,) loadings run and failed.
        failure: (n,) reason of the first failure, "" where there was none.
        replay: (n,) path or address of a replay page, "" where there is none.
        provenance: where the table comes from (contents of study.json), shown in the report.
    """

    problem: Problem
    X: Array
    Y: Array
    noise: Array = None  # type: ignore[assignment]
    point: tuple[str, ...] = ()
    role: tuple[str, ...] = ()
    n_loadings: tuple[int, ...] = ()
    n_failed: tuple[int, ...] = ()
    failure: tuple[str, ...] = ()
    replay: tuple[str, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n, d, k = len(self.X), len(self.problem.variables), len(self.problem.objectives)
        fill: dict[str, Any] = {
            "noise": np.full((n, k), np.nan),
            "point": tuple(str(i) for i in range(n)),
            "role": ("sample",) * n,
            "n_loadings": (1,) * n,
            "n_failed": (0,) * n,
            "failure": ("",) * n,
            "replay": ("",) * n,
        }
        for name, value in fill.items():
            given = getattr(self, name)
            if given is None or (isinstance(given, tuple) and not given):
                object.__setattr__(self, name, value)
        for name in ("X", "Y", "noise"):
            shape = (n, d) if name == "X" else (n, k)
            value = np.asarray(getattr(self, name), dtype=float)
            if value.shape != shape:
                raise InputError(f"response table: {name} must have the shape {shape}, got {value.shape}")
            object.__setattr__(self, name, value)
        for name in ("point", "role", "n_loadings", "n_failed", "failure", "replay"):
            if len(getattr(self, name)) != n:
                raise InputError(
                    f"response table: {name} must have {n} entries, got {len(getattr(self, name))}"
                )
        self._check()

    def _check(self) -> None:
        for i, row in enumerate(self.X):
            for v, value in zip(self.problem.variables, row, strict=True):
                # One part in 1e9 covers ranges that went through a decimal text.
                margin = 1e-9 * (v.high - v.low)
                if not v.low - margin <= value <= v.high + margin:
                    raise InputError(
                        f"response table, point '{self.point[i]}': {v.name} = {value:g} is not in "
                        f"[{v.low:g}, {v.high:g}]"
                    )
        for i, role in enumerate(self.role):
            if role not in ROLES:
                raise InputError(
                    f"response table, point '{self.point[i]}': role '{role}' is not one of {', '.join(ROLES)}"
                )
        if np.isinf(self.Y).any() or np.nanmin(self.noise, initial=0.0) < 0.0:
            raise InputError(
                "response table: responses must be finite or empty, standard errors >= 0 or empty"
            )

    def __len__(self) -> int:
        return len(self.X)

    def select(self, role: str) -> Self:
        """Return the rows of one role."""
        return self.take([i for i, r in enumerate(self.role) if r == role])

    def take(self, rows: Sequence[int]) -> Self:
        """Return the rows of these indices, in this order."""
        changes: dict[str, Any] = {name: getattr(self, name)[list(rows)] for name in ("X", "Y", "noise")}
        for name in ("point", "role", "n_loadings", "n_failed", "failure", "replay"):
            changes[name] = tuple(getattr(self, name)[i] for i in rows)
        return replace(self, **changes)

    def to_arrow(self) -> pa.Table:
        """Return the table in the column layout of the file."""
        columns: dict[str, Any] = {"point": list(self.point), "role": list(self.role)}
        for j, name in enumerate(self.problem.variable_names):
            columns[name] = self.X[:, j]
        for j, name in enumerate(self.problem.objective_names):
            columns[name] = pa.array(self.Y[:, j], from_pandas=True)
            columns[f"{name}_se"] = pa.array(self.noise[:, j], from_pandas=True)
        columns |= {
            name: list(getattr(self, name)) for name in ("n_loadings", "n_failed", "failure", "replay")
        }
        return pa.table(columns)

    def save(self, path: str | Path) -> Path:
        """Write CSV or Parquet, by the suffix; Parquet also holds the problem. Returns the path."""
        path = Path(path)
        arrow = self.to_arrow()
        if path.suffix == ".csv":
            pyarrow.csv.write_csv(arrow, path)
        elif path.suffix == ".parquet":
            metadata = {_METADATA_KEY: self.problem.model_dump_json().encode()}
            pyarrow.parquet.write_table(arrow.replace_schema_metadata(metadata), path)
        else:
            raise InputError(f"{path}: a response table is written as .csv or .parquet")
        return path

    @classmethod
    def load(cls, path: str | Path, problem: Problem | None = None) -> Self:
        """Read a table from a file, or from a study folder with `responses.parquet` or `responses.csv`.

        The problem is taken from, in this order: the argument, the file itself (Parquet), `study.json` beside
        it (key `problem`), the default `Problem`.

        Raises:
            InputError: no such file, missing columns, values that are no numbers or out of range.
        """
        path = _find_table(Path(path))
        try:
            read = pyarrow.parquet.read_table if path.suffix == ".parquet" else pyarrow.csv.read_csv
            arrow = read(path)
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{path}: cannot be read as a table: {error}") from None
        provenance = _read_provenance(path.parent / "study.json")
        problem = problem or _find_problem(path, arrow, provenance)
        return _from_arrow(cls, arrow, problem, provenance, str(path))


def _find_table(path: Path) -> Path:
    if path.is_dir():
        for name in ("responses.parquet", "responses.csv"):
            if (path / name).exists():
                return path / name
        raise InputError(
            f"{path}: no responses.parquet or responses.csv in this folder; "
            "make one with `drakerock study export`"
        )
    if not path.exists():
        raise InputError(f"{path}: no such file or folder")
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"{path}: a response table is a .csv or .parquet file")
    return path


def _read_provenance(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not valid JSON: {error}") from None
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a JSON object")
    return data


def _find_problem(path: Path, arrow: pa.Table, provenance: Mapping[str, Any]) -> Problem:
    stored = (arrow.schema.metadata or {}).get(_METADATA_KEY)
    try:
        if stored is not None:
            return Problem.model_validate_json(stored)
        if "problem" in provenance:
            return Problem.model_validate(provenance["problem"])
    except ValidationError as error:
        first = error.errors()[0]
        where = path if stored is not None else path.parent / "study.json"
        key = ".".join(str(part) for part in ("problem", *first["loc"]))
        raise InputError(f"{where}: {key}: {first['msg']}") from None
    return Problem()


def _from_arrow(
    cls: type[Any], arrow: pa.Table, problem: Problem, provenance: Mapping[str, Any], source: str
) -> Any:
    names = arrow.column_names
    for name in (*problem.variable_names, *problem.objective_names):
        if name not in names:
            near = difflib.get_close_matches(name, names, n=1)
            hint = f" (did you mean '{near[0]}'?)" if near else ""
            raise InputError(
                f"{source}: no column '{name}'{hint}; needed are {', '.join(problem.variable_names)} and "
                f"{', '.join(problem.objective_names)}. Other names and ranges: key 'problem' of study.json"
            )
    n = arrow.num_rows

    def numbers(name: str) -> Array:
        try:
            column = arrow.column(name).cast(pa.float64())
        except pa.ArrowInvalid as error:
            raise InputError(f"{source}: column '{name}' has a value that is no number: {error}") from None
        return np.array([np.nan if v is None else v for v in column.to_pylist()], dtype=float)

    def texts(name: str, default: Sequence[str]) -> tuple[str, ...]:
        if name not in names:
            return tuple(default)
        return tuple("" if v is None else str(v) for v in arrow.column(name).to_pylist())

    def counts(name: str, default: int) -> tuple[int, ...]:
        if name not in names:
            return (default,) * n
        return tuple(default if np.isnan(v) else int(v) for v in numbers(name))

    X = np.column_stack([numbers(name) for name in problem.variable_names])
    Y = np.column_stack([numbers(name) for name in problem.objective_names])
    point = texts("point", [str(i) for i in range(n)])
    role = tuple(r or "sample" for r in texts("role", ["sample"] * n))
    failure, replay = texts("failure", [""] * n), texts("replay", [""] * n)
    try:
        if "loading" in names:
            return average_loadings(
                problem, point, numbers("loading"), X, Y, role, failure, replay, provenance
            )
        unknown = np.full(n, np.nan)
        noise = np.column_stack(
            [numbers(f"{name}_se") if f"{name}_se" in names else unknown for name in problem.objective_names]
        )
        return cls(
            problem,
            X,
            Y,
            noise,
            point,
            role,
            counts("n_loadings", 1),
            counts("n_failed", 0),
            failure,
            replay,
            provenance,
        )
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def average_loadings(
    problem: Problem,
    point: Sequence[str],
    loading: Sequence[float] | Array,
    X: Array,
    Y: Array,
    role: Sequence[str] = (),
    failure: Sequence[str] = (),
    replay: Sequence[str] = (),
    provenance: Mapping[str, Any] | None = None,
) -> ResponseTable:
    """Return the table of points from one row per loading.

    Args:
        problem: variables and objectives.
        point: (m,) identifier of each loading's point.
        loading: (m,) number of the loading within its sequence.
        X: (m, d) the point, the same in all rows of one identifier.
        Y: (m, k) responses of each loading, NaN where it failed.
        role, failure, replay: (m,) as in `ResponseTable`; the first entry that is not empty counts.
        provenance: passed on.

    The standard errors use one autocorrelation per objective, pooled over all sequences.
    """
    m = len(point)
    role, failure, replay = role or ("sample",) * m, failure or ("",) * m, replay or ("",) * m
    rows: dict[str, list[int]] = {}
    for i in np.argsort(np.asarray(loading, dtype=float), kind="stable"):
        rows.setdefault(point[int(i)], []).append(int(i))
    order = list(dict.fromkeys(point))
    for name in order:
        if np.ptp(X[rows[name]], axis=0).any() or len({role[i] for i in rows[name]}) > 1:
            raise InputError(f"point '{name}' has loadings with different design variables or roles")
    mean = np.full((len(order), Y.shape[1]), np.nan)
    noise = np.full_like(mean, np.nan)
    for j in range(Y.shape[1]):
        sequences = [Y[rows[name], j] for name in order]
        rho = calc_autocorrelation(sequences)
        for i, sequence in enumerate(sequences):
            if np.isfinite(sequence).any():
                mean[i, j] = np.nanmean(sequence)
                noise[i, j] = calc_standard_error(sequence, rho)

    def first(texts: Sequence[str]) -> tuple[str, ...]:
        return tuple(next((texts[i] for i in rows[name] if texts[i]), "") for name in order)

    return ResponseTable(
        problem,
        X[[rows[name][0] for name in order]],
        mean,
        noise,
        tuple(order),
        first(role),
        tuple(len(rows[name]) for name in order),
        tuple(int(np.isnan(Y[rows[name]]).any(axis=1).sum()) for name in order),
        first(failure),
        first(replay),
        provenance or {},
    )
