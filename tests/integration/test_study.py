"""The shipped smoke study with the real simulation, by the real command."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from drakerock.exploration.table import ResponseTable
from drakerock.identity import calc_config_hash
from drakerock.resources import find_data
from drakerock.study.db import Store
from drakerock.study.runner import run_study
from drakerock.study.schema import load_study
from drakerock.study.verify import verify_store

COMMAND = Path(sys.executable).with_name("drakerock")
SETTINGS = [
    "--set", "exploration.sampling.n_initial=3", "--set", "exploration.sampling.n_samples=3",
    "--set", "exploration.sampling.n_validation=0", "--set", "loadings=2",
]  # fmt: skip


def start(folder, out, *args):
    command = [
        str(COMMAND),
        "study",
        "run",
        str(find_data("studies", "smoke.yaml")),
        "--out",
        out,
        *SETTINGS,
        *args,
    ]
    return subprocess.Popen(
        command, cwd=folder, env=os.environ | {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


@pytest.mark.slow
def test_a_real_study_killed_in_a_cycle_ends_the_same(tmp_path):
    # Kernels just compiled and kernels from the cache round differently: have all of them in the cache first.
    start(tmp_path, "warm", "--set", "executor.kind=serial").communicate(timeout=400)
    straight = start(tmp_path, "straight", "--workers", "1", "--json")
    out, err = straight.communicate(timeout=300)
    assert straight.returncode == 0, err
    assert json.loads(out)["complete"]
    killed = start(tmp_path, "killed", "--set", "executor.kind=serial")
    first = tmp_path / "killed/points/s0001/attempt_0/loading_00/outcome.json"
    while not first.exists():
        assert killed.poll() is None
        time.sleep(0.05)
    time.sleep(0.5)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    before = first.stat().st_mtime_ns
    again = start(tmp_path, "killed", "--workers", "2")
    _, err = again.communicate(timeout=300)
    assert again.returncode == 0, err
    assert first.stat().st_mtime_ns == before
    for name in ("responses.csv", "responses.parquet"):
        assert (tmp_path / "killed" / name).read_bytes() == (tmp_path / "straight" / name).read_bytes()
    with Store.open(tmp_path / "killed") as store:
        assert verify_store(store) == []
    table = ResponseTable.load(tmp_path / "killed")
    assert table.Y.shape == (3, 3)
    assert set(table.n_loadings) == {2}


def test_controller_and_machine_parameters_act_on_a_real_study(tmp_path):
    """The shipped study that varies no dig variable: two points with the real simulation, on a few rocks."""
    study = load_study(
        find_data("studies", "control_parameters.yaml"),
        [
            "scenario.site.void_depth=0.6", "scenario.pile.rocks=60", "scenario.pile.emission_height=1.8",
            "scenario.pile.emission_reach=1.2", "scenario.pile.settle_speed=0.2", "loadings=1",
            "exploration.sampling.n_initial=2", "exploration.sampling.n_corners=0",
            "exploration.sampling.n_samples=2", "exploration.sampling.n_validation=0", "executor.kind=serial",
        ],
    )  # fmt: skip
    status = run_study(study, tmp_path)
    assert status["complete"]
    assert status["cycles"]["failed"] == 0
    table = ResponseTable.load(tmp_path)
    assert table.problem.objective_names == ("production", "damage", "specific_energy")
    # So few rocks may leave the bucket empty, and then there is no energy per tonne.
    assert np.isfinite(table.Y[:, :2]).all()
    energies = pq.read_table(tmp_path / "loadings.parquet")["energy_J"].to_pylist()
    assert len(set(energies)) == 2
    assert min(energies) > 0.0
    for point, x in zip(table.point, table.X, strict=True):
        outcome = json.loads((tmp_path / f"points/{point}/attempt_0/loading_00/outcome.json").read_text())
        assert outcome["strategy"] == study.scenario.loading.strategy.model_dump()  # the dig strategy is held
        scenario = study.make_scenario(x, point)
        assert scenario.loading.planning.v_x_max == x[0]
        assert scenario.machine.boom.effort == x[3]
        assert outcome["scenario_hash"] == calc_config_hash(scenario)


@pytest.mark.parametrize(
    "name",
    ["smoke", "reduced", "full_size", "paper", "control_parameters", "loading_control", "slip_control"],
)
def test_shipped_studies_can_be_read(name):
    study = load_study(find_data("studies", f"{name}.yaml"))
    sampling = study.exploration.sampling
    n_cycles = (sampling.n_samples + sampling.n_validation) * study.loadings
    assert (
        n_cycles
        == {
            "smoke": 10,
            "reduced": 760,
            "full_size": 1560,
            "paper": 4880,
            "control_parameters": 290,
            "loading_control": 200,
            "slip_control": 200,
        }[name]
    )
