"""Every fenced block of README and docs is run, in order, in a folder of its own; what cannot be run stands in NOT_RUN.

Loadings and piles are of 60 rocks here, whatever scenario a command names, and studies have the stand-in of
`study_work` for a simulation: a block is held to run as printed, not to its numbers. Caught: README's YAML was no valid
scenario; Python that used names nobody had given; a machine's file printed without the key that it belongs to.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml

import calibration_work
import study_work
from drakerock.config import load_config
from drakerock.loading import scenario as scenario_module
from drakerock.loading.scenario import Scenario
from drakerock.rocks.surveying import files as cloud_files
from drakerock.study import preview_server, schema
from drakerock.study.calibration import run_calibration
from drakerock.study.resimulation import Resimulation
from drakerock.study.runner import run_study
from drakerock.study.schema import StudyConfig, load_study
from drakerock.viewing import report
from report_helpers import save_confirmation
from tests.autonomy_study import make_study
from tests.browsers import find_fault
from tests.conftest import make_heap
from tests.cycle_files import make_recording, write_cycle

ROOT = Path(__file__).resolve().parents[2]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
Run = Callable[..., tuple[int, str, str]]

# By document and the block's first line.
NOT_RUN = {
    (
        "docs/architecture.md",
        "Scenario (YAML) --> pile (cache or made) --> station",
    ): "a diagram in characters",
    (
        "docs/machine.md",
        "src/drakerock/models/lhd/design.yaml   shapes, pins, masses, stops: what one edits",
    ): ("a list of files; test_paths_that_documents_name_are_there looks for them"),
    (
        "docs/autonomy.md",
        "nice python benchmarks/autonomy.py run out/full_size --out out/autonomy --loadings 15",
    ): "a day of CPU time; tests/unit/autonomy/test_benchmark.py runs the parts of it",
    ("docs/machine.md", "python benchmarks/walls.py run out/walls"): (
        "two loadings at full size; tests/unit/loading/test_walls.py holds its geometry to closed forms"
    ),
    ("docs/validation/motors.md", "for d in 1e7 1e8 1e9 1e10; do for s in 1 2 3; do"): (
        "a loop of twelve loadings; test_the_commands_in_the_documentation_are_valid reads its command"
    ),
}

# What makes any scenario one of 60 rocks.
TINY = [
    "site={drift_width: 3.9, void_depth: 0.6, rear_layer: 0.0}",
    "pile.rocks=60",
    "pile.emission_height=2.0",
    "pile.emission_reach=1.2",
    "pile.emission_interval=0.25",
    "pile.settle_speed=0.2",
    "loading.control.timeout=0.5",
    "loading.performance.settle_time=1.0",
    "loading.planning.run_up=1.0",
]
# What long commands are given besides.
SHORTER = {
    "lab": [
        *("--set", "rocks.gradation=[{size_m: 0.3, mass_fraction: 1.0}]"),
        *("--with", "rocks=60", "--repeats", "1"),
    ],
    "autoload": ["--choice", "best_fixed", "--cycles", "1", "--no-replay"],
    "film": ["--fps", "1", "--speed", "4", "--size", "240x160"],
}


@dataclass(frozen=True)
class Block:
    """A fenced block: where it stands, its language ("" for a shell's), its lines."""

    document: str
    line: int
    language: str
    text: str

    @property
    def key(self) -> tuple[str, str]:
        return self.document, self.text.split("\n", 1)[0]


def list_blocks(path: Path) -> Iterator[Block]:
    text = path.read_text()
    for found in re.finditer(r"^```(.*?)\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        line = text[: found.start()].count("\n") + 1
        yield Block(str(path.relative_to(ROOT)), line, found[1].strip(), found[2].rstrip("\n"))


BLOCKS = [block for path in DOCUMENTS for block in list_blocks(path)]
# {eval-rst} is Sphinx's; `make docs` runs it, with warnings as errors.
WITH_BLOCKS = sorted({block.document for block in BLOCKS if not block.language.startswith("{")})


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder that looks like the checkout, with what documents say has been there before."""
    for name in ("docs", "examples", "src", "studies"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(ROOT))
    shutil.copytree(ROOT / "studies" / "full_size", "out/paper")
    # A measured pile, its alignment, measured curves.
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-4.0, 0.9, 12_000), rng.uniform(-2.8, 2.8, 12_000)
    cloud_files.save_cloud_ply(
        np.column_stack([x, y, np.clip(0.5 * (x + 3.0), 0.0, None)]), Path("muckpile.ply")
    )
    Path("align.yaml").write_text("unit: m\n")
    time = np.linspace(0.1, 5.9, 100)
    angle, force = calibration_work.calc_curves(2500.0, 1.0, time)
    speed = calibration_work.calc_speed(1.7e5, time)
    rows = np.column_stack([time, angle, speed, -3.0 + 0.4 * time, force, 2.0 * force])
    Path("measured.csv").write_text(
        "t [s],boom angle [rad],speed [m/s],tip [m],push force [N],boom torque [N m]\n"
        + "\n".join(",".join(f"{value:.6g}" for value in row) for row in rows)
        + "\n"
    )
    return tmp_path


@pytest.fixture
def cheap(monkeypatch):
    """60 rocks in every loading, a stand-in in every study, a server that does not wait for Ctrl-C."""
    load = scenario_module.load_scenario

    def load_tiny(path=None, overrides=()):
        scan = any(text.startswith(("pile.scan", "pile.source")) for text in overrides)
        return load(path, [*(text for text in TINY if not (scan and text.startswith("pile."))), *overrides])

    def load_serial(path, overrides=()):
        return load_study(path, ["executor.kind=serial", *overrides])

    monkeypatch.setattr(scenario_module, "load_scenario", load_tiny)
    monkeypatch.setattr(schema, "load_study", load_serial)
    monkeypatch.setattr(study_work, "DURATION", 0.0)
    monkeypatch.setattr(report, "save_figures", save_confirmation)
    for function in (run_study, Resimulation.__init__):
        monkeypatch.setitem(function.__kwdefaults__, "work", "study_work:run")
    monkeypatch.setitem(run_calibration.__kwdefaults__, "work", "calibration_work:run")
    monkeypatch.setattr(preview_server, "serve_preview", lambda preview, say: say("http://nowhere"))


def run_shell(block: Block, run: Run) -> None:
    for line in block.text.replace("\\\n", " ").split("\n"):
        words = shlex.split(line, comments=True)
        match words:
            case []:
                continue
            case ["drakerock", "study", "run", "studies/reduced.yaml", *_]:
                continue  # that is the study in miniature here
            case ["drakerock", "film", *_] if find_fault():
                continue  # without a browser; tests/unit/viewing/test_pages.py says so
            case ["drakerock", *rest]:
                code, out, error = run(*rest, *SHORTER.get(rest[0] if rest else "", []))
                assert code == 0, f"{block.document}:{block.line}: {line}\n{out}{error}"
            case ["python", "-m", module, *rest]:
                subprocess.run([sys.executable, "-m", module, *rest], check=True, capture_output=True)
            case ["make", *targets]:
                subprocess.run(["make", "-n", *targets], cwd=ROOT, check=True, capture_output=True)
            case ["pip", "wheel", "--no-deps", "--wheel-dir", "dist", "."]:
                continue  # needs a network; the wheel's name is looked at in the next line
            case ["pip", "install", *names]:
                check_installable(names)
            case ["source", ".venv/bin/activate"] | ["git", "clone", *_] | ["cd", "drakerock"]:
                continue  # a shell's own
            case _:
                pytest.fail(f"{block.document}:{block.line}: nobody knows how to run {line!r}")


def check_installable(names: list[str]) -> None:
    """Without a network: extras and wheel are this package's, and other packages are among its own needs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wheel = f"dist/drakerock-{project['version']}-py3-none-any.whl"
    known = [*project["dependencies"], *(item for items in extras.values() for item in items)]
    known = [".", wheel, "jupyterlab", *(re.split("[<>=]", item)[0] for item in known)]
    for name in names:
        if found := re.fullmatch(r"(?:drakerock|\.)\[(.+)\]", name):
            assert set(found[1].split(",")) <= set(extras), name
        else:
            assert name in known, name


def check_yaml(block: Block) -> None:
    """A file of its own: a study if it has what only studies have, else a scenario."""
    Path("block.yaml").write_text(block.text + "\n")
    top = set(yaml.safe_load(block.text))
    load_config("block.yaml", StudyConfig if top & {"variables", "loadings", "exploration"} else Scenario, ())


@pytest.mark.parametrize("document", WITH_BLOCKS)
def test_blocks_run(document, place, cheap, run_command, plan, shapes):
    names: dict[str, object] = {"__name__": "__main__"}
    if document in {"README.md", "docs/autonomy.md"}:
        make_study(scenario_module.load_scenario("studies/small.yaml"), Path("out/reduced"))
    if document == "docs/data.md":
        run_study(load_study("studies/smoke.yaml", ["executor.kind=serial"]), Path("out/smoke"))
    if document == "docs/replay.md":
        for name in ("first", "second"):
            write_cycle(Path("out", name), plan, make_recording(make_heap(), shapes))
    for block in BLOCKS:
        if block.document != document or block.key in NOT_RUN:
            continue
        match block.language:
            case "":
                run_shell(block, run_command)
            case "yaml":
                check_yaml(block)
            case "python":
                exec(compile(block.text, f"{document}:{block.line}", "exec"), names)
            case language:
                assert language.startswith("{"), f"{document}:{block.line}: {language}"


def test_what_is_not_run_is_there():
    assert set(NOT_RUN) <= {block.key for block in BLOCKS}
    assert len(BLOCKS) > 30


def test_paths_that_documents_name_are_there():
    address = re.compile(r"\b(?:src|tests|benchmarks|studies|examples|notebooks)/[\w./-]*\w")
    for path in DOCUMENTS:
        for name in address.findall(path.read_text()):
            assert (ROOT / name).exists(), f"{path.name}: {name}"
