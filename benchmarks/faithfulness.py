"""Does reduction, iterations or time step change the answer? Paired digs, stored as they finish.

    nice python benchmarks/faithfulness.py run 300 --seeds 40 --out build/faithfulness
    python benchmarks/faithfulness.py table --out build/faithfulness

Each seed is a place and depth of a dig, five to a pile (at full size all in one), dug once per variant. The table
gives the mean paired difference against `none` (all awake) relative to its mean, with its 90 % confidence
interval. Runs that are stored already are skipped, so a study can be stopped and continued.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from rocks import (
    ROCKS,
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
from drakerock.pile.config import PileConfig, SiteConfig
from drakerock.pile.state import PileState

# Per size of pile: number of rocks, site and emission height.
SIZES = {
    "300": (300, SiteConfig(drift_width=5.0, void_depth=1.2, rear_layer=0.0), 6.0),
    "1000": (1000, SiteConfig(drift_width=6.5, void_depth=2.2, rear_layer=0.0), 6.0),
    "full": (0, SITE, 8.0),
}
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


def run(size: str, seeds: range, variants: list[str], out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    n, site, height = SIZES[size]
    path = out / f"{size}.jsonl"
    done = {(r["seed"], r["variant"]) for r in read(path)}
    made = -1
    for seed in seeds:
        todo = [name for name in variants if (seed, name) not in done]
        if not todo:
            continue
        rng = np.random.default_rng(1000 + seed)
        if size == "full":
            pile = clear_way(get_pile())
        else:
            number = seed // DIGS_PER_PILE
            if number != made:
                pile, made = clear_way(make_small_pile(n, site, height, number)), number
        depth = rng.uniform(0.8, 2.5)
        free = 0.5 * site.drift_width - 1.7
        y = rng.uniform(-free, free)
        for name in todo:
            settings, time_step = VARIANTS[name]
            # Reduction starts with all at rest, so that its rules are what differs.
            contacts = replace(pile.contacts, resting=np.full(len(pile), settings["reduction"] == "rest"))
            start = replace(pile, contacts=contacts, V_WRs=np.zeros((len(pile), 6)))
            result = run_dig(start, make_dig(depth), NonsmoothConfig(**settings), 12.0, time_step, site, y)
            with open(path, "a", encoding="utf-8") as file:
                file.write(json.dumps({"seed": seed, "variant": name, **result}) + "\n")
            print(size, seed, name, {k: round(result[k], 3) for k in METRICS}, flush=True)


def read(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def print_table(out: Path, baseline: str = "none") -> None:
    print("| rocks | variant | pairs | " + " | ".join(METRICS) + " |")
    print("|---|---|---|" + "---|" * len(METRICS))
    for size in SIZES:
        results = {(r["variant"], r["seed"]): r for r in read(out / f"{size}.jsonl")}
        for variant in VARIANTS:
            if variant == baseline:
                continue
            seeds = [s for v, s in results if v == variant and (baseline, s) in results]
            if len(seeds) < 3:
                continue
            cells = []
            for metric in METRICS:
                a = np.array([results[variant, s][metric] for s in seeds])
                b = np.array([results[baseline, s][metric] for s in seeds])
                mean = (a - b).mean() / b.mean()
                half = stats.t.ppf(0.95, len(a) - 1) * (a - b).std(ddof=1) / np.sqrt(len(a)) / b.mean()
                cells.append(f"{100 * mean:+.1f} ± {100 * half:.1f} %")
            print(f"| {size} | {variant} | {len(seeds)} | " + " | ".join(cells) + " |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("run")
    one.add_argument("size", choices=SIZES)
    one.add_argument("--seeds", type=int, default=40)
    one.add_argument("--first", type=int, default=0)
    one.add_argument("--variants", nargs="+", choices=VARIANTS, default=["none", "rest"])
    one.add_argument("--out", type=Path, default=Path("build/faithfulness"))
    two = commands.add_parser("table")
    two.add_argument("--out", type=Path, default=Path("build/faithfulness"))
    arguments = parser.parse_args()
    if arguments.command == "run":
        seeds = range(arguments.first, arguments.first + arguments.seeds)
        run(arguments.size, seeds, arguments.variants, arguments.out)
    else:
        print_table(arguments.out)


if __name__ == "__main__":
    main()
