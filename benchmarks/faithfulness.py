"""Does reduction, iterations or time step change the answer? Paired digs, stored as they finish.

    nice python benchmarks/faithfulness.py run 300 --seeds 40
    nice python benchmarks/faithfulness.py cycles full --seeds 40
    nice python benchmarks/faithfulness.py states 300 --seeds 8
    nice python benchmarks/faithfulness.py held full --seeds 3 --variants rest rest-alone
    python benchmarks/faithfulness.py table

`run` digs by fixed motor rates; `cycles` plans and drives whole loading cycles of two of the method's reference
strategies in turn, each a little changed, which gives time, damage and debris too. (The third, [1.3, 0.85, 1.0, 0.6],
stalls or does not, so its bucket mass scatters three times as much.) Each seed is a place and depth of a dig, or a
strategy; there are five to a pile (at full size all in one), and each is done once per variant. The table gives the
mean paired difference against `none` (all awake) relative to its mean, with its 90 % confidence interval.

`states` stops a dig every 0.75 s, and each variant goes on from there for as long. That is short for chaos, so small
differences show; what it leaves out is that variants come to different states.

`held` stops a dig with reduction at some times, and goes on from there for half a second by its own rule and with all
rocks awake: what moves more then was held back by the rule. That tells rules apart in a few digs.

Runs are stored beside the docs, with the results revision that made them. Those that are stored already are
skipped, so a study can be stopped and continued, also at another time.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from rocks import (
    ROCKS,
    SHAPES,
    SITE,
    TIME_STEP,
    build_dig,
    calc_bucket_mass,
    clear_way,
    get_pile,
    make_dig,
    make_engine,
    run_dig,
)
from scipy import stats

from drakerock.identity import RESULTS_REVISION
from drakerock.loading.config import LoadingConfig
from drakerock.loading.cycle import run_cycle
from drakerock.loading.scenario import Scenario
from drakerock.rocks.config import PileConfig, SiteConfig
from drakerock.rocks.drake.system import NonsmoothRocks
from drakerock.rocks.engine.config import DynamicsConfig, NonsmoothConfig
from drakerock.rocks.making.make import make_pile
from drakerock.rocks.making.recipe import PileRecipe
from drakerock.rocks.state import PileState

# Per size of pile: number of rocks, site and emission height.
SIZES = {
    "300": (300, SiteConfig(drift_width=5.0, void_depth=1.2, rear_layer=0.0), 6.0),
    "1000": (1000, SiteConfig(drift_width=6.5, void_depth=2.2, rear_layer=0.0), 6.0),
    "full": (0, SITE, 8.0),
}
OUT = Path(__file__).parents[1] / "docs" / "validation" / "faithfulness"
# Strategies of `cycles`, in turn, each varied by so much to either side.
STRATEGIES = ((0.3, 0.6, 0.6, 0.2), (1.8, 0.1, 0.2, 1.0))
VARIATION = 0.05
N_LACKING = 5
USUAL = NonsmoothConfig()
VARIANTS: dict[str, tuple[dict[str, object], float]] = {
    "none": ({"reduction": "none"}, TIME_STEP),
    "rest": ({"reduction": "rest"}, TIME_STEP),
    "none-repeat": ({"reduction": "none", "iterations": USUAL.iterations + 1}, TIME_STEP),
    "twice-iterations": (
        {"reduction": "none", "iterations": 2 * USUAL.iterations},
        TIME_STEP,
    ),
    "half-step": ({"reduction": "none"}, 0.5 * TIME_STEP),
    # Each rock for itself: what rests and wakes does not ask whether a neighbour moves, and nothing is looked at again.
    "rest-alone": (
        {
            "reduction": "rest",
            "rest": {"mover_speed": 1e9, "wake_load": 0.3, "wake_share": 0.1, "recheck_period": 1e9},
        },
        TIME_STEP,
    ),
    # The method's own threshold, 10 mm/s, and later waking.
    "rest-10mm/s": (
        {
            "reduction": "rest",
            "rest": {"displacement": 1e-3, "mover_speed": 0.003, "wake_load": 0.6, "wake_share": 0.6},
        },
        TIME_STEP,
    ),
    "search-every-step": ({"reduction": "none", "search_period": 1}, TIME_STEP),
    "plain-50": (
        {"reduction": "none", "iterations": 50, "momentum": 0.0, "machine_sweeps": 3},
        TIME_STEP,
    ),
    "plain-200": (
        {"reduction": "none", "iterations": 200, "momentum": 0.0, "machine_sweeps": 3},
        TIME_STEP,
    ),
    "no-machine-sweeps": ({"reduction": "none", "machine_sweeps": 0}, TIME_STEP),
    "none-200": ({"reduction": "none", "iterations": 200}, TIME_STEP),
    "rest-200": ({"reduction": "rest", "iterations": 200}, TIME_STEP),
    "converged": ({"reduction": "none", "iterations": 400}, TIME_STEP),
}
# With reduction, what the two baselines of `table` are without.
REDUCED = ("rest", "rest-200")
# Making a pile costs as much as several digs; each is at another place and depth.
DIGS_PER_PILE = 5
CYCLE_METRICS = (
    "bucket_mass_kg",
    "loading_time_s",
    "peak_push_kN",
    "mean_push_kN",
    "displaced_m3",
    "production_kg_s",
    "damage",
    "debris_kg",
    "cpu_s",
)
STATE_METRICS = ("push_kN", "peak_push_kN", "gain_kg", "displaced_m3", "moved_1cm_m3", "tip_mm", "cpu_s")
# Of `states`: time between states, and how long each variant goes on [s]. States without push say nothing [kN].
STATE_PERIOD, STATE_TIME, MIN_PUSH = 0.75, 0.75, 20.0
# Of `held`: when digs are stopped, and how long they go on [s]; what moved farther than this meanwhile has moved [m].
HELD_TIMES, HELD_TIME, HELD_DISTANCES = (1.5, 2.5, 3.5, 4.5, 5.5, 7.0, 8.5, 10.0), 0.5, (0.002, 0.005, 0.02)
HELD_METRICS = ("rule_m3", "none_m3", "awake", "cpu_s")
METRICS = ("bucket_mass_kg", "peak_push_kN", "mean_push_kN", "displaced_m3", "reach_m", "cpu_s")


def make_small_pile(n: int, site: SiteConfig, height: float, seed: int) -> PileState:
    recipe = PileRecipe(
        seed=seed,
        site=site,
        rocks=ROCKS,
        pile=PileConfig(rocks=n, emission_height=height),
        dynamics=DynamicsConfig(rocks="nonsmooth"),
    )
    pile = make_pile(recipe)
    # At rest with all awake: both variants start from the same true rest.
    engine = make_engine(pile, site, reduction="none")
    arrays = engine.make_arrays(pile)
    for _ in range(200):
        arrays, _ = engine.advance(arrays)
    return engine.make_pile(arrays)


@lru_cache(maxsize=1)
def get_start(size: str, seed: int) -> PileState:
    n, site, height = SIZES[size]
    return get_pile() if size == "full" else make_small_pile(n, site, height, seed)


def start_at_rest(size: str, seed: int, reduction: object) -> PileState:
    """Return the pile of a seed; with reduction all is at rest, so that its rules are what differs."""
    pile = get_start(size, 0 if size == "full" else seed // DIGS_PER_PILE)
    contacts = replace(pile.contacts, resting=np.full(len(pile), reduction == "rest"))
    return replace(pile, contacts=contacts, V_WRs=np.zeros((len(pile), 6)))


def list_work(seeds: range, variants: list[str], path: Path) -> Iterator[tuple[int, str]]:
    """Yield the seed and variant of what is not stored yet."""
    path.parent.mkdir(parents=True, exist_ok=True)
    done = {(r["seed"], r["variant"]) for r in read(path)}
    yield from (work for work in product(seeds, variants) if work not in done)


def draw_dig(seed: int, site: SiteConfig) -> tuple[float, float]:
    """Return depth and place of a seed's dig [m]."""
    rng = np.random.default_rng(1000 + seed)
    free = 0.5 * site.drift_width - 1.7
    return rng.uniform(0.8, 2.5), rng.uniform(-free, free)


def store(
    path: Path, seed: int, variant: str, values: Mapping[str, float | list[float]], metrics: Sequence[str]
) -> None:
    with open(path, "a", encoding="utf-8") as file:
        rounded = {
            key: value if isinstance(value, list) else float(f"{value:.6g}") for key, value in values.items()
        }
        file.write(
            json.dumps({"seed": seed, "variant": variant, "results": RESULTS_REVISION, **rounded}) + "\n"
        )
    means = {k: round(float(np.mean(values[k])), 3) for k in metrics if k in values}
    print(path.stem, seed, variant, means, flush=True)


def run(size: str, seeds: range, variants: list[str], out: Path) -> None:
    """Digs by fixed rates, each at another place and depth."""
    site, path = SIZES[size][1], out / f"{size}.jsonl"
    for seed, name in list_work(seeds, variants, path):
        settings, time_step = VARIANTS[name]
        pile, (depth, y) = start_at_rest(size, seed, settings["reduction"]), draw_dig(seed, site)
        result = run_dig(pile, make_dig(depth), NonsmoothConfig(**settings), 12.0, time_step, site, y)
        store(path, seed, name, result, METRICS)


def run_cycles(size: str, seeds: range, variants: list[str], out: Path) -> None:
    """Whole loading cycles, each of another strategy."""
    n, site, height = SIZES[size]
    path = out / f"{size}-cycles.jsonl"
    for seed, name in list_work(seeds, variants, path):
        settings, time_step = VARIANTS[name]
        # Few strategies would be few digs: each pile lacks some rocks, others for each seed.
        pile = start_at_rest(size, seed, settings["reduction"])
        lacking = np.random.default_rng(3000 + seed).choice(
            np.flatnonzero(~pile.fixed), N_LACKING, replace=False
        )
        pile = pile.select(np.delete(np.arange(len(pile)), lacking))
        chosen = np.array(STRATEGIES[seed % len(STRATEGIES)])
        rng = np.random.default_rng(2000 + seed)
        values = np.clip(chosen + rng.uniform(-VARIATION, VARIATION, 4), 0.0, [2.0, 1.0, 1.0, 1.0])
        strategy = dict(zip(("alpha", "beta", "gamma", "kappa"), values.tolist(), strict=True))
        scenario = Scenario(
            seed=seed,
            site=site,
            pile=PileConfig(rocks=n or None, emission_height=height),
            dynamics=DynamicsConfig(nonsmooth=NonsmoothConfig(**settings), time_step=time_step),
            loading=LoadingConfig(strategy=strategy),
        )
        cpu = time.process_time()
        result = run_cycle(scenario, pile)
        cpu = time.process_time() - cpu
        outcome = result.outcome
        values: dict[str, float | list[float]] = {}
        if outcome.loading_time_s is None or outcome.peak_push_force_N is None:
            print(path.stem, seed, name, outcome.reason)
        else:
            moved = np.linalg.norm(result.pile_after.p_WRs - result.pile_before.p_WRs, axis=1) > 0.05
            masses = pile.calc_masses(np.array([shape.volume for shape in SHAPES]), ROCKS.density)
            values = {
                "bucket_mass_kg": outcome.bucket_mass_kg,
                "loading_time_s": outcome.loading_time_s,
                "peak_push_kN": outcome.peak_push_force_N / 1e3,
                "mean_push_kN": outcome.mean_push_force_N / 1e3,
                "displaced_m3": float(masses[moved].sum() / ROCKS.density),
                "production_kg_s": outcome.objectives["production"],
                "damage": outcome.objectives["damage"],
                "debris_kg": outcome.objectives["debris"],
                "cpu_s": cpu,
            }
        store(path, seed, name, values, CYCLE_METRICS)


def run_states(size: str, seeds: range, variants: list[str], out: Path) -> None:
    """What each variant makes of the same states of a dig (with `rest`; the others wake all rocks first)."""
    site, path = SIZES[size][1], out / f"{size}-states.jsonl"
    missing: dict[int, list[str]] = {}
    for seed, name in list_work(seeds, variants, path):
        missing.setdefault(seed, []).append(name)
    for seed, names in missing.items():
        pile, (depth, y) = start_at_rest(size, seed, "rest"), draw_dig(seed, site)
        simulator, plant, _, rocks = build_dig(
            clear_way(pile), make_dig(depth), NonsmoothConfig(), TIME_STEP, site, y
        )
        found: dict[str, list[dict[str, float]]] = {name: [] for name in names}
        for t in np.arange(STATE_PERIOD, 9.0, STATE_PERIOD):
            simulator.AdvanceTo(t)
            for name in names:
                settings = NonsmoothConfig(**VARIANTS[name][0])
                found[name].append(continue_dig(simulator, plant, rocks, settings))
        for name in names:
            values = {metric: [one[metric] for one in found[name]] for metric in STATE_METRICS}
            store(path, seed, name, values, STATE_METRICS)


def run_held(size: str, seeds: range, variants: list[str], out: Path) -> None:
    """What each variant holds back that moves when all rocks are woken."""
    site, path = SIZES[size][1], out / f"{size}-held.jsonl"
    none = NonsmoothConfig(reduction="none")
    for seed, name in list_work(seeds, variants, path):
        pile, (depth, y) = clear_way(start_at_rest(size, seed, "rest")), draw_dig(seed, site)
        settings = NonsmoothConfig(**VARIANTS[name][0])
        simulator, _, _, rocks = build_dig(pile, make_dig(depth), settings, TIME_STEP, site, y)
        root = simulator.get_mutable_context()
        rocks.get_report(root)  # loads the compiled kernels
        found: dict[str, list[float]] = {metric: [] for metric in HELD_METRICS}
        cpu = 0.0
        for t in HELD_TIMES:
            cpu -= time.process_time()
            while root.get_time() < t - 1e-9:
                simulator.AdvanceTo(root.get_time() + 0.1)
                found["awake"].append(float(rocks.get_report(root).n_awake))
            cpu += time.process_time()
            before = rocks.get_pile(root)
            for metric, config in (("rule_m3", settings), ("none_m3", none)):
                with go_on_with(simulator, rocks, config) as other:
                    other.AdvanceTo(t + HELD_TIME)
                    after = rocks.get_pile(other.get_context())
                moved = np.linalg.norm(after.p_WRs - before.p_WRs, axis=1)
                found[metric] += [
                    float(rocks.engine.mass[moved > distance].sum() / ROCKS.density)
                    for distance in HELD_DISTANCES
                ]
        found["cpu_s"].append(cpu)
        store(path, seed, name, found, HELD_METRICS)


@contextmanager
def go_on_with(simulator: Simulator, rocks: NonsmoothRocks, settings: NonsmoothConfig) -> Iterator[Simulator]:
    """Give a simulator that goes on from a copy of another's context, the rocks with other settings meanwhile."""
    usual = rocks.engine.config
    rocks.engine.config = settings
    try:
        other = Simulator(simulator.get_system(), simulator.get_context().Clone())
        # The step's solution is to be found anew.
        rocks.GetMyMutableContextFromRoot(other.get_mutable_context()).get_mutable_discrete_state()
        yield other
    finally:
        rocks.engine.config = usual


def continue_dig(
    simulator: Simulator, plant: MultibodyPlant, rocks: NonsmoothRocks, settings: NonsmoothConfig
) -> dict[str, float]:
    """Go on for `STATE_TIME` from a copy of the simulator's context with other settings."""
    with go_on_with(simulator, rocks, settings) as other:
        root = other.get_mutable_context()
        context = rocks.GetMyContextFromRoot(root)
        bucket_force = rocks.get_body_force_output_port(plant.GetBodyByName("bucket").index())
        tip = plant.GetFrameByName("tip")
        plant_context = plant.GetMyContextFromRoot(root)
        before, masses = rocks.get_pile(root), rocks.engine.mass
        held = calc_bucket_mass(before, masses, plant, plant_context)
        forces, start, cpu = [], root.get_time(), time.process_time()
        for k in range(round(STATE_TIME / TIME_STEP)):
            other.AdvanceTo(start + (k + 1) * TIME_STEP)
            forces.append(-bucket_force.Eval(context)[3] / 1e3)
        cpu = time.process_time() - cpu
        after = rocks.get_pile(root)
        way = np.linalg.norm(after.p_WRs - before.p_WRs, axis=1)
        window = round(0.1 / TIME_STEP)
        return {
            "push_kN": float(np.mean(forces)),
            "peak_push_kN": float(np.convolve(forces, np.ones(window) / window, mode="valid").max()),
            "gain_kg": calc_bucket_mass(after, masses, plant, plant_context) - held,
            "displaced_m3": float(masses[way > 0.05].sum() / ROCKS.density),
            "moved_1cm_m3": float(masses[way > 0.01].sum() / ROCKS.density),
            "tip_mm": float(tip.CalcPoseInWorld(plant_context).translation()[0]) * 1e3,
            "cpu_s": cpu,
        }


def read(path: Path) -> list[dict]:
    """Return the stored runs of this results revision."""
    lines = path.read_text().splitlines() if path.exists() else []
    return [run for run in map(json.loads, lines) if run["results"] == RESULTS_REVISION]


def compare(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Return the mean of the paired differences a - b and half its 90 % confidence interval."""
    half = stats.t.ppf(0.95, len(a) - 1) * (a - b).std(ddof=1) / np.sqrt(len(a)) if len(a) > 1 else np.nan
    return float((a - b).mean()), float(half)


def print_table(out: Path, baselines: Sequence[str] = ("none", "none-200")) -> None:
    """Print the tables of digs and of cycles; cycles that failed in a variant are left out.

    The last row of a size is the effect of the reduction at both numbers of sweeps, from the means of the two.
    """
    for suffix, metrics in (("", METRICS), ("-cycles", CYCLE_METRICS)):
        print("| rocks | variant | against | pairs | " + " | ".join(metrics) + " |")
        print("|---|---|---|---|" + "---|" * len(metrics))
        pairs = [
            ((variant,), (baseline,))
            for baseline, variant in product(baselines, VARIANTS)
            if variant != baseline
        ]
        stored = {
            size: {(r["variant"], r["seed"]): r for r in read(out / f"{size}{suffix}.jsonl") if "cpu_s" in r}
            for size in SIZES
        }
        for size, (variants, others) in product(SIZES, [*pairs, (REDUCED, baselines)]):
            results = stored[size]
            seeds = [s for v, s in results if v == variants[0]]
            seeds = [s for s in seeds if all((name, s) in results for name in (*variants, *others))]
            if len(seeds) < 3:
                continue
            cells = []
            for metric in metrics:
                a, b = (
                    np.array([np.mean([results[name, s][metric] for name in names]) for s in seeds])
                    for names in (variants, others)
                )
                mean, half = compare(a, b)
                cells.append(f"{100 * mean / b.mean():+.1f} ± {100 * half / b.mean():.1f} %")
            names = " and ".join(variants), " and ".join(others)
            print(f"| {size} | {names[0]} | {names[1]} | {len(seeds)} | " + " | ".join(cells) + " |")
        print()


def print_states(out: Path, baselines: Sequence[str] = ("none", "converged")) -> None:
    """Print what variants make of the same states: mean difference with its 90 % interval, all states together."""
    print("| rocks | variant | against | states | " + " | ".join(STATE_METRICS) + " |")
    print("|---|---|---|---|" + "---|" * len(STATE_METRICS))
    for size in SIZES:
        results = {(r["variant"], r["seed"]): r for r in read(out / f"{size}-states.jsonl")}
        for baseline, variant in product(baselines, VARIANTS):
            seeds = [s for v, s in results if v == variant and (baseline, s) in results]
            if variant == baseline or not seeds:
                continue
            cells = []
            pushed = np.concatenate([results[baseline, s]["push_kN"] for s in seeds]) > MIN_PUSH
            for metric in STATE_METRICS:
                a, b = (
                    np.concatenate([results[v, s][metric] for s in seeds])[pushed]
                    for v in (variant, baseline)
                )
                scale, unit = (1.0, "") if metric == "tip_mm" else (100.0 / b.mean(), " %")
                mean, half = compare(a, b)
                cells.append(f"{scale * mean:+.1f} ± {scale * half:.1f}{unit}")
            print(f"| {size} | {variant} | {baseline} | {pushed.sum()} | " + " | ".join(cells) + " |")


def print_held(out: Path) -> None:
    """Print what rules hold back: volume that moves against that when all are woken, with its 90 % interval."""
    titles = [f"moves by more than {1e3 * distance:g} mm" for distance in HELD_DISTANCES]
    print("| rocks | variant | states | " + " | ".join(titles) + " | awake | CPU s to 10 s |")
    print("|---|---|---|" + "---|" * (len(titles) + 2))
    for size in SIZES:
        results = read(out / f"{size}-held.jsonl")
        for variant in VARIANTS:
            chosen = [r for r in results if r["variant"] == variant]
            if not chosen:
                continue
            rule, none = (
                np.concatenate([np.reshape(r[metric], (-1, len(HELD_DISTANCES))) for r in chosen])
                for metric in ("rule_m3", "none_m3")
            )
            cells = []
            for a, b in zip(rule.T, none.T, strict=True):
                mean, half = compare(a, b)
                cells.append(f"{100 * mean / b.mean():+.1f} ± {100 * half / b.mean():.1f} %")
            awake, cpu = (np.mean([np.mean(r[metric]) for r in chosen]) for metric in ("awake", "cpu_s"))
            print(
                f"| {size} | {variant} | {len(rule)} | " + " | ".join(cells) + f" | {awake:.0f} | {cpu:.1f} |"
            )
    print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("run", "cycles", "states", "held"):
        one = commands.add_parser(name)
        one.add_argument("size", choices=SIZES)
        one.add_argument("--seeds", type=int, default=40)
        one.add_argument("--first", type=int, default=0)
        one.add_argument("--variants", nargs="+", choices=VARIANTS, default=["none", "rest"])
        one.add_argument("--out", type=Path, default=OUT)
    two = commands.add_parser("table")
    two.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    if arguments.command == "table":
        print_table(arguments.out)
        print_states(arguments.out)
        print_held(arguments.out)
    else:
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        work = {"run": run, "cycles": run_cycles, "states": run_states, "held": run_held}[arguments.command]
        work(arguments.size, seeds, arguments.variants, arguments.out)


if __name__ == "__main__":
    main()
