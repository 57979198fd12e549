"""What a finished (or running) study says: report, confirmation, strategy.

A source is a study folder, whose store is exported first; or a folder with a table (`responses.parquet` or
`responses.csv`) and, where there is one, `study.json` beside it; or such a table alone. `FULL_SIZE` is shipped. Of
`study.json`, `problem` (variables and objectives), `exploration` (settings, an `ExplorationConfig`) and `seed` are
used, and all of it is shown in the report.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from drakerock.errors import InputError
from drakerock.exploration.analysis import Progress, explore
from drakerock.exploration.config import Bound, ExplorationConfig
from drakerock.exploration.confirmation import Confirmation, Evaluate, confirm_points
from drakerock.exploration.pareto import ParetoFront, pareto_front, parse_bound, select_spread
from drakerock.exploration.problem import Array, Problem, format_number
from drakerock.exploration.strategy import Strategy, choose_strategy, parse_weights
from drakerock.exploration.surrogate import Surrogate, fit_surrogate
from drakerock.exploration.table import ResponseTable
from drakerock.exploration.validation import calc_learning_curve, validate
from drakerock.exploration.verdict import Grade, Verdict, judge
from drakerock.files import read_json, write_text
from drakerock.resources import find_study_file
from drakerock.study.db import DATABASE
from drakerock.study.replays import link_replays, write_study_replays
from drakerock.study.tables import export_tables

# The shipped study: the method at full size.
FULL_SIZE = Path("studies/full_size")
_CONFIRMATION = "confirmation.json"
# Beside a table: the surrogate fitted to it, so that nobody has to wait for the fit again.
SURROGATE = "surrogate.json"


def run_report(
    source: str | Path,
    out: str | Path | None = None,
    progress: Progress | None = None,
    *,
    replays: bool = False,
) -> list[Path]:
    """Write the report of a study or table; returns the written paths, report.html first.

    Args:
        source: study folder or table file.
        out: folder to write into; None: `report` in the study folder, or beside the table, where the fitted
            surrogate is then kept, too.
        progress: told what is being done.
        replays: make the replay of each loading first; those that are there are linked anyway.

    Raises:
        InputError: see `ResponseTable.load` and `explore`; replays asked for, and no recordings there.
    """
    # matplotlib and plotly take a second to import: only who wants a report pays for it.
    from drakerock.viewing.report import write_report

    source = find_study_file(Path(source))
    if replays:
        write_study_replays(source, progress)
    table, config, seed = _load(source)
    folder = _find_folder(source)
    place = Path(out) if out else folder / "report"
    table = link_replays(table, folder, place)
    confirmation = _read_confirmation(folder / _CONFIRMATION, table.problem)
    name = table.provenance.get("name")
    title = f"Exploration of {name}" if name else f"Exploration of {source.resolve().name}"
    exploration = explore(table, config, seed, confirmation, progress)
    if out is None:
        exploration.surrogate.save(folder / SURROGATE)
    if progress:
        progress("drawing", None)
    return write_report(exploration, place, title)


def run_strategy(
    source: str | Path,
    weights: Mapping[str, float] | str | None = None,
    bounds: Sequence[str] = (),
    progress: Progress | None = None,
    *,
    best: str | None = None,
    probability: float | None = None,
) -> Strategy:
    """Return the Pareto-optimal strategy of a study or table for a trade-off, with a verdict on the study.

    Args:
        source: study folder or table file.
        weights: by objective, as a mapping or as text (``production=0.6,damage=0.4``); None: the knee point.
        bounds: limits such as ``debris<=500``. The front is searched within them.
        progress: told what is being done.
        best: instead of weights: the objective that counts alone, within the bounds.
        probability: with which each bound has to hold; None: 0.9.

    Raises:
        InputError: weights and `best` both; see `parse_weights`, `parse_bound`, `pareto_front` and `choose_strategy`.
    """
    source = find_study_file(Path(source))
    table, config, seed = _load(source)
    if isinstance(weights, str):
        weights = parse_weights(weights, table.problem)
    if best is not None:
        if weights is not None:
            raise InputError("weights and a best objective exclude each other")
        table.problem.get_objective(best)
        weights = {best: 1.0}
    limits = [parse_bound(text, table.problem, probability) for text in bounds]
    surrogate, front = _search_front(source, table, config, seed, limits, progress)
    chosen = choose_strategy(front, weights, limits)
    name = chosen.chosen_by if best is None else _name(best, limits)
    return replace(chosen, verdict=_judge(surrogate, table), chosen_by=name)


def _name(best: str, limits: Sequence[Bound]) -> str:
    within = ", ".join(str(bound) for bound in limits)
    return f"best {best}{f', within {within}' if within else ''}"


class Predictor:
    """What the surrogate of a study or table says of any strategy, with a verdict on how far it can be relied on.

    Args:
        source: study folder or table file.

    Attributes:
        problem: its variables and objectives.
        verdict: on its surrogate.

    Raises:
        InputError: see `ResponseTable.load` and `fit_surrogate`.
    """

    def __init__(self, source: str | Path) -> None:
        source = find_study_file(Path(source))
        table, config, seed = _load(source)
        self.problem = table.problem
        self._surrogate = _get_surrogate(source, table, config, seed)
        self.verdict = _judge(self._surrogate, table)

    def predict(self, values: Mapping[str, float]) -> Strategy:
        """Return the prediction at a point, given by variable name; variables of others are left out.

        Raises:
            InputError: a variable is missing, or outside its range.
        """
        names = self.problem.variable_names
        x = self.problem.make_point({name: values[name] for name in names if name in values})
        y, std = self._surrogate.predict(x[None], return_std=True)
        return Strategy(self.problem, x, y[0], std[0], -1, "hand", verdict=self.verdict)


def _judge(surrogate: Surrogate, table: ResponseTable) -> Verdict:
    accuracy, n_points = validate(surrogate, table), table.role.count("sample")
    verdict = judge(accuracy, n_points)
    # Many refits, and only the advice of a study that falls short is made of them.
    return (
        verdict
        if verdict.grade == Grade.GOOD
        else judge(accuracy, n_points, *calc_learning_curve(surrogate, table))
    )


def run_confirm(
    source: str | Path,
    evaluate: Evaluate,
    n: int | None = None,
    prepare: Callable[[Array], None] | None = None,
    progress: Progress | None = None,
) -> Confirmation:
    """Simulate points of the front again and store predicted against simulated in `confirmation.json`.

    Args:
        source: study folder or table file; `run_report` finds the result there.
        evaluate: from a point (d,) to mean responses and standard errors (k,), in natural senses.
        n: how many points: the knee, the best of each objective, then points spread between them. None: the
            settings' `n_confirm`.
        prepare: called with all points (n, d) before the first is evaluated, to simulate them at once.
        progress: told what is being done until then.

    Raises:
        InputError: see `ResponseTable.load` and `explore`; n below one.
    """
    if n is not None and n < 1:
        raise InputError(f"confirm: asked for {n} points; ask for at least one")
    table, config, seed = _load(Path(source))
    surrogate, front = _search_front(Path(source), table, config, seed, progress=progress)
    chosen = select_spread(front, n or config.n_confirm, [choose_strategy(front).index])
    if progress:
        progress("simulating", None)
    if prepare:
        prepare(front.X[chosen])
    confirmation = confirm_points(surrogate, front.X[chosen], evaluate)
    path = _find_folder(Path(source)) / _CONFIRMATION
    # Whole or not at all: a report may be made while this is written.
    write_text(path, json.dumps(confirmation.to_rows(), indent=2) + "\n")
    return confirmation


def format_confirmation(confirmation: Confirmation) -> str:
    """Return predicted against simulated as text, one line per point and objective."""
    problem = confirmation.problem
    width = max(map(len, problem.objective_names))
    lines = []
    for i, x in enumerate(confirmation.X):
        place = ", ".join(
            f"{name} {value:.3f}" for name, value in zip(problem.variable_names, x, strict=True)
        )
        lines.append(f"point {i}: {place}")
        if confirmation.failure[i]:
            lines.append(f"  failed: {confirmation.failure[i]}")
            continue
        for j, name in enumerate(problem.objective_names):
            predicted = _join(confirmation.predicted[i, j], confirmation.predicted_std[i, j])
            simulated = _join(confirmation.simulated[i, j], confirmation.simulated_se[i, j])
            z = format_number(confirmation.z[i, j], 2)
            lines.append(f"  {name:<{width}}  predicted {predicted:<18}  simulated {simulated:<18}  z {z}")
    return "\n".join(lines)


def _join(value: float, spread: float) -> str:
    return f"{format_number(value, 4)} +- {format_number(spread, 2)}"


def _search_front(
    source: Path,
    table: ResponseTable,
    config: ExplorationConfig,
    seed: int,
    bounds: Sequence[Bound] = (),
    progress: Progress | None = None,
) -> tuple[Surrogate, ParetoFront]:
    tell = progress or (lambda _stage, _share: None)
    tell("fitting", None)
    surrogate = _get_surrogate(source, table, config, seed)
    front = pareto_front(
        surrogate, bounds, config.pareto, seed, lambda share: tell("searching the front", share)
    )
    return surrogate, front


def _get_surrogate(source: Path, table: ResponseTable, config: ExplorationConfig, seed: int) -> Surrogate:
    """Return the surrogate of a table: the one that is kept beside it if it is of these samples and settings."""
    path = _find_folder(source) / SURROGATE
    if path.exists():
        with suppress(InputError):  # a damaged one is no loss
            kept, samples = Surrogate.load(path), table.select("sample")
            if (kept.problem_, kept.config, kept.seed) == (table.problem, config.surrogate, seed) and all(
                np.array_equal(mine, its, equal_nan=True)
                for mine, its in ((kept.X_, samples.X), (kept.Y_, samples.Y), (kept.noise_, samples.noise))
            ):
                return kept
    return fit_surrogate(table, config.surrogate, seed)


def _find_folder(source: Path) -> Path:
    return source if source.is_dir() else source.parent


def _load(source: Path) -> tuple[ResponseTable, ExplorationConfig, int]:
    try:
        stored = (source / DATABASE).exists()
    except OSError as error:  # a name too long, a folder that may not be entered
        raise InputError(f"{source}: cannot be read: {error.strerror}") from None
    if stored:
        export_tables(source, ["parquet"], fields=False)
    table = ResponseTable.load(source)
    path = _find_folder(source) / "study.json"
    try:
        config = ExplorationConfig.model_validate(table.provenance.get("exploration", {}))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in ("exploration", *first["loc"]))
        raise InputError(f"{path}: {key}: {first['msg']}") from None
    seed = table.provenance.get("seed", 0)
    if not isinstance(seed, int) or seed < 0:
        raise InputError(f"{path}: seed must be an integer >= 0, got {seed!r}")
    return table, config, seed


def _read_confirmation(path: Path, problem: Problem) -> Confirmation | None:
    if not path.exists():
        return None
    try:
        rows: list[dict[str, Any]] = read_json(path)
        return Confirmation.from_rows(problem, rows)
    except InputError as error:
        raise InputError(
            f"{path}: {error}; make it again with `drakerock study confirm`, or remove it"
        ) from None
