"""Surveys: a scan's keys from a file of their own, and a pile written as a survey of it would be."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drakerock.config import load_config
from drakerock.errors import InputError
from drakerock.files import make_folder, write_text
from drakerock.loading.scenario import Scenario
from drakerock.loading.sensing import calc_height_field, calc_scan, estimate_height_field
from drakerock.loading.station import make_station
from drakerock.randomness import make_generator
from drakerock.rocks.config import ScanConfig
from drakerock.rocks.geometry import make_pile_mesh
from drakerock.rocks.surveying.files import (
    save_cloud_las,
    save_cloud_ply,
    save_field_npz,
    save_field_tiff,
    save_mesh_ply,
)
from drakerock.study.jobs import get_pile


class _Alignment(ScanConfig):
    """A scan's keys without its file, which the command names."""

    file: str = ""


def make_scan_overrides(cloud: Path, align: Path | None) -> list[str]:
    """Return the scenario's overrides for a scan whose keys stand in a YAML file of their own.

    Raises:
        InputError: an unreadable file, an unknown key.
    """
    data: dict[str, Any] = {}
    if align is not None:
        data = load_config(align, _Alignment).model_dump(mode="json", exclude_unset=True)
    data["file"] = str(cloud)
    return ["pile.source=null", "pile.rocks=null", f"pile.scan={json.dumps(data)}"]


def write_survey(
    scenario: Scenario, folder: Path, progress: Callable[..., None]
) -> tuple[dict[str, Any], list[Path]]:
    """Write the scenario's pile as the machine's scanner, standing `distance` before the brow, would survey it.

    ``cloud.ply``, ``cloud.las``: the scanner's points, noise and shadows included, whatever `loading.sensing.kind`.
    ``height.npz``, ``height.tif``: the height field estimated from them. ``true_height.npz``, ``true_height.tif``: the
    ideal sensor's. ``rocks.ply``: the rocks' own surfaces as a mesh. All in W, the site's frame [m].
    What needs a package that is not installed is left out and said.

    Raises:
        InputError: a folder that cannot be written, a pile that cannot be made.
        SimulationFailure: the pile could not be made.
    """
    make_folder(folder)
    pile = get_pile(scenario, progress)
    progress("scanning", None)
    sensing, site = scenario.loading.sensing, scenario.site
    station = make_station(scenario, pile)
    X_WF = station.find_scanning_pose()
    rng = make_generator(scenario.seed, "survey")
    points = calc_scan(pile, station.shapes, sensing.scanner, X_WF, rng)
    length = 0.5 * site.drift_length
    field = estimate_height_field(points, site, sensing.cell, length)
    truth = calc_height_field(pile, station.shapes, site, sensing.cell, length)
    mesh = make_pile_mesh(pile, station.shapes)
    progress("writing", None)
    writers: dict[str, Callable[[Path], None]] = {
        "cloud.ply": lambda path: save_cloud_ply(points, path),
        "cloud.las": lambda path: save_cloud_las(points, path),
        "height.npz": lambda path: save_field_npz(field.x, field.y, field.h, path),
        "height.tif": lambda path: save_field_tiff(field.x, field.y, field.h, path),
        "true_height.npz": lambda path: save_field_npz(truth.x, truth.y, truth.h, path),
        "true_height.tif": lambda path: save_field_tiff(truth.x, truth.y, truth.h, path),
        "rocks.ply": lambda path: save_mesh_ply(mesh, path),
    }
    paths, left_out = [], []
    for name, write in writers.items():
        try:
            write(folder / name)
        except InputError as error:
            if "pip install" not in str(error):
                raise
            left_out.append(f"{name}: {error}")
            continue
        paths.append(folder / name)
    difference = (field.h - truth.h)[(truth.h > sensing.front_height) | (field.h > sensing.front_height)]
    summary = {
        "points": len(points),
        "rocks": len(pile),
        "cells": int(field.h.size),
        "scanned_volume_m3": round(float(field.h.sum()) * field.cell**2, 2),
        "true_volume_m3": round(float(truth.h.sum()) * truth.cell**2, 2),
        "rms_to_true_m": round(float(np.sqrt(np.mean(difference**2))), 4) if difference.size else 0.0,
        "left_out": left_out,
    }
    write_text(folder / "survey.json", json.dumps(summary, indent=2) + "\n")
    return summary, [*paths, folder / "survey.json"]
