"""What `drakerock autoload` does: learn, load, tell of each loading as it ends, write summary and page."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drakerock.autonomy.decision import Decision
from drakerock.autonomy.model import CHOICES, LoaderModel, load_model
from drakerock.autonomy.preference import Preference, make_preference
from drakerock.autonomy.sequence import DECISION, Adviser, run_autonomous
from drakerock.errors import InputError
from drakerock.files import read_json, write_text
from drakerock.loading.folder import OUTCOME
from drakerock.loading.scenario import Scenario
from drakerock.memory import freeze_imports
from drakerock.study.job_folder import use_folder
from drakerock.study.jobs import calc_sequence_summary
from drakerock.study.replays import update_replay
from drakerock.viewing.autonomy_page import write_autonomy_page


@dataclass(frozen=True)
class AutoloadJob:
    """What is asked for.

    Attributes:
        source: folder of a study, or of its exported tables.
        choice: one of `CHOICES`.
        depth: loadings that ``look_ahead`` looks ahead.
        weights, bounds: the preference, as text.
        then: other weights from a loading on, such as ``10:damage=1``; loadings count from 1.
        cycles: loadings in all.
        replay: whether each loading's replay is written.
    """

    source: Path | None
    choice: str = "look_ahead"
    depth: int = 3
    weights: str | None = None
    bounds: tuple[str, ...] = ()
    then: tuple[str, ...] = ()
    cycles: int = 20
    replay: bool = True


def run_autoload(
    scenario: Scenario,
    job: AutoloadJob,
    folder: Path,
    progress: Callable[..., None],
    say: Callable[[str], None],
) -> tuple[dict[str, Any], list[Path]]:
    """Run or resume a sequence of autonomous loadings.

    Args:
        scenario: the configuration.
        job: what is asked for.
        folder: where to write: loading_00, ... with a cycle's files and decision.json each, sequence.json, the page.
        progress: called with stage, share in [0, 1] or None, and a note.
        say: called with a line on each decision and each outcome.

    Returns:
        The summary, and the paths written.

    Raises:
        InputError: see `run_autonomous`; no model, an unknown choice, a bad preference.
        SimulationFailure: the pile could not be made or refilled.
    """
    if job.source is None:
        raise InputError("model: the folder of a study to learn from is needed, such as out/full_size")
    if job.choice not in CHOICES:
        raise InputError(f"choice {job.choice}: one of {', '.join(CHOICES)}")
    progress("learning", None)
    model = load_model(job.source)
    model.check_fits(scenario)
    preference = read_schedule(model, job)
    _check_reachable(model, preference(0))
    n_points = len(set(model.data.point.tolist()))
    say(f"learned from {len(model.data)} loadings at {n_points} points of {job.source}")
    if differs := model.list_differences(scenario):
        say(f"warning: the study has another {', '.join(differs)}; predictions may be off")
    for line in describe_skill(model, job.choice):
        say(line)
    freeze_imports()

    def tell(number: int, stage: str, time: float) -> None:
        progress(
            stage, number / job.cycles, note=f"loading {number + 1} of {job.cycles}, {time:.1f} s simulated"
        )

    def finish(place: Path) -> None:
        say(describe_loading(place))
        if job.replay and (place / "recording.npz").exists():
            progress("drawing", None, note=place.name)
            update_replay(place, job.cycles)
        write_autonomy_page(folder)

    with use_folder(folder, force=False, sequence=True):
        outcomes = run_autonomous(
            scenario, Adviser(model, str(job.source), job.choice, job.depth), preference, job.cycles, folder,
            progress=tell, decided=lambda number, decision: say(describe_decision(number, decision)), finished=finish,
        )  # fmt: skip
        summary = calc_sequence_summary(outcomes) | {"choice": job.choice, "source": str(job.source)}
        decisions = [read_json(folder / f"loading_{n:02d}" / DECISION) for n in range(len(outcomes))]
        summary["decisions"] = decisions
        summary["fell_back"] = sum(item["fell_back"] for item in decisions)
        summary["cleaned"] = sum(item["cleaned_kg"] is not None for item in decisions)
        write_text(folder / "sequence.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
        page = write_autonomy_page(folder)
    return summary, [page, folder / "sequence.json"]


def describe_skill(model: LoaderModel, choice: str) -> list[str]:
    """Return in lines how well what a choice relies on foretold loadings that were not learned from."""
    if choice in ("fixed", "best_fixed"):
        return []
    skill = model.field_outcome.skill
    shown = ", ".join(f"{name} {100 * max(value, 0.0):.0f} %" for name, value in skill.items())
    lines = [f"explained of what single loadings at other points differ by: {shown}"]
    if choice == "look_ahead":
        lines[0] += f"; of what becomes of the pile: {100 * max(model.pile_model.skill, 0.0):.0f} %"
    if all(value <= 0.0 for value in skill.values()):
        lines.append(
            "warning: the loadings teach nothing about other points; the choice best_fixed is as good, or more data"
        )
    return lines


def read_schedule(model: LoaderModel, job: AutoloadJob) -> Callable[[int], Preference]:
    """Return the preference of each loading by its number from 0.

    Raises:
        InputError: a bad preference, or a change that is not N:WEIGHTS.
    """
    changes = [(0, make_preference(model.problem, job.weights, job.bounds))]
    for text in job.then:
        number, colon, weights = text.partition(":")
        if not colon or not number.strip().isdigit() or int(number) < 1:
            raise InputError(
                f"then {text}: a loading's number and weights, such as 10:production=0.5,damage=0.5"
            )
        changes.append((int(number) - 1, make_preference(model.problem, weights, job.bounds)))
    changes.sort(key=lambda item: item[0])

    def find(number: int) -> Preference:
        return [wanted for start, wanted in changes if start <= number][-1]

    return find


def _check_reachable(model: LoaderModel, preference: Preference) -> None:
    """Raise InputError if no fixed strategy is predicted to keep the bounds."""
    if preference.bounds:
        from drakerock.exploration.strategy import choose_strategy

        choose_strategy(model.front, dict(preference.weights) or None, preference.bounds)


def describe_decision(number: int, decision: Decision) -> str:
    """Return a decision in one line."""
    values = " ".join(f"{name} {value:.2f}" for name, value in decision.strategy.items())
    return f"loading {number + 1}: {values}: {'; '.join(decision.reasons)}"


def describe_loading(place: Path) -> str:
    """Return in one line what came of a loading, against what was predicted."""
    decision, outcome = read_json(place / DECISION), read_json(place / OUTCOME)
    number, predicted = decision["number"] + 1, decision["predicted"] or {}
    if outcome["status"] == "failed":
        return f"loading {number} failed: {outcome['reason']}; the machine stands, nothing more is run"
    parts = []
    for name, value in outcome["objectives"].items():
        told = f" ({predicted[name]['mean']:.4g} predicted)" if name in predicted else ""
        parts.append(f"{name} {value:.4g}{told}")
    return f"loading {number}: {', '.join(parts)}; {outcome['reason']}"
