"""The present tree against a git revision, side by side: ratios of CPU time (below 1: the present tree is faster).

    make bench-compare REV=main
    python benchmarks/compare_revisions.py main --cases help step --repeats 3

The other revision is checked out into a temporary folder; both run with the same interpreter, one after the other, in
alternation, so that a machine whose speed changes does so for both. Each case is run once before it counts (kernels are
compiled, the pile is in the cache); the result is the median of the ratios of the pairs. It is appended to
`benchmarks/history.jsonl`, one line per comparison, and `out/bench/history.png` shows all of them over commits.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
HISTORY = Path(__file__).with_name("history.jsonl")
PICTURE = ROOT / "out" / "bench" / "history.png"

COMMAND = "import sys; from drakerock.cli import main; sys.argv = ['drakerock', *{arguments!r}]; main()"
# A program that prints the CPU time of what counts [s]; others count as a whole.
STEP = """
import time
from pydrake.systems.analysis import Simulator
from drakerock import get_pile, load_scenario, make_station
from drakerock.lhd.placement import set_machine_pose
scenario = load_scenario({scenario!r})
pile = get_pile(scenario)
station = make_station(scenario, pile)
simulator = Simulator(station.diagram)
root = simulator.get_mutable_context()
station.rocks.set_pile(root, pile)
context = station.plant.GetMyMutableContextFromRoot(root)
set_machine_pose(station.plant, context, station.machine, x_tip=-15.0, y=0.0, z_tip=0.03)
simulator.AdvanceTo(0.05)
start = time.process_time()
simulator.AdvanceTo(1.05)
print(time.process_time() - start)
"""
REFILL = """
import inspect
import time
import numpy as np
from drakerock import get_pile, load_scenario
from drakerock.loading.scenario import make_recipe
from drakerock.rocks.making.refill import refill
from drakerock.rocks.shapes import load_rock_shapes
scenario = load_scenario({scenario!r})
pile = get_pile(scenario)
removed = np.zeros(len(pile), bool)
removed[np.argsort(np.linalg.norm(pile.p_WRs - [-3.0, 0.0, 0.5], axis=1) + 100.0 * pile.fixed)[:120]] = True
# Builds up to 23d883c take the names of the files.
takes_files = "uris" in inspect.signature(load_rock_shapes).parameters
shapes = load_rock_shapes(scenario.rocks.shapes if takes_files else scenario.rocks)
start = time.process_time()
refill(pile, removed, shapes, make_recipe(scenario), np.random.default_rng(0))
print(time.process_time() - start)
"""
CASES = {
    "load": COMMAND.format(arguments=["load", "{scenario}", "--no-replay", "--out", "{out}"]),
    "step": STEP,
    "help": COMMAND.format(arguments=["--help"]),
    "refill": REFILL,
}
MEANING = {
    "load": "drakerock load of the demo's cycle",
    "step": "a second of the station's Diagram, machine standing off the pile",
    "help": "drakerock --help",
    "refill": "a refill after 120 rocks",
}


@contextlib.contextmanager
def check_out(revision: str) -> Iterator[Path]:
    """Give a folder with the revision's files for a while."""
    with tempfile.TemporaryDirectory(prefix="drakerock-bench-") as folder:
        tree = Path(folder) / "tree"
        subprocess.run(
            ["git", "worktree", "add", "--quiet", "--detach", tree, revision], cwd=ROOT, check=True
        )
        try:
            yield tree
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", tree], cwd=ROOT, check=True)


def measure(tree: Path, case: str) -> float:
    """Run a case once in a process of its own; return its CPU time [s].

    Raises:
        RuntimeError: it failed.
    """
    with tempfile.TemporaryDirectory(prefix="drakerock-bench-") as out:
        program = CASES[case].replace("{scenario!r}", repr(str(tree / "studies" / "demo.yaml")))
        program = program.replace("{scenario}", str(tree / "studies" / "demo.yaml")).replace("{out}", out)
        environment = os.environ | {
            "OMP_NUM_THREADS": "1",
            "NUMBA_NUM_THREADS": "1",
            "PYTHONPATH": str(tree / "src"),
        }
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        run = subprocess.run(
            [sys.executable, "-c", program],
            env=environment,
            cwd=out,
            capture_output=True,
            text=True,
            check=False,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if run.returncode:
        raise RuntimeError(f"{case} failed in {tree}: {run.stderr.strip().splitlines()[-1:]}")
    if case in ("step", "refill"):
        return float(run.stdout.split()[-1])
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def compare(other: Path, case: str, repeats: int) -> dict[str, Any]:
    """Return the median ratio of CPU times, present over other, all ratios, and both medians [s]."""
    trees = (ROOT, other)
    for tree in trees:
        measure(tree, case)
    times: dict[Path, list[float]] = {tree: [] for tree in trees}
    for k in range(repeats):
        for tree in trees if k % 2 == 0 else reversed(trees):
            times[tree].append(measure(tree, case))
    ratios = [present / before for present, before in zip(times[ROOT], times[other], strict=True)]
    return {
        "ratio": round(statistics.median(ratios), 4),
        "ratios": [round(ratio, 4) for ratio in ratios],
        "cpu_s": [round(statistics.median(times[tree]), 3) for tree in trees],
    }


def describe_revision(revision: str) -> str:
    """Return a revision's short hash."""
    return run_git("rev-parse", "--short", f"{revision}^{{commit}}")


def run_git(*arguments: str) -> str:
    """Return what git prints."""
    run = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
    if run.returncode:
        sys.exit(f"git {' '.join(arguments)}: {run.stderr.strip()}")
    return run.stdout.strip()


def describe_machine() -> str:
    """Return processor and number of cores."""
    models = [
        line.split(":", 1)[1].strip()
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        if line.startswith("model name")
    ]
    return f"{models[0] if models else 'unknown processor'}, {os.cpu_count()} cores"


def draw(path: Path) -> None:
    """Draw all comparisons of the history over the commits they were made at."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    lines = [json.loads(line) for line in HISTORY.read_text(encoding="utf-8").splitlines()]
    figure, axes = plt.subplots(figsize=(9, 4), layout="constrained")
    for case in CASES:
        points = [(k, line["cases"][case]["ratio"]) for k, line in enumerate(lines) if case in line["cases"]]
        if points:
            axes.plot(*zip(*points, strict=True), "o-", label=MEANING[case])
    axes.axhline(1.0, color="0.6", linewidth=1)
    axes.set_xticks(range(len(lines)), [f"{line['revision']}\nagainst {line['against']}" for line in lines])
    axes.tick_params(axis="x", rotation=45)
    axes.set_ylabel("CPU time, ratio")
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Compare, say, keep and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("revision", help="what to compare the present tree with")
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--repeats", type=int, default=5, help="pairs of runs of each case")
    arguments = parser.parse_args()
    against = describe_revision(arguments.revision)
    changed = "+" if run_git("status", "--porcelain", "--untracked-files=no") else ""
    line: dict[str, Any] = {
        "revision": describe_revision("HEAD") + changed,
        "against": against,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": describe_machine(),
        "cases": {},
    }
    with check_out(against) as other:
        for case in arguments.cases:
            try:
                result = compare(other, case, arguments.repeats)
            except RuntimeError as error:  # an older revision may lack what a case uses
                print(error)
                continue
            line["cases"][case] = result
            present, before = result["cpu_s"]
            print(
                f"{MEANING[case]}: {result['ratio']:.3f} ({present:.2f} s, {before:.2f} s at {against})",
                flush=True,
            )
    with open(HISTORY, "a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
    draw(PICTURE)
    print(f"{HISTORY.relative_to(ROOT)}, {PICTURE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
