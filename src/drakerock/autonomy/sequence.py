"""Loadings one after the other, each decided by its pile: sense -> choose -> plan -> load -> refill -> sense."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakerock.autonomy.choices import Choice
from drakerock.autonomy.decision import Decision
from drakerock.autonomy.loader import AutonomousLoader
from drakerock.autonomy.model import LoaderModel
from drakerock.autonomy.preference import Preference
from drakerock.errors import InputError
from drakerock.files import make_folder, read_json, write_text
from drakerock.loading.cycle import CycleResult, Progress, run_cycle
from drakerock.loading.field_file import load_height_fields
from drakerock.loading.folder import HEIGHT_FIELDS, OUTCOME
from drakerock.loading.outcome import CycleOutcome
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.loading.sequence import SequenceProgress, run_sequence
from drakerock.loading.station import Station, make_station
from drakerock.randomness import make_generator
from drakerock.rocks.contact_graph import find_loose
from drakerock.rocks.making.refill import refill
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.state import PileState
from drakerock.study.db import read_outcome
from drakerock.study.objectives import get_objective

DECISION = "decision.json"
AUTOLOAD = "autoload.json"


@dataclass(frozen=True)
class Adviser:
    """What decides.

    Attributes:
        model: what was learned.
        source: folder that it was learned from, as the scenario names it.
        choice: one of `drakerock.autonomy.model.CHOICES`.
        depth: loadings that ``look_ahead`` looks ahead.
    """

    model: LoaderModel
    source: str
    choice: str = "look_ahead"
    depth: int = 3

    def describe(self) -> dict[str, Any]:
        """Return what decisions depend on besides pile and preference."""
        return {
            "model": self.source, "choice": self.choice, "depth": self.depth, "seed": self.model.seed,
            "learned_from": self.model.learned_from,
        }  # fmt: skip


def run_autonomous(
    scenario: Scenario,
    adviser: Adviser,
    preference: Callable[[int], Preference],
    n_loadings: int,
    folder: Path,
    *,
    progress: SequenceProgress | None = None,
    decided: Callable[[int, Decision], None] | None = None,
    finished: Callable[[Path], None] | None = None,
) -> list[CycleOutcome]:
    """Run or resume a sequence of autonomous loadings.

    As `run_sequence`, with ``decision.json`` in each loading's folder, written before the loading begins. A choice that
    learns does so from what is stored: resumed, it has learned the same. The preference may differ between loadings and
    between runs; each decision tells its own. A failed loading is recorded and is the last.

    Args:
        scenario: the configuration; its planner gives way to the autonomous loader.
        adviser: what decides.
        preference: what is wanted of each loading, by its number from 0.
        n_loadings: how many.
        folder: where the loadings' subfolders are.
        progress: called as things proceed.
        decided: called with each loading's number and what was decided.
        finished: called with each loading's subfolder once it is complete, also if it was before.

    Returns:
        The outcomes, fewer than `n_loadings` after a failure.

    Raises:
        InputError: as `run_sequence`; a model that does not fit the scenario; a folder begun with another adviser; a
            pile that cannot be entered, or a preference that no strategy keeps.
        SimulationFailure: the pile could not be made or refilled.
    """
    adviser.model.check_fits(scenario)
    make_folder(folder)
    _check_folder(folder, adviser)
    part = {"system": "drakerock.autonomy.loader:make_loader", "parameters": adviser.describe()}
    scenario = scenario.replace(**{"loading.parts.planner": part})
    sequence = _Sequence(adviser, preference, decided)

    def finish(place: Path) -> None:
        sequence.learn(place)
        if finished:
            finished(place)

    return run_sequence(scenario, n_loadings, folder, progress=progress, finished=finish, load=sequence.load)


class _Sequence:
    """A sequence under way; it holds the choice, which learns."""

    def __init__(
        self,
        adviser: Adviser,
        preference: Callable[[int], Preference],
        decided: Callable[[int, Decision], None] | None,
    ) -> None:
        self._adviser, self._preference, self._decided = adviser, preference, decided
        self._choice: Choice | None = None
        self._unlearned: list[Path] = []

    def load(
        self, scenario: Scenario, pile: PileState, number: int, place: Path, progress: Progress
    ) -> CycleResult:
        """Run one loading: look, decide, clean if need be, load."""
        choice = self._get_choice(scenario)
        preference = self._preference(number)
        progress("sense", 0.0)
        station, decision = self._decide(scenario, pile, choice, preference, cleaned=False)
        cleaned_kg = None
        if decision.action == "clean":
            progress("clean", 0.0)
            pile, cleaned_kg = clean_floor(scenario, pile, number)
            first = decision
            station, decision = self._decide(scenario, pile, choice, preference, cleaned=True)
            decision = _join(first, decision)
        make_folder(place)
        told = decision.to_dict() | {"cleaned_kg": cleaned_kg, "number": number}
        write_text(place / DECISION, json.dumps(told, indent=2, allow_nan=False) + "\n")
        if decision.action == "stop":
            raise InputError(f"loading {number + 1}: {decision.reasons[-1]}")
        if self._decided:
            self._decided(number, decision)
        return run_cycle(scenario, pile, progress, station)

    def learn(self, place: Path) -> None:
        """Note a loading that is complete; it is learned from when the next one is decided."""
        self._unlearned.append(place)

    def _get_choice(self, scenario: Scenario) -> Choice:
        adviser = self._adviser
        choice = self._choice or adviser.model.make_choice(
            adviser.choice, scenario.loading.strategy, adviser.depth
        )
        for place in self._unlearned:
            choice = _learn(choice, adviser.model, place)
        self._choice, self._unlearned = choice, []
        return choice

    def _decide(
        self, scenario: Scenario, pile: PileState, choice: Choice, preference: Preference, *, cleaned: bool
    ) -> tuple[Station, Decision]:
        model = self._adviser.model
        station = make_station(
            scenario,
            pile,
            planner=lambda view, **_: AutonomousLoader(
                model, choice, view.scenario, view.digger, preference, cleaned=cleaned
            ),
            visible=False,
        )
        root = station.diagram.CreateDefaultContext()
        station.initialize(root)
        context = station.planner.GetMyContextFromRoot(root)
        return station, station.planner.GetOutputPort("decision").Eval(context)


def clean_floor(scenario: Scenario, pile: PileState, number: int) -> tuple[PileState, float]:
    """Return the pile without the rocks that are loose on the floor, refilled and at rest, and their mass [kg].

    Raises:
        SimulationFailure: it did not come to rest.
    """
    shapes = load_rock_shapes(scenario.rocks)
    loose = find_loose(pile, shapes, scenario.pile.contact_gap)
    if not loose.any():
        return pile, 0.0
    volumes = np.array([shape.volume for shape in shapes])
    mass = float(pile.calc_masses(volumes, scenario.rocks.density)[loose].sum())
    rng = make_generator(scenario.seed, "clean", number)
    return refill(pile, loose, shapes, make_recipe(scenario), rng), mass


def _join(first: Decision, second: Decision) -> Decision:
    """Return the second decision with the first one's reasons before its own."""
    values = vars(second) | {"reasons": (*first.reasons, *second.reasons)}
    return Decision(**values)


def _learn(choice: Choice, model: LoaderModel, place: Path) -> Choice:
    data = read_json(place / DECISION, "a readable decision")
    outcome = read_outcome(place / OUTCOME)
    if outcome.status == "failed" or not (place / HEIGHT_FIELDS).exists():
        return choice
    before, _ = load_height_fields(place / HEIGHT_FIELDS)
    Y = np.array([get_objective(name).evaluate(outcome) for name in model.problem.objective_names])
    return choice.learn(before.h, np.array(data["x"], dtype=float), Y)


def _check_folder(folder: Path, adviser: Adviser) -> None:
    path, now = folder / AUTOLOAD, adviser.describe()
    if path.exists():
        differs = [key for key, value in now.items() if read_json(path).get(key) != value]
        if differs:
            raise InputError(
                f"{path}: this sequence was begun with another {', '.join(differs)}; take another folder, or the same "
                "adviser (a running study's loadings grow: export them once, and learn from the tables)"
            )
        return
    if any(folder.glob("loading_[0-9][0-9]")):
        raise InputError(f"{folder}: holds loadings of another kind; take another folder")
    write_text(path, json.dumps(now, indent=2) + "\n")
