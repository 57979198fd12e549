"""What a mesh file may hold: one rock each; what taking its hull changes is said."""

import logging

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from drakerock.errors import InputError
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.rocks.config import RocksConfig, SizeClass
from drakerock.rocks.engine.collision.shapes import make_convex_shapes
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.making import make
from drakerock.rocks.shapes import (
    MAX_ASPECT,
    calc_aspect,
    calc_height,
    calc_sieve_width,
    choose_corners,
    load_convex_meshes,
    load_rock_shapes,
)


@pytest.fixture(autouse=True)
def warnings_are_seen(caplog):
    caplog.set_level(logging.WARNING, logger="drakerock.rocks.shapes")
    load_convex_meshes.cache_clear()


@pytest.fixture
def load(tmp_path):
    """Write a mesh and load it as a rock."""

    def run(mesh, name="rock.obj", **options):
        mesh.export(tmp_path / name)
        return load_rock_shapes(RocksConfig(shapes=(str(tmp_path / name),), **options))[0]

    return run


def read(caplog):
    return "\n".join(record.getMessage() for record in caplog.records)


@pytest.mark.parametrize("name", ["rocks.obj", "rocks.stl", "rocks.ply"])
@pytest.mark.parametrize("number", [2, 3])
def test_several_rocks_in_one_file_are_refused(load, name, number):
    boxes = [trimesh.creation.box((1, 0.8, 0.7)).apply_translation([3 * k, 0, 0]) for k in range(number)]
    with pytest.raises(InputError, match=f"{name}: {number} bodies in one mesh"):
        load(trimesh.util.concatenate(boxes), name)


@pytest.mark.parametrize("name", ["rock.obj", "rock.stl", "rock.ply"])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_one_convex_rock_in_any_unit_is_taken_without_a_word(load, caplog, name, unit):
    shape = load(trimesh.creation.box((1.2 * unit, 1.0 * unit, 0.8 * unit)), name)
    width = calc_sieve_width(box(1.2, 1.0, 0.8))
    assert shape.volume == pytest.approx(1.2 * 1.0 * 0.8 / width**3, rel=1e-6)
    assert not read(caplog)


def box(a, b, c):
    return np.array([[x, y, z] for x in (-a / 2, a / 2) for y in (-b / 2, b / 2) for z in (-c / 2, c / 2)])


def test_vertices_that_no_face_uses_do_not_count(tmp_path):
    mesh = trimesh.creation.box((1, 1, 1))
    text = mesh.export(file_type="obj") + "\nv 50 0 0\n"
    (tmp_path / "stray.obj").write_text(text)
    assert load_rock_shapes(RocksConfig(shapes=(str(tmp_path / "stray.obj"),)))[0].radius < 2.0


@pytest.mark.parametrize("thickness", [0.001, 0.1])
def test_plates_and_needles_are_refused(load, thickness):
    for sides in ((1.0, 1.0, thickness), (1.0, thickness, thickness)):
        with pytest.raises(InputError, match=r"rock.obj: .* times as long as thin; at most 10"):
            load(trimesh.creation.box(sides))


def test_aspect_is_length_over_thickness():
    assert calc_aspect(box(3.0, 2.0, 0.5)) == pytest.approx(np.sqrt(9 + 4 + 0.25) / 0.5)


def test_the_engine_takes_the_longest_plates_and_needles_that_are_allowed(load):
    for other in (1.0, 1.0 / MAX_ASPECT):
        # The diagonal is the length.
        shape = load(trimesh.creation.box((1.0, other, 1.5 / MAX_ASPECT)))
        make_convex_shapes([shape.vertices], [NonsmoothConfig().rounding])


def test_a_mesh_with_holes_is_told_of(load, caplog):
    mesh = trimesh.creation.box((1, 1, 1))
    mesh.update_faces(np.arange(len(mesh.faces)) > 1)
    load(mesh)
    assert "rock.obj: the mesh has holes" in read(caplog)
    assert "1 after" in read(caplog)


def test_a_hollow_mesh_is_told_of_with_volume_and_depth(load, caplog):
    # A box with a pyramid cut out from its top down to its middle: a sixth of its volume.
    mesh = trimesh.Trimesh(box(1.0, 1.0, 1.0), trimesh.creation.box((1, 1, 1)).faces, process=False)
    mesh = trimesh.Trimesh(*hollow_out(mesh), process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(5 / 6)
    load(mesh)
    assert "20.0 % more volume" in read(caplog)
    assert "0.500 sieve widths deep" in read(caplog)


def hollow_out(mesh):
    """Replace the top face by four that meet in the middle."""
    top = mesh.vertices[mesh.faces][:, :, 2].min(axis=1) > 0.49
    corners = np.flatnonzero(mesh.vertices[:, 2] > 0.49)
    angle = np.arctan2(mesh.vertices[corners, 1], mesh.vertices[corners, 0])
    ring = corners[np.argsort(angle)]
    middle = len(mesh.vertices)
    faces = [[a, b, middle] for a, b in zip(ring, np.roll(ring, -1), strict=True)]
    return np.vstack([mesh.vertices, [[0, 0, 0]]]), np.vstack([mesh.faces[~top], faces])


def test_a_scan_is_reduced_to_the_corners_allowed(load, caplog):
    scan = trimesh.creation.icosphere(subdivisions=4)
    scan.vertices *= [1.0, 0.9, 0.8]
    assert len(scan.vertices) == 2562
    shape = load(scan)
    assert len(shape.vertices) == 40
    assert "2562 corners reduced to 40 (rocks.max_corners)" in read(caplog)
    # An ellipsoid passes along its longest axis, the section's axes on the square's diagonals.
    width = 2.0 * np.sqrt((0.9**2 + 0.8**2) / 2)
    assert shape.volume == pytest.approx(4 / 3 * np.pi * 0.9 * 0.8 / width**3, rel=0.1)
    assert len(load(trimesh.creation.icosphere(subdivisions=3), max_corners=100).vertices) == 100


@settings(max_examples=30)
@given(seed=st.integers(0, 2**31), n=st.integers(5, 300), number=st.integers(4, 60))
def test_chosen_corners_span_a_hull_inside_that_comes_closer_with_each(seed, n, number):
    points = np.random.default_rng(seed).normal(size=(n, 3))
    chosen = choose_corners(points, number)
    hull = points[ConvexHull(points).vertices]
    assert len(chosen) == len(set(chosen)) <= number
    assert set(map(tuple, points[chosen])) <= set(map(tuple, hull))
    if len(chosen) < number:
        assert calc_height(points[chosen], points).max() < 1e-6
    few = choose_corners(points, max(number // 2, 4))
    assert set(few) <= set(chosen)


def test_shipped_shapes_are_below_the_limit(shapes, caplog):
    load_convex_meshes.cache_clear()
    for first, second in zip(shapes, load_rock_shapes(RocksConfig()), strict=True):
        np.testing.assert_array_equal(first.vertices, second.vertices)
    assert not read(caplog)


def test_an_unusable_cache_costs_time_only(load, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    one = load(trimesh.creation.box((1.2, 1.0, 0.8)), "a.obj")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    two = load(trimesh.creation.box((1.2, 1.0, 0.8)), "b.obj")
    (entry,) = (tmp_path / "cache").rglob("sieve_widths/*")
    entry.write_text("no number")
    three = load(trimesh.creation.box((1.2, 1.0, 0.8)), "c.obj")
    four = load(trimesh.creation.box((1.2, 1.0, 0.8)), "d.obj")
    assert one.volume == two.volume == three.volume == four.volume


def test_a_gradation_with_fines_is_refused_with_the_number_of_rocks():
    fines = (SizeClass(size_m=0.02, mass_fraction=0.1), SizeClass(size_m=0.6, mass_fraction=0.9))
    recipe = make_recipe(Scenario(rocks=RocksConfig(gradation=fines)))
    with pytest.raises(
        InputError, match=r"rocks.gradation: .* about 5\d{6} rocks, .* size_m 0.02; at most 100000"
    ):
        make.make_pile(recipe)


def test_number_of_rocks_is_told_before_they_fall(caplog, monkeypatch):
    def stop(*_arguments, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr(make, "drop_rocks", stop)
    with pytest.raises(KeyboardInterrupt):
        make.make_pile(make_recipe(Scenario()))
    # The shipped pile, of this recipe, has 5 770.
    number = int(read(caplog).split("about ")[1].split()[0])
    assert number == pytest.approx(5770, rel=0.1)
