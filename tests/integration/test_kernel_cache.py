"""Kernels just compiled and kernels from the cache give the same bits: otherwise no study could be repeated."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import hashlib
from dataclasses import replace

import numpy as np

from drakerock.rocks.engine.engine import NonsmoothEngine
from drakerock.loading.scenario import Scenario
from drakerock.rocks.making.emission import make_emitter, place_rocks, sample_rocks
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.site import make_site, make_surroundings
from drakerock.rocks.state import make_empty_pile

scenario = Scenario.model_validate({"site": {"void_depth": 3.0, "rear_layer": 0.0}})
shapes = load_rock_shapes(scenario.rocks)
rng = np.random.default_rng(1)
waiting = sample_rocks(60, scenario.rocks, shapes, rng)
pile, _ = place_rocks(waiting, make_empty_pile(), shapes, make_emitter(scenario.site, scenario.pile), rng)
pile = replace(pile, p_WRs=pile.p_WRs - [0, 0, pile.p_WRs[:, 2].min() - 0.6])
engine = NonsmoothEngine(
    scenario.rocks, shapes, make_surroundings(make_site(scenario.site)), scenario.dynamics.nonsmooth, 0.01,
    pile.shape, pile.size, pile.fixed,
)
arrays = engine.make_arrays(pile)
for _ in range(150):
    arrays, _ = engine.advance(arrays)
print(hashlib.sha256(arrays.positions.tobytes()).hexdigest())
"""


@pytest.mark.slow  # compiles all kernels
def test_cold_and_warm_cache_give_the_same_bits(tmp_path):
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path), "NUMBA_CACHE_DIR": ""}
    runs = [
        subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
        )
        for _ in range(2)
    ]
    assert runs[0].stdout == runs[1].stdout
    assert len(runs[0].stdout.strip()) == 64


KERNELS = """
from drakerock.rocks.engine.compiling import kernel


@kernel
def add_up(values, power):
    total = 0.0
    for value in values:
        total += value**power
    return total


@kernel
def find_mean(values, power):
    return (add_up(values, power) / len(values)) ** (1 / power)
"""

USE = """
import sys
import numpy as np
sys.path.insert(0, ".")
import kernels

print("ready", flush=True)
input()
assert kernels.find_mean(np.full(9, 2.0), 2.0) == 2.0
both = [item for name in ("find_mean", "add_up") for item in (getattr(kernels, name), getattr(kernels, name).inlined)]
print(sum(sum(item.stats.cache_misses.values()) for item in both))
"""

HOLD = """
import time
from drakerock.rocks.engine import compiling

with compiling._one_process:
    print("held", flush=True)
    time.sleep(100)
"""


@pytest.fixture
def start(tmp_path):
    """Return a function that starts a program with a kernel cache of the test's own."""
    (tmp_path / "kernels.py").write_text(KERNELS)
    processes = []

    def run(program):
        processes.append(
            subprocess.Popen(
                [sys.executable, "-c", program], cwd=tmp_path, text=True,
                env=os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache"), "NUMBA_CACHE_DIR": ""},
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            )
        )  # fmt: skip
        return processes[-1]

    yield run
    for process in processes:
        process.kill()
        process.communicate()


def test_processes_that_start_together_compile_each_kernel_once(start):
    users = [start(USE) for _ in range(3)]
    for user in users:
        assert user.stdout.readline() == "ready\n", user.communicate()[1]
    for user in users:
        user.stdin.write("\n")
        user.stdin.flush()
    answers = [user.communicate(timeout=120) for user in users]
    assert sorted(int(out) for out, _ in answers) == [0, 0, 2], [error for _, error in answers]


def test_a_process_killed_while_it_compiles_leaves_no_lock(start):
    holder, user = start(HOLD), start(USE)
    assert holder.stdout.readline() == "held\n", holder.communicate()[1]
    assert user.stdout.readline() == "ready\n", user.communicate()[1]
    user.stdin.write("\n")
    user.stdin.flush()
    with pytest.raises(subprocess.TimeoutExpired):
        user.wait(timeout=1.0)  # it waits
    holder.kill()
    out, error = user.communicate(timeout=120)
    assert out == "2\n", error
