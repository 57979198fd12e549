"""What `compare_revisions.py` measures, each alone as a command; it prints one line of JSON.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python benchmarks/cases.py idle --rocks 100000
    ... benchmarks/cases.py step | push | refill | make | memory --loadings 200 --scenario studies/demo.yaml

Times are CPU times. It keeps to names that have long been there, since it is run with older revisions, too.

- step: a second of the station's Diagram, machine standing off the pile.
- idle: a step of it, none of so many rocks awake (more than 5 770: further blocks of the pile behind it).
- push: a blade through the shipped pile's toe at imposed speed (a body so heavy that nothing slows it): median and
  slowest step, and noise of its force: the standard deviation of its change from step to step.
- refill: a refill after 120 rocks.
- make: the shipped pile, from nothing.
- memory: of this process as a campaign's worker, a sequence of loadings with refill: at its end, and its growth per
  loading, the first two left out.
"""

from __future__ import annotations

import argparse
import gc
import inspect
import json
import logging
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drakerock import AddRocks, get_pile, load_scenario, make_station
from drakerock.lhd.placement import set_machine_pose
from drakerock.loading.scenario import make_recipe
from drakerock.loading.sequence import run_sequence
from drakerock.rocks.drake.drift import AddDrift
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.making.make import make_pile
from drakerock.rocks.making.refill import refill
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.site import calc_bounds, make_site

# No rock wakes, and none falls asleep.
FROZEN = {"dynamics.nonsmooth.rest.wake_load": 1e9, "dynamics.nonsmooth.rest.time": 1e9}
BLADE = (0.3, 2.6, 1.6)  # along the drift, across, high [m]
SPEED = 1.0  # of the blade [m/s]
WAY = 2.5  # from just before the pile [m]


def _load_shapes(scenario):
    """Builds up to 23d883c take the names of the files."""
    takes_files = "uris" in inspect.signature(load_rock_shapes).parameters
    return load_rock_shapes(scenario.rocks.shapes if takes_files else scenario.rocks)


def start_standing(scenario: Any, pile: Any) -> Simulator:
    """Return a simulator of the station with the machine standing off the pile."""
    station = make_station(scenario, pile)
    simulator = Simulator(station.diagram)
    root = simulator.get_mutable_context()
    station.rocks.set_pile(root, pile)
    context = station.plant.GetMyMutableContextFromRoot(root)
    set_machine_pose(station.plant, context, station.machine, x_tip=-15.0, y=0.0, z_tip=0.03)
    simulator.AdvanceTo(0.05)
    return simulator


def measure_step(arguments: Any) -> dict[str, float]:
    scenario = load_scenario(arguments.scenario)
    simulator = start_standing(scenario, get_pile(scenario))
    start = time.process_time()
    simulator.AdvanceTo(1.05)
    return {"step": time.process_time() - start}


def measure_idle(arguments: Any) -> dict[str, float]:
    scenario = load_scenario(arguments.scenario)
    pile = get_pile(scenario)
    block = pile.select(np.flatnonzero(pile.p_WRs[:, 0] > 0.6))
    width = scenario.site.void_depth - 0.5
    n_blocks = 0
    while len(pile) < arguments.rocks:
        n_blocks += 1
        added = block.select(np.arange(min(len(block), arguments.rocks - len(pile))))
        pile = pile.join(replace(added, p_WRs=added.p_WRs + [n_blocks * width, 0.0, 0.0]))
    resting = replace(pile.contacts, resting=np.ones(len(pile), bool))
    pile = replace(pile, contacts=resting, V_WRs=np.zeros((len(pile), 6)))
    depth = scenario.site.void_depth + n_blocks * width
    simulator = start_standing(scenario.replace(**FROZEN, **{"site.void_depth": depth}), pile)
    start, n = time.process_time(), 100
    simulator.AdvanceTo(0.05 + n * scenario.dynamics.time_step)
    return {f"idle_{arguments.rocks}": (time.process_time() - start) / n}


def measure_push(arguments: Any) -> dict[str, float]:
    scenario = load_scenario(arguments.scenario)
    pile = get_pile(scenario)
    before = pile.p_WRs[(np.abs(pile.p_WRs[:, 1]) < 1.5) & (pile.p_WRs[:, 2] < 0.6)]
    toe = float(np.percentile(before[:, 0], 5))
    pile = pile.select(np.flatnonzero(pile.p_WRs[:, 0] > toe - 0.5))
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, scenario.dynamics)
    AddDrift(plant, make_site(scenario.site), scenario.dynamics.plant)
    blade = plant.AddRigidBody("blade", SpatialInertia.SolidBoxWithMass(1e9, *BLADE))
    plant.RegisterCollisionGeometry(blade, RigidTransform(), Box(*BLADE), "blade", CoulombFriction(0.3, 0.3))
    # A little above the floor.
    height = RigidTransform([0.0, 0.0, 0.5 * BLADE[2] + 0.02])
    frame = plant.AddFrame(FixedOffsetFrame("rail", plant.world_frame(), height))
    rail = plant.AddJoint(PrismaticJoint("rail", frame, blade.body_frame(), [1.0, 0.0, 0.0]))
    plant.Finalize()
    rocks = AddRocks(
        builder, plant, scene_graph, pile, scenario.rocks, engine=scenario.dynamics.nonsmooth,
        shapes=_load_shapes(scenario), bounds=calc_bounds(scenario.site),
    )  # fmt: skip
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    context = plant.GetMyMutableContextFromRoot(root)
    rail.set_translation(context, float(pile.p_WRs[:, 0].min()) - 0.7)
    rail.set_translation_rate(context, SPEED)
    force = rocks.get_body_force_output_port(blade.index())
    own = rocks.GetMyContextFromRoot(root)
    steps, forces = [], []
    dt = scenario.dynamics.time_step
    simulator.AdvanceTo(5 * dt)  # loads the kernels
    for k in range(5, round(WAY / SPEED / dt)):
        start = time.process_time()
        simulator.AdvanceTo((k + 1) * dt)
        steps.append(time.process_time() - start)
        forces.append(force.Eval(own)[3])
    pushing = np.array(forces)[len(forces) // 2 :]
    return {
        "push_median": float(np.median(steps)),
        "push_slowest": float(np.max(steps)),
        "push_mean_kN": -float(pushing.mean()) / 1e3,
        "push_noise_kN": float(np.diff(pushing).std()) / 1e3,
    }


def measure_refill(arguments: Any) -> dict[str, float]:
    scenario = load_scenario(arguments.scenario)
    pile = get_pile(scenario)
    removed = np.zeros(len(pile), bool)
    removed[np.argsort(np.linalg.norm(pile.p_WRs - [-3.0, 0.0, 0.5], axis=1) + 100.0 * pile.fixed)[:120]] = (
        True
    )
    shapes = _load_shapes(scenario)
    start = time.process_time()
    refill(pile, removed, shapes, make_recipe(scenario), np.random.default_rng(0))
    return {"refill": time.process_time() - start}


def measure_make(arguments: Any) -> dict[str, float]:
    recipe = make_recipe(load_scenario(arguments.scenario))
    make_pile(recipe.replace(**{"pile.rocks": 5}))  # loads the kernels
    start = time.process_time()
    make_pile(recipe)
    return {"make": time.process_time() - start}


def read_memory() -> float:
    """Return the resident memory of this process [MB]."""
    gc.collect()
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS"))


def measure_memory(arguments: Any) -> dict[str, float]:
    used: list[float] = []

    def note(number: int, *_: Any) -> None:
        while len(used) <= number:  # at the beginning of each loading
            used.append(read_memory())

    start = time.process_time()
    with tempfile.TemporaryDirectory(prefix="drakerock-bench-") as folder:
        run_sequence(load_scenario(arguments.scenario), arguments.loadings, Path(folder), progress=note)
    cpu = time.process_time() - start
    used.append(read_memory())
    after = used[min(2, len(used) - 2) :]
    return {
        "memory_MB": used[-1],
        "memory_growth_MB": (after[-1] - after[0]) / (len(after) - 1),
        "loading": cpu / arguments.loadings,
    }


CASES: dict[str, Callable[[Any], dict[str, float]]] = {
    "step": measure_step,
    "idle": measure_idle,
    "push": measure_push,
    "refill": measure_refill,
    "make": measure_make,
    "memory": measure_memory,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("case", choices=list(CASES))
    parser.add_argument("--scenario", default="studies/demo.yaml", help="path of a scenario")
    parser.add_argument("--rocks", type=int, default=5770, help="of idle")
    parser.add_argument("--loadings", type=int, default=6, help="of memory")
    arguments = parser.parse_args()
    logging.getLogger("drake").setLevel(logging.ERROR)
    print(json.dumps(CASES[arguments.case](arguments)))


if __name__ == "__main__":
    main()
