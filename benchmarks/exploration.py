"""Speed and accuracy of the exploration, measured.

    OMP_NUM_THREADS=1 python benchmarks/exploration.py [speed] [accuracy] [sampling] [smt] [--json FILE]

Without names, all four are run (some minutes on one core). The figures in docs/exploration.md are its output.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
from rich.console import Console
from rich.table import Table
from scipy.spatial.distance import cdist

from drakerock.exploration.config import ParetoConfig, SamplingConfig, SensitivityConfig
from drakerock.exploration.kriging import Kriging
from drakerock.exploration.pareto import pareto_front
from drakerock.exploration.problems import (
    KnownProblem,
    calc_loading_spread,
    make_branin,
    make_dtlz2,
    make_ishigami,
    make_noisy_loading,
    make_noisy_table,
    make_zdt,
)
from drakerock.exploration.sampling import (
    SAMPLERS,
    make_initial_design,
    make_sampler,
    make_validation_points,
)
from drakerock.exploration.sensitivity import calc_sensitivity
from drakerock.exploration.surrogate import Surrogate, calc_ranges, fit_surrogate
from drakerock.exploration.validation import validate
from drakerock.study.analysis import run_report

Row = dict[str, Any]


def take_time(function: Callable[[], Any], repeat: int = 3) -> float:
    """Return the least processor time [s] of some runs: the wall time on an idle core, whatever else runs."""
    times = []
    for _ in range(repeat):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def make_campaign(seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return the 204 sample points of a noisy campaign (section 6) and its 40 validation points."""
    problem, config = make_noisy_loading().problem, SamplingConfig()
    sampler = make_sampler(problem, config, seed)
    X = sampler.ask(40)
    while len(X) < config.n_samples:
        table = make_noisy_table(X, np.random.default_rng(seed))
        sampler.tell(table.X, table.Y, table.noise)
        X = np.vstack([X, sampler.ask(min(config.batch_size, config.n_samples - len(X)))])
    return X, make_validation_points(problem, config, seed)


def write_cycles(path: Path, X: np.ndarray, V: np.ndarray) -> None:
    """Write a table of 4 880 single loadings, one row each, as a full-size study exports them."""
    known, rng = make_noisy_loading(), np.random.default_rng(2)
    points = np.vstack([X, V])
    n = len(points)
    noise = rng.standard_normal((20, n, 3)) * calc_loading_spread(points)
    Y = (known.evaluate(points) + noise).reshape(-1, 3)
    columns: dict[str, Any] = {
        "point": np.tile(np.arange(n), 20),
        "loading": np.repeat(np.arange(20), n),
        "role": (["sample"] * len(X) + ["validation"] * len(V)) * 20,
    }
    columns |= dict(zip(known.problem.variable_names, np.tile(points, (20, 1)).T, strict=True))
    columns |= dict(zip(known.problem.objective_names, Y.T, strict=True))
    pyarrow.csv.write_csv(pa.table(columns), path)


def measure_speed() -> list[Row]:
    X, V = make_campaign()
    table = make_noisy_table(np.vstack([X, V]), np.random.default_rng(2), n_validation=len(V))
    surrogate = fit_surrogate(table)
    samples = table.select("sample")
    batch = np.random.default_rng(0).uniform(samples.problem.low, samples.problem.high, (40_000, 4))
    config = ParetoConfig(n_draws=0)
    rows: list[Row] = []

    def add(what: str, value: float, target: float | None = None) -> None:
        rows.append({"what": what, "value": value, "target": target})

    add("fit, 3 objectives, 204 points, known noise, s", take_time(lambda: fit_surrogate(table)), 5.0)
    unknown = Surrogate(samples.problem)
    add("the same, unknown noise, s", take_time(lambda: unknown.fit(samples.X, samples.Y)), 5.0)
    add("NSGA-II, 40 000 evaluations, s", take_time(lambda: pareto_front(surrogate, config=config)), 10.0)
    add("the same and 64 draws for its uncertainty, s", take_time(lambda: pareto_front(surrogate)))
    micro = 1e6 / len(batch)
    add("batch prediction, 3 objectives, us/point", micro * take_time(lambda: surrogate.predict(batch)), 10.0)
    with_std = micro * take_time(lambda: surrogate.predict(batch, return_std=True))
    add("the same with standard deviation, us/point", with_std, 10.0)
    add("Sobol' indices, s", take_time(lambda: calc_sensitivity(surrogate.predict, samples.problem)))
    for name, kind in SAMPLERS.items():
        one = kind(samples.problem, SamplingConfig(), 2)
        one.tell(X[:196], samples.Y[:196], samples.noise[:196])
        seconds = take_time(lambda one=one: one.ask(8), repeat=1)
        add(f"sampler {name}, 8 points after 196, s", seconds)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cycles.csv"
        write_cycles(path, X, V)
        seconds = take_time(lambda: run_report(path), repeat=1)
        size = (Path(folder) / "report" / "report.html").stat().st_size / 1e6
    add("report on a table of 4 880 cycles, s", seconds, 60.0)
    add("size of report.html, MB", size)
    return rows


def calc_front_distances(Y: np.ndarray, exact: np.ndarray) -> tuple[float, float]:
    """Return mean distances found -> exact and exact -> found, in ranges of the exact front."""
    gap = cdist(Y / np.ptp(exact, axis=0), exact / np.ptp(exact, axis=0))
    return float(gap.min(axis=1).mean()), float(gap.min(axis=0).mean())


class Truth:
    """The exact functions in the place of a surrogate."""

    def __init__(self, known: KnownProblem) -> None:
        self.problem_, self._evaluate = known.problem, known.evaluate

    def predict(self, X: Any, return_std: bool = False) -> Any:
        Y = self._evaluate(np.asarray(X))
        return (Y, np.zeros_like(Y)) if return_std else Y


def measure_accuracy() -> list[Row]:
    rows = []
    cases = [
        (make_branin(), 40),
        (make_ishigami(), 200),
        (make_zdt(1), 100),
        (make_zdt(2), 100),
        (make_zdt(3), 200),
        (make_dtlz2(), 150),
        (make_dtlz2(), 300),
        (make_noisy_loading(), 204),
    ]
    for known, n in cases:
        d = len(known.problem.variables)
        if known.name == "noisy loading":
            X, V = make_campaign()
            table = make_noisy_table(np.vstack([X, V]), np.random.default_rng(2), n_validation=len(V))
            surrogate, Y = fit_surrogate(table), table.select("sample").Y
            print_validation(validate(surrogate, table))
        else:
            X = make_initial_design(known.problem, SamplingConfig(n_initial=n, n_corners=0), 1)
            Y = known.evaluate(X)
            surrogate = Surrogate(known.problem).fit(X, Y)
        Z = np.random.default_rng(5).uniform(known.problem.low, known.problem.high, (5000, d))
        error = (surrogate.predict(Z) - known.evaluate(Z)) / calc_ranges(Y)
        row: Row = {"problem": known.name, "d": d, "points": n}
        row["NRMSE to the truth"] = np.sqrt(np.mean(error**2, axis=0))
        if known.first is not None and known.total is not None:
            indices = calc_sensitivity(surrogate.predict, known.problem, SensitivityConfig(n_base=4096))
            row["Sobol' S1, largest error"] = max(
                np.abs(s.first - f).max() for s, f in zip(indices, known.first, strict=True)
            )
            row["Sobol' ST, largest error"] = max(
                np.abs(s.total - t).max() for s, t in zip(indices, known.total, strict=True)
            )
        if known.make_front is not None:
            exact = known.make_front(2000)
            config = ParetoConfig(n_draws=0)
            on_truth = pareto_front(Truth(known), config=config)
            row["front on the truth"] = calc_front_distances(on_truth.Y, exact)
            found = pareto_front(surrogate, config=config)
            row["front on the surrogate, true values"] = calc_front_distances(known.evaluate(found.X), exact)
        else:
            found = pareto_front(surrogate, config=ParetoConfig(n_draws=0))
            if known.name == "Branin":
                row["least value found - true"] = float(known.evaluate(found.X)[0, 0] - 0.39788735772973816)
        rows.append(row)
    return rows


def print_validation(accuracies: Any) -> None:
    for a in accuracies:
        Console().print(
            f"noisy {a.objective}: leave-one-out {a.loo_nrmse:.4f}, validation {a.validation_nrmse:.4f}, "
            f"floor {a.noise_floor:.4f}, inside 50/80/95 %: {', '.join(f'{c:.3f}' for c in a.coverage)}"
        )


def measure_sampling() -> list[Row]:
    """Error after a campaign by each sampler, mean of three seeds: a hard function, and the noisy problem."""
    rows = []
    ishigami, noisy = make_ishigami(), make_noisy_loading()
    Zi = np.random.default_rng(5).uniform(ishigami.problem.low, ishigami.problem.high, (4000, 3))
    Zn = np.random.default_rng(5).uniform(noisy.problem.low, noisy.problem.high, (4000, 4))
    exact = noisy.make_front(1000) if noisy.make_front else np.empty(0)
    for methods in [*((name,) for name in SAMPLERS), ("lola_voronoi", "error")]:
        error: dict[str, list[float]] = {"ishigami": [], "noisy": [], "front": []}
        for seed in range(3):
            config = SamplingConfig(methods=methods, n_initial=24, n_corners=8)
            sampler = make_sampler(ishigami.problem, config, seed)
            X = sampler.ask(32)
            while len(X) < 120:
                sampler.tell(X, ishigami.evaluate(X))
                X = np.vstack([X, sampler.ask(8)])
            e = Surrogate(ishigami.problem).fit(X, ishigami.evaluate(X)).predict(Zi) - ishigami.evaluate(Zi)
            error["ishigami"].append(float(np.sqrt(np.mean(e**2)) / np.ptp(ishigami.evaluate(Zi))))
            sampler = make_sampler(
                noisy.problem, SamplingConfig(methods=methods, n_initial=24, n_corners=16), seed
            )
            X = sampler.ask(40)
            table = make_noisy_table(X, np.random.default_rng(seed))
            while len(X) < 104:
                sampler.tell(table.X, table.Y, table.noise)
                X = np.vstack([X, sampler.ask(8)])
                table = make_noisy_table(X, np.random.default_rng(seed))
            surrogate = fit_surrogate(table)
            e = (surrogate.predict(Zn) - noisy.evaluate(Zn)) / np.ptp(noisy.evaluate(Zn), axis=0)
            error["noisy"].append(float(np.sqrt(np.mean(e**2))))
            found = pareto_front(
                surrogate, config=ParetoConfig(population=150, evaluations=10_000, n_draws=0)
            )
            error["front"].append(sum(calc_front_distances(noisy.evaluate(found.X), exact)) / 2)
        rows.append(
            {
                "sampler": " + ".join(methods),
                "Ishigami, 120 points: NRMSE": np.mean(error["ishigami"]),
                "noisy loading, 104 points: NRMSE": np.mean(error["noisy"]),
                "its front: mean distance to the exact": np.mean(error["front"]),
            }
        )
    return rows


def measure_smt() -> list[Row]:
    """Agreement with SMT's Kriging: predictions with everything imposed equal, likelihoods when free."""
    from smt.surrogate_models import KRG

    rows = []
    for known in (make_branin(), make_ishigami(), make_noisy_loading()):
        problem, d = known.problem, len(known.problem.variables)
        rng = np.random.default_rng(0)
        X = problem.unscale(rng.uniform(-1, 1, (25 * d, d)))
        Z = problem.unscale(rng.uniform(-1, 1, (1000, d)))
        for j, name in enumerate(problem.objective_names):
            y = known.evaluate(X)[:, j]
            y = y + 0.03 * y.std() * rng.standard_normal(len(y))
            other = KRG(
                theta0=[1.0] * d,
                theta_bounds=[1e-6, 100.0],
                eval_noise=True,
                noise0=[1e-2],
                noise_bounds=[1e-9, 10.0],
                n_start=40,
                print_global=False,
                poly="constant",
                corr="squar_exp",
                nugget=0.0,
            )
            other.set_training_values(X, y)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                other.train()
            bounds, parameters = np.stack([problem.low, problem.high]), other.optimal_par
            theta = other.optimal_theta * ((bounds[1] - bounds[0]) / 2 / other.X_scale) ** 2
            trend = float(np.squeeze(parameters["beta"]) * np.squeeze(other.y_std) + np.squeeze(other.y_mean))
            imposed = Kriging(
                bounds, theta=theta, lam=float(np.squeeze(other.optimal_noise)), trend=trend
            ).fit(X, y)
            sigma2 = float(np.squeeze(parameters["sigma2"]))
            theirs = -0.5 * len(y) * (np.log(2 * np.pi * sigma2) + 1) - np.log(np.diag(parameters["C"])).sum()
            gap = np.abs(imposed.predict(Z) - other.predict_values(Z)[:, 0]).max() / np.ptp(y)
            rows.append(
                {
                    "case": f"{known.name}, {name}",
                    "imposed: largest difference / range": gap,
                    "log-likelihood SMT": theirs,
                    "ours, trend by likelihood": Kriging(bounds, trend="likelihood")
                    .fit(X, y)
                    .log_likelihood_,
                    "ours, y centred by its mean": Kriging(bounds).fit(X, y).log_likelihood_,
                }
            )
    return rows


def format_value(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, (tuple, list, np.ndarray)):
        return " / ".join(format_value(v) for v in value)
    return (
        f"{value:.3g}"
        if isinstance(value, float) and abs(value) < 100
        else f"{value:.1f}"
        if isinstance(value, float)
        else str(value)
    )


def print_rows(title: str, rows: list[Row]) -> None:
    columns = list(dict.fromkeys(key for row in rows for key in row))
    table = Table(*columns, title=title)
    for row in rows:
        table.add_row(*(format_value(row.get(column)) for column in columns))
    Console(width=180).print(table)


MEASUREMENTS = {
    "speed": measure_speed,
    "accuracy": measure_accuracy,
    "sampling": measure_sampling,
    "smt": measure_smt,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", choices=[[], *MEASUREMENTS], help="what to measure; default all")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    arguments = parser.parse_args()
    results = {}
    for name in arguments.names or MEASUREMENTS:
        results[name] = MEASUREMENTS[name]()
        print_rows(name, results[name])
    if arguments.json:
        arguments.json.write_text(
            json.dumps(results, indent=2, default=lambda v: np.asarray(v).tolist()) + "\n"
        )


if __name__ == "__main__":
    main()
