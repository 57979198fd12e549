import numpy as np
import pytest
from scipy.spatial import ConvexHull

from drakerock.pile.config import SiteConfig
from drakerock.pile.site import calc_roof_height, make_site


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
    for point in ([-5, 0, -0.1], [-5, half + 0.1, 1], [-5, 0.1, 6], [6, 0.1, 2], [-1.5, 0.1, 8]):
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
