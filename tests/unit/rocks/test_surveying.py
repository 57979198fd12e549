"""A scan's way to a surface: every format, every fault that is refused or mended, heights that are known."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from drakerock.errors import InputError
from drakerock.rocks.config import PileConfig, RocksConfig, ScanConfig, SiteConfig
from drakerock.rocks.surveying import files
from drakerock.rocks.surveying.cloud import read_cloud
from drakerock.rocks.surveying.surface import Surface, calc_rms, view_pile
from drakerock.rocks.surveying.survey import calc_median_rock, survey_scan
from rock_helpers import make_box, make_pile

SITE = SiteConfig(drift_width=6.0, void_depth=1.0, rear_layer=0.0, drift_length=20.0)


def slope(x):
    return np.clip(0.6 * (x + 3.5), 0.0, 2.4)


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-8, 0.9, 12_000), rng.uniform(-2.8, 2.8, 12_000)
    return np.column_stack([x, y, slope(x)])


def survey(tmp_path, points, **keys):
    path = tmp_path / "scan.ply"
    files.save_cloud_ply(points, path)
    return survey_scan(ScanConfig(file=str(path), **keys), SITE, PileConfig(), RocksConfig())


@pytest.mark.parametrize(
    "name", ["a.ply", "a.las", "a.laz", "a.xyz", "a.csv", "semicolons.csv", "header.csv", "a.pts"]
)
def test_every_format_gives_the_same_points(tmp_path, cloud, name):
    path, points = tmp_path / name, cloud[:200]
    if path.suffix in (".las", ".laz"):
        pytest.importorskip("laspy")
        files.save_cloud_las(points, path)
    elif path.suffix == ".ply":
        files.save_cloud_ply(points, path)
    elif name == "header.csv":
        rows = np.column_stack([np.arange(200), points[:, [2, 0, 1]]])
        np.savetxt(path, rows, delimiter=",", header="id,Elevation [m],Easting [m],Northing [m]", comments="")
    else:
        separator = {"a.csv": ",", "semicolons.csv": ";"}.get(name, "  ")
        np.savetxt(path, points, delimiter=separator, header="200" if name == "a.pts" else "", comments="")
    np.testing.assert_allclose(read_cloud(path), points, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.xyz", "", "empty file"),
        ("a.xyz", "no numbers here\n", "no line with three numbers"),
        ("a.csv", "1,5;2,0;3,1\n", "decimal commas"),
        ("a.xyz", "1 2 3\n4 five 6\n", "not three columns"),
        ("a.ply", "ply\nnonsense", "not a readable PLY"),
        ("a.e57", "x", "known are .ply"),
    ],
)
def test_unreadable_files_are_refused(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_cloud(tmp_path / name)


def test_the_surface_is_the_clouds(tmp_path, cloud):
    result = survey(tmp_path, cloud)
    surface = result.surface
    inner = surface.seen & (surface.x[:, None] > -7.5)
    assert np.abs(surface.h - slope(surface.x)[:, None])[inner].max() < 0.12  # a median over a sloping cell
    assert surface.x[-1] < SITE.void_depth < surface.x[-1] + surface.cell
    assert not [note for note in result.notes if "outliers" in note]


def test_alignment_by_unit_turn_and_shift_is_undone(tmp_path, cloud):
    straight = survey(tmp_path, cloud).surface
    # The scanner's frame: at (2, 1, 1.5), yawed by 90 degrees, in millimetres.
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    raw = 1e3 * (cloud - [2.0, 1.0, 1.5]) @ turn
    keys = survey(tmp_path, raw, unit="mm", rotation_deg=(0, 0, 90), translation=(2, 1, 1.5)).surface
    rows = tuple(
        tuple(row) for row in np.vstack([np.column_stack([turn, [2, 1, 1.5]]), [0, 0, 0, 1]]).tolist()
    )
    matrix = survey(tmp_path, raw, unit="mm", matrix=rows).surface
    np.testing.assert_allclose(keys.h, straight.h, atol=1e-3)
    np.testing.assert_allclose(matrix.h, straight.h, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: 1e3 * p, "may be in millimetres"),
        (lambda p: 1e-3 * p, "less than a rock"),
        (lambda p: p * [1, -1, -1], "upside down"),
        (lambda p: p * [1, -1, -1] + [0, 0, 2.4], "upside down"),
        (lambda p: p + [300.0, 0, 0], "lie in the site"),
        (lambda p: p[:50], "at least 100"),
        (lambda p: np.full_like(p, np.nan), "0 of 12000 points are numbers"),
        (lambda p: p[(np.abs(p[:, 0] + 1.5) > 1) | (np.abs(p[:, 1]) > 1)], "hole wider than"),
        (lambda p: p * [1, 1, 0], "shows no pile"),
        (lambda p: p[np.abs(p[:, 1]) < 0.2], "at least 4 x 4"),
    ],
)  # fmt: skip
def test_a_useless_scan_is_refused(tmp_path, cloud, change, message):
    with pytest.raises(InputError, match=message) as info:
        survey(tmp_path, change(cloud))
    assert "scan.ply" in str(info.value)


def test_what_is_mended_is_said(tmp_path, cloud):
    rng = np.random.default_rng(1)
    hole = (np.abs(cloud[:, 0] + 1.5) > 0.5) | (np.abs(cloud[:, 1]) > 0.5)
    birds = np.column_stack([rng.uniform(-6, 0, 60), rng.uniform(-2, 2, 60), rng.uniform(3, 4.3, 60)])
    broken = np.vstack([cloud[hole], birds, np.full((30, 3), np.nan)])
    result = survey(tmp_path, broken)
    text = "; ".join(result.notes)
    assert "not finite" in text
    assert "outliers" in text
    assert "filled linearly" in text
    whole = survey(tmp_path, cloud).surface
    assert np.abs(result.surface.h - whole.h)[whole.seen].max() < 0.25


def test_beyond_its_edges_the_surface_goes_on(tmp_path, cloud):
    seen = cloud[(cloud[:, 0] < -0.6) & (cloud[:, 0] > -2.5)]
    surface = survey(tmp_path, seen, edge_slope_deg=30.0).surface
    behind = surface.x > -0.3
    rise = np.diff(surface.h[behind], axis=0) / surface.cell
    np.testing.assert_allclose(rise, np.tan(np.deg2rad(30)), atol=1e-6)
    # Before the cloud it falls to the floor.
    assert surface.h[surface.x < -3.4].max() < 0.15


def test_a_piles_view_is_its_height():
    box = make_box(1.0, 1.0, 1.0)
    pile = make_pile([[0.0, 0.0, 0.5], [0.0, 0.0, 1.5]], size=np.array([1.0, 1.0]))
    x = np.array([-0.6, -0.2, 0.2, 0.6])
    surface = Surface(x, x, np.zeros((4, 4)), np.ones((4, 4), bool), 0.4)
    view = view_pile(pile, (box,), surface)
    assert view.h[1:3, 1:3] == pytest.approx(2.0)
    assert (view.rock[1:3, 1:3] == 1).all()
    assert view.below[1:3, 1:3] == pytest.approx(1.0)
    assert view.h[0, 0] == 0.0
    # Four cells of 2 m against none: the others are floor to both and do not count.
    assert calc_rms(view.h, surface) == pytest.approx((2.0, 2.0))


def test_the_median_rock_is_by_mass():
    assert calc_median_rock(RocksConfig()) == 0.4


def test_files_hold_the_same_heights(tmp_path):
    tifffile = pytest.importorskip("tifffile")
    x, y = np.arange(5) * 0.5 - 1.0, np.arange(3) * 0.5
    h = np.add.outer(x, 10 * y)
    files.save_field_tiff(x, y, h, tmp_path / "h.tif")
    with tifffile.TiffFile(tmp_path / "h.tif") as tiff:
        image, tags = tiff.asarray(), tiff.pages[0].tags
        np.testing.assert_allclose(image[::-1].T, h, rtol=1e-6)
        # North up: the first row is the largest y, the tie point its outer corner.
        assert tuple(tags[33550].value)[:2] == (0.5, 0.5)
        assert tuple(tags[33922].value) == (0, 0, 0, -1.25, 1.25, 0)
    mesh = trimesh.creation.box((1, 2, 3))
    files.save_mesh_ply(mesh, tmp_path / "box.ply")
    assert trimesh.load(tmp_path / "box.ply").volume == pytest.approx(6.0)


def test_a_matrix_with_scale_is_refused():
    rows = ((2.0, 0, 0, 0), (0, 2.0, 0, 0), (0, 0, 2.0, 0), (0, 0, 0, 1.0))
    with pytest.raises(ValueError, match="rotation without scale"):
        ScanConfig(file="a.ply", matrix=rows)
