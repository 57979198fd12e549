"""A pile in numbers: closed forms of slopes, and the file of height fields."""

import math
from dataclasses import astuple

import numpy as np
import pytest

from drakerock.errors import InputError
from drakerock.loading.cost import LoadingCost, Meter
from drakerock.loading.features import calc_pile_features
from drakerock.loading.field import HeightField
from drakerock.loading.field_file import load_height_fields, save_height_fields
from drakerock.loading.sensing import make_grid
from drakerock.rocks.config import SiteConfig

CELL = 0.1


def make_slope(angle_deg=40.0, toe=-3.0, tilt=0.0, width=4.0):
    """Return a plane that rises from its toe, which moves by `tilt` per metre across the drift."""
    x, y = make_grid(SiteConfig(drift_width=width), CELL, 6.0)
    rise = math.tan(math.radians(angle_deg))
    return HeightField(x, y, np.maximum(rise * (x[:, None] - toe - tilt * y[None, :]), 0.0), CELL)


def test_features_of_a_plane_are_its_own():
    features = calc_pile_features(make_slope(), 0.2)
    rise = math.tan(math.radians(40.0))
    assert features.volume_m3 == pytest.approx(4.0 * rise * 3.0**2 / 2, rel=0.01)
    assert features.front_mean_m == pytest.approx(-3.0 + 0.2 / rise, abs=CELL)
    assert [features.front_std_m, features.front_tilt, features.slope_std_deg] == pytest.approx(
        [0.0] * 3, abs=1e-12
    )
    # The slope runs from the front, 0.2 m up, to the height at the centre of mass.
    assert features.slope_mean_deg == pytest.approx(40.0, abs=6.0)
    assert features.height_brow_m == pytest.approx(3.0 * rise, abs=CELL)
    assert features.roughness_m < 0.01
    assert features.loose_volume_m3 < 0.15


def test_a_tilted_front_is_seen():
    assert calc_pile_features(make_slope(tilt=0.3), 0.2).front_tilt == pytest.approx(0.3, abs=0.03)


def test_rocks_on_the_floor_are_loose_and_bumps_are_rough():
    plane = make_slope()
    h = plane.h.copy()
    h[5:8, 3:6] = 0.5
    features = calc_pile_features(HeightField(plane.x, plane.y, h, CELL), 0.2)
    before = calc_pile_features(plane, 0.2)
    assert features.loose_volume_m3 - before.loose_volume_m3 == pytest.approx(9 * CELL**2 * 0.5)
    bumps = plane.h + 0.1 * (np.indices(plane.h.shape).sum(0) % 2) * (plane.h > 0.4)
    assert calc_pile_features(HeightField(plane.x, plane.y, bumps, CELL), 0.2).roughness_m == pytest.approx(
        0.05, rel=0.2
    )


def test_no_pile_has_a_volume_and_no_front():
    features = calc_pile_features(make_slope(toe=10.0), 0.2)
    assert features.volume_m3 == 0.0
    assert math.isnan(features.slope_mean_deg)
    assert len(astuple(features)) == len(features.list_names())


def test_height_fields_come_back_to_a_millimetre(tmp_path):
    before, after = make_slope(), make_slope(toe=-2.5)
    save_height_fields(before, after, tmp_path / "fields.npz")
    assert (tmp_path / "fields.npz").stat().st_size < 6000
    for field, read in zip((before, after), load_height_fields(tmp_path / "fields.npz"), strict=True):
        assert np.array_equal(read.x, field.x)
        assert np.array_equal(read.y, field.y)
        assert np.abs(read.h - field.h).max() <= 0.5001e-3
        assert read.cell == field.cell
    (tmp_path / "fields.npz").write_bytes(b"nothing")
    with pytest.raises(InputError, match="not a readable drakerock-height-fields file"):
        load_height_fields(tmp_path / "fields.npz")


def test_a_cost_is_measured_and_comes_back(tmp_path):
    assert LoadingCost.read(tmp_path) is None
    meter = Meter()
    sum(range(300_000))
    cost = meter.read()
    assert 0.0 < cost.cpu_time_s < 5.0
    assert 10.0 < cost.memory_MB < 50_000.0
    cost.save(tmp_path)
    assert LoadingCost.read(tmp_path) == cost
