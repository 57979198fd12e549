"""Single jobs: a scenario in; a folder with a pile, or with one loading cycle, out."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drakerock.dynamics.settling import calc_creep, fetch_pile
from drakerock.loading.cycle import CycleOutcome, make_folder, run_cycle, save_cycle, write_text
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.pile.shapes import load_rock_shapes
from drakerock.pile.site import make_site
from drakerock.pile.state import PileState, save_pile
from drakerock.pile.summary import calc_summary
from drakerock.viewing.pile_figures import write_pile_picture
from drakerock.viewing.pile_page import write_pile_page
from drakerock.viewing.replay import write_replay

# Woken rocks of a pile at rest creep no faster: 30 mm in 5 s [m/s].
REST_SPEED = 0.006


def get_pile(scenario: Scenario, progress: Callable[..., None] | None = None) -> PileState:
    """Return the scenario's pile: the file it names, or from the cache, or made now.

    Raises:
        InputError: an unreadable pile file, or a pile that cannot be made so.
        SimulationFailure: the pile did not come to rest.
    """
    return fetch_pile(make_recipe(scenario), progress)[0]


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
    pile = get_pile(scenario, progress)
    result = run_cycle(
        scenario, pile, lambda mode, time: progress(mode.lower(), None, note=f"{time:.1f} s simulated")
    )
    progress("writing", None)
    paths = save_cycle(result, folder)
    if result.recording is not None:
        write_replay(result.recording, folder / "replay.html")
        paths.append(folder / "replay.html")
    return result.outcome, paths


def make_pile_files(
    scenario: Scenario, folder: Path, progress: Callable[..., None]
) -> tuple[dict[str, Any], list[Path]]:
    """Make or fetch the scenario's pile and write pile.npz, pile.json, pile.png and pile.html.

    Returns:
        The summary, and the paths written. ``at_rest`` is measured: all rocks are woken for half a second.

    Raises:
        InputError: bad configuration, or the folder cannot be written.
        SimulationFailure: the pile could not be made.
    """
    make_folder(folder)
    recipe = make_recipe(scenario)
    pile, source = fetch_pile(recipe, progress)
    shapes = load_rock_shapes(scenario.rocks.shapes)
    progress("measuring", None)
    site = make_site(scenario.site)
    moved = calc_creep(pile, shapes, recipe, scenario.pile.settle_window)
    p99 = float(np.percentile(moved, 99)) if len(moved) else 0.0
    summary = calc_summary(pile, shapes, scenario.rocks, site, scenario.dynamics.time_step) | {
        "at_rest": p99 < max(scenario.pile.settle_speed, REST_SPEED) * scenario.pile.settle_window,
        "creep_mm_p99": round(1e3 * p99, 3),
        "taken_from": str(source),
    }
    progress("writing", None)
    paths = [folder / name for name in ("pile.npz", "pile.json", "pile.png", "pile.html")]
    save_pile(pile, paths[0])
    write_text(paths[1], json.dumps(summary | {"provenance": pile.provenance}, indent=2) + "\n")
    write_pile_picture(pile, shapes, scenario.site, paths[2])
    write_pile_page(pile, shapes, scenario.site, paths[3])
    return summary, paths
