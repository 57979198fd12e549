"""What the machine's motors do to loadings: the method's compliance, valves that hold, a torque curve, weight transfer.

    python benchmarks/motors.py run out/motors --loadings 10
    python benchmarks/motors.py table out/motors

`run` loads the shipped pile, four strategies by four choices of motors: one loading of each, then a second one, and so
on; each strategy and choice is a sequence from the same pile. It takes a minute of CPU time or more for each loading,
can be stopped at any time and goes on from there. `table` reads what is there, writes a line per loading to
`docs/validation/motors/loadings.jsonl` and prints the table of `docs/validation/motors.md`.
"""

from __future__ import annotations

from pathlib import Path

from drakerock import load_scenario
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
