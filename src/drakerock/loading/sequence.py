"""A sequence: loadings one after the other from one pile (method section 5, a sequence)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from drakerock.errors import InputError, SimulationFailure
from drakerock.files import make_folder
from drakerock.identity import calc_config_hash, get_versions
from drakerock.loading.cost import Meter
from drakerock.loading.cycle import CycleResult, Progress, run_cycle, save_cycle
from drakerock.loading.folder import NEXT_PILE, OUTCOME
from drakerock.loading.outcome import CycleOutcome
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.memory import free_diagrams
from drakerock.randomness import make_generator
from drakerock.rocks.making.cache import fetch_pile
from drakerock.rocks.making.refill import refill
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.state import PileState, load_pile, save_pile

SequenceProgress = Callable[[int, str, float], None]
"""Called with the loading's number, what is being done, and the simulated time [s]."""
Load = Callable[[Scenario, PileState, int, Path, Progress], CycleResult]
"""Runs one loading, given the pile it starts from, its number and its folder; default: `run_cycle`."""


def run_sequence(
    scenario: Scenario,
    n_loadings: int,
    folder: Path,
    *,
    progress: SequenceProgress | None = None,
    finished: Callable[[Path], None] | None = None,
    load: Load | None = None,
) -> list[CycleOutcome]:
    """Run loadings from the scenario's pile: weigh, clean, refill, relax, sense and plan anew.

    Each loading has its own subfolder, whose ``outcome.json`` is written last and at once, after the pile that
    the next loading starts from. Called again with the same folder, the sequence goes on after the last
    complete loading, and ends with the same outcomes, bit for bit, as one that was never interrupted. A failed
    loading is the last: from the same pile the next one would fail in the same way.

    Args:
        scenario: the configuration; its seed also seeds the refills.
        n_loadings: how many.
        folder: where the loadings' subfolders are.
        progress: called as things proceed.
        finished: called with each loading's subfolder once it is complete, also if it was before.
        load: what runs one loading in place of `run_cycle`; what it depends on beside the scenario is its own care.

    Returns:
        The outcomes, fewer than `n_loadings` after a failure.

    Raises:
        InputError: bad configuration, a folder that cannot be written or that holds another sequence.
        SimulationFailure: the pile could not be made or refilled.
    """
    make_folder(folder)
    identity = calc_config_hash(scenario)
    outcomes: list[CycleOutcome] = []
    pile: PileState | None = None
    for number in range(n_loadings):
        place = folder / f"loading_{number:02d}"
        outcome = _read_loading(place, identity)
        if outcome is None:
            if pile is None:
                pile = _read_pile(scenario, folder, number)
            outcome, pile = _run_loading(scenario, pile, number, place, progress, load)
        outcomes.append(outcome)
        if finished:
            finished(place)
        if outcome.status == "failed":
            break
    return outcomes


def _read_pile(scenario: Scenario, folder: Path, number: int) -> PileState:
    """Return the pile that a loading starts from."""
    if number == 0:
        return fetch_pile(make_recipe(scenario))[0]
    return load_pile(folder / f"loading_{number - 1:02d}" / NEXT_PILE)


def _read_loading(place: Path, identity: str) -> CycleOutcome | None:
    path = place / OUTCOME
    if not path.exists():
        return None
    try:
        outcome = CycleOutcome.from_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError, RecursionError):
        raise InputError(
            f"{path}: not a readable outcome; remove {place} to run this loading again"
        ) from None
    if outcome.scenario_hash != identity:
        raise InputError(
            f"{path}: of another scenario ({outcome.scenario_hash}, not {identity}); take another folder"
        )
    if outcome.versions != get_versions():
        raise InputError(
            f"{path}: made by other versions ({_show(outcome.versions)}, not {_show(get_versions())}); take another "
            "folder"
        )
    return outcome


def _show(versions: dict[str, str]) -> str:
    return " ".join(f"{name} {number}" for name, number in versions.items())


def _run_loading(
    scenario: Scenario,
    pile: PileState,
    number: int,
    place: Path,
    progress: SequenceProgress | None,
    load: Load | None,
) -> tuple[CycleOutcome, PileState]:
    def tell(stage: str, time: float) -> None:
        if progress:
            progress(number, stage, time)

    meter = Meter()

    def advance(mode: str, time: float) -> None:
        tell(mode.lower(), time)

    result = load(scenario, pile, number, place, advance) if load else run_cycle(scenario, pile, advance)
    free_diagrams()
    tell("refill", result.outcome.sim_time_s)
    following = make_next_pile(scenario, result, number)
    make_folder(place)
    save_pile(following, place / NEXT_PILE)
    meter.read().save(place)
    save_cycle(result, place)
    return result.outcome, following


def make_next_pile(scenario: Scenario, result: CycleResult, number: int) -> PileState:
    """Return the pile for the next loading: bucket emptied, debris removed, void refilled, all at rest.

    After a failed loading it is the pile before it.

    Args:
        scenario: the configuration.
        result: the loading's.
        number: of the loading, from 0; with the scenario's seed it seeds the refill.

    Raises:
        SimulationFailure: the refilled pile did not come to rest.
    """
    if result.outcome.status == "failed":
        return result.pile_before
    removed = result.in_bucket | result.debris
    rng = make_generator(scenario.seed, "refill", number)
    shapes = load_rock_shapes(scenario.rocks)
    following = refill(result.pile_after, removed, shapes, make_recipe(scenario), rng)
    if not np.all(np.isfinite(following.p_WRs)):
        raise SimulationFailure(f"the refill after loading {number} is not finite")
    return following
