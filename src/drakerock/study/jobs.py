"""Single jobs: a scenario in; a folder with a pile, or with one loading cycle, out.

What draws pictures is imported by those that do: it takes longer to import than Drake.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat

from drakerock.exploration.noise import calc_standard_error
from drakerock.files import make_folder, write_text
from drakerock.loading.cycle import run_cycle, save_cycle
from drakerock.loading.folder import RECORDING
from drakerock.loading.live import make_live_station
from drakerock.loading.mining import MINING
from drakerock.loading.outcome import CycleOutcome
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.loading.sequence import run_sequence
from drakerock.memory import freeze_imports
from drakerock.rocks.making.cache import fetch_pile
from drakerock.rocks.making.settle import calc_creep
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.site import make_site
from drakerock.rocks.state import PileState, save_pile
from drakerock.rocks.summary import calc_summary
from drakerock.rocks.surveying.survey import survey_scan
from drakerock.study.replays import update_replay
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
    scenario: Scenario,
    folder: Path,
    progress: Callable[..., None],
    *,
    replay: bool = True,
    figures: bool = False,
    meshcat: Meshcat | None = None,
) -> tuple[CycleOutcome, list[Path]]:
    """Get the pile, run the cycle, write its files and the replay.

    Args:
        scenario: the configuration.
        folder: where to write.
        progress: called with stage, share in [0, 1] or None, and a note.
        replay: whether to write replay.html.
        figures: whether to write the pictures, too.
        meshcat: where to show the cycle while it is computed.

    Raises:
        InputError: bad configuration, or the folder cannot be written.
        SimulationFailure: the pile could not be made.
    """
    make_folder(folder)
    freeze_imports()
    pile = get_pile(scenario, progress)
    station = make_live_station(scenario, pile, meshcat) if meshcat else None
    result = run_cycle(
        scenario,
        pile,
        lambda mode, time: progress(mode.lower(), None, note=f"{time:.1f} s simulated"),
        station,
    )
    progress("writing", None)
    paths = save_cycle(result, folder)
    if result.recording is not None:
        if replay:
            paths.append(write_replay(folder))
        if figures:
            from drakerock.viewing.cycle_figures import write_cycle_figures

            progress("drawing", None)
            paths += write_cycle_figures(folder)
    return result.outcome, paths


def run_and_save_sequence(
    scenario: Scenario,
    n_loadings: int,
    folder: Path,
    progress: Callable[..., None],
    *,
    replay: bool = True,
    figures: bool = False,
) -> tuple[dict[str, Any], list[Path]]:
    """Run or resume a sequence of loadings, and write its summary.

    Args:
        scenario: the configuration.
        n_loadings: how many.
        folder: where to write: loading_00, loading_01, ... with a cycle's files each, and sequence.json.
        progress: called with stage, share in [0, 1] or None, and a note.
        replay: whether to write each loading's replay.html, as soon as it is complete.
        figures: whether to write each loading's pictures, too.

    Returns:
        The summary (`calc_sequence_summary`), and the paths written.

    Raises:
        InputError: bad configuration, a folder that cannot be written or that holds another sequence.
        SimulationFailure: the pile could not be made or refilled.
    """

    def tell(number: int, stage: str, time: float) -> None:
        note = f"loading {number + 1} of {n_loadings}, {time:.1f} s simulated"
        progress(stage, number / n_loadings, note=note)

    def show(place: Path) -> None:
        if not (place / RECORDING).exists():
            return
        progress("drawing", None, note=place.name)
        if replay:
            update_replay(place, n_loadings)
        if figures:
            from drakerock.viewing.cycle_figures import write_cycle_figures

            write_cycle_figures(place)

    freeze_imports()
    outcomes = run_sequence(scenario, n_loadings, folder, progress=tell, finished=show)
    places = [folder / f"loading_{number:02d}" for number in range(len(outcomes))]
    summary = calc_sequence_summary(outcomes)
    write_text(folder / "sequence.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
    return summary, [*places, folder / "sequence.json"]


def calc_sequence_summary(outcomes: list[CycleOutcome]) -> dict[str, Any]:
    """Return what a sequence came to: per quantity mean, spread and standard error, what ended each loading, and how
    often each event happened.

    The spread is the standard deviation of single loadings, ``payload_spread_percent`` that of the load over its
    mean; the standard error of the mean allows for successive loadings resembling each other
    (`drakerock.exploration.noise`). Failed loadings count in neither; null where there are too few values.
    """
    objectives = ("production", "damage", "debris")
    values = {name: [outcome.objectives[name] for outcome in outcomes] for name in objectives}
    for name in ("bucket_mass_kg", "weighed_mass_kg", "loading_time_s", "energy_J", "wall_time_s"):
        values[name] = [getattr(outcome, name) for outcome in outcomes]
    for name in MINING:
        values[name] = [(outcome.mining or {}).get(name) for outcome in outcomes]
    quantities = {name: _summarise(column) for name, column in values.items()}
    payload = quantities["bucket_mass_kg"]
    return {
        "loadings": len(outcomes),
        "failed": sum(outcome.status == "failed" for outcome in outcomes),
        "strategy": outcomes[0].strategy if outcomes else None,
        "reasons": [outcome.reason for outcome in outcomes],
        "events": dict(Counter(item["event"] for outcome in outcomes for item in outcome.events or ())),
        "quantities": quantities,
        "payload_spread_percent": 100.0 * payload["spread"] / payload["mean"]
        if payload["spread"] is not None and payload["mean"]
        else None,
        "scenario_hash": outcomes[0].scenario_hash if outcomes else None,
    }


def _summarise(values: list[float | None]) -> dict[str, Any]:
    array = np.array([np.nan if value is None else value for value in values], dtype=float)
    good = array[np.isfinite(array)]
    return {
        "mean": float(good.mean()) if len(good) else None,
        "spread": float(good.std(ddof=1)) if len(good) > 1 else None,
        "standard_error": calc_standard_error(array) if len(good) > 1 else None,
        "values": values,
    }


def make_pile_files(
    scenario: Scenario, folder: Path, progress: Callable[..., None]
) -> tuple[dict[str, Any], list[Path]]:
    """Make or fetch the scenario's pile and write pile.npz, .json, .png and .html; of a scan, scan.png, too.

    Returns:
        The summary, and the paths written. ``at_rest`` is measured: all rocks are woken for half a second.

    Raises:
        InputError: bad configuration, or the folder cannot be written.
        SimulationFailure: the pile could not be made.
    """
    from drakerock.viewing.pile_figures import write_pile_picture
    from drakerock.viewing.pile_page import write_pile_page

    make_folder(folder)
    recipe = make_recipe(scenario)
    pile, source = fetch_pile(recipe, progress)
    shapes = load_rock_shapes(scenario.rocks)
    progress("measuring", None)
    site = make_site(scenario.site)
    moved = calc_creep(pile, shapes, recipe, scenario.pile.settle_window)
    p99 = float(np.percentile(moved, 99)) if len(moved) else 0.0
    summary = calc_summary(pile, shapes, scenario.rocks, site, scenario.dynamics.time_step) | {
        "at_rest": p99 < max(scenario.pile.settle_speed, REST_SPEED) * scenario.pile.settle_window,
        "creep_mm_p99": round(1e3 * p99, 3),
        "taken_from": str(source),
    }
    if "scan" in pile.provenance:
        summary |= {
            f"scan_{name}": value for name, value in pile.provenance["scan"].items() if name != "notes"
        }
    progress("writing", None)
    paths = [folder / name for name in ("pile.npz", "pile.json", "pile.png", "pile.html")]
    save_pile(pile, paths[0])
    write_text(paths[1], json.dumps(summary | {"provenance": pile.provenance}, indent=2) + "\n")
    write_pile_picture(pile, shapes, scenario.site, paths[2])
    write_pile_page(pile, shapes, scenario.site, paths[3])
    if scenario.pile.scan is not None:
        survey = survey_scan(scenario.pile.scan, scenario.site, scenario.pile, scenario.rocks)
        from drakerock.viewing.scan_figures import write_scan_picture

        write_scan_picture(survey, pile, shapes, folder / "scan.png", Path(scenario.pile.scan.file).name)
        paths.append(folder / "scan.png")
    return summary, paths
