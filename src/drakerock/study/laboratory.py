"""A test of the laboratory as a job: a scenario's rocks in; a folder with table, curves and picture out."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from drakerock.files import make_folder, write_text
from drakerock.laboratory.lab import find_test, make_settings, run_test
from drakerock.laboratory.material import make_material
from drakerock.laboratory.results import LabResult
from drakerock.loading.scenario import Scenario
from drakerock.viewing.lab_figures import write_lab_picture


def run_and_save_test(
    name: str,
    scenario: Scenario,
    folder: Path,
    overrides: Sequence[str] = (),
    progress: Callable[..., None] | None = None,
) -> tuple[LabResult, list[Path]]:
    """Test the scenario's rocks; write NAME.json and NAME.png.

    Args:
        name: of the test.
        scenario: its rocks, dynamics and seed are used.
        folder: where to write.
        overrides: ``"key=value"`` strings for the test's settings.
        progress: called with what is being done and its share done.

    Raises:
        InputError: an unknown test or setting, too few rocks, or the folder cannot be written.
        SimulationFailure: the dynamics failed.
    """
    test = find_test(name)
    settings = make_settings(test, overrides)
    make_folder(folder)
    material = make_material(scenario.rocks, scenario.dynamics)
    result = run_test(test, material, settings, scenario.seed, progress)
    data, picture = folder / f"{name}.json", folder / f"{name}.png"
    write_text(data, json.dumps(result.to_dict(), indent=1) + "\n")
    write_lab_picture(result, material.shapes, picture)
    return result, [data, picture]
