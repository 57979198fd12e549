"""The present tree against a git revision, side by side: ratios of CPU time (below 1: the present tree is faster).

    make bench-compare REV=main
    python benchmarks/compare_revisions.py main --cases help step --repeats 3
    python benchmarks/compare_revisions.py main --cases idle-100000 make memory --repeats 1

Cases: the commands `load` and `help`, and those of `cases.py`; the three of the last line take minutes each, and are
measured when asked for. A push has the noise of its force, a worker its memory beside the times.

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
COMMANDS = {"load": ["load", "{scenario}", "--no-replay", "--out", "{out}"], "help": ["--help"]}
# The others are this tree's `cases.py`, with the modules of either revision.
CASES: dict[str, list[str]] = {
    "step": ["step"],
    "idle": ["idle"],
    "idle-100000": ["idle", "--rocks", "100000"],
    "push": ["push"],
    "refill": ["refill"],
    "make": ["make"],
    "memory": ["memory"],
}
DEFAULT = ["load", "help", "step", "idle", "push", "refill"]
MEANING = {
    "load": "drakerock load of the demo's cycle [CPU s]",
    "help": "drakerock --help [CPU s]",
    "step": "a second of the station's Diagram, machine standing off the pile [CPU s]",
    "idle_5770": "a step of it, none of 5 770 rocks awake [CPU s]",
    "idle_100000": "a step of it, none of 100 000 rocks awake [CPU s]",
    "push_median": "a blade's push at imposed speed, median step [CPU s]",
    "push_slowest": "a blade's push at imposed speed, slowest step [CPU s]",
    "push_mean_kN": "its mean force [kN]",
    "push_noise_kN": "the noise of its force [kN]",
    "refill": "a refill after 120 rocks [CPU s]",
    "make": "the shipped pile from nothing [CPU s]",
    "memory_MB": "a worker's memory after six loadings [MB]",
    "memory_growth_MB": "its growth per loading [MB]",
    "loading": "a loading in it, with refill [CPU s]",
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


def measure(tree: Path, case: str) -> dict[str, float]:
    """Run a case once in a process of its own; return its quantities, of a command its CPU time [s].

    Raises:
        RuntimeError: it failed.
    """
    scenario = str(tree / "studies" / "demo.yaml")
    with tempfile.TemporaryDirectory(prefix="drakerock-bench-") as out:
        if case in COMMANDS:
            words = [word.format(scenario=scenario, out=out) for word in COMMANDS[case]]
            program = ["-c", COMMAND.format(arguments=words)]
        else:
            program = [str(Path(__file__).with_name("cases.py")), *CASES[case], "--scenario", scenario]
        environment = os.environ | {
            "OMP_NUM_THREADS": "1",
            "NUMBA_NUM_THREADS": "1",
            "PYTHONPATH": str(tree / "src"),
        }
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        run = subprocess.run(
            [sys.executable, *program], env=environment, cwd=out, capture_output=True, text=True, check=False
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if run.returncode:
        raise RuntimeError(f"{case} failed in {tree}: {run.stderr.strip().splitlines()[-1:]}")
    if case in COMMANDS:
        return {case: after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime}
    return dict(json.loads(run.stdout.splitlines()[-1]))


def compare(other: Path, case: str, repeats: int) -> dict[str, dict[str, Any]]:
    """Return, of each quantity, the median ratio of present over other, all ratios, and both medians."""
    trees = (ROOT, other)
    for tree in trees:
        measure(tree, case)
    values: dict[Path, list[dict[str, float]]] = {tree: [] for tree in trees}
    for k in range(repeats):
        for tree in trees if k % 2 == 0 else reversed(trees):
            values[tree].append(measure(tree, case))
    results = {}
    for name in values[ROOT][0]:
        present, before = ([item[name] for item in values[tree]] for tree in trees)
        ratios = [one / two if two else float("nan") for one, two in zip(present, before, strict=True)]
        results[name] = {
            "ratio": round(statistics.median(ratios), 4),
            "ratios": [round(ratio, 4) for ratio in ratios],
            "medians": [round(statistics.median(part), 6) for part in (present, before)],
        }
    return results


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
    for case in MEANING:
        points = [(k, line["cases"][case]["ratio"]) for k, line in enumerate(lines) if case in line["cases"]]
        if points:
            axes.plot(*zip(*points, strict=True), "o-", label=MEANING[case])
    axes.axhline(1.0, color="0.6", linewidth=1)
    axes.set_xticks(range(len(lines)), [f"{line['revision']}\nagainst {line['against']}" for line in lines])
    axes.tick_params(axis="x", rotation=45)
    axes.set_ylabel("ratio")
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Compare, say, keep and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("revision", help="what to compare the present tree with")
    parser.add_argument("--cases", nargs="+", choices=[*COMMANDS, *CASES], default=DEFAULT)
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
                results = compare(other, case, arguments.repeats)
            except RuntimeError as error:  # an older revision may lack what a case uses
                print(error)
                continue
            line["cases"] |= results
            for name, result in results.items():
                present, before = result["medians"]
                print(
                    f"{MEANING[name]}: {result['ratio']:.3f} ({present:.4g}, {before:.4g} at {against})",
                    flush=True,
                )
    with open(HISTORY, "a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
    draw(PICTURE)
    print(f"{HISTORY.relative_to(ROOT)}, {PICTURE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
