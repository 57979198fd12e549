"""One rock under the edge of a plate at a given speed, by variants of both engines: python benchmarks/plate_jam.py

A rock of 0.8 m lies on the floor; a plate 0.52 m over the floor is pushed against it at 0.6 m/s. Where the rock jams
between edge and floor, the force is what the contacts' stiffness makes of it. Needed: pip install rapier3d.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from plate_push import OURS, THEIRS, make_rig

from drakerock.laboratory.beds import settle, take_out
from drakerock.laboratory.material import make_material
from drakerock.laboratory.rig import DrakeRig
from drakerock.laboratory.scene import Mover, Scene, Slab
from drakerock.loading.scenario import load_scenario
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.geometry import make_pile_mesh
from drakerock.rocks.making.scatter import scatter_rocks

SIZE, HEIGHT, SPEED, WAY = 0.8, 0.52, 0.6, 1.2
ROCK = RocksConfig.model_validate({"gradation": [{"size_m": SIZE, "mass_fraction": 1.0}]})
FLOOR = Slab((40.0, 40.0, 4.0), (0.0, 0.0, -2.0))
VARIANTS = (
    "drakerock",
    "all awake, 2.5 ms",
    "rapier as it comes",
    "rapier, 5 ms, 16 iterations",
    "rapier, 2.5 ms, 32 iterations, stiff",
    "rapier, 1 ms, 64 iterations, stiff",
)


def run(name: str, seed: int) -> tuple[float, float]:
    """Return the greatest force [kN] and how deep the rock was pressed into the floor [mm]."""
    material = make_material(ROCK, load_scenario(None, OURS.get(name, ())).dynamics)
    usual = make_material(ROCK, load_scenario().dynamics)
    rig = DrakeRig(Scene((FLOOR,)), scatter_rocks(1, (0, -1, 0), (2, 1, 1.4), ROCK, seed), usual)
    settle(rig, usual)
    rock = take_out(rig.get_pile(), 0.0)
    start = float(make_pile_mesh(rock, material.shapes).vertices[:, 0].min()) - 0.02
    plate = Slab((6.0, 4.0, 0.1), (start - 3.0, 0.0, HEIGHT + 0.05), friction=0.4)
    rig = make_rig(name, Scene((FLOOR,), (Mover("plate", (plate,), (1.0, 0.0, 0.0)),)), rock, material)
    peak, deepest = 0.0, 0.0
    for _ in range(round(WAY / SPEED / 0.05)):
        record = rig.advance(0.05, {"plate": SPEED})
        peak = max(peak, float(-record.forces["plate"][:, 0].min()))
        low = make_pile_mesh(rig.get_pile(), material.shapes).vertices[:, 2].min()
        deepest = max(deepest, -float(low))
    return peak / 1e3, 1e3 * deepest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--variants", nargs="+", choices=[*OURS, *THEIRS], default=list(VARIANTS))
    parser.add_argument("--rocks", type=int, default=8)
    parser.add_argument("--out", type=Path, default=Path("build/plate_jam.jsonl"))
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    print("| variant | greatest force by rock [MN] | deepest in the floor [mm] |")
    print("|---|---|---|")
    for name in options.variants:
        found = np.array([run(name, seed) for seed in range(options.rocks)])
        with open(options.out, "a", encoding="utf-8") as file:
            entry = {"variant": name, "peak_kN": found[:, 0].tolist(), "in_floor_mm": found[:, 1].tolist()}
            file.write(json.dumps(entry) + "\n")
        peaks = ", ".join(f"{peak / 1e3:.3g}" for peak in found[:, 0])
        print(f"| {name} | {peaks} | {found[:, 1].max():.0f} |", flush=True)


if __name__ == "__main__":
    main()
