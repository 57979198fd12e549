"""Kernels just compiled and kernels from the cache give the same bits: otherwise no study could be repeated."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import hashlib
from dataclasses import replace

import numpy as np

from drakerock.dynamics.nonsmooth.engine import NonsmoothEngine
from drakerock.loading.scenario import Scenario
from drakerock.pile.emission import make_emitter, place_rocks, sample_rocks
from drakerock.pile.shapes import load_rock_shapes
from drakerock.pile.site import make_site
from drakerock.pile.state import make_empty_pile

scenario = Scenario.model_validate({"site": {"void_depth": 3.0, "rear_layer": 0.0}})
shapes = load_rock_shapes(scenario.rocks.shapes)
rng = np.random.default_rng(1)
waiting = sample_rocks(60, scenario.rocks, shapes, rng)
pile, _ = place_rocks(waiting, make_empty_pile(), shapes, make_emitter(scenario.site, scenario.pile), rng)
pile = replace(pile, p_WRs=pile.p_WRs - [0, 0, pile.p_WRs[:, 2].min() - 0.6])
engine = NonsmoothEngine(
    scenario.rocks, shapes, make_site(scenario.site), scenario.dynamics.nonsmooth, 0.01,
    pile.shape, pile.size, pile.fixed,
)
arrays = engine.make_arrays(pile)
for _ in range(150):
    arrays, _ = engine.advance(arrays)
print(hashlib.sha256(arrays.positions.tobytes()).hexdigest())
"""


@pytest.mark.slow  # compiles all kernels
def test_cold_and_warm_cache_give_the_same_bits(tmp_path):
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    runs = [
        subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
        )
        for _ in range(2)
    ]
    assert runs[0].stdout == runs[1].stdout
    assert len(runs[0].stdout.strip()) == 64
