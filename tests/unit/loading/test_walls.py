"""`benchmarks/walls.py`: how deep a recorded machine is in a wall, against closed forms."""

import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from drakerock.loading.scenario import Scenario

PATH = Path(__file__).resolve().parents[3] / "benchmarks" / "walls.py"


@dataclass
class Frames:
    """What of a recording is read."""

    times: np.ndarray
    bodies: tuple[str, ...]
    X_WBs: np.ndarray


@pytest.fixture(scope="module")
def walls():
    spec = importlib.util.spec_from_file_location("walls_benchmark", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules["walls_benchmark"] = module
    spec.loader.exec_module(module)
    return module


def test_depth_of_a_turned_box_in_walls_and_roof(walls):
    scenario = Scenario()
    half, height = scenario.site.drift_width / 2, scenario.site.drift_height
    corners = {"box": np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)}
    diagonal = np.array([np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8)])  # 45 deg about z
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    frames = [
        (upright, (-9.0, 0.0, 2.0)),  # in nothing
        (diagonal, (-9.0, half - 1.3, 2.0)),  # an edge sqrt(2) from its middle: 114 mm into the left wall
        (upright, (-9.0, 0.0, height - 0.9)),  # its top 100 mm above the roof's crown
    ]
    X_WBs = np.array([[np.concatenate([turn, place])] for turn, place in frames])
    recording = Frames(np.array([0.0, 0.01, 0.02]), ("box",), X_WBs)
    found = {
        item.wall: item for item in walls.find_penetrations(recording, corners, walls.make_walls(scenario))
    }
    assert found["left_wall"].depth == pytest.approx(np.sqrt(2.0) - 1.3)
    assert found["left_wall"].time == 0.01
    assert found["left_wall"].duration == pytest.approx(0.01)
    assert "right_wall" not in found
    assert "rear_wall" not in found
    # The roof falls off towards the sides: by as much as the parabola of the method at the box's corners, or less
    # where it is cut into flat pieces, which lie on the parabola at 1/4 of the drift's width apart.
    roof = [item for name, item in found.items() if name.startswith("roof")]
    sag = scenario.site.roof_sag / half**2
    deepest = max(item.depth for item in roof)
    assert 0.1 <= deepest <= 0.1 + sag * 1.0**2 + sag * (half / 8) ** 2
    assert {item.time for item in roof} == {0.02}
