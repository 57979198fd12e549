"""The nonsmooth engine against the plant engine: the same machine digs the same small piles.

    python benchmarks/compare_engines.py digs --rocks 300 --seeds 4 --points 1 --out build/engines.jsonl
    python benchmarks/compare_engines.py states --seeds 8 --variants nonsmooth,manifold_points=1 plant

`digs`: each seed is one pile, filled and at rest in the nonsmooth engine, relaxed for a second in each engine with
the machine standing, then dug with the same motor targets. Finished runs are skipped, unless they were of another
pile: that of a seed comes out otherwise on another processor. The table is over all that are stored; `--seeds 0` makes
it alone. `--points 1`: the nonsmooth engine with one contact point per pair, as the plant engine's point contact has
it. `--against hydroelastic`: the plant engine with pressure fields over faces instead of single points, five times as
dear. `--set damping_time=2`: another setting of the nonsmooth engine; give it an `--out` of its own. `--repeats 3`:
each pile is dug three times in the nonsmooth engine, with one more iteration each, and their mean taken: digs are
chaotic, these are cheap.

One contact law in both, of the same sharp rocks, is `--points 1 --dissipation 0 --set linear_overlap=0.001
damping_time=1 impact_threshold=50 rounding=0.002`: the plant's springs, as damped as an implicit Euler step makes them,
also for what comes near, and no rigid impacts. (The plant's usual Hunt-Crossley dissipation has no counterpart in the
other; what the machine's steel has of it remains, a tenth beside soft rocks.)

`states` stops a dig of the first variant every half second; all variants go on from there for 0.3 s, and their pushes
are compared. A variant is an engine with settings of its own, `time_step` and the plant's `dissipation` among them.
That tells within minutes where engines, contact laws or time steps part, which whole digs hide in chaos. Piles that are
stored are skipped here, too.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from faithfulness import SIZES, compare, make_small_pile
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from rocks import ROCKS, SHAPES, TIME_STEP, HeldRates, calc_bucket_mass, clear_way, make_dig

from drakerock.lhd.config import MachineConfig
from drakerock.lhd.model import add_machine
from drakerock.lhd.motors import add_motors
from drakerock.lhd.placement import set_machine_pose
from drakerock.lhd.rocks import add_lhd_rocks
from drakerock.rocks.drake.drift import AddDrift
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.drake.plant_engine import AddRockBodies
from drakerock.rocks.engine.config import DynamicsConfig, NonsmoothConfig, PlantEngineConfig
from drakerock.rocks.site import make_site
from drakerock.rocks.state import PileState

METRICS = ("bucket_mass_kg", "peak_push_kN", "mean_push_kN", "displaced_m3", "reach_m")
RELAXING = 1.0
SMALL_SITE = SIZES["300"][1]
# Of `states`: when digs are stopped [s], and between which times after it pushes are compared [s]. States whose push is
# below this say nothing [kN].
STATE_TIMES, STATE_WINDOWS, MIN_PUSH = np.arange(1.0, 6.1, 0.5), (0.0, 0.05, 0.1, 0.2, 0.3), 20.0


@dataclass(frozen=True)
class Variant:
    """An engine with its settings; `nonsmooth` are those of the nonsmooth engine."""

    engine: str
    nonsmooth: dict[str, float]
    dissipation: float = PlantEngineConfig().dissipation
    time_step: float = TIME_STEP
    name: str = ""


def parse_setting(text: str) -> tuple[str, float]:
    """Return key and value of a text such as `damping_time=2`."""
    key, value = text.split("=")
    return key, float(value)


def parse_variant(text: str) -> Variant:
    """Return the variant of a text such as `nonsmooth,manifold_points=1,time_step=0.005`."""
    engine, *items = text.split(",")
    if engine not in ("nonsmooth", "plant", "hydroelastic"):
        raise argparse.ArgumentTypeError(f"{engine}: one of nonsmooth, plant, hydroelastic")
    settings = dict(map(parse_setting, items))
    general = {key: settings.pop(key) for key in ("dissipation", "time_step") if key in settings}
    return Variant(engine, settings, **general, name=text)


class Dig:
    """A machine before a pile on the small site: it stands still for a second, then digs.

    Args:
        pile: the rocks.
        variant: what moves them.
        depth: of the dig [m].
    """

    def __init__(self, pile: PileState, variant: Variant, depth: float) -> None:
        dynamics = DynamicsConfig(
            rocks="nonsmooth" if variant.engine == "nonsmooth" else "plant",
            plant=PlantEngineConfig(
                contact_model="hydroelastic" if variant.engine == "hydroelastic" else "point",
                dissipation=variant.dissipation,
            ),
            time_step=variant.time_step,
        )
        if variant.engine == "nonsmooth":
            dynamics = dynamics.replace(nonsmooth=NonsmoothConfig(reduction="none", **variant.nonsmooth))
        builder = DiagramBuilder()
        self.plant, scene_graph = add_plant(builder, dynamics)
        AddDrift(self.plant, make_site(SMALL_SITE), dynamics.plant)
        self.machine = add_machine(self.plant, MachineConfig())
        bodies = None
        if dynamics.rocks == "plant":
            bodies = AddRockBodies(
                self.plant, pile, ROCKS, dynamics.plant, dynamics.reference_overlap, SHAPES
            )
        self.plant.Finalize()
        rates = make_dig(depth)

        def delayed(t: float) -> tuple[float, float, float]:
            return rates(t - RELAXING) if t > RELAXING else (0.0, 0.0, 0.0)

        motors = add_motors(builder, self.plant, self.machine)
        builder.Connect(
            builder.AddSystem(HeldRates(delayed)).get_output_port(), motors.GetInputPort("motor_speeds")
        )
        self.rocks = add_lhd_rocks(
            builder, self.plant, scene_graph, self.machine, pile, ROCKS, dynamics, SMALL_SITE,
            shapes=SHAPES, bodies=bodies,
        )  # fmt: skip
        self.bucket_force = self.rocks.get_body_force_output_port(self.plant.GetBodyByName("bucket").index())
        self.simulator = Simulator(builder.Build())
        self.root = self.simulator.get_mutable_context()
        self.plant_context = self.plant.GetMyMutableContextFromRoot(self.root)
        self.rocks.set_pile(self.root, pile)
        x_tip = float(pile.p_WRs[:, 0].min()) - 0.7
        set_machine_pose(self.plant, self.plant_context, self.machine, x_tip=x_tip, z_tip=0.02)
        self.simulator.Initialize()

    def go_on_from(self, other: Dig) -> None:
        """Take over time and state of another dig of the same rocks."""
        self.root.SetTime(other.root.get_time())
        self.rocks.set_pile(self.root, other.rocks.get_pile(other.root))
        of_machine = self.machine.instance, other.machine.instance
        self.plant.SetPositionsAndVelocities(
            self.plant_context,
            of_machine[0],
            other.plant.GetPositionsAndVelocities(other.plant_context, of_machine[1]),
        )
        self.simulator.Initialize()

    def advance(self, duration: float) -> Iterator[float]:
        """Go on so long [s]; yield the push on the rocks after each step [N]."""
        start, time_step = self.root.get_time(), self.plant.time_step()
        context = self.rocks.GetMyContextFromRoot(self.root)
        for k in range(round(duration / time_step)):
            self.simulator.AdvanceTo(start + (k + 1) * time_step)
            yield -self.bucket_force.Eval(context)[3]

    def get_reach(self) -> float:
        """Return where the tip of the bucket is along x [m]."""
        return float(self.plant.GetFrameByName("tip").CalcPoseInWorld(self.plant_context).translation()[0])


def run(pile: PileState, variant: Variant, depth: float, duration: float) -> dict[str, float]:
    dig = Dig(pile, variant, depth)
    start = dig.get_reach()
    dig.simulator.AdvanceTo(RELAXING)
    before = dig.rocks.get_pile(dig.root).p_WRs
    push, reach = [], []
    cpu = time.process_time()
    for force in dig.advance(duration):
        push.append(force)
        reach.append(dig.get_reach() - start)
    cpu = time.process_time() - cpu
    after = dig.rocks.get_pile(dig.root)
    moved = np.linalg.norm(after.p_WRs - before, axis=1) > 0.05
    masses = pile.calc_masses(np.array([shape.volume for shape in SHAPES]), ROCKS.density)
    smooth = np.convolve(push, np.full(10, 0.1), mode="valid")
    return {
        "bucket_mass_kg": calc_bucket_mass(after, masses, dig.plant, dig.plant_context),
        "peak_push_kN": float(smooth.max()) / 1e3,
        "mean_push_kN": float(np.clip(push[:600], 0.0, None).mean()) / 1e3,
        "displaced_m3": float(masses[moved].sum() / ROCKS.density),
        "reach_m": float(np.max(reach)),
        "cpu_s": cpu,
    }


def make_start(rocks: int, seed: int) -> tuple[PileState, float]:
    """Return a seed's pile, at rest, and the depth of its dig [m]."""
    pile = clear_way(make_small_pile(rocks, SMALL_SITE, 6.0, seed))
    depth = np.random.default_rng(seed).uniform(0.6, 1.4)
    return replace(pile, V_WRs=np.zeros((len(pile), 6))), depth


def compare_states(arguments: argparse.Namespace) -> None:
    """Go on from the states of digs of the first variant with each of them; print their pushes."""
    variants = [replace(one, nonsmooth=dict(arguments.set) | one.nonsmooth) for one in arguments.variants]
    windows = [round(edge / TIME_STEP) for edge in STATE_WINDOWS]
    results = {(r["seed"], r["variant"]): r["push_kN"] for r in read_lines(arguments.out)}
    names = [variant.name for variant in variants]
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        if all((seed, name) in results for name in names):
            continue
        pile, depth = make_start(arguments.rocks, seed)
        dig = Dig(pile, variants[0], depth)
        others = [Dig(pile, variant, depth) for variant in variants]
        found: list[list[list[float]]] = [[] for _ in variants]
        for t in STATE_TIMES:
            dig.simulator.AdvanceTo(RELAXING + t)
            for other, pushes in zip(others, found, strict=True):
                other.go_on_from(dig)
                push = np.array(list(other.advance(STATE_WINDOWS[-1]))) / 1e3
                # Forces of steps of any length, as means over usual steps.
                push = push.reshape(windows[-1], -1).mean(axis=1)
                pushes.append([round(float(part.mean()), 3) for part in np.split(push, windows[1:-1])])
        for variant, pushes in zip(variants, found, strict=True):
            results[seed, variant.name] = pushes
            add_line(arguments.out, {"seed": seed, "variant": variant.name, "push_kN": pushes})
        print(f"pile {seed}", flush=True)
    seeds = find_complete(results, names)
    if not seeds:
        return
    base = np.concatenate([results[seed, names[0]] for seed in seeds])
    pushed = np.average(base, axis=1, weights=np.diff(STATE_WINDOWS)) > MIN_PUSH
    edges = [f"{low:g} to {high:g} s" for low, high in pairwise(STATE_WINDOWS)] + ["all"]
    print(f"push [kN] of {pushed.sum()} states, and the difference (90 %): " + ", ".join(edges))
    for name in names:
        pushes = np.concatenate([results[seed, name] for seed in seeds])
        cells = []
        for a, b in zip(*(_append_mean(one[pushed]).T for one in (pushes, base)), strict=True):
            mean, half = compare(a, b)
            cells.append(f"{a.mean():.1f} ({100 * mean / b.mean():+.1f} ± {100 * half / b.mean():.1f} %)")
        print(f"{name}: " + ", ".join(cells))


def _append_mean(pushes: np.ndarray) -> np.ndarray:
    """Return the pushes in the windows (states, windows), and last their mean over the whole time."""
    return np.column_stack([pushes, np.average(pushes, axis=1, weights=np.diff(STATE_WINDOWS))])


def read_lines(path: Path) -> list[dict]:
    """Return the stored runs, if any; make room for more."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def find_complete[Kind](results: dict[tuple[int, Kind], Any], kinds: list[Kind]) -> list[int]:
    """Return the seeds that have results of all kinds, those of earlier calls among them."""
    return sorted({seed for seed, _ in results if all((seed, kind) in results for kind in kinds)})


def add_line(path: Path, entry: dict[str, object]) -> None:
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")


def compare_digs(arguments: argparse.Namespace) -> None:
    """Dig the piles in both engines, unless that is stored; print the differences."""
    results = {(r["seed"], (r["engine"], r["repeat"])): r for r in read_lines(arguments.out)}
    settings = dict(arguments.set)
    iterations = settings.pop("iterations", float(NonsmoothConfig().iterations))
    ours = f"nonsmooth-{arguments.points}"
    digs = [(arguments.against, 0)] + [(ours, repeat) for repeat in range(arguments.repeats)]
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        if all((seed, dig) in results for dig in digs):
            continue
        pile, depth = make_start(arguments.rocks, seed)
        mark = hashlib.sha256(pile.p_WRs.tobytes()).hexdigest()[:12]
        for engine, repeat in digs:
            if results.get((seed, (engine, repeat)), {}).get("pile") == mark:
                continue
            own = {"manifold_points": float(arguments.points), "iterations": iterations + repeat}
            variant = Variant(
                "nonsmooth" if engine == ours else engine, settings | own, arguments.dissipation
            )
            result = run(pile, variant, depth, arguments.duration)
            results[seed, (engine, repeat)] = result
            entry = {
                "seed": seed,
                "engine": engine,
                "repeat": repeat,
                "pile": mark,
                "rocks": len(pile),
                **result,
            }
            add_line(arguments.out, entry)
            print(seed, engine, repeat, len(pile), {k: round(v, 2) for k, v in result.items()}, flush=True)
    seeds = find_complete(results, digs)
    if len(seeds) < 2:
        return
    for metric in (*METRICS, "cpu_s"):
        a, b = (
            np.array(
                [np.mean([results[seed, dig][metric] for dig in digs if dig[0] == engine]) for seed in seeds]
            )
            for engine in (ours, arguments.against)
        )
        mean, half = compare(a, b)
        text = f"{metric}: {ours} {a.mean():.4g}, {arguments.against} {b.mean():.4g}"
        share = 100 / b.mean()
        print(f"{text}, difference {share * mean:+.1f} ± {share * half:.1f} % (90 %, {len(a)} pairs)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    digs, states = commands.add_parser("digs"), commands.add_parser("states")
    for command, work, name in ((digs, compare_digs, "engines"), (states, compare_states, "engine-states")):
        command.set_defaults(work=work)
        command.add_argument("--out", type=Path, default=Path(f"build/{name}.jsonl"))
        command.add_argument("--rocks", type=int, default=300)
        command.add_argument("--seeds", type=int, default=4)
        command.add_argument("--first", type=int, default=0)
        command.add_argument(
            "--set",
            nargs="*",
            type=parse_setting,
            default=[],
            metavar="KEY=VALUE",
            help="of the nonsmooth engine",
        )
    digs.add_argument("--points", type=int, choices=range(1, 5), default=4)
    digs.add_argument("--duration", type=float, default=10.0)
    digs.add_argument("--against", choices=("plant", "hydroelastic"), default="plant")
    digs.add_argument(
        "--dissipation", type=float, default=PlantEngineConfig().dissipation, help="of the plant's"
    )
    digs.add_argument("--repeats", type=int, default=1, help="digs of a pile in the nonsmooth engine")
    states.add_argument(
        "--variants", nargs="+", type=parse_variant, required=True, metavar="ENGINE[,KEY=VALUE]..."
    )
    arguments = parser.parse_args()
    arguments.work(arguments)


if __name__ == "__main__":
    main()
