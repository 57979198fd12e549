"""Does reduction, iterations or time step change the answer? Paired digs, stored as they finish.

    nice python benchmarks/faithfulness.py run 300 --seeds 40 --out build/faithfulness
    nice python benchmarks/faithfulness.py cycles 300 --seeds 40 --out build/faithfulness
    python benchmarks/faithfulness.py table --out build/faithfulness

`run` digs by fixed motor rates; `cycles` plans and drives whole loading cycles of random strategies, which gives
time, damage and debris too. Each seed is a place and depth of a dig, or a strategy; there are five to a pile (at full
size all in one), and each is done once per variant. The table gives the mean paired difference against `none` (all
awake) relative to its mean, with its 90 % confidence interval. Runs that are stored already are skipped, so a study
can be stopped and continued.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from rocks import (
    ROCKS,
    SHAPES,
    SITE,
    TIME_STEP,
    clear_way,
    get_pile,
    make_dig,
    make_engine,
    run_dig,
)
from scipy import stats

from drakerock.dynamics.config import DynamicsConfig, NonsmoothConfig
from drakerock.dynamics.settling import PileRecipe, make_pile
from drakerock.loading.config import LoadingConfig
from drakerock.loading.cycle import run_cycle
from drakerock.loading.scenario import Scenario
from drakerock.pile.config import PileConfig, SiteConfig
from drakerock.pile.state import PileState

# Per size of pile: number of rocks, site and emission height.
SIZES = {
    "300": (300, SiteConfig(drift_width=5.0, void_depth=1.2, rear_layer=0.0), 6.0),
    "1000": (1000, SiteConfig(drift_width=6.5, void_depth=2.2, rear_layer=0.0), 6.0),
    "full": (0, SITE, 8.0),
}
# The method's ranges of the strategy.
STRATEGY = {"alpha": (0.2, 2.0), "beta": (0.0, 1.0), "gamma": (0.0, 1.0), "kappa": (0.0, 1.0)}
VARIANTS: dict[str, tuple[dict[str, object], float]] = {
    "none": ({"reduction": "none"}, TIME_STEP),
    "rest": ({"reduction": "rest"}, TIME_STEP),
    "none-repeat": ({"reduction": "none", "iterations": 51}, TIME_STEP),
    "iterations-100": ({"reduction": "none", "iterations": 100}, TIME_STEP),
    "half-step": ({"reduction": "none"}, 0.5 * TIME_STEP),
    "rest-slow": ({"reduction": "rest", "rest": {"displacement": 0.004, "time": 0.3}}, TIME_STEP),
    "alpha-0.5": ({"reduction": "rest", "rest": {"wake_load": 0.5}}, TIME_STEP),
    "alpha-2": ({"reduction": "rest", "rest": {"wake_load": 2.0}}, TIME_STEP),
}
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


def list_work(
    size: str, seeds: range, variants: list[str], path: Path
) -> Iterator[tuple[int, str, NonsmoothConfig, float, PileState]]:
    """Yield what is not stored yet: seed, variant, its settings and time step, and the pile it starts from."""
    path.parent.mkdir(parents=True, exist_ok=True)
    n, site, height = SIZES[size]
    done = {(r["seed"], r["variant"]) for r in read(path)}
    made = -1
    for seed, name in product(seeds, variants):
        if (seed, name) in done:
            continue
        number = 0 if size == "full" else seed // DIGS_PER_PILE
        if number != made:
            pile = get_pile() if size == "full" else make_small_pile(n, site, height, number)
            made = number
        settings, time_step = VARIANTS[name]
        # Reduction starts with all at rest, so that its rules are what differs.
        contacts = replace(pile.contacts, resting=np.full(len(pile), settings["reduction"] == "rest"))
        start = replace(pile, contacts=contacts, V_WRs=np.zeros((len(pile), 6)))
        yield seed, name, NonsmoothConfig(**settings), time_step, start


def store(path: Path, seed: int, variant: str, values: dict[str, float], metrics: Sequence[str]) -> None:
    with open(path, "a", encoding="utf-8") as file:
        file.write(json.dumps({"seed": seed, "variant": variant, **values}) + "\n")
    print(path.stem, seed, variant, {k: round(values[k], 3) for k in metrics if k in values}, flush=True)


def run(size: str, seeds: range, variants: list[str], out: Path) -> None:
    """Digs by fixed rates, each at another place and depth."""
    site, path = SIZES[size][1], out / f"{size}.jsonl"
    free = 0.5 * site.drift_width - 1.7
    for seed, name, config, time_step, pile in list_work(size, seeds, variants, path):
        rng = np.random.default_rng(1000 + seed)
        depth, y = rng.uniform(0.8, 2.5), rng.uniform(-free, free)
        result = run_dig(clear_way(pile), make_dig(depth), config, 12.0, time_step, site, y)
        store(path, seed, name, result, METRICS)


def run_cycles(size: str, seeds: range, variants: list[str], out: Path) -> None:
    """Whole loading cycles, each of a strategy drawn from the method's ranges."""
    n, site, height = SIZES[size]
    path = out / f"{size}-cycles.jsonl"
    for seed, name, config, time_step, pile in list_work(size, seeds, variants, path):
        rng = np.random.default_rng(2000 + seed)
        strategy = dict(zip(STRATEGY, rng.uniform(*np.transpose(list(STRATEGY.values()))), strict=True))
        scenario = Scenario(
            seed=seed,
            site=site,
            pile=PileConfig(rocks=n or None, emission_height=height),
            dynamics=DynamicsConfig(nonsmooth=config, time_step=time_step),
            loading=LoadingConfig(strategy=strategy),
        )
        cpu = time.process_time()
        result = run_cycle(scenario, pile)
        cpu = time.process_time() - cpu
        outcome = result.outcome
        values: dict[str, float] = {}
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


def read(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def print_table(out: Path, baseline: str = "none") -> None:
    """Print the tables of digs and of cycles; cycles that failed in either variant are left out."""
    for suffix, metrics in (("", METRICS), ("-cycles", CYCLE_METRICS)):
        print("| rocks | variant | pairs | " + " | ".join(metrics) + " |")
        print("|---|---|---|" + "---|" * len(metrics))
        for size in SIZES:
            results = {
                (r["variant"], r["seed"]): r for r in read(out / f"{size}{suffix}.jsonl") if "cpu_s" in r
            }
            for variant in VARIANTS:
                if variant == baseline:
                    continue
                seeds = [s for v, s in results if v == variant and (baseline, s) in results]
                if len(seeds) < 3:
                    continue
                cells = []
                for metric in metrics:
                    a = np.array([results[variant, s][metric] for s in seeds])
                    b = np.array([results[baseline, s][metric] for s in seeds])
                    mean = (a - b).mean() / b.mean()
                    half = stats.t.ppf(0.95, len(a) - 1) * (a - b).std(ddof=1) / np.sqrt(len(a)) / b.mean()
                    cells.append(f"{100 * mean:+.1f} ± {100 * half:.1f} %")
                print(f"| {size} | {variant} | {len(seeds)} | " + " | ".join(cells) + " |")
        print()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    for name in ("run", "cycles"):
        one = commands.add_parser(name)
        one.add_argument("size", choices=SIZES)
        one.add_argument("--seeds", type=int, default=40)
        one.add_argument("--first", type=int, default=0)
        one.add_argument("--variants", nargs="+", choices=VARIANTS, default=["none", "rest"])
        one.add_argument("--out", type=Path, default=Path("build/faithfulness"))
    two = commands.add_parser("table")
    two.add_argument("--out", type=Path, default=Path("build/faithfulness"))
    arguments = parser.parse_args()
    if arguments.command == "table":
        print_table(arguments.out)
    else:
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        work = run if arguments.command == "run" else run_cycles
        work(arguments.size, seeds, arguments.variants, arguments.out)


if __name__ == "__main__":
    main()
