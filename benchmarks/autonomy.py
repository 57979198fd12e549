"""Is the autonomous loader better than a fixed strategy? Paired and blind: unseen piles, the same for every choice.

    python benchmarks/autonomy.py speed --loadings 2000
    python benchmarks/autonomy.py accuracy out/full_size --out out/autonomy
    nice python benchmarks/autonomy.py run out/full_size --out out/autonomy --loadings 15
    python benchmarks/autonomy.py table out/autonomy
    nice python benchmarks/autonomy.py control --out out/control --seeds 11 12 13
    python benchmarks/autonomy.py run out/small --scenario studies/small.yaml --piles seed_11 --loadings 2

`speed` measures training on so many loadings of formulas' piles, on the method's grid, and a decision of each
choice [CPU s]. `accuracy` holds the models of outcome and pile against design points that were not fitted to, over the
share of the points that was: the learning curve.

`run` loads from each starting pile with each choice, a sequence of its own each; what is stored is skipped, so it can
be stopped and continued. No pile has a seed of the study's. `--choices look_ahead:1 look_ahead:2 look_ahead:3` is the
ablation of the depth, `--shares 0.25 0.5 1` that of the amount of training data.

`control` loads once from the same piles with the same plans (the method's three reference strategies) under
feed-forward, admittance and slip control, with their default gains, and prints the means with paired differences to
feed-forward.

`table` gives means with 90 % intervals of the paired differences to `best_fixed`, over piles (bootstrap), as
JSON, Markdown and picture. The pairs share the starting pile; refills differ as soon as the piles do.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from drakerock.autonomy.data import LoadingData, read_loading_data
from drakerock.autonomy.model import CHOICES, LoaderModel
from drakerock.autonomy.outcome_models import BlindOutcome
from drakerock.autonomy.preference import make_preference
from drakerock.autonomy.sequence import Adviser, run_autonomous
from drakerock.errors import DrakerockError
from drakerock.exploration.problem import REFERENCE_STRATEGIES, Problem
from drakerock.files import make_folder, write_text
from drakerock.loading.config import StrategyConfig
from drakerock.loading.cycle import run_cycle
from drakerock.loading.features import PileFeatures, calc_pile_features
from drakerock.loading.field import HeightField
from drakerock.loading.folder import NEXT_PILE
from drakerock.loading.scenario import Scenario, load_scenario
from drakerock.loading.sensing import make_grid
from drakerock.loading.sequence import run_sequence
from drakerock.randomness import make_generator
from drakerock.study.jobs import get_pile

COARSE = [
    {"size_m": 0.4, "mass_fraction": 0.2}, {"size_m": 0.6, "mass_fraction": 0.3}, {"size_m": 0.8, "mass_fraction": 0.3},
    {"size_m": 1.0, "mass_fraction": 0.2},
]  # fmt: skip
# Starting piles of other seeds; flatter and steeper ones by the rocks' friction; other voids behind the brow, which
# press on the slope otherwise; coarser rock; a front that is dug at one place only, so many times.
PILES: dict[str, dict[str, Any]] = {
    **{f"seed_{seed}": {"seed": seed} for seed in range(11, 16)},
    "smooth_21": {"seed": 21, "rocks.friction": 0.6},
    "smooth_22": {"seed": 22, "rocks.friction": 0.7},
    "rough_23": {"seed": 23, "rocks.friction": 1.2},
    "taper_24": {"seed": 24, "site.void_taper_deg": 6.0},
    "shallow_25": {"seed": 25, "site.void_depth": 7.0},
    "coarse_26": {"seed": 26, "rocks.gradation": COARSE},
    "seed_27": {"seed": 27},
    "uneven_28": {"seed": 28, "dug": 4},
    "uneven_29": {"seed": 29, "dug": 4},
}
# Always at the rear-most place, where the last loading has dug already: a notch, deeper each time.
NOTCH = {"alpha": 1.2, "beta": 0.5, "gamma": 0.0, "kappa": 0.8}
OBJECTIVES = ("production", "damage", "debris")
NUMBERS = ("J_per_kg", "wheel_slip_m", "bucket_mass_kg", "loading_time_s")


def make_formula_data(n: int, seed: int = 0) -> LoadingData:
    """Return loadings of formulas on the method's grid: sizes as of a full study, for timing only."""
    scenario = Scenario()
    sensing = scenario.loading.sensing
    x, y = make_grid(scenario.site, sensing.cell, scenario.site.drift_length / 2)
    rng, problem, each = make_generator(seed, "formulas"), Problem(), 12
    points = -(-n // each)
    X = np.repeat(problem.low + rng.uniform(size=(points, 4)) * (problem.high - problem.low), each, axis=0)[
        :n
    ]
    toe, slope, skew = rng.uniform(-6, -4, n), rng.uniform(0.6, 1.0, n), rng.uniform(-0.3, 0.3, n)
    H = slope[:, None, None] * (
        x[None, :, None] - toe[:, None, None] - skew[:, None, None] * y[None, None, :]
    )
    H = np.clip(H + rng.normal(0.0, 0.1, H.shape), 0.0, 5.0) * (H > 0)
    Y = np.stack([400 + 200 * X[:, 0] * slope, X[:, 0] * (1 - X[:, 1]), 300 * X[:, 3]], axis=1)
    Y *= 1.0 + 0.2 * rng.standard_normal(Y.shape)
    following = np.roll(H, -1, axis=0)
    loading = np.arange(n) % each
    following[loading == each - 1] = np.nan
    features = np.array(
        [
            list(vars(calc_pile_features(HeightField(x, y, h, sensing.cell), sensing.front_height)).values())
            for h in H
        ]
    )
    assert features.shape[1] == len(PileFeatures.list_names())
    return LoadingData(
        problem, scenario, x, y, sensing.cell, X, Y, H, H, following, features,
        np.array([f"s{i:04d}" for i in np.arange(n) // each]), np.zeros(n, int), loading, np.array(["sample"] * n),
    )  # fmt: skip


def run_speed(n: int) -> None:
    data = make_formula_data(n)
    model = LoaderModel(data)
    start = time.process_time()
    for name in (
        "surrogate",
        "front",
        "encoder",
        "novelty",
        "hazard_limits",
        "feature_outcome",
        "field_outcome",
        "pile_model",
    ):
        begun = time.process_time()
        getattr(model, name)
        print(f"{name:<16} {time.process_time() - begun:6.1f} CPU s")
    print(f"training on {n} loadings: {time.process_time() - start:.1f} CPU s")
    wanted = make_preference(model.problem, "production=0.6,damage=0.4")
    for name in CHOICES:
        choice = model.make_choice(name, StrategyConfig())
        spent = []
        for i in range(5):
            begun = time.process_time()
            choice.choose(model.look_at(data.get_field(i), data.scenario), wanted)
            spent.append(time.process_time() - begun)
        print(f"decision {name:<12} {np.median(spent):.3f} CPU s, at most {max(spent):.3f}")


def run_accuracy(source: Path, out: Path, shares: Sequence[float], seed: int) -> None:
    """Hold models against a fifth of the points, fitted to shares of the others."""
    data = read_loading_data(source)
    fit, test = data.split(0.2, seed)
    rows = []
    for share in shares:
        names = make_generator(seed, "share").permutation(np.unique(fit.point))
        part = fit.take(np.isin(fit.point, names[: max(round(share * len(names)), 7)]))
        model = LoaderModel(part, seed)
        start = time.process_time()
        spread = test.Y.std(axis=0)
        row: dict[str, Any] = {"share": share, "points": len(np.unique(part.point)), "loadings": len(part)}
        for name, made in (
            ("blind", lambda model=model: BlindOutcome(model.surrogate)),
            ("features", lambda model=model: model.feature_outcome),
            ("field", lambda model=model: model.field_outcome),
        ):
            outcome = made()
            told = np.array(
                [outcome.predict(h[None], x[None])[0][0] for h, x in zip(test.before, test.X, strict=True)]
            )
            row[name] = (np.sqrt(np.mean((told - test.Y) ** 2, axis=0)) / spread).round(3).tolist()
        row["pile_skill"] = round(model.pile_model.skill, 3)
        row["novel_share"] = float(np.mean([model.novelty.calc(h) > 1.0 for h in test.before]))
        row["cpu_s"] = round(time.process_time() - start, 1)
        rows.append(row)
        print(json.dumps(row))
    make_folder(out)
    names = list(data.problem.objective_names)
    write_text(
        out / "accuracy.json",
        json.dumps({"objectives": names, "tested": len(test), "rows": rows}, indent=2) + "\n",
    )
    draw_accuracy(rows, names, out / "accuracy.png")


def draw_accuracy(rows: list[dict[str, Any]], names: list[str], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2 * len(names), 3), dpi=110, layout="constrained")
    for j, (name, axes) in enumerate(zip(names, np.ravel(figure.subplots(1, len(names))), strict=True)):
        for model, style in (("blind", "k--"), ("features", "C0o-"), ("field", "C1s-")):
            axes.plot([row["loadings"] for row in rows], [row[model][j] for row in rows], style, label=model)
        axes.set(title=name, xlabel="loadings fitted to", ylabel="error / spread of loadings", ylim=(0, None))
        axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path)


def make_start(base: Scenario, pile: str, out: Path) -> Scenario:
    """Return the scenario whose pile is one of `PILES`; what has to be dug for it is dug once."""
    changes = dict(PILES[pile])
    dug = changes.pop("dug", 0)
    scenario = base.replace(**changes)
    if not dug:
        return scenario
    folder = out / "dug" / pile
    run_sequence(scenario.replace(**{"loading.strategy": NOTCH}), dug, folder)
    drop_large_files(folder)
    return scenario.replace(**{"pile.source": str(folder / f"loading_{dug - 1:02d}" / NEXT_PILE)})


def run_sequences(args: argparse.Namespace) -> None:
    base = load_scenario(args.scenario, args.set or [])
    data = read_loading_data(args.model)
    wanted = make_preference(data.problem, args.weights, args.bound or [])
    for share in args.shares:
        names = make_generator(0, "share").permutation(np.unique(data.point))
        kept = data.take(np.isin(data.point, names[: max(round(share * len(names)), 7)]))
        model = LoaderModel(kept)
        for pile in args.piles:
            scenario = make_start(base, pile, args.out)
            for label in args.choices:
                choice, _, depth = label.partition(":")
                name = label.replace(":", "_") + ("" if share == 1 else f"_share_{share:g}")
                folder = args.out / "runs" / pile / name
                adviser = Adviser(model, str(args.model), choice, int(depth or 3))
                start = time.process_time()
                try:
                    outcomes = run_autonomous(scenario, adviser, lambda _: wanted, args.loadings, folder)
                    note = f"{len(outcomes)} loadings, {sum(o.status == 'failed' for o in outcomes)} failed"
                except DrakerockError as error:
                    note = f"ended: {error}"
                    make_folder(folder)
                    write_text(folder / "ended.txt", f"{error}\n")
                print(f"{pile:<12} {name:<16} {note}, {time.process_time() - start:.0f} CPU s", flush=True)
                drop_large_files(folder)


CONTROLLERS: dict[str, dict[str, Any]] = {
    "feed-forward": {},
    "admittance": {"loading.parts.controller.system": "drakerock.loading.yielding_control:make_admittance"},
    "slip control": {
        "loading.parts.controller.system": "drakerock.loading.yielding_control:make_slip_control"
    },
}


def run_control(args: argparse.Namespace) -> None:
    """Compare the controllers, one loading each; what is stored is skipped."""
    make_folder(args.out)
    path = args.out / "control.json"
    rows: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    base = load_scenario(args.scenario, args.set or [])
    known = {(row["seed"], row["strategy"], row["controller"]) for row in rows}
    for seed, (label, values) in product(args.seeds, REFERENCE_STRATEGIES.items()):
        strategy = dict(zip(("alpha", "beta", "gamma", "kappa"), values, strict=True))
        scenario = base.replace(**{"seed": seed, "loading.strategy": strategy})
        for controller, changes in CONTROLLERS.items():
            if (seed, label, controller) in known:
                continue
            outcome = run_cycle(scenario.replace(**changes), get_pile(scenario)).outcome
            numbers = {name: (outcome.mining or {}).get(name) for name in ("wheel_slip_m",)}
            numbers |= {
                name: getattr(outcome, name) for name in ("bucket_mass_kg", "loading_time_s", "energy_J")
            }
            row = {"seed": seed, "strategy": label, "controller": controller, "reason": outcome.reason}
            rows.append(row | outcome.objectives | numbers)
            write_text(path, json.dumps(rows, indent=1) + "\n")
            print(json.dumps(rows[-1]), flush=True)
    print_control(rows)


def print_control(rows: list[dict[str, Any]]) -> None:
    names = (*OBJECTIVES, "wheel_slip_m", "bucket_mass_kg", "loading_time_s")
    pairs: dict[tuple[int, str], dict[str, dict[str, Any]]] = {}
    for row in rows:
        pairs.setdefault((row["seed"], row["strategy"]), {})[row["controller"]] = row
    whole = [pair for pair in pairs.values() if len(pair) == len(CONTROLLERS)]
    print(f"| controller ({len(whole)} pairs) | {' | '.join(names)} |")
    print(f"|{'---|' * (len(names) + 1)}")
    for controller in CONTROLLERS:
        cells = []
        for name in names:
            values = np.array([_get(pair[controller][name]) for pair in whole])
            cell = f"{np.nanmean(values):.4g}"
            if controller != "feed-forward":
                base = np.array([_get(pair["feed-forward"][name]) for pair in whole])
                mean, low, high = calc_interval(values - base)
                cell += f" ({mean:+.3g}" + (f", {low:+.3g} to {high:+.3g})" if low is not None else ")")
            cells.append(cell)
        print(f"| {controller} | {' | '.join(cells)} |")


def _get(value: float | None) -> float:
    return float("nan") if value is None else value


def drop_large_files(folder: Path) -> None:
    """Keep what the table, the page and going on need: outcomes, decisions, plans, fields, the last pile."""
    places = sorted(folder.glob("loading_*"))
    for place in places:
        names = ["signals.parquet", "recording.npz", "pile_before.npz", "pile_after.npz"]
        for name in names + ([] if place == places[-1] else ["pile_next.npz"]):
            (place / name).unlink(missing_ok=True)


def read_runs(folder: Path) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Return by choice and pile the loadings' numbers."""
    runs: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for place in sorted(folder.glob("runs/*/*")):
        rows = []
        for path in sorted(place.glob("loading_*/outcome.json")):
            outcome = json.loads(path.read_text())
            decision = json.loads((path.parent / "decision.json").read_text())
            row = {name: outcome["objectives"][name] for name in OBJECTIVES}
            load, work = outcome["bucket_mass_kg"], outcome["energy_J"]
            row |= {"bucket_mass_kg": load, "loading_time_s": outcome["loading_time_s"]}
            row["J_per_kg"] = None if not load or work is None else work / load
            row["wheel_slip_m"] = (outcome.get("mining") or {}).get("wheel_slip_m")
            row |= {"failed": outcome["status"] == "failed", "fell_back": decision["fell_back"]}
            row["cleaned"] = decision["cleaned_kg"] is not None
            rows.append(row)
        if rows:
            runs.setdefault(place.name, {})[place.parent.name] = rows
    return runs


def average(rows: list[dict[str, Any]], name: str) -> float:
    values = [row[name] for row in rows if row[name] is not None and not row["failed"]]
    return float(np.mean(values)) if values else float("nan")


def make_table(folder: Path, base: str = "best_fixed") -> dict[str, Any]:
    """Return per choice: mean of the piles' means, and its paired difference to the base with a 90 % interval."""
    runs = read_runs(folder)
    table: dict[str, Any] = {}
    for name, piles in runs.items():
        rows = [row for loadings in piles.values() for row in loadings]
        entry: dict[str, Any] = {"piles": len(piles), "loadings": len(rows)}
        entry |= {key: sum(row[key] for row in rows) for key in ("failed", "fell_back", "cleaned")}
        for quantity in (*OBJECTIVES, *NUMBERS):
            entry[quantity] = float(np.nanmean([average(loadings, quantity) for loadings in piles.values()]))
            shared = sorted(set(piles) & set(runs.get(base, {})))
            if name != base and shared:
                difference = np.array(
                    [average(piles[p], quantity) - average(runs[base][p], quantity) for p in shared]
                )
                entry[f"{quantity}_difference"] = calc_interval(difference)
        table[name] = entry
    return table


def calc_interval(difference: np.ndarray) -> list[float | None]:
    """Return mean and the bootstrap's 90 % interval over piles; without an interval from fewer than three."""
    known = difference[np.isfinite(difference)]
    if len(known) == 0:
        return [None, None, None]
    mean = float(known.mean())
    if len(known) < 3:
        return [mean, None, None]
    drawn = make_generator(0, "bootstrap").choice(known, (4000, len(known))).mean(axis=1)
    return [mean, *np.quantile(drawn, (0.05, 0.95)).tolist()]


def write_table(folder: Path) -> None:
    table = make_table(folder)
    if not table:
        raise SystemExit(f"{folder}: no runs there")
    heads = ("choice", "piles", "loadings", *OBJECTIVES, *NUMBERS, "failed", "fell_back", "cleaned")
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for name, entry in table.items():
        cells = [name]
        for head in heads[1:]:
            cell = f"{entry[head]:.4g}"
            mean, low, high = entry.get(f"{head}_difference", [None, None, None])
            if mean is not None:
                cell += f" ({mean:+.3g}" + (f", {low:+.3g} to {high:+.3g})" if low is not None else ")")
            cells.append(cell)
        lines.append(f"| {' | '.join(cells)} |")
    write_text(folder / "table.md", "\n".join(lines) + "\n")
    write_text(folder / "table.json", json.dumps(table, indent=2).replace("NaN", "null") + "\n")
    draw_table(table, folder / "table.png")
    print("\n".join(lines))


def draw_table(table: dict[str, Any], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 0.5 * len(table) + 1.6), dpi=110, layout="constrained")
    for quantity, axes in zip(OBJECTIVES, figure.subplots(1, 3, sharey=True), strict=True):
        for row, entry in enumerate(table.values()):
            mean, low, high = entry.get(f"{quantity}_difference", [0.0, None, None])
            if mean is not None:
                axes.plot(mean, row, "o", color="#1f6fb2")
            if low is not None:
                axes.plot([low, high], [row, row], color="#1f6fb2", lw=2)
        axes.axvline(0.0, color="#5b6672", lw=1)
        axes.set_yticks(range(len(table)), list(table))
        axes.set_xlabel(f"{quantity}, less that of best_fixed")
        axes.grid(alpha=0.3, axis="x")
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    speed = commands.add_parser("speed")
    speed.add_argument("--loadings", type=int, default=2000)
    accuracy = commands.add_parser("accuracy")
    accuracy.add_argument("study", type=Path)
    accuracy.add_argument("--out", type=Path, default=Path("out/autonomy"))
    accuracy.add_argument("--shares", type=float, nargs="+", default=[0.25, 0.5, 1.0])
    accuracy.add_argument("--seed", type=int, default=0)
    run = commands.add_parser("run")
    run.add_argument("model", type=Path)
    run.add_argument("--out", type=Path, default=Path("out/autonomy"))
    run.add_argument("--scenario", type=Path)
    run.add_argument("--set", nargs="*")
    run.add_argument("--piles", nargs="+", default=list(PILES), choices=list(PILES))
    run.add_argument("--choices", nargs="+", default=list(CHOICES))
    run.add_argument("--shares", type=float, nargs="+", default=[1.0])
    run.add_argument("--loadings", type=int, default=15)
    run.add_argument("--weights", default="production=0.6,damage=0.2,debris=0.2")
    run.add_argument("--bound", nargs="*")
    control = commands.add_parser("control")
    control.add_argument("--out", type=Path, default=Path("out/control"))
    control.add_argument("--scenario", type=Path)
    control.add_argument("--set", nargs="*")
    control.add_argument("--seeds", type=int, nargs="+", default=[11, 12, 13])
    table = commands.add_parser("table")
    table.add_argument("folder", type=Path)
    args = parser.parse_args()
    if args.command == "speed":
        run_speed(args.loadings)
    elif args.command == "accuracy":
        run_accuracy(args.study, args.out, args.shares, args.seed)
    elif args.command == "run":
        run_sequences(args)
    elif args.command == "control":
        run_control(args)
    else:
        write_table(args.folder)


if __name__ == "__main__":
    main()
