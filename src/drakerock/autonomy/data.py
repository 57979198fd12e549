"""What a model of loadings learns from: the loadings of a study, each with the pile before it and what came of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from numpy.typing import NDArray

from drakerock.errors import InputError
from drakerock.exploration.problem import Array, Problem
from drakerock.loading.features import PileFeatures
from drakerock.loading.field import HeightField
from drakerock.loading.scenario import Scenario
from drakerock.randomness import make_generator
from drakerock.study.db import DATABASE, Store, read_study
from drakerock.study.tables import read_height_fields, read_loadings

_KEY = ("point", "attempt", "loading")


@dataclass(frozen=True, eq=False)
class LoadingData:
    """Loadings that were done, one a row, in the order point, attempt, loading.

    Attributes:
        problem: variables and objectives.
        scenario: of the study, without the variables' values.
        x, y: (nx,), (ny,) the height fields' cell centres in W [m].
        cell: their spacing [m].
        X: (n, d) design points.
        Y: (n, k) objectives in their natural senses.
        before: (n, nx, ny) heights as sensed before the loading [m].
        after: (n, nx, ny) heights when the rocks rest again, the load left out [m].
        following: (n, nx, ny) heights as sensed before the next loading of the sequence, cleaned and refilled [m]; NaN
            after the last one.
        features: (n, f) `PileFeatures` of the pile before, in their order; NaN where there is no pile.
        point: (n,) names of the design points.
        attempt, loading: (n,) numbers from 0.
        role: (n,) sample or validation.
        keys: (d,) the scenario keys that the variables set, None for choices; empty: not known.
    """

    problem: Problem
    scenario: Scenario
    x: Array
    y: Array
    cell: float
    X: Array
    Y: Array
    before: Array
    after: Array
    following: Array
    features: Array
    point: NDArray[np.str_]
    attempt: NDArray[np.int_]
    loading: NDArray[np.int_]
    role: NDArray[np.str_]
    keys: tuple[str | None, ...] = ()

    def __len__(self) -> int:
        return len(self.X)

    def take(self, rows: NDArray[np.int_] | NDArray[np.bool_]) -> Self:
        """Return the rows of a mask or of indices."""
        whole = ("problem", "scenario", "x", "y", "cell", "keys")
        names = [item.name for item in fields(self) if item.name not in whole]
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def get_field(self, row: int) -> HeightField:
        """Return the pile before a loading."""
        return HeightField(self.x, self.y, self.before[row], self.cell)

    def split(self, share: float | None = None, seed: int = 0) -> tuple[Self, Self]:
        """Return rows to fit to and rows to test with; no design point is in both.

        Loadings of one sequence resemble each other, and attempts at one point start from the same pile: rows drawn
        singly would let a model be tested on what it has all but seen.

        Args:
            share: of the points that are for the test, drawn at random; None: those of the role ``validation``.
            seed: of the draw.

        Raises:
            InputError: one of the two would be empty.
        """
        if share is None:
            held = self.role == "validation"
        else:
            names = np.unique(self.point)
            drawn = make_generator(seed, "split").permutation(names)[: round(share * len(names))]
            held = np.isin(self.point, drawn)
        if not held.any() or held.all():
            raise InputError(
                f"{len(np.unique(self.point))} points with loadings cannot be split into some to fit to and some to "
                f"test with ({'by their role' if share is None else f'a share of {share:g}'})"
            )
        return self.take(~held), self.take(held)

    def iterate_folds(
        self, n_folds: int, seed: int = 0
    ) -> Sequence[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
        """Return masks (n,) of rows to fit to and to test with, of each fold; a point's rows are in one fold."""
        names = np.unique(self.point)
        n_folds = min(n_folds, len(names))
        place = dict(
            zip(
                make_generator(seed, "folds").permutation(names), np.arange(len(names)) % n_folds, strict=True
            )
        )
        fold = np.array([place[name] for name in self.point])
        return [(fold != k, fold == k) for k in range(n_folds)] if n_folds > 1 else []


def read_loading_data(source: str | Path) -> LoadingData:
    """Read the loadings of a study.

    Args:
        source: a study's folder, finished or running; or a folder with `loadings.parquet`, `height_fields.parquet` and
            `study.json`, as `drakerock study export --format parquet` leaves them.

    Raises:
        InputError: nothing of the sort there, or no loading that is done and has its height fields.
    """
    folder = Path(source)
    study = read_study(folder)
    if (folder / DATABASE).exists():
        with Store.open(folder) as store:
            loadings, piles = read_loadings(store), read_height_fields(store)
    else:
        loadings, piles = (_read_table(folder / f"{name}.parquet") for name in ("loadings", "height_fields"))
    data = _join(folder, study.problem, study.scenario, loadings, piles)
    return replace(data, keys=tuple(variable.key for variable in study.variables))


def _read_table(path: Path) -> pa.Table:
    try:
        return pyarrow.parquet.read_table(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; exporting the study's tables as Parquet writes it") from None
    except (OSError, pa.ArrowException) as error:
        raise InputError(f"{path}: not a readable table: {error}") from None


def _join(
    folder: Path, problem: Problem, scenario: Scenario, loadings: pa.Table, piles: pa.Table
) -> LoadingData:
    wanted = {
        "loadings": (loadings, [*_KEY, "role", "status", *problem.variable_names, *problem.objective_names]),
        "height_fields": (
            piles,
            [*_KEY, "nx", "ny", "cell", "h_before", "h_after", *PileFeatures.list_names()],
        ),
    }
    for name, (table, columns) in wanted.items():
        missing = [column for column in columns if column not in table.column_names]
        if missing and len(table):
            raise InputError(f"{folder}: the table {name} has no column {', '.join(missing)}")
    seen = {_find_key(row): row for row in piles.to_pylist()} if len(piles) else {}
    rows = [row for row in loadings.to_pylist() if row["status"] == "done" and _find_key(row) in seen]
    rows = [row for row in rows if all(row[name] is not None for name in problem.objective_names)]
    if not rows:
        raise InputError(f"{folder}: no loading of this study is done and has its height fields")
    rows.sort(key=_find_key)
    of_pile = [seen[_find_key(row)] for row in rows]
    forms = {(pile["nx"], pile["ny"], pile["cell"]) for pile in of_pile}
    if len(forms) > 1:
        raise InputError(f"{folder}: height fields on {len(forms)} different grids; one study has one")
    nx, ny, cell = forms.pop()
    # As docs/data.md has the grid: x = 0 is the brow, y = 0 the drift's middle.
    x, y = -cell * (np.arange(nx)[::-1] + 0.5), cell * (np.arange(ny) - 0.5 * (ny - 1))
    before, after = (
        np.array([pile[name] for pile in of_pile], dtype=float).reshape(-1, nx, ny)
        for name in ("h_before", "h_after")
    )
    keys = [_find_key(row) for row in rows]
    place = {key: i for i, key in enumerate(keys)}
    following = np.full_like(before, np.nan)
    for i, (point, attempt, loading) in enumerate(keys):
        if (successor := place.get((point, attempt, loading + 1))) is not None:
            following[i] = before[successor]
    return LoadingData(
        problem, scenario, x, y, cell,
        np.array([[row[name] for name in problem.variable_names] for row in rows], dtype=float),
        np.array([[row[name] for name in problem.objective_names] for row in rows], dtype=float),
        before, after, following,
        np.array([[pile[name] for name in PileFeatures.list_names()] for pile in of_pile], dtype=float),
        point=np.array([row["point"] for row in rows]), attempt=np.array([row["attempt"] for row in rows]),
        loading=np.array([row["loading"] for row in rows]), role=np.array([row["role"] for row in rows]),
    )  # fmt: skip


def _find_key(row: dict[str, object]) -> tuple[str, int, int]:
    return tuple(row[name] for name in _KEY)  # type: ignore[return-value]
