import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial import ConvexHull

from drakerock.rocks.config import SiteConfig
from drakerock.rocks.site import calc_roof_height, make_confined_site, make_site


def contains(site, point):
    """Whether a point lies in solid rock."""
    if any(plane.normal @ point < plane.offset for plane in site.planes):
        return True
    for piece in site.pieces:
        equations = ConvexHull(piece.vertices).equations
        if np.all(equations[:, :3] @ point + equations[:, 3] < 0):
            return True
    return False


@pytest.mark.parametrize("width", [3.9, 6.5])
def test_drift_and_void_are_open_and_the_rest_is_solid(width):
    site = make_site(SiteConfig(drift_width=width))
    half = width / 2
    for point in ([-5, 0, 2], [-5, half - 0.05, 1], [2, 0, 9], [-0.3, 0, 11]):
        assert not contains(site, np.array(point, float)), point
    for point in ([-5, 0, -0.1], [-5, half + 0.1, 1], [-5, 0.1, 6], [9.0, 0.1, 2], [-1.5, 0.1, 8]):
        assert contains(site, np.array(point, float)), point


def test_roof_is_a_parabola_with_its_crown_on_the_centreline():
    config = SiteConfig()
    assert calc_roof_height(config, 0.0) == config.drift_height
    assert calc_roof_height(config, 3.25) == pytest.approx(config.drift_height - config.roof_sag)


@pytest.mark.parametrize("lean", [10.0, -10.0, 0.0])
def test_face_above_the_brow_leans_as_asked(lean):
    site = make_site(SiteConfig(wall_lean_deg=lean))
    x = -np.tan(np.deg2rad(lean)) * 5.0  # the face at z = 10, 5 m above the crown
    assert contains(site, np.array([x - 0.1, 0.1, 10.0]))
    assert not contains(site, np.array([x + 0.1, 0.0, 10.0]))


def test_mould_of_the_rear_layer_is_as_thick_as_asked():
    config = SiteConfig(void_depth=6.0, rear_layer=1.0)
    mould = make_confined_site(config)
    for x, solid in ((4.95, True), (5.05, False), (5.95, False), (6.05, True)):
        assert contains(mould, np.array([x, 0.1, 3.0])) == solid, x


def test_tapered_void_narrows_to_the_floor_and_leaves_the_drift_as_it_is():
    config = SiteConfig(void_taper_deg=5.0)
    site = make_site(config)
    foot = 12.0 * np.tan(np.deg2rad(5.0))
    for z, shift in ((0.01, foot), (6.0, foot / 2), (11.99, 0.0)):
        for side in (1, -1):
            wall = side * (3.25 - shift)
            assert not contains(site, np.array([3.0, wall - side * 0.02, z]))
            assert contains(site, np.array([3.0, wall + side * 0.02, z]))
        assert not contains(site, np.array([config.void_depth - shift - 0.02, 0.0, z]))
        assert contains(site, np.array([config.void_depth - shift + 0.02, 0.0, z]))
    assert not contains(site, np.array([-1.0, 3.2, 0.1]))
    # The mould's plane stays parallel to the rear wall.
    mould = make_confined_site(config)
    for z in (1.0, 8.0):
        wall = config.void_depth - (12.0 - z) * np.tan(np.deg2rad(5.0))
        assert contains(mould, np.array([wall - 1.02, 0.0, z]))
        assert not contains(mould, np.array([wall - 0.98, 0.0, z]))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"void_depth": 1.2}, "rear_layer"),
        ({"void_taper_deg": 25.0}, "void_taper_deg"),
        ({"roof_sag": 2.8}, "roof_sag"),
        ({"void_height": 4.0}, "void_height"),
    ],
)
def test_impossible_sites_are_refused(values, words):
    with pytest.raises(ValidationError, match=words):
        SiteConfig(**values)
