"""Scan to pile: five generated shapes and one real terrain, filled with rocks; how near the surface comes.

    python benchmarks/scans.py --out out/scans [SHAPE ...]

Writes scans.json (stored as docs/validation/scans.json) and a picture of each. The terrain is the digital elevation
model of Jacksboro, Tennessee, that matplotlib ships (sample data ``jacksboro_fault_dem.npz``), at a scale of 1:400.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from matplotlib.cbook import get_sample_data
from scipy.ndimage import map_coordinates

from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.loading.sensing import calc_height_field
from drakerock.rocks.making.make import make_pile
from drakerock.rocks.making.settle import calc_creep
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.state import load_pile, save_pile
from drakerock.rocks.summary import calc_gradation
from drakerock.rocks.surveying.survey import survey_scan
from drakerock.viewing.scan_figures import write_scan_picture

# The terrain's scale, and its cell [m]: 3 seconds of arc.
SCALE, CELL = 400.0, 93.0
WIDTH, NOISE, POINTS = 6.0, 0.01, 40_000
SITE = {"drift_width": WIDTH, "void_depth": 1.0, "rear_layer": 0, "drift_length": 20}


def tan(degrees):
    return np.tan(np.deg2rad(degrees))


def cone(x, y):
    return np.maximum(1.9 - tan(32) * np.hypot(x + 3.2, y), 0)


def ridge(x, y):
    return np.maximum(1.6 - tan(30) * np.abs(x + 3.5 + 0.25 * y), 0)


def slope(x, y):
    return np.clip(tan(33) * (x + 3.5), 0, 2.4) + 0 * y


def dug(x, y):
    """The slope after a dig at its middle: a notch of a bucket's width, its faces at 40 degrees."""
    floor = np.maximum(tan(33) * (x + 3.5) - 0.9, 0)
    return np.minimum(slope(x, y), floor + tan(40) * np.maximum(np.abs(y) - 1.0, 0))


def uneven(x, y):
    return np.maximum(
        slope(x, y) * (1 + 0.25 * np.sin(1.3 * y + 0.5)) + 0.25 * np.sin(1.7 * x) * np.cos(1.1 * y) - 0.1, 0
    )


def terrain(x, y):
    """The foot of the Cumberland Mountains: 3.6 x 2.4 km with 580 m of relief."""
    with get_sample_data("jacksboro_fault_dem.npz") as data:
        z = data["elevation"].astype(float)
    cells = SCALE / CELL
    rows, columns = 315 + (y + 0.5 * WIDTH) * cells, 80 + (x + 8) * cells
    h = map_coordinates(z, [rows.ravel(), columns.ravel()], order=1).reshape(x.shape) / SCALE
    return h - z[315:341, 80:119].min() / SCALE


SHAPES = {f.__name__: f for f in (cone, ridge, slope, dug, uneven, terrain)}


def make_scan(name, path):
    rng = np.random.default_rng(7)
    x, y = rng.uniform(-8, 1, POINTS), rng.uniform(-0.5 * WIDTH, 0.5 * WIDTH, POINTS)
    z = SHAPES[name](x, y)
    np.savetxt(path, np.column_stack([x, y, z + NOISE * rng.normal(size=POINTS)]), fmt="%.4f")


def run(name, out):
    scan = out / f"{name}.xyz"
    make_scan(name, scan)
    scenario = Scenario.model_validate(
        {"seed": 1, "site": SITE, "pile": {"scan": {"file": str(scan)}, "settle_speed": 0.02}}
    )
    recipe = make_recipe(scenario)
    begin = time.process_time()
    pile = make_pile(recipe)
    seconds = time.process_time() - begin
    save_pile(pile, out / f"{name}.npz")
    pile = load_pile(out / f"{name}.npz")
    shapes = load_rock_shapes(scenario.rocks)
    survey = survey_scan(scenario.pile.scan, scenario.site, scenario.pile, scenario.rocks)
    write_scan_picture(survey, pile, shapes, out / f"{name}.png", name)
    creep = calc_creep(pile, shapes, recipe, 1.0)
    # As the loading's own sensor sees both: single vertical rays at the cells' middles.
    sensed = calc_height_field(pile, shapes, scenario.site, 0.26, 8.0)
    truth = survey.surface
    rows = np.searchsorted(truth.x, sensed.x - 0.01)
    held = truth.seen[rows] & ((truth.h[rows] > 0.15) | (sensed.h > 0.15))
    single = float(np.sqrt(np.mean((sensed.h - truth.h[rows])[held] ** 2)))
    gradation = calc_gradation(pile, shapes, scenario.rocks)
    return {
        "rocks": len(pile), "mass_t": round(float(sum(g["mass_kg"] for g in gradation)) / 1e3, 1),
        **{k: v for k, v in pile.provenance["scan"].items() if k != "notes"},
        "rms_single_rays_m": round(single, 4), "volume_m3": round(truth.volume, 1),
        "highest_m": round(float(truth.h.max()), 2), "shares": [g["share"] for g in gradation],
        "creep_1s_mm_p99": round(1e3 * float(np.percentile(creep, 99)), 2), "cpu_s": round(seconds, 1),
    }  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/scans"))
    parser.add_argument("shapes", nargs="*", default=[])
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    table = options.out / "scans.json"
    results = json.loads(table.read_text()) if table.exists() else {}
    for shape in options.shapes or SHAPES:
        results[shape] = run(shape, options.out)
        print(shape, results[shape], flush=True)
        table.write_text(json.dumps(results, indent=1) + "\n")
