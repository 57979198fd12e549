import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drakerock.loading.field import HeightField, calc_pile_profile

CELL = 0.26


def make_field(height, length=10.0, width=6.5, cell=CELL):
    """A height field from a function of x and y; x ends at the brow, 0."""
    nx, ny = round(length / cell), int(width / cell)
    x = -cell * (np.arange(nx, dtype=float)[::-1] + 0.5)
    y = cell * (np.arange(ny, dtype=float) - 0.5 * (ny - 1))
    gx, gy = np.meshgrid(x, y, indexing="ij")
    return HeightField(x, y, np.maximum(height(gx, gy), 0.0), cell)


@given(slope=st.floats(0.3, 1.0), toe=st.floats(-8.0, -3.0))
def test_wedge_has_its_front_at_the_toe_and_its_slope(slope, toe):
    tangent = np.tan(slope)
    profile = calc_pile_profile(make_field(lambda x, y: tangent * (x - toe), cell=0.02), 0.15)
    # h exceeds 0.15 m at toe + 0.15 / tan(slope), to within a cell.
    front = toe + 0.15 / tangent
    assert np.all(np.abs(profile.x_front - front) <= 0.03)
    # A uniform wedge from a to the brow has its centre of mass two thirds of the way, beyond the cut toe.
    h0 = tangent * (front - toe)
    run = -front
    area = h0 * run + 0.5 * tangent * run**2
    expected = front + (0.5 * h0 * run**2 + tangent * run**3 / 3) / area
    assert np.allclose(profile.x_mass, expected, atol=0.03)
    height = tangent * (profile.x_mass - toe)
    assert np.allclose(profile.slope, np.arctan(height / (profile.x_mass - profile.x_front)), atol=1e-3)


def test_cone_front_is_a_circle():
    profile = calc_pile_profile(make_field(lambda x, y: 3.0 - 0.6 * np.hypot(x, y), cell=0.05), 0.15)
    radius = (3.0 - 0.15) / 0.6
    inside = np.abs(profile.y) < 2.5
    expected = -np.sqrt(radius**2 - profile.y[inside] ** 2)
    assert np.abs(profile.x_front[inside] - expected).max() < 0.12


def test_flat_plane_has_half_way_centre_of_mass():
    field = make_field(lambda x, y: np.where(x > -4.0, 1.0, 0.0))
    profile = calc_pile_profile(field, 0.15)
    assert np.allclose(profile.x_mass, 0.5 * (profile.x_front + field.x[-1]))
    assert np.allclose(profile.slope, np.arctan(1.0 / (profile.x_mass - profile.x_front)))


def test_loose_rock_before_the_pile_is_not_the_front():
    def height(x, y):
        return np.maximum(0.7 * (x + 4.0), np.where((np.abs(x + 8.0) < 0.3) & (np.abs(y) < 0.3), 0.5, 0.0))

    profile = calc_pile_profile(make_field(height), 0.15)
    assert profile.x_front.min() > -4.1


def test_empty_field_has_no_front_anywhere():
    profile = calc_pile_profile(make_field(lambda x, y: 0 * x), 0.15)
    assert np.all(np.isnan(profile.x_front))
    assert np.all(np.isnan(profile.slope))


def test_heap_away_from_the_brow_still_counts():
    profile = calc_pile_profile(make_field(lambda x, y: 2.0 - np.abs(x + 5.0) - np.abs(y)), 0.15)
    middle = np.argmin(np.abs(profile.y))
    assert profile.x_front[middle] == pytest.approx(-6.7, abs=0.3)
