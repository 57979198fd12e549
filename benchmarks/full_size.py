"""What the study at full size says beyond its report: docs/results.

    drakerock study unpack docs/results/full_size.tar.xz out/full_size
    python benchmarks/full_size.py tables out/full_size --out docs/results
    python benchmarks/full_size.py ship out/full_size

`tables` prints, as Markdown: the loadings and their scatter; accuracy against the noise floor; Sobol' indices; the
strategies for some trade-offs; how the same number of loadings is best spent on points and on loadings a point; what
half and a quarter of the points say; the method's reference strategies, predicted and simulated (those of
`benchmarks/motors.py`); confirmed points of the front; the loadings that stand out. It writes the same numbers as
`results.json`, and the pictures `pareto.png` and `budget.png`.

`ship` copies the response table, the fitted surrogate and the confirmation into `studies/full_size`, which
`drakerock strategy` answers from.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from drakerock.exploration.config import ExplorationConfig
from drakerock.exploration.confirmation import Confirmation
from drakerock.exploration.noise import calc_autocorrelation
from drakerock.exploration.pareto import ParetoFront, pareto_front
from drakerock.exploration.problem import REFERENCE_STRATEGIES, Array, Problem, format_number
from drakerock.exploration.sensitivity import calc_sensitivity
from drakerock.exploration.strategy import Strategy, choose_strategy
from drakerock.exploration.surrogate import Surrogate, fit_surrogate
from drakerock.exploration.table import ResponseTable, average_loadings
from drakerock.exploration.validation import Accuracy, validate
from drakerock.study.analysis import FULL_SIZE, SURROGATE, run_report
from drakerock.study.tables import export_tables
from drakerock.viewing.exploration_figures import draw_front

MOTORS = Path(__file__).resolve().parents[1] / "docs" / "validation" / "motors" / "loadings.jsonl"
TRADE_OFFS: dict[str, dict[str, float]] = {
    "production 0.6, damage 0.2, debris 0.2": {"production": 0.6, "damage": 0.2, "debris": 0.2},
    "production 0.2, damage 0.6, debris 0.2": {"production": 0.2, "damage": 0.6, "debris": 0.2},
    "production 0.2, damage 0.2, debris 0.6": {"production": 0.2, "damage": 0.2, "debris": 0.6},
}
# Shares of the sample points, and loadings a point.
BUDGETS = tuple(product((0.25, 0.5, 1.0), (3, 6, 12)))
Row = dict[str, Any]


class Study:
    """A study's tables, surrogate and front.

    Args:
        folder: of the study.
    """

    def __init__(self, folder: Path) -> None:
        export_tables(folder, ["parquet"], fields=False)
        self.folder = folder
        self.table = ResponseTable.load(folder)
        self.problem: Problem = self.table.problem
        self.config = ExplorationConfig.model_validate(self.table.provenance["exploration"])
        self.seed: int = self.table.provenance["seed"]
        loadings = pd.read_parquet(folder / "loadings.parquet")
        # What counts of each point: its last attempt.
        self.loadings = loadings[
            loadings.attempt == loadings.groupby("point").attempt.transform("max")
        ].reset_index(drop=True)
        self.surrogate, self.front = self.fit(self.table)

    def fit(self, table: ResponseTable) -> tuple[Surrogate, ParetoFront]:
        surrogate = fit_surrogate(table, self.config.surrogate, self.seed)
        return surrogate, pareto_front(surrogate, config=self.config.pareto, seed=self.seed)

    def shorten(self, share: float, n_loadings: int) -> ResponseTable:
        """Return the table of the first points and the first loadings of each; validation points stay whole."""
        samples = self.table.select("sample").point
        kept = set(samples[: round(share * len(samples))])
        data = self.loadings
        short = data[data.point.isin(kept) & (data.loading < n_loadings)]
        names, objectives = list(self.problem.variable_names), list(self.problem.objective_names)
        part = average_loadings(
            self.problem,
            list(short.point),
            short.loading.to_numpy(dtype=float),
            short[names].to_numpy(dtype=float),
            short[objectives].to_numpy(dtype=float),
        )
        whole = self.table.select("validation")
        return replace(
            part,
            **{name: np.vstack([getattr(part, name), getattr(whole, name)]) for name in ("X", "Y", "noise")},
            **{
                name: getattr(part, name) + getattr(whole, name)
                for name in ("point", "role", "n_loadings", "n_failed", "failure", "replay")
            },
        )


def describe_loadings(study: Study) -> list[Row]:
    """Return the scatter of loadings within and between points, and how much they resemble the one before."""
    rows = []
    done = study.loadings[study.loadings.status != "failed"]
    for name in study.problem.objective_names:
        groups = [group[name].to_numpy(dtype=float) for _, group in done.groupby("point")]
        means = np.array([values.mean() for values in groups])
        within = float(np.sqrt(np.mean([values.var(ddof=1) for values in groups if len(values) > 1])))
        j = study.problem.objective_names.index(name)
        error = float(np.sqrt(np.nanmean(study.table.noise[:, j] ** 2)))
        rows.append(
            {
                "objective": name,
                "mean": float(done[name].mean()),
                "scatter of loadings": within,
                "spread of points": float(np.sqrt(max(means.var(ddof=1) - error**2, 0.0))),
                "standard error of a point": error,
                "correlation with the loading before": calc_autocorrelation(groups),
            }
        )
    return rows


def judge(accuracy: Accuracy) -> Row:
    own = np.sqrt(max(accuracy.validation_nrmse**2 - accuracy.noise_floor**2, 0.0))
    return {
        "objective": accuracy.objective,
        "validation NRMSE": accuracy.validation_nrmse,
        "noise floor": accuracy.noise_floor,
        "surrogate's own": float(own),
        "leave-one-out NRMSE": accuracy.loo_nrmse,
        **{f"inside {100 * p:.0f} %": c for p, c in zip((0.5, 0.8, 0.95), accuracy.coverage, strict=True)},
    }


def rank(study: Study) -> list[Row]:
    rows = []
    for item, model in zip(
        calc_sensitivity(study.surrogate.predict, study.problem, study.config.sensitivity, study.seed),
        study.surrogate.models_,
        strict=True,
    ):
        for i, variable in enumerate(item.variables):
            rows.append(
                {
                    "objective": item.objective,
                    "variable": variable,
                    "first": pm(item.first[i], item.first_half[i], 2),
                    "total": pm(item.total[i], item.total_half[i], 2),
                    "theta": float(model.theta_[i]),
                    "lambda": float(model.lam_),
                }
            )
    return rows


def choose_all(front: ParetoFront) -> dict[str, Strategy]:
    chosen = {"knee": choose_strategy(front)}
    chosen |= {name: choose_strategy(front, weights) for name, weights in TRADE_OFFS.items()}
    return chosen | {
        f"best {name}": choose_strategy(front, {name: 1.0}) for name in front.problem.objective_names
    }


def describe_strategy(problem: Problem, name: str, x: Array, y: Array, std: Array, p: float = np.nan) -> Row:
    row: Row = {"trade-off": name, "strategy": "[" + ", ".join(f"{v:.2f}" for v in x) + "]"}
    row |= {o.label: pm(a, b) for o, a, b in zip(problem.objectives, y, std, strict=True)}
    return row | ({"stays optimal": p} if np.isfinite(p) else {})


def spend(study: Study) -> list[Row]:
    """Return the accuracy of smaller studies against the same validation points."""
    rows = []
    for share, n in BUDGETS:
        table = study.table if (share, n) == (1.0, 12) else study.shorten(share, n)
        surrogate = fit_surrogate(table, study.config.surrogate, study.seed)
        points = table.role.count("sample")
        row: Row = {"points": points, "loadings a point": n, "loadings": points * n}
        for item, whole in zip(
            validate(surrogate, table), validate(study.surrogate, study.table), strict=True
        ):
            # In ranges of the whole study, so that lines compare.
            row[item.objective] = item.validation.calc_nrmse(whole.value_range)
        rows.append(row)
    return rows


def halve(study: Study) -> list[Row]:
    """Return what fewer points would have chosen, valued by the whole study's surrogate."""
    rows = []
    for share in (0.25, 0.5, 1.0):
        table = study.table if share == 1.0 else study.shorten(share, 12)
        front = study.front if share == 1.0 else study.fit(table)[1]
        for name, strategy in choose_all(front).items():
            y, std = study.surrogate.predict(strategy.x[None], return_std=True)
            n = table.role.count("sample")
            rows.append({"points": n} | describe_strategy(study.problem, name, strategy.x, y[0], std[0]))
    return rows


def compare_references(study: Study) -> list[Row]:
    """Return the method's strategies: predicted, and simulated by sequences that the study does not hold."""
    stored = [json.loads(line) for line in MOTORS.read_text().splitlines()]
    rows = []
    for name, x in REFERENCE_STRATEGIES.items():
        mine = [i for i in stored if i["choice"] == "holding, curve" and tuple(i["strategy"]) == x]
        y, std = study.surrogate.predict(np.array([x]), return_std=True)
        row: Row = {"strategy": name, "[alpha, beta, gamma, kappa]": str(list(x)), "n": len(mine)}
        for j, objective in enumerate(study.problem.objectives):
            values = np.array([item[objective.name] for item in mine])
            error = values.std(ddof=1) / np.sqrt(len(values))
            row[f"{objective.label}: predicted"] = pm(y[0, j], std[0, j])
            row["simulated" + " " * j] = pm(values.mean(), error)
            row["z" + " " * j] = float((values.mean() - y[0, j]) / np.hypot(std[0, j], error))
        rows.append(row)
    return rows


def read_confirmation(study: Study) -> list[Row]:
    path = study.folder / "confirmation.json"
    if not path.exists():
        return []
    c = Confirmation.from_rows(study.problem, json.loads(path.read_text()))
    rows = []
    for i, x in enumerate(c.X):
        row: Row = {"strategy": "[" + ", ".join(f"{v:.2f}" for v in x) + "]"}
        for j, objective in enumerate(study.problem.objectives):
            row[f"{objective.label}: predicted"] = pm(c.predicted[i, j], c.predicted_std[i, j])
            row["simulated" + " " * j] = pm(c.simulated[i, j], c.simulated_se[i, j])
            row["z" + " " * j] = float(c.z[i, j])
        rows.append(row)
    return rows


def find_outliers(study: Study, n: int = 8) -> list[Row]:
    """Return the loadings of greatest damage, with what came with it."""
    data = study.loadings.sort_values("damage", ascending=False).head(n)
    names = list(study.problem.variable_names)
    return [
        {
            "point": item.point,
            "loading": int(item.loading),
            "strategy": "[" + ", ".join(f"{v:.2f}" for v in item[names]) + "]",
            "damage": float(item.damage),
            "median of its point": float(study.loadings[study.loadings.point == item.point].damage.median()),
            "peak push [kN]": float(item.peak_push_force_N) / 1e3,
            "load [t]": float(item.load_t),
            "slip [m]": float(item.wheel_slip_m),
        }
        for _, item in data.iterrows()
    ]


def pm(value: float, spread: float, digits: int = 3) -> str:
    """Return value and spread, to the place of the spread's second digit."""
    if not np.isfinite(spread) or spread <= 0.0:
        return format_number(value, digits)
    places = max(0, 1 - int(np.floor(np.log10(spread))))
    return f"{value:.{places}f} ± {spread:.{places}f}"


def write_table(title: str, rows: Sequence[Row]) -> str:
    if not rows:
        return ""
    header = list(rows[0])
    lines = [f"## {title}", "", "| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for row in rows:
        cells = [format_number(v) if isinstance(v, float) else str(v) for v in row.values()]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def draw_pareto(study: Study, path: Path) -> None:
    """Draw the front for README: production against damage and debris, strategies named."""
    names = study.problem.objective_names
    references = {
        str(i + 1): study.surrogate.predict(np.array([x]))[0]
        for i, x in enumerate(REFERENCE_STRATEGIES.values())
    }
    marks = {"K": choose_strategy(study.front).y} | references
    figure, axes = plt.subplots(1, 2, figsize=(10, 4.4), layout="constrained")
    for ax, other, shade in zip(axes, ("damage", "debris"), ("debris", "damage"), strict=True):
        pair = (names.index("production"), names.index(other))
        draw_front(ax, study.front, pair, names.index(shade), study.table.Y, marks)
        # Draws reach beyond what any point has shown.
        shown = np.vstack([study.front.Y, study.table.Y])[:, pair[1]]
        ax.set_ylim(0.0, 1.05 * float(np.nanmax(shown)))
    axes[0].legend(fontsize=8, loc="upper left")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_budget(rows: Sequence[Row], problem: Problem, floors: dict[str, float], path: Path) -> None:
    """Draw the validation error over the loadings spent, a line for each number of loadings a point."""
    names = problem.objective_names
    figure, axes = plt.subplots(1, len(names), figsize=(11, 3.4), layout="constrained", sharex=True)
    for ax, name in zip(np.atleast_1d(axes), names, strict=True):
        for n, marker in zip((3, 6, 12), "os^", strict=True):
            line = [row for row in rows if row["loadings a point"] == n]
            ax.plot(
                [r["loadings"] for r in line], [r[name] for r in line], marker=marker, label=f"{n} a point"
            )
        ax.axhline(floors[name], color="0.5", ls="--", lw=1, label="noise floor of the validation points")
        ax.set(title=name, xlabel="loadings of the sample", ylim=(0.0, None))
    np.atleast_1d(axes)[0].set_ylabel("validation NRMSE")
    np.atleast_1d(axes)[0].legend(fontsize=7, loc="lower left")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def make_tables(folder: Path, out: Path) -> None:
    study = Study(folder)
    out.mkdir(parents=True, exist_ok=True)
    accuracy = [judge(item) for item in validate(study.surrogate, study.table)]
    budget = spend(study)
    tables = {
        "Loadings": describe_loadings(study),
        "Accuracy": accuracy,
        "Sensitivity": rank(study),
        "Strategies": [
            describe_strategy(study.problem, name, s.x, s.y, s.std, s.p_optimal)
            for name, s in choose_all(study.front).items()
        ],
        "Points and loadings a point": budget,
        "Half and a quarter of the points": halve(study),
        "Reference strategies": compare_references(study),
        "Confirmation": read_confirmation(study),
        "Loadings of greatest damage": find_outliers(study),
    }
    done = study.loadings
    print(
        f"{study.table.role.count('sample')} + {study.table.role.count('validation')} points, {len(done)} loadings, "
        f"{int((done.status == 'failed').sum())} failed, {done.cpu_seconds.sum() / 3600:.1f} CPU hours, "
        f"{len(study.front)} points on the front\n"
    )
    print("\n".join(write_table(title, rows) for title, rows in tables.items()))
    (out / "results.json").write_text(json.dumps(tables, indent=1, ensure_ascii=False) + "\n")
    draw_pareto(study, out / "pareto.png")
    draw_budget(
        budget, study.problem, {row["objective"]: row["noise floor"] for row in accuracy}, out / "budget.png"
    )


def ship(folder: Path) -> None:
    """Write the report, and copy what answers need into the package's studies."""
    run_report(folder)
    export_tables(folder, ["csv"], fields=False)
    place = Path(__file__).resolve().parents[1] / FULL_SIZE
    place.mkdir(exist_ok=True)
    # As text, the numbers are the same to the last bit.
    for name in ("responses.csv", "study.json", SURROGATE, "confirmation.json"):
        if (folder / name).exists():
            shutil.copy(folder / name, place / name)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    tables = commands.add_parser("tables", help="print the tables, write results.json and pictures")
    tables.add_argument("folder", type=Path)
    tables.add_argument("--out", type=Path, default=Path("docs/results"))
    commands.add_parser("ship", help="copy table and surrogate into studies/full_size").add_argument(
        "folder", type=Path
    )
    arguments = parser.parse_args()
    if arguments.command == "tables":
        make_tables(arguments.folder, arguments.out)
    else:
        ship(arguments.folder)


if __name__ == "__main__":
    main()
