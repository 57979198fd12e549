"""The nonsmooth engine against the plant engine: the same machine digs the same small piles.

    python benchmarks/compare_engines.py --rocks 300 --seeds 4 --points 1 --out build/engines.jsonl

Each seed is one pile, filled and at rest in the nonsmooth engine, relaxed for a second in each engine with the
machine standing, then dug with the same motor targets. Finished runs are skipped. `--points 1`: the nonsmooth engine
with one contact point per pair, as the plant engine's point contact has it. `--against hydroelastic`: the plant engine
with pressure fields over faces instead of single points, five times as dear. `--set damping_time=2`: another setting of
the nonsmooth engine; give it an `--out` of its own. `--set linear_overlap=0.001 damping_time=0.75
stiffness_factor=0.73 --dissipation 0` is one contact law in both: a spring of the same linear stiffness, as damped as
an implicit Euler step makes it (the plant's usual Hunt-Crossley dissipation has no counterpart in the other).
`--repeats 3`: each pile is dug three times in the nonsmooth engine, with one more iteration each, and their mean taken:
digs are chaotic, these are cheap.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from faithfulness import SIZES, compare, make_small_pile
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from rocks import ROCKS, SHAPES, TIME_STEP, Motors, clear_way, make_dig

from drakerock.dynamics.assembly import add_plant, add_site
from drakerock.dynamics.config import DynamicsConfig, NonsmoothConfig, PlantEngineConfig
from drakerock.dynamics.nonsmooth.system import add_nonsmooth_rocks
from drakerock.dynamics.plant.rocks import add_plant_rocks, add_rock_bodies
from drakerock.machine.config import MachineConfig
from drakerock.machine.model import add_machine, calc_motor_targets
from drakerock.machine.placement import set_machine_pose
from drakerock.pile.config import SiteConfig
from drakerock.pile.site import make_site
from drakerock.pile.state import PileState

METRICS = ("bucket_mass_kg", "peak_push_kN", "mean_push_kN", "displaced_m3", "reach_m")
RELAXING = 1.0


def run(
    pile: PileState,
    engine: str,
    site: SiteConfig,
    depth: float,
    duration: float,
    dissipation: float,
    settings: dict[str, float],
) -> dict[str, float]:
    nonsmooth = engine.startswith("nonsmooth")
    dynamics = DynamicsConfig(
        rocks="nonsmooth" if nonsmooth else "plant",
        nonsmooth=NonsmoothConfig(
            reduction="none",
            manifold_points=int(engine.removeprefix("nonsmooth-")) if nonsmooth else 4,
            **settings,
        ),
        plant=PlantEngineConfig(
            contact_model="hydroelastic" if engine == "hydroelastic" else "point", dissipation=dissipation
        ),
        time_step=TIME_STEP,
    )
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, dynamics)
    built = make_site(site)
    add_site(plant, built, dynamics)
    machine = add_machine(plant, MachineConfig())
    inputs = []
    if dynamics.rocks == "plant":
        geometries = add_rock_bodies(plant, pile, SHAPES, ROCKS, dynamics)
        plant.Finalize()
        rocks = add_plant_rocks(builder, plant, pile, geometries)
    else:
        plant.Finalize()
        rocks, view = add_nonsmooth_rocks(
            builder, plant, scene_graph, machine, built, SHAPES, ROCKS, dynamics, pile
        )
        inputs.append(view.GetInputPort("desired_state"))
    inputs.append(plant.get_desired_state_input_port(machine.instance))
    rates = make_dig(depth)

    def delayed(t: float) -> np.ndarray:
        wanted = rates(t - RELAXING) if t > RELAXING else (0.0, 0.0, 0.0)
        return calc_motor_targets(plant, machine, *wanted)

    motors = builder.AddSystem(Motors(delayed, len(delayed(0.0))))
    for port in inputs:
        builder.Connect(motors.GetOutputPort("desired_state"), port)
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    rocks.set_pile(root, pile)
    context = rocks.GetMyContextFromRoot(root)
    plant_context = plant.GetMyMutableContextFromRoot(root)
    set_machine_pose(plant, plant_context, machine, x_tip=float(pile.p_WRs[:, 0].min()) - 0.7, z_tip=0.02)
    simulator.Initialize()
    tip, bucket = plant.GetFrameByName("tip"), plant.GetBodyByName("bucket")
    start = tip.CalcPoseInWorld(plant_context).translation()[0]
    n = round(duration / TIME_STEP)
    push, reach = np.zeros(n), np.zeros(n)
    simulator.AdvanceTo(RELAXING)
    before = rocks.get_pile(root).p_WRs
    cpu = time.process_time()
    for k in range(n):
        simulator.AdvanceTo(RELAXING + (k + 1) * TIME_STEP)
        push[k] = -rocks.GetOutputPort("F_B_W").Eval(context)[3]
        reach[k] = tip.CalcPoseInWorld(plant_context).translation()[0] - start
    cpu = time.process_time() - cpu
    after = rocks.get_pile(root).p_WRs
    X_WB = plant.EvalBodyPoseInWorld(plant_context, bucket)
    local = (after - X_WB.translation()) @ X_WB.rotation().matrix()
    inside = (np.abs(local - [0.95, 0.0, 0.9]) < [1.15, 1.5, 1.4]).all(axis=1)
    masses = pile.calc_masses(np.array([shape.volume for shape in SHAPES]), ROCKS.density)
    smooth = np.convolve(push, np.full(10, 0.1), mode="valid")
    return {
        "bucket_mass_kg": float(masses[inside].sum()),
        "peak_push_kN": float(smooth.max()) / 1e3,
        "mean_push_kN": float(push[:600].clip(0.0).mean()) / 1e3,
        "displaced_m3": float(masses[np.linalg.norm(after - before, axis=1) > 0.05].sum() / ROCKS.density),
        "reach_m": float(reach.max()),
        "cpu_s": cpu,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rocks", type=int, default=300)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--points", type=int, choices=range(1, 5), default=4)
    parser.add_argument("--duration", type=float, default=10.0)
    parser.add_argument("--against", choices=("plant", "hydroelastic"), default="plant")
    parser.add_argument(
        "--dissipation", type=float, default=PlantEngineConfig().dissipation, help="of the plant's"
    )
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="of the nonsmooth engine")
    parser.add_argument("--repeats", type=int, default=1, help="digs of a pile in the nonsmooth engine")
    parser.add_argument("--out", type=Path, default=Path("build/engines.jsonl"))
    arguments = parser.parse_args()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    lines = arguments.out.read_text().splitlines() if arguments.out.exists() else []
    results = {(r["seed"], r["engine"], r.get("repeat", 0)): r for r in map(json.loads, lines)}
    site = SIZES["300"][1]
    settings = {key: float(value) for key, value in (item.split("=") for item in arguments.set)}
    iterations = settings.pop("iterations", float(NonsmoothConfig().iterations))
    ours = f"nonsmooth-{arguments.points}"
    digs = [(arguments.against, 0)] + [(ours, repeat) for repeat in range(arguments.repeats)]
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    for seed in seeds:
        todo = [dig for dig in digs if (seed, *dig) not in results]
        if not todo:
            continue
        pile = clear_way(make_small_pile(arguments.rocks, site, 6.0, seed))
        pile = replace(pile, V_WRs=np.zeros((len(pile), 6)))
        depth = np.random.default_rng(seed).uniform(0.6, 1.4)
        for engine, repeat in todo:
            result = run(
                pile,
                engine,
                site,
                depth,
                arguments.duration,
                arguments.dissipation,
                {**settings, "iterations": iterations + repeat},
            )
            results[seed, engine, repeat] = result
            entry = {"seed": seed, "engine": engine, "repeat": repeat, "rocks": len(pile), **result}
            with open(arguments.out, "a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
            print(seed, engine, repeat, len(pile), {k: round(v, 2) for k, v in result.items()}, flush=True)
    for metric in (*METRICS, "cpu_s"):
        a, b = (
            np.array(
                [np.mean([results[seed, *dig][metric] for dig in digs if dig[0] == engine]) for seed in seeds]
            )
            for engine in (ours, arguments.against)
        )
        mean, half = compare(a, b)
        text = f"{metric}: {ours} {a.mean():.4g}, {arguments.against} {b.mean():.4g}"
        share = 100 / b.mean()
        print(f"{text}, difference {share * mean:+.1f} ± {share * half:.1f} % (90 %, {len(a)} pairs)")


if __name__ == "__main__":
    main()
