import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drakerock.errors import InputError
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.shapes import calc_sieve_width, load_rock_shapes, make_rock_shape, sample_rock_points


def make_box(a, b, c):
    return np.array([[x, y, z] for x in (-a / 2, a / 2) for y in (-b / 2, b / 2) for z in (-c / 2, c / 2)])


def test_sieve_width_of_a_stick_is_that_of_its_section():
    # A 3 x 0.6 x 0.5 stick passes end on: the square has to hold its 0.6 x 0.5 section.
    assert calc_sieve_width(make_box(3.0, 0.6, 0.5)) == pytest.approx(0.6, rel=1e-4)


def test_flat_plate_passes_a_square_on_its_diagonal():
    # A thin plate of side 1 x 3, end on, is a line of length 1: it lies on the square's diagonal.
    assert calc_sieve_width(make_box(3.0, 1.0, 1e-6)) == pytest.approx(1 / np.sqrt(2), rel=1e-3)


@settings(max_examples=6)
@given(seed=st.integers(0, 2**31), scale=st.floats(0.01, 100.0))
def test_made_shape_has_sieve_width_one_at_any_turn_and_scale(seed, scale):
    rng = np.random.default_rng(seed)
    points = Rotation.random(rng=rng).apply(sample_rock_points(rng, 13)) * scale + rng.normal(size=3)
    shape = make_rock_shape("a", points)
    assert calc_sieve_width(shape.vertices) == pytest.approx(1.0, rel=2e-3)
    assert shape.volume == pytest.approx(ConvexHull(shape.vertices).volume, rel=1e-9)


def test_volume_centre_and_inertia_against_monte_carlo(shapes):
    rng = np.random.default_rng(0)
    for shape in shapes:
        hull = ConvexHull(shape.vertices)
        low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
        points = rng.uniform(low, high, size=(200_000, 3))
        inside = points[np.all(points @ hull.equations[:, :3].T + hull.equations[:, 3] <= 0, axis=1)]
        volume = len(inside) / len(points) * np.prod(high - low)
        assert volume == pytest.approx(shape.volume, rel=0.01)
        assert np.abs(inside.mean(axis=0)).max() < 0.005
        second = inside.T @ inside / len(inside)
        inertia = volume * (np.trace(second) * np.eye(3) - second)
        assert np.abs(inertia - shape.inertia).max() < 0.02 * np.trace(shape.inertia)


def test_triangles_face_outward(shapes):
    for shape in shapes:
        a, b, c = (shape.vertices[shape.triangles[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        assert np.all(np.einsum("ij,ij->i", normals, a) > 0)


def test_six_shipped_shapes_differ(shapes):
    assert len(shapes) == 6
    assert len({round(shape.volume, 6) for shape in shapes}) == 6


def test_flat_points_and_missing_mesh_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no volume"):
        make_rock_shape("flat", np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1e-12]], float))
    with pytest.raises(InputError, match="no such mesh file"):
        load_rock_shapes(RocksConfig(shapes=("package://drakerock/rocks/nothing.obj",)))
    (tmp_path / "bad.obj").write_text("this is no mesh")
    with pytest.raises(InputError, match=r"rocks.shapes: .*bad.obj"):
        load_rock_shapes(RocksConfig(shapes=(str(tmp_path / "bad.obj"),)))
