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
import logging
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
from drakerock.exploration.problem import MAX_MAGNITUDE, Array, Problem
from drakerock.exploration.table_file import TableFile, read_csv, read_parquet
from drakerock.files import read_json
from drakerock.resources import find_study_file

ROLES = ("sample", "validation")
# What else people call them; an empty cell is a sample.
_ROLE_WORDS = dict.fromkeys(("", "sample", "samples", "train", "training", "fit"), "sample") | dict.fromkeys(
    ("validation", "validate", "valid", "val", "test", "testing", "holdout"), "validation"
)
_OPTIONAL = ("point", "role", "loading", "n_loadings", "n_failed", "failure", "replay", "status")
_METADATA_KEY = b"drakerock"
_log = logging.getLogger(__name__)


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
        if np.nanmin(self.noise, initial=0.0) < 0.0 or any(
            np.nanmax(np.abs(values), initial=0.0) > MAX_MAGNITUDE for values in (self.Y, self.noise)
        ):
            raise InputError(
                f"response table: responses must be finite (up to {MAX_MAGNITUDE:g}) or empty, standard errors >= 0 "
                "or empty"
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

        ``studies/full_size`` is shipped.

        The problem is taken from, in this order: the argument, the file itself (Parquet), `study.json` beside
        it (key `problem`), the default `Problem`. What is taken for something else than it looks (other separators,
        decimal commas, names spelled otherwise) is logged as a warning.

        Raises:
            InputError: no such file, damaged, missing columns, columns that may be two things, values that are no
                numbers or out of range.
        """
        try:
            path = _find_table(find_study_file(Path(path)))
            provenance = _read_provenance(path.parent / "study.json")
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from None
        file, problem = _read_file(path, problem, provenance)
        return _from_file(cls, file, problem, provenance)


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
    if path.suffix.lower() not in (".csv", ".tsv", ".txt", ".parquet"):
        raise InputError(f"{path}: a response table is a .csv or .parquet file")
    return path


def _read_provenance(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    data = read_json(path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a JSON object")
    return data


def _find_problem(path: Path, stored: bytes | None, provenance: Mapping[str, Any]) -> Problem:
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


def _read_file(path: Path, given: Problem | None, provenance: Mapping[str, Any]) -> tuple[TableFile, Problem]:
    if path.suffix.lower() == ".parquet":
        file = read_parquet(path)
        problem = given or _find_problem(path, file.metadata.get(_METADATA_KEY), provenance)
    else:
        problem = given or _find_problem(path, None, provenance)
        file = read_csv(path, [*problem.variable_names, *problem.objective_names])
    return file, problem


def _from_file(cls: type[Any], file: TableFile, problem: Problem, provenance: Mapping[str, Any]) -> Any:
    _find_columns(file, problem)
    n = len(file)

    def texts(name: str, default: str) -> tuple[str, ...]:
        return tuple(file.get_texts(name)) if name in file else (default,) * n

    X = np.column_stack([file.get_numbers(name) for name in problem.variable_names])
    Y = np.column_stack([file.get_numbers(name) for name in problem.objective_names])
    point = texts("point", "") if "point" in file else tuple(str(i) for i in range(n))
    point, role = tuple(name.strip() for name in point), _read_roles(file, texts("role", "sample"))
    failure, replay = texts("failure", ""), texts("replay", "")
    loading = _read_counts(file, "loading", None)
    n_loadings, n_failed = _read_counts(file, "n_loadings", 1), _read_counts(file, "n_failed", 0)
    noise = _read_noise(file, problem)
    if "loading" not in file:
        _check_points(file, point)
    try:
        if "loading" in file:
            status = (
                texts("status", "") if "status" in file else tuple("failed" * bool(text) for text in failure)
            )
            failed = [s == "failed" or bool(np.isnan(y).all()) for s, y in zip(status, Y, strict=True)]
            table = average_loadings(problem, point, loading, X, Y, role, failure, replay, failed, provenance)
        else:
            table = cls(problem, X, Y, noise, point, role, n_loadings, n_failed, failure, replay, provenance)
    except InputError as error:
        raise InputError(f"{file.source}: {error}") from None
    if file.notes:
        _log.warning("%s: %s", file.source, "; ".join(file.notes))
    return table


def _find_columns(file: TableFile, problem: Problem) -> None:
    """Find the problem's columns, whatever the file calls them, and how their numbers are written."""
    needed = [*problem.variable_names, *problem.objective_names]
    file.find_columns(needed)
    for name in needed:
        if name not in file:
            near = difflib.get_close_matches(name, file.headers, n=1)
            hint = f" (did you mean '{near[0]}'?)" if near else ""
            found = ", ".join(f"'{header[:40]}'" for header in file.headers[:30])
            raise InputError(
                f"{file.source}: no column '{name}'{hint}; needed are {', '.join(problem.variable_names)} and "
                f"{', '.join(problem.objective_names)}; found are {found or 'none'}. Other names and ranges: key "
                "'problem' of study.json"
            )
    errors = [f"{name}_se" for name in problem.objective_names]
    file.find_columns([*errors, *_OPTIONAL])
    units = {v.name: v.unit for v in problem.variables} | {o.name: o.unit for o in problem.objectives}
    for name, unit in units.items():
        file.check_unit(name, file.get_header_unit(name), unit)
    file.drop_units_row(units)
    file.find_decimal_comma([*needed, *errors])


def _read_noise(file: TableFile, problem: Problem) -> Array:
    names = [f"{name}_se" for name in problem.objective_names]
    unknown = np.full(len(file), np.nan)
    return np.column_stack([file.get_numbers(name) if name in file else unknown for name in names])


def _read_roles(file: TableFile, texts: Sequence[str]) -> tuple[str, ...]:
    roles = tuple(_ROLE_WORDS.get(text.strip().casefold(), text) for text in texts)
    taken = {
        text.strip(): role for text, role in zip(texts, roles, strict=True) if text.strip() not in ("", role)
    }
    file.notes.extend(f"role '{text}' is taken as {role}" for text, role in taken.items() if role in ROLES)
    return roles


def _read_counts(file: TableFile, name: str, default: int | None) -> tuple[int, ...]:
    """Return a column of whole numbers; InputError for others, and for empty cells without a default.

    Where there is no such column, the default stands in all rows; without a default, nothing is returned.
    """
    if name not in file:
        return () if default is None else (default,) * len(file)
    result = []
    for value, place in zip(file.get_numbers(name), file.places, strict=True):
        if np.isnan(value) and default is not None:
            result.append(default)
        elif 0 <= value < 2**53 and value == int(value):
            result.append(int(value))
        else:
            raise InputError(f"{file.source}: {place}: {name} is {value:g}; needed is a whole number >= 0")
    return tuple(result)


def _check_points(file: TableFile, point: Sequence[str]) -> None:
    places: dict[str, str] = {}
    for name, place in zip(point, file.places, strict=True):
        if name in places:
            raise InputError(
                f"{file.source}: point '{name}' has two rows ({places[name]} and {place}); a table of single loadings "
                "has a column 'loading'"
            )
        places[name] = place


def average_loadings(
    problem: Problem,
    point: Sequence[str],
    loading: Sequence[float] | Array,
    X: Array,
    Y: Array,
    role: Sequence[str] = (),
    failure: Sequence[str] = (),
    replay: Sequence[str] = (),
    failed: Sequence[bool] = (),
    provenance: Mapping[str, Any] | None = None,
) -> ResponseTable:
    """Return the table of points from one row per loading.

    Args:
        problem: variables and objectives.
        point: (m,) identifier of each loading's point.
        loading: (m,) number of the loading within its sequence.
        X: (m, d) the point, the same in all rows of one identifier.
        Y: (m, k) responses of each loading, NaN where it failed or where an objective has no value.
        role, failure, replay: (m,) as in `ResponseTable`; the first entry that is not empty counts.
        failed: (m,) which loadings failed; left out: those without any response.
        provenance: passed on.

    A loading without a value of an objective is left out of that objective's mean, and has not failed for that. The
    standard errors use one autocorrelation per objective, pooled over all sequences.

    Raises:
        InputError: a point with two variables' values or roles, or with a loading twice.
    """
    m = len(point)
    lost = np.array(failed, dtype=bool) if len(failed) else np.isnan(Y).all(axis=1)
    role, failure, replay = role or ("sample",) * m, failure or ("",) * m, replay or ("",) * m
    rows: dict[str, list[int]] = {}
    for i in np.argsort(np.asarray(loading, dtype=float), kind="stable"):
        rows.setdefault(point[int(i)], []).append(int(i))
    order = list(dict.fromkeys(point))
    for name in order:
        if np.isnan(X[rows[name]]).any():
            raise InputError(f"point '{name}' has a loading without the value of a variable")
        if np.ptp(X[rows[name]], axis=0).any() or len({role[i] for i in rows[name]}) > 1:
            raise InputError(f"point '{name}' has loadings with different design variables or roles")
        numbers = [loading[i] for i in rows[name]]
        if len(set(numbers)) < len(numbers):
            twice = next(number for number in numbers if numbers.count(number) > 1)
            raise InputError(
                f"point '{name}' has the loading {twice:g} twice; keep one attempt of each point"
            )
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
        tuple(int(lost[rows[name]].sum()) for name in order),
        first(failure),
        first(replay),
        provenance or {},
    )
