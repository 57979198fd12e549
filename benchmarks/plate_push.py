"""A plate of 30 t pushed into a small pile with 80 kN, by variants of both engines: python benchmarks/plate_push.py

What is displaced differed between engines; the finer solution tells which is right. `--bench full`: a plate of 60 t and
300 kN in the shipped pile of 5 770 rocks, between boxes for the drift's and the void's walls. Needed: pip install
rapier3d. Runs are added to a file of lines, and skipped if stored.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rapier3d as rapier
from laboratory_peers import RapierRig
from scipy.stats import t as student

from drakerock.laboratory.beds import calc_profile, fit_slope, make_bin
from drakerock.laboratory.material import Material, make_material
from drakerock.laboratory.repose import make_slope
from drakerock.laboratory.rig import DrakeRig
from drakerock.laboratory.scene import Mover, Scene, Slab
from drakerock.loading.scenario import load_scenario
from drakerock.randomness import derive_seed
from drakerock.rocks.state import PileState, load_pile, save_pile
from drakerock.study.jobs import get_pile as get_scenario_pile

# Times [s].
RELAXING, PUSHING, RESTING = 1.0, 2.5, 0.5
THRESHOLDS = (0.01, 0.02, 0.05, 0.1, 0.2)
ROCKS = 400
# Of the plate, its edge forward, on the floor [m].
THICKNESS, LENGTH, GAP = 0.1, 6.0, 0.03
# Thickness of the full bench's walls, and of the rock above the brow [m].
WALL, FACE = 2.0, 0.3


@dataclass(frozen=True)
class Push:
    """A plate's width [m] and mass [kg], and the force on it [N]."""

    width: float
    mass: float
    force: float


# The small pile bears less.
PUSHES = {"small": Push(1.4, 30e3, 80e3), "full": Push(2.7, 60e3, 300e3)}
NONE = "dynamics.nonsmooth.reduction=none"
# Name: settings of the scenario, for the nonsmooth engine.
OURS = {
    "drakerock": (),
    "all awake": (NONE,),
    "all awake, 400 iterations": (NONE, "dynamics.nonsmooth.iterations=400"),
    "all awake, searched in every step": (
        NONE, "dynamics.nonsmooth.search_period=1", "dynamics.nonsmooth.search_distance=0",
        "dynamics.nonsmooth.slow_speed=0",
    ),
    "all awake, 2.5 ms": (NONE, "dynamics.time_step=0.0025"),
    "all awake, 1 ms, 200 iterations": (
        NONE, "dynamics.time_step=0.001", "dynamics.nonsmooth.iterations=200",
    ),
    "sharp": (NONE, "dynamics.nonsmooth.rounding=0.002"),
    "sharp, one point per pair": (
        NONE, "dynamics.nonsmooth.rounding=0.002", "dynamics.nonsmooth.manifold_points=1",
    ),
    "no spin damping": (NONE, "dynamics.nonsmooth.spin_damping=0"),
    "one point per pair": (NONE, "dynamics.nonsmooth.manifold_points=1"),
}  # fmt: skip
# Name: Rapier's substeps, iterations, and what is done to its settings.
THEIRS = {
    "rapier as it comes": (1, 4, {"friction_model": rapier.FrictionModel.SIMPLIFIED}),
    "rapier, Coulomb": (1, 4, {}),
    "rapier, 16 iterations": (1, 16, {}),
    "rapier, 5 ms, 16 iterations": (2, 16, {}),
    "rapier, 2.5 ms, 32 iterations": (4, 32, {}),
    "rapier, 2.5 ms, 32 iterations, stiff": (4, 32, {"stiff": True}),
    "rapier, 1 ms, 64 iterations, stiff": (10, 64, {"stiff": True}),
}


def make_rig(name: str, scene: Scene, pile: PileState, material: Material) -> object:
    if name in OURS:
        return DrakeRig(scene, pile, material)
    substeps, iterations, changes = THEIRS[name]
    rig = RapierRig(scene, pile, material, substeps, iterations)
    settings = rig.world.integration_parameters
    for key, value in changes.items():
        if key == "stiff":
            settings.contact_softness = rapier.SpringCoefficients(natural_frequency=300.0, damping_ratio=1.0)
            settings.static_contact_softness = rapier.SpringCoefficients(
                natural_frequency=300.0, damping_ratio=1.0
            )
        else:
            setattr(settings, key, value)
    return rig


def get_pile(seed: int, material: Material, folder: Path) -> PileState:
    path = folder / f"pile_{ROCKS}_{seed}.npz"
    if not path.exists():
        room = make_bin(material, ROCKS, 2.2, 1.3)
        _, pile, _ = make_slope(
            material, room, ROCKS, derive_seed(0, "plate push", seed) % 2**31, DrakeRig, 1.0
        )
        save_pile(pile, path)
    return load_pile(path)


@dataclass(frozen=True)
class Start:
    """A pile without the single rocks before it, where it begins, and the walls around it."""

    pile: PileState
    toe: float
    walls: tuple[Slab, ...]


def make_start(seed: int, folder: Path) -> Start:
    scenario = load_scenario(None, ())
    material = make_material(scenario.rocks, scenario.dynamics)
    d = material.mean_size
    room = make_bin(material, ROCKS, 2.2, 1.3)
    pile = get_pile(seed, material, folder)
    x = np.arange(-4.0 * room.height, room.length, 0.25 * d)
    slope, offset = fit_slope(x, calc_profile(pile, material, x, 0.4 * room.width))
    toe = -offset / slope
    pile = pile.select(pile.p_WRs[:, 0] > toe - 0.5 * d)
    return Start(pile, toe, room.make_walls("flre", 0.0, 4.0 * room.height))


def make_full_start() -> Start:
    """Return the shipped pile; its curved roof is a box at the crown's height."""
    scenario = load_scenario(None, ())
    site, material = scenario.site, make_material(scenario.rocks, scenario.dynamics)
    pile = get_scenario_pile(scenario)
    x = np.arange(-8.0, 0.0, 0.25 * material.mean_size)
    slope, offset = fit_slope(x, calc_profile(pile, material, x, 1.5))
    toe = -offset / slope
    pile = pile.select(pile.fixed | (pile.p_WRs[:, 0] > toe - 0.5 * material.mean_size))
    length, height, middle = site.void_depth + 20.0, site.void_height, 0.5 * (site.void_depth - 20.0)
    width, top, lean = site.drift_width, site.drift_height, np.deg2rad(site.wall_lean_deg)
    # The middle of the face above the brow, and out of the rock's side of it.
    up, out = np.array([-np.sin(lean), 0.0, np.cos(lean)]), np.array([np.cos(lean), 0.0, np.sin(lean)])
    face = np.array([0.0, 0.0, top]) + 0.5 * (height * up - FACE * out)
    friction = 2.0 / (1.0 / site.friction + 1.0 / scenario.rocks.friction)
    walls = (
        Slab((length, width + 2.0 * WALL, WALL), (middle, 0.0, -0.5 * WALL), friction=friction),
        *(Slab((length, WALL, height), (middle, side * 0.5 * (width + WALL), 0.5 * height), friction=friction)
          for side in (-1.0, 1.0)),
        Slab((WALL, width, height), (site.void_depth + 0.5 * WALL, 0.0, 0.5 * height), friction=friction),
        Slab((20.0, width, FACE), (-10.0 - FACE, 0.0, top + 0.5 * FACE), friction=friction),
        Slab((FACE, width, height), tuple(face), -lean, friction),
    )  # fmt: skip
    return Start(pile, toe, walls)


def make_variant(name: str) -> Material:
    scenario = load_scenario(None, OURS.get(name, ()))
    return make_material(scenario.rocks, scenario.dynamics)


def run(name: str, bench: str, seed: int, folder: Path) -> dict[str, float]:
    begin = make_full_start() if bench == "full" else make_start(seed, folder)
    pile, toe, material, push = begin.pile, begin.toe, make_variant(name), PUSHES[bench]
    ahead = pile.p_WRs[:, 2] < 1.0
    start = float(np.min((pile.p_WRs[:, 0] - 0.8 * pile.size)[ahead])) - 0.2
    plate = Slab(
        (LENGTH, push.width, THICKNESS), (start - 0.5 * LENGTH, 0.0, GAP + 0.5 * THICKNESS), friction=0.4
    )
    mover = Mover("plate", (plate,), (1.0, 0.0, 0.0), drive="force", mass=push.mass)
    cpu = time.process_time()
    rig = make_rig(name, Scene(begin.walls, (mover,)), pile, material)
    rig.advance(RELAXING)
    before = rig.get_pile().p_WRs
    record = rig.advance(PUSHING, {"plate": push.force})
    pushed = rig.get_pile().p_WRs
    rig.advance(RESTING, {"plate": push.force})
    after = rig.get_pile().p_WRs
    volumes = material.calc_volumes(pile)

    def calc_moved(a: np.ndarray, b: np.ndarray, far: float) -> float:
        return float(volumes[np.linalg.norm(b - a, axis=1) > far].sum())

    travel, force = record.travels["plate"], -record.forces["plate"][:, 0]
    result = {
        "relaxed_5cm_m3": calc_moved(pile.p_WRs, before, 0.05),
        "rested_5cm_m3": calc_moved(pushed, after, 0.05),
        "reach_m": float(travel.max() - (toe - start)),
        "last_metre_kN": float(force[travel > travel.max() - 1.0].mean()) / 1e3,
        "peak_kN": float(force.max()) / 1e3,
        "lowest_m": float(after[:, 2].min()),
        "cpu_s": round(time.process_time() - cpu, 1),
    }
    return result | {f"moved_{100 * far:g}cm_m3": calc_moved(before, pushed, far) for far in THRESHOLDS}


COLUMNS = (
    "reach_m",
    "last_metre_kN",
    "relaxed_5cm_m3",
    "moved_1cm_m3",
    "moved_5cm_m3",
    "moved_20cm_m3",
    "cpu_s",
)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--variants", nargs="+", choices=[*OURS, *THEIRS], default=[*OURS, *THEIRS])
    parser.add_argument("--bench", choices=list(PUSHES), default="small")
    parser.add_argument("--piles", type=int, default=4, help="of the small bench")
    parser.add_argument("--out", type=Path, default=Path("build/plate_push"))
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    path = options.out / ("force.jsonl" if options.bench == "small" else "force_full.jsonl")
    lines = path.read_text().splitlines() if path.exists() else []
    stored = {(one["variant"], one["pile"]): one for one in map(json.loads, lines)}
    for seed in range(options.piles if options.bench == "small" else 1):
        for name in options.variants:
            if (name, seed) in stored:
                continue
            found = {k: round(v, 4) for k, v in run(name, options.bench, seed, options.out).items()}
            stored[name, seed] = {"variant": name, "pile": seed, **found}
            with open(path, "a", encoding="utf-8") as file:
                file.write(json.dumps(stored[name, seed]) + "\n")
            print(name, seed, found, flush=True)
    print("| variant | piles | " + " | ".join(COLUMNS) + " |")
    print("|---" * (2 + len(COLUMNS)) + "|")
    for name in options.variants:
        rows = [one for (variant, _), one in stored.items() if variant == name]
        cells = [_show(np.array([row[key] for row in rows])) for key in COLUMNS]
        print(f"| {name} | {len(rows)} | " + " | ".join(cells) + " |")


def _show(values: np.ndarray) -> str:
    if len(values) < 2:
        return f"{values.mean():.3g}" if len(values) else "-"
    half = student.ppf(0.95, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return f"{values.mean():.3g} ± {half:.2g}"


if __name__ == "__main__":
    main()
