"""Cost and quality of the nonsmooth rock engine at full size, one core.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python benchmarks/rocks.py all
    ... benchmarks/rocks.py awake resting quality woken shallow deep shallow-none deep-none scaling

The pile is the default scenario's, about 5 500 moving rocks in a drift of 6.5 m.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem

from drakerock.lhd.config import MachineConfig
from drakerock.lhd.model import Machine, add_machine
from drakerock.lhd.motors import add_motors
from drakerock.lhd.placement import set_machine_pose
from drakerock.lhd.rocks import add_lhd_rocks
from drakerock.loading.cycle import run_cycle
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.rocks.config import RocksConfig, SiteConfig
from drakerock.rocks.drake.drift import AddDrift
from drakerock.rocks.drake.interface import ROCK_SUMMARY
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.drake.system import NonsmoothRocks
from drakerock.rocks.engine.config import DynamicsConfig, NonsmoothConfig
from drakerock.rocks.engine.engine import NonsmoothEngine
from drakerock.rocks.making.cache import fetch_pile
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.site import make_site, make_surroundings
from drakerock.rocks.state import PileState, load_pile

ROCKS = RocksConfig()
SHAPES = load_rock_shapes(ROCKS)
SITE = SiteConfig()
TIME_STEP = 0.01


def make_engine(pile: PileState, site: SiteConfig = SITE, **settings: object) -> NonsmoothEngine:
    return NonsmoothEngine(
        ROCKS,
        SHAPES,
        make_surroundings(make_site(site)),
        NonsmoothConfig(**settings),
        TIME_STEP,
        pile.shape,
        pile.size,
        pile.fixed,
    )


def get_pile() -> PileState:
    """Return the default scenario's pile; made on first use (minutes) if it is not the shipped one."""
    return fetch_pile(make_recipe(Scenario()))[0]


def time_steps(engine: NonsmoothEngine, pile: PileState, n: int) -> tuple[PileState, float, list[object]]:
    """Return the pile after n steps, the median CPU time of a step [s] and the reports."""
    arrays = engine.make_arrays(pile)
    times, reports = [], []
    for _ in range(n):
        start = time.process_time()
        arrays, report = engine.advance(arrays)
        times.append(time.process_time() - start)
        reports.append(report)
    return engine.make_pile(arrays), float(np.median(times[n // 10 :])), reports


def bench_awake(pile: PileState) -> None:
    """All rocks awake: cost per rock and step."""
    engine = make_engine(pile, reduction="none")
    for iterations in (20, 50, 150):
        engine = make_engine(pile, reduction="none", iterations=iterations)
        _, median, reports = time_steps(engine, pile, 60)
        last = reports[-1]
        print(
            f"awake: {last.n_awake} rocks, {last.n_contacts} contacts ({last.n_loaded} loaded), {iterations} it: "
            f"{median * 1e3:.1f} ms per step, {median / last.n_awake * 1e6:.1f} us per rock"
        )


def bench_resting(pile: PileState, site: SiteConfig = SITE) -> None:
    """300 rocks awake among resting ones; and none awake."""
    resting = replace(pile.contacts, resting=np.ones(len(pile), bool))
    for n_awake in (0, 300, 800, 2000):
        flags = resting.resting.copy()
        # a block around the middle of the slope
        middle = np.argsort(np.linalg.norm(pile.p_WRs - [-1.0, 0.0, 2.0], axis=1))
        flags[middle[:n_awake]] = False
        start = replace(pile, contacts=replace(resting, resting=flags), V_WRs=np.zeros((len(pile), 6)))
        # the count is held: neither waking nor resting
        engine = make_engine(pile, site, rest={"wake_load": 1e9, "time": 1e9})
        _, median, reports = time_steps(engine, start, 100)
        print(f"resting: {reports[-1].n_awake} awake of {len(pile)}: {median * 1e3:.2f} ms per step")


def bench_woken(pile: PileState) -> None:
    """300 rocks woken inside the stored pile, 5 s without a machine."""
    resting = np.ones(len(pile), bool)
    chosen = np.argsort(np.linalg.norm(pile.p_WRs - [1.5, 0.0, 2.0], axis=1))[:300]
    resting[chosen] = False
    start = replace(pile, contacts=replace(pile.contacts, resting=resting), V_WRs=np.zeros((len(pile), 6)))
    after, _, reports = time_steps(make_engine(start), start, 500)
    moved = np.linalg.norm(after.p_WRs - start.p_WRs, axis=1)
    print(
        f"woken: of 300 rocks, mean displacement {moved[chosen].mean() * 1e3:.2f} mm, "
        f"p99 {np.percentile(moved[chosen], 99) * 1e3:.2f} mm; at most {max(r.n_awake for r in reports)} awake, "
        f"in the end {reports[-1].n_awake}"
    )


def bench_quality(pile: PileState) -> None:
    """At rest with all awake: speed, penetration, creep."""
    engine = make_engine(pile, reduction="none")
    after, _, _ = time_steps(engine, pile, 250)
    arrays = engine.make_arrays(after)
    speeds, depths = [], []
    for _ in range(250):
        arrays, report = engine.advance(arrays)
        speeds.append(np.sqrt((arrays.velocities[:, 3:] ** 2).sum(axis=1).mean()))
        depths.append(report.p99_penetration)
    final = engine.make_pile(arrays)
    moved = np.linalg.norm(final.p_WRs - after.p_WRs, axis=1)
    all_moved = np.linalg.norm(final.p_WRs - pile.p_WRs, axis=1)
    print(
        f"quality: rms speed {np.mean(speeds) * 1e3:.2f} mm/s, penetration p99 {np.mean(depths) * 1e3:.2f} mm, "
        f"creep p50 / p99 {np.percentile(moved, 50) / 2.5e-3:.2f} / {np.percentile(moved, 99) / 2.5e-3:.2f} mm/s; "
        f"in 5 s moved: mean {all_moved.mean() * 1e3:.2f} mm, p99 {np.percentile(all_moved, 99) * 1e3:.2f} mm"
    )


Rates = Callable[[float], tuple[float, float, float]]


class HeldRates(LeafSystem):
    def __init__(self, rates: Rates) -> None:
        super().__init__()
        self._rates = rates
        # Held over a step, as a digital controller's would be.
        state = self.DeclareDiscreteState(3)
        self.DeclareInitializationDiscreteUpdateEvent(self._update)
        self.DeclarePeriodicDiscreteUpdateEvent(TIME_STEP, 0.0, self._update)
        self.DeclareStateOutputPort("motor_speeds", state)

    def _update(self, context: Context, state: object) -> None:
        state.set_value(self._rates(context.get_time()))


def make_dig(depth: float) -> Rates:
    """Rates (wheels, boom, bucket) of a dig that drives `depth` [m] into the pile's toe, 12 s in all."""
    drive = (1.2 + depth) / 1.2

    def rates(t: float) -> tuple[float, float, float]:
        if t < drive:
            return 1.2 * min(t / 0.5, 1.0), 0.0, 0.0
        if t < drive + 3.0:
            return 0.35, -0.12, -0.13
        if t < drive + 4.5:
            return 0.0, 0.0, -0.35
        return -1.0 * min((t - drive - 4.5) / 0.5, 1.0), 0.0, 0.0

    return rates


def find_toe(pile: PileState) -> float:
    """Return where the pile begins on the machine's way [m]; single rocks before it are left out."""
    low = pile.p_WRs[(np.abs(pile.p_WRs[:, 1]) < 1.5) & (pile.p_WRs[:, 2] < 0.6)]
    return float(np.percentile(low[:, 0], 5))


def clear_way(pile: PileState) -> PileState:
    """Return the pile without the single rocks where the machine starts."""
    return pile.select(np.flatnonzero(pile.p_WRs[:, 0] > find_toe(pile) - 0.5))


def build_dig(
    pile: PileState,
    rates: Rates,
    config: NonsmoothConfig,
    time_step: float = TIME_STEP,
    site: SiteConfig = SITE,
    y: float = 0.0,
) -> tuple[Simulator, object, Machine, NonsmoothRocks]:
    """Return simulator, plant, machine and rocks of a dig, the bucket's tip before the first rock."""
    dynamics = DynamicsConfig(rocks="nonsmooth", nonsmooth=config, time_step=time_step)
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, dynamics)
    AddDrift(plant, make_site(site), dynamics.plant)
    machine = add_machine(plant, MachineConfig())
    plant.Finalize()
    motors = add_motors(builder, plant, machine)
    builder.Connect(
        builder.AddSystem(HeldRates(rates)).get_output_port(), motors.GetInputPort("motor_speeds")
    )
    rocks = add_lhd_rocks(builder, plant, scene_graph, machine, pile, ROCKS, dynamics, site, shapes=SHAPES)
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    x_tip = float(pile.p_WRs[:, 0].min()) - 0.7
    set_machine_pose(plant, plant.GetMyMutableContextFromRoot(context), machine, x_tip=x_tip, y=y, z_tip=0.02)
    simulator.Initialize()
    return simulator, plant, machine, rocks


def calc_bucket_mass(pile: PileState, masses: np.ndarray, plant: MultibodyPlant, context: Context) -> float:
    """Return the mass of the rocks in the bucket's room, its heap included [kg]."""
    X_WB = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("bucket"))
    local = (pile.p_WRs - X_WB.translation()) @ X_WB.rotation().matrix()
    inside = ((local > [-0.2, -1.5, -0.5]) & (local < [2.1, 1.5, 2.3])).all(axis=1)
    return float(masses[inside].sum())


def run_dig(
    pile: PileState, rates: Rates, config: NonsmoothConfig, duration: float = 12.0, time_step: float = TIME_STEP,
    site: SiteConfig = SITE, y: float = 0.0,
) -> dict[str, float]:  # fmt: skip
    """Run a dig; return what it cost and did."""
    pile = clear_way(pile)
    simulator, plant, _machine, rocks = build_dig(pile, rates, config, time_step, site, y)
    root = simulator.get_mutable_context()
    context = rocks.GetMyContextFromRoot(root)
    bucket_force = rocks.get_body_force_output_port(plant.GetBodyByName("bucket").index())
    plant_context = plant.GetMyContextFromRoot(root)
    rocks.get_report(root)  # loads the compiled kernels
    n_steps = round(duration / time_step)
    tip = plant.GetFrameByName("tip")
    start = tip.CalcPoseInWorld(plant_context).translation()[0]
    forces, summaries, reach = (
        np.zeros((n_steps, 6)),
        np.zeros((n_steps, len(ROCK_SUMMARY))),
        np.zeros(n_steps),
    )
    fastest, cpu = 0.0, 0.0
    for k in range(n_steps):
        cpu -= time.process_time()
        simulator.AdvanceTo((k + 1) * time_step)
        cpu += time.process_time()
        forces[k] = bucket_force.Eval(context)
        summaries[k] = rocks.GetOutputPort("summary").Eval(context)
        reach[k] = tip.CalcPoseInWorld(plant_context).translation()[0] - start
        if k % 10 == 0:
            fastest = max(fastest, float(np.abs(rocks.get_pile(root).V_WRs[:, 3:]).max()))
    after = rocks.get_pile(root)
    moved = np.linalg.norm(after.p_WRs - pile.p_WRs, axis=1)
    masses = rocks.engine.mass
    push = -forces[:, 3]
    # Forces of single steps are noise: the mean over 0.1 s counts.
    window = round(0.1 / time_step)
    smooth = np.convolve(push, np.ones(window) / window, mode="valid")
    return {
        "cpu_s": cpu,
        "bucket_mass_kg": calc_bucket_mass(after, masses, plant, plant_context),
        "peak_push_kN": float(smooth.max()) / 1e3,
        "mean_push_kN": float(push[: round(6.0 / time_step)].clip(0.0).mean()) / 1e3,
        "displaced_m3": float((masses * (moved > 0.05)).sum() / ROCKS.density),
        "reach_m": float(reach.max()),
        "n_moved_5cm": float((moved > 0.05).sum()),
        "awake_mean": float(summaries[:, 0].mean()),
        "awake_max": float(summaries[:, 0].max()),
        "penetration_max_mm": float(summaries[:, 2].max()) * 1e3,
        "penetration_p99_mm": float(np.percentile(summaries[:, 3], 99)) * 1e3,
        "residual_max": float(summaries[:, 4].max()),
        "fastest_m_s": fastest,
        "lost": float(summaries[-1, 5]),
        "flagged": float(summaries[-1, 6]),
    }


# Where digs are made; how many rocks slide, and with it the cost, differs from place to place [m].
PLACES = (-1.0, -0.5, 0.0, 0.5, 1.0)


def bench_dig(pile: PileState, depth: float, reduction: str) -> None:
    """Whole digs, machine included; one only with all rocks awake, whose cost does not depend on the place."""
    costs = []
    for y in PLACES if reduction == "rest" else (0.0,):
        result = run_dig(pile, make_dig(depth), NonsmoothConfig(reduction=reduction), y=y)
        costs.append((result["cpu_s"], result["awake_mean"]))
        text = ", ".join(f"{k} {v:.4g}" for k, v in result.items())
        print(f"dig {depth:g} m at y {y:g}, reduction {reduction}: {text}")
    seconds, awake = np.array(costs).T
    print(
        f"dig {depth:g} m, reduction {reduction}: median {np.median(seconds):.1f} CPU s, "
        f"{1e6 * seconds.sum() / awake.sum() / 1200:.1f} us per awake rock and step"
    )


def bench_idle(pile: PileState, site: SiteConfig) -> float:
    """Return the median CPU time of a step of the whole Diagram when no rock is awake [s]."""
    assert pile.contacts is not None
    resting = replace(pile.contacts, resting=np.ones(len(pile), bool))
    pile = clear_way(replace(pile, contacts=resting, V_WRs=np.zeros((len(pile), 6))))
    config = NonsmoothConfig(rest={"wake_load": 1e9, "time": 1e9})
    simulator, plant, machine, _ = build_dig(pile, lambda _: (0.0, 0.0, 0.0), config, site=site)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    set_machine_pose(plant, context, machine, x_tip=-9.0, y=0.0, z_tip=0.02)
    times = []
    for k in range(150):
        start = time.process_time()
        simulator.AdvanceTo((k + 1) * TIME_STEP)
        times.append(time.process_time() - start)
    return float(np.median(times[20:]))


def bench_scaling(pile: PileState) -> None:
    """What four more blocks of the same pile behind it cost, about 26 000 rocks in all.

    The blocks are as much at rest as the pile, so the difference is what resting rocks cost in every step.
    """
    block = pile.select(pile.p_WRs[:, 0] > 0.6)
    width = SITE.void_depth - 0.5
    n_blocks = 4
    total = pile
    for k in range(1, n_blocks + 1):
        total = total.join(replace(block, p_WRs=block.p_WRs + [k * width, 0.0, 0.0]))
    site = SITE.replace(void_depth=SITE.void_depth + n_blocks * width)
    bench_resting(total, site)
    few, many = bench_idle(pile, SITE), bench_idle(total, site)
    print(
        f"scaling: a step without an awake rock takes {few * 1e3:.2f} ms with {len(pile)} rocks, "
        f"{many * 1e3:.2f} ms with {len(total)}"
    )
    start = time.process_time()
    steps = run_cycle(Scenario(), pile).outcome.steps
    seconds = time.process_time() - start
    extra = steps * (many - few)
    print(
        f"scaling: a loading cycle of {steps} steps takes {seconds:.1f} CPU s with {len(pile)} rocks, "
        f"{extra:.1f} s more with {len(total)}: times {1.0 + extra / seconds:.2f}"
    )
    share = (22_000 - len(pile)) / (len(total) - len(pile))
    print(f"scaling: in proportion, with 22 000 rocks: times {1.0 + share * extra / seconds:.2f}")


CASES: dict[str, Callable[[PileState], None]] = {
    "awake": bench_awake,
    "resting": bench_resting,
    "quality": bench_quality,
    "woken": bench_woken,
    "shallow": lambda pile: bench_dig(pile, 1.0, "rest"),
    "deep": lambda pile: bench_dig(pile, 3.5, "rest"),
    "shallow-none": lambda pile: bench_dig(pile, 1.0, "none"),
    "deep-none": lambda pile: bench_dig(pile, 3.5, "none"),
    "scaling": bench_scaling,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="+", choices=[*CASES, "all"])
    parser.add_argument("--pile", type=Path, help="a stored pile to take instead")
    arguments = parser.parse_args()
    pile = load_pile(arguments.pile) if arguments.pile else get_pile()
    print(f"pile: {len(pile)} rocks")
    for case in CASES if "all" in arguments.cases else arguments.cases:
        CASES[case](pile)


if __name__ == "__main__":
    main()
