"""Contract: what a test cannot do is said in one message; the engine behind it does not matter to it."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from drakerock.cli import app
from drakerock.errors import InputError
from drakerock.laboratory.beds import Bin, fit_slope, make_bin
from drakerock.laboratory.lab import TESTS, find_test, make_settings, run_test
from drakerock.laboratory.material import make_material
from drakerock.laboratory.scene import Record
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.engine.config import DynamicsConfig


@pytest.fixture(scope="module")
def material():
    config = RocksConfig.model_validate({"gradation": [{"size_m": 0.4, "mass_fraction": 1.0}]})
    return make_material(config, DynamicsConfig())


def test_an_unknown_test_is_told_which_there_are():
    with pytest.raises(InputError, match="there is no test 'triaxial'; there are repose, shear, "):
        find_test("triaxial")


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("repose", "rock=30", "unknown key 'rock'"),
        ("repose", "rocks=5", "rocks"),
        ("shear", "stresses_kPa=[50]", "stresses_kPa"),
        ("drag", "friction_angle_deg=90", "friction_angle_deg"),
        ("plate", "speeds=fast", "speeds"),
    ],
)
def test_settings_are_checked(name, override, message):
    with pytest.raises(InputError, match=message):
        make_settings(find_test(name), [override])


def test_all_tests_have_settings_and_titles():
    for name, test in TESTS.items():
        assert test.name == name
        assert test.title
        assert make_settings(test).repeats >= 3


def test_a_bin_holds_its_rocks_and_is_not_narrower_than_them(material):
    room = make_bin(material, 200, 2.0, 1.0)
    assert room.length == pytest.approx(2.0 * room.height)
    assert room.length * room.width * room.height * 0.57 == pytest.approx(200 * material.mean_volume)
    with pytest.raises(InputError, match="raise rocks to"):
        make_bin(material, 20, 1.0, 0.3)


def test_the_command_says_what_is_wrong(tmp_path):
    done = CliRunner().invoke(app, ["lab", "oedometer", "--out", str(tmp_path)])
    assert isinstance(done.exception, InputError)


def test_a_flank_is_fitted_where_it_is_straight():
    x = np.linspace(-4, 6, 60)
    slope, offset = fit_slope(x, np.clip(0.7 * x, 0.0, 2.1))
    assert slope == pytest.approx(0.7, rel=0.02)
    assert offset == pytest.approx(0.0, abs=0.05)
    assert np.isnan(fit_slope(x, np.zeros(60))[0])


class _Heap:
    """A rig in which a gate leaves a slope of 30 degrees, and a box that tilts lets go at 40."""

    def __init__(self, scene, pile, material):
        self.scene, self.pile, self.angle = scene, pile, 0.0

    def advance(self, duration, drive=None):
        n = round(duration / 0.01)
        for name, speed in (drive or {}).items():
            if name == "box":
                self.angle += speed * duration
            elif speed:
                self._slump()
        travels = {mover.name: np.full(n, self.angle) for mover in self.scene.movers}
        return Record(0.01 * np.arange(n), travels, {name: np.zeros((n, 3)) for name in travels})

    def _slump(self):
        rng = np.random.default_rng(0)
        p = rng.uniform((-1, -2, 0), (8, 2, 3), (len(self.pile), 3))
        below = p[:, 2] < np.clip(np.tan(np.pi / 6) * p[:, 0], 0.0, 2.5)
        p[:, 2] = np.where(below, p[:, 2], -9.0)
        self.pile = replace(self.pile, p_WRs=p)

    def get_pile(self):
        if self.angle < np.deg2rad(40.0):
            return self.pile
        p = self.pile.p_WRs - np.array([2.0, 0.0, 0.0])
        return replace(self.pile, p_WRs=p)


def test_a_tilting_box_is_asked_in_its_own_frame_and_stopped_when_it_lets_go(material):
    # Rocks that stay where they are in W go down the box's own x axis as it turns: so the fall of 2 m decides.
    settings = make_settings(find_test("repose"), ["rocks=60", "repeats=2"])
    result = run_test(find_test("repose"), material, settings, 0, make_rig=_Heap)
    rows = {row.name: row for row in result.rows}
    assert len(rows["tilt at which the bed lets go"].values) == 2
    assert 5.0 < rows["tilt at which the bed lets go"].mean <= 41.0


def test_bins_have_the_walls_that_are_asked_for():
    floor, left = Bin(3.0, 2.0, 1.0).make_walls("fl", 0.2)
    assert floor.calc_corners()[:, 2].max() == pytest.approx(0.0)
    assert left.calc_corners()[:, 1].min() == pytest.approx(1.0)
    assert left.friction == 0.2
