"""The main job: a scenario in, a folder with one loading cycle out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from drakerock.dynamics.settling import PileRecipe, get_pile
from drakerock.loading.cycle import CycleOutcome, make_folder, run_cycle, save_cycle
from drakerock.loading.scenario import Scenario
from drakerock.viewing.replay import write_replay


def make_recipe(scenario: Scenario) -> PileRecipe:
    """Return what the scenario's pile depends on."""
    return PileRecipe(
        seed=scenario.seed,
        site=scenario.site,
        rocks=scenario.rocks,
        pile=scenario.pile,
        dynamics=scenario.dynamics,
    )


def run_and_save(
    scenario: Scenario, folder: Path, progress: Callable[..., None]
) -> tuple[CycleOutcome, list[Path]]:
    """Get the pile, run the cycle, write its files and the replay.

    Args:
        scenario: the configuration.
        folder: where to write.
        progress: called with stage, share in [0, 1] or None, and a note.

    Raises:
        InputError: bad configuration, or the folder cannot be written.
        SimulationFailure: the pile could not be made.
    """
    make_folder(folder)
    pile, _ = get_pile(make_recipe(scenario), progress)
    result = run_cycle(
        scenario, pile, lambda mode, time: progress(mode.lower(), None, note=f"{time:.1f} s simulated")
    )
    progress("writing", None)
    paths = save_cycle(result, folder)
    if result.recording is not None:
        write_replay(result.recording, folder / "replay.html")
        paths.append(folder / "replay.html")
    return result.outcome, paths
