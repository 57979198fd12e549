"""What the machine's motors do to loadings: the method's compliance, valves that hold, a torque curve, weight transfer.

    python benchmarks/motors.py run out/motors --loadings 10
    python benchmarks/motors.py table out/motors

`run` loads the shipped pile, four strategies by four choices of motors: one loading of each, then a second one, and so
on; each strategy and choice is a sequence from the same pile. It takes a minute of CPU time or more for each loading,
can be stopped at any time and goes on from there. `table` reads what is there, writes a line per loading to
`docs/validation/motors/loadings.jsonl` and prints the table of `docs/validation/motors.md`.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from scipy import stats

from drakerock import load_scenario
from drakerock.loading.outcome import CycleOutcome
from drakerock.loading.scenario import Scenario
from drakerock.loading.sequence import run_sequence

STORED = Path(__file__).resolve().parents[1] / "docs" / "validation" / "motors" / "loadings.jsonl"

STRATEGIES = ((1.8, 0.1, 0.2, 1.0), (1.3, 0.85, 1.0, 0.6), (0.3, 0.6, 0.6, 0.2), (1.3, 0.8, 0.9, 0.8))
COMPLIANT = ("machine.boom.holds=false", "machine.bucket.holds=false")
CONSTANT = ("machine.wheel.torque_curve=null",)
CHOICES: dict[str, tuple[str, ...]] = {
    "compliance": (*COMPLIANT, *CONSTANT),
    "holding": CONSTANT,
    "holding, curve": (),
    "holding, curve, transfer": ("loading.control.weight_transfer.height=0.15",),
}


def make_scenario(choice: str, strategy: tuple[float, ...]) -> Scenario:
    """Return the scenario of a choice of motors and a strategy."""
    names = ("alpha", "beta", "gamma", "kappa")
    values = [f"loading.strategy.{name}={value}" for name, value in zip(names, strategy, strict=True)]
    return load_scenario(None, [*CHOICES[choice], *values])


def name_folder(choice: str, strategy: tuple[float, ...]) -> str:
    """Return a folder's name for a choice and a strategy."""
    return "-".join([choice.replace(", ", "_"), *(f"{value:g}" for value in strategy)])


def run(out: Path, n_loadings: int) -> None:
    """Run all sequences, a loading of each at a time."""
    for count in range(1, n_loadings + 1):
        for strategy in STRATEGIES:
            for choice in CHOICES:
                folder = out / name_folder(choice, strategy)
                outcomes = run_sequence(make_scenario(choice, strategy), count, folder)
                last = outcomes[-1]
                print(
                    f"{count} {choice:<26} {strategy} {last.reason}: {last.bucket_mass_kg:.0f} kg in "
                    f"{last.loading_time_s:.1f} s, {last.cpu_time_s:.0f} CPU s",
                    flush=True,
                )


def make_row(
    choice: str, strategy: tuple[float, ...], number: int, outcome: CycleOutcome
) -> dict[str, object]:
    """Return a line of the stored results: one loading."""
    return {
        "choice": choice,
        "strategy": strategy,
        "loading": number,
        "status": outcome.status,
        "reason": outcome.reason,
        **outcome.objectives,
        "loading_time_s": outcome.loading_time_s,
        "mean_push_force_N": outcome.mean_push_force_N,
        "timeouts": sum(event["event"] == "timeout" for event in outcome.events),
        **(outcome.mining or {}),
        "cpu_time_s": outcome.cpu_time_s,
        "seed": outcome.seed,
        "versions": outcome.versions,
        "scenario_hash": outcome.scenario_hash,
    }


def read_rows(out: Path) -> list[dict[str, object]]:
    """Return the lines of all loadings in a folder of `run`."""
    rows = []
    for strategy in STRATEGIES:
        for choice in CHOICES:
            paths = sorted((out / name_folder(choice, strategy)).glob("loading_*/outcome.json"))
            rows += [
                make_row(choice, strategy, number, CycleOutcome.from_json(path.read_text()))
                for number, path in enumerate(paths)
            ]
    return rows


COLUMNS: dict[str, tuple[str, float, str]] = {
    "load_t": ("load t", 1.0, ".1f"),
    "loading_time_s": ("time s", 1.0, ".1f"),
    "production": ("production kg/s", 1.0, ".0f"),
    "damage": ("damage", 1.0, ".2f"),
    "mean_push_force_N": ("push kN", 1e-3, ".0f"),
    "loading_kWh_per_t": ("kWh/t", 1.0, ".3f"),
    "wheel_slip_m": ("slip m", 1.0, ".2f"),
    "breakout_use": ("breakout use", 1.0, ".2f"),
    "timeouts": ("time-outs", 1.0, ".1f"),
}


def describe(values: list[float], form: str) -> str:
    """Return a mean and the half width of its 95 % interval (Student's t, loadings as if independent)."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return f"{mean:{form}}"
    half = stats.t.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return f"{mean:{form}} ± {half:{form}}"


def make_table(rows: list[dict[str, object]]) -> str:
    """Return the table of means and intervals, as Markdown."""
    heads = ["strategy", "motors", "n", *(label for label, _, _ in COLUMNS.values())]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for strategy in STRATEGIES:
        for choice in CHOICES:
            chosen = [
                row for row in rows
                if row["choice"] == choice and tuple(row["strategy"]) == strategy and row["status"] == "done"
            ]  # fmt: skip
            if not chosen:
                continue
            cells = [str(list(strategy)), choice, str(len(chosen))]
            for name, (_, factor, form) in COLUMNS.items():
                values = [factor * float(row[name]) for row in chosen if row[name] is not None]
                cells.append(describe(values, form) if values else "-")
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run or tabulate, as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", choices=["run", "table"])
    parser.add_argument(
        "folder", type=Path, nargs="?", help="of the sequences; table without it: what is stored"
    )
    parser.add_argument("--loadings", type=int, default=10, help="of each sequence")
    arguments = parser.parse_args()
    if arguments.what == "run":
        run(arguments.folder or Path("out/motors"), arguments.loadings)
        return
    if arguments.folder:
        STORED.parent.mkdir(parents=True, exist_ok=True)
        STORED.write_text("".join(json.dumps(row) + "\n" for row in read_rows(arguments.folder)))
    print(make_table([json.loads(line) for line in STORED.read_text().splitlines()]))


if __name__ == "__main__":
    main()
