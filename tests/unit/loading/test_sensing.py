from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drakerock.errors import InputError
from drakerock.loading.config import ScannerConfig, SensingConfig
from drakerock.loading.field import calc_pile_profile
from drakerock.loading.sensing import (
    PileSensor,
    calc_height_field,
    calc_scan,
    estimate_height_field,
    make_grid,
    make_ray_directions,
)
from drakerock.rocks.config import SiteConfig
from drakerock.rocks.state import PileState, make_empty_pile


def find_height_by_half_spaces(pile, shapes, x, y):
    """Independent of ray casting: the highest point of the vertical line inside any rock."""
    best = 0.0
    for rock in range(len(pile)):
        R = Rotation.from_quat(pile.q_WRs[rock], scalar_first=True).as_matrix()
        equations = ConvexHull(
            pile.size[rock] * shapes[pile.shape[rock]].vertices @ R.T + pile.p_WRs[rock]
        ).equations
        slope, rest = equations[:, 2], -(equations[:, 0] * x + equations[:, 1] * y + equations[:, 3])
        upper = np.min(rest[slope > 1e-12] / slope[slope > 1e-12])
        lower = np.max(rest[slope < -1e-12] / slope[slope < -1e-12])
        if lower <= upper:
            best = max(best, upper)
    return best


def test_height_field_is_the_rocks_upper_surface(heap, shapes):
    field = calc_height_field(heap, shapes, SiteConfig(drift_width=3.9), 0.13, 4.0)
    assert field.h.max() > 0.5
    for i in range(0, len(field.x), 2):
        for j in range(0, len(field.y), 2):
            expected = find_height_by_half_spaces(heap, shapes, field.x[i], field.y[j])
            assert abs(field.h[i, j] - expected) < 2e-4


@pytest.mark.parametrize("cells", range(5, 40))
def test_width_of_whole_cells_is_covered_by_them(cells):
    x, y = make_grid(SiteConfig(drift_width=cells * 0.26), 0.26, 26.0)
    assert len(y) == cells
    assert len(x) == 100
    assert x[-1] == pytest.approx(-0.13)
    assert y.sum() == pytest.approx(0.0, abs=1e-12)


def test_no_rocks_no_height(shapes):
    field = calc_height_field(make_empty_pile(), shapes, SiteConfig(), 0.26, 5.0)
    assert field.h.max() == 0.0
    assert field.x_end == 0.0


def test_what_lies_behind_the_brow_is_not_sensed(heap, shapes):
    site = SiteConfig(drift_width=3.9)
    behind = replace(heap, p_WRs=heap.p_WRs + [3.0, 0.0, 0.0])
    assert calc_height_field(behind, shapes, site, 0.26, 5.0).h.max() == 0.0


def test_sensor_alone_in_a_users_diagram(heap, shapes):
    builder = DiagramBuilder()
    site = SiteConfig(drift_width=3.9)
    sensor = builder.AddSystem(PileSensor(shapes, site, SensingConfig(), 5.0))
    builder.ExportInput(sensor.GetInputPort("pile"), "pile")
    builder.ExportOutput(sensor.GetOutputPort("height_field"), "height_field")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    for shift in (0.0, -1.0):
        moved = replace(heap, p_WRs=heap.p_WRs + [shift, 0, 0])
        diagram.get_input_port().FixValue(context, Value[object](moved))
        seen = diagram.get_output_port().Eval(context)
        assert np.array_equal(seen.h, calc_height_field(moved, shapes, site, 0.26, 5.0).h)


SCANNER = ScannerConfig(range_noise=0.0, dropout=0.0, resolution_deg=0.5)
X_WF = RigidTransform([-9.0, 0.0, 1.0])
QUIET_SITE = SiteConfig(drift_width=3.9)


def scan(heap, shapes, seed=0, **changes):
    config = SCANNER.replace(**changes)
    return calc_scan(heap, shapes, config, X_WF, np.random.default_rng(seed))


def test_scanned_points_lie_on_the_floor_or_on_the_rocks_in_view(heap, shapes):
    points = scan(heap, shapes)
    assert points[:, 2].min() == pytest.approx(0.0, abs=1e-9)
    on_rocks = points[points[:, 2] > 1e-6]
    assert len(on_rocks) > 50
    # Independent of ray casting: each lies in the surface of a rock's hull, and the way to it is free.
    hulls = [make_hull(heap, shapes, rock) for rock in range(len(heap))]
    origin = X_WF.translation() + np.array(SCANNER.position)
    for point in on_rocks[::7]:
        assert min(abs(calc_outside(hull, point)) for hull in hulls) < 1e-6
        for share in np.linspace(0.05, 0.999, 60):
            assert min(calc_outside(hull, origin + share * (point - origin)) for hull in hulls) > -1e-6


def make_hull(pile, shapes, rock):
    R = Rotation.from_quat(pile.q_WRs[rock], scalar_first=True).as_matrix()
    return ConvexHull(pile.size[rock] * shapes[pile.shape[rock]].vertices @ R.T + pile.p_WRs[rock]).equations


def calc_outside(equations, point):
    return float(np.max(equations[:, :3] @ point + equations[:, 3]))


def test_rays_fill_the_field_of_view():
    rays = make_ray_directions(SCANNER.replace(resolution_deg=1.0))
    assert len(rays) == 121 * 61
    assert np.allclose(np.linalg.norm(rays, axis=1), 1.0)
    assert np.rad2deg(np.arcsin(rays[:, 2])).min() == pytest.approx(-30.0)
    assert np.rad2deg(np.arctan2(rays[:, 1], rays[:, 0])).max() == pytest.approx(60.0)


def test_pitch_turns_the_scan_downwards(heap, shapes):
    # Level and narrow, the rays meet no floor within reach; pitched down, they do.
    narrow = {"vertical_field_deg": 2.0, "pitch_deg": 0.0, "range": 20.0}
    assert len(scan(make_empty_pile(), shapes, **narrow)) == 0
    assert len(scan(make_empty_pile(), shapes, **narrow | {"pitch_deg": 20.0})) > 100


def test_noise_and_dropouts_have_the_stated_size(shapes):
    empty = make_empty_pile()
    clean = scan(empty, shapes)
    noisy = scan(empty, shapes, range_noise=0.05)
    origin = X_WF.translation() + np.array(SCANNER.position)
    error = np.linalg.norm(noisy - origin, axis=1) - np.linalg.norm(clean - origin, axis=1)
    assert error.std() == pytest.approx(0.05, rel=0.05)
    assert error.mean() == pytest.approx(0.0, abs=0.005)
    assert len(scan(empty, shapes, dropout=0.3)) == pytest.approx(0.7 * len(clean), rel=0.03)
    assert len(scan(empty, shapes, dropout=1.0)) == 0
    assert np.linalg.norm(scan(empty, shapes, range=6.0) - origin, axis=1).max() <= 6.0


def test_plane_seen_sparsely_is_filled_exactly():
    rng = np.random.default_rng(1)
    xy = np.column_stack([rng.uniform(-6, 0, 4000), rng.uniform(-1.95, 1.95, 4000)])
    points = np.column_stack([xy, 3.0 + 0.4 * xy[:, 0] + 0.1 * xy[:, 1]])
    hole = (np.abs(xy[:, 0] + 3.0) < 1.0) & (np.abs(xy[:, 1]) < 0.8)
    field = estimate_height_field(points[~hole], QUIET_SITE, 0.26, 6.0)
    gx, gy = np.meshgrid(field.x, field.y, indexing="ij")
    expected = np.maximum(3.0 + 0.4 * gx + 0.1 * gy, 0.0)
    assert np.abs(field.h - expected).max() < 0.15
    middle = (np.abs(gx + 3.0) < 0.8) & (np.abs(gy) < 0.6)
    assert np.abs(field.h - expected)[middle].max() < 0.06


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_hardly_any_points_still_make_a_field(n):
    points = np.array([[-1.0, 0.0, 0.7], [-2.0, 0.0, 0.7], [-3.0, 0.0, 0.7]])[:n]
    field = estimate_height_field(points.reshape(-1, 3), QUIET_SITE, 0.26, 5.0)
    assert np.all(field.h == (0.7 if n else 0.0))


def make_slope(shapes):
    """Rocks laid on a slope of about 40 degrees, close together."""
    rows = [
        (-0.3 * i - 0.3, 0.3 * j, 0.25 * k + 0.15)
        for i in range(9)
        for j in range(-6, 7)
        for k in range(9 - i)
    ]
    n = len(rows)
    quaternions = np.random.default_rng(2).normal(size=(n, 4))
    return PileState(
        np.array(rows), quaternions / np.linalg.norm(quaternions, axis=1)[:, None], np.zeros((n, 6)),
        np.arange(n) % 6, np.full(n, 0.3), np.zeros(n, bool),
    )  # fmt: skip


def test_scan_gives_about_the_ideal_field_where_it_sees(shapes):
    pile = make_slope(shapes)
    ideal = calc_height_field(pile, shapes, QUIET_SITE, 0.26, 6.0)
    points = calc_scan(pile, shapes, ScannerConfig(), X_WF, np.random.default_rng(0))
    scanned = estimate_height_field(points, QUIET_SITE, 0.26, 6.0)
    assert np.abs(scanned.h - ideal.h).mean() < 0.1
    assert scanned.h.sum() == pytest.approx(ideal.h.sum(), rel=0.12)
    assert (
        np.abs(calc_pile_profile(scanned, 0.15).x_front - calc_pile_profile(ideal, 0.15).x_front).max() < 0.3
    )


def test_scanner_in_a_users_diagram_is_deterministic_and_noisy_anew(heap, shapes):
    config = SensingConfig(kind="scanner")
    with pytest.raises(InputError, match="front unit"):
        PileSensor(shapes, QUIET_SITE, config, 5.0)

    def see(pile, seed):
        sensor = PileSensor(shapes, QUIET_SITE, config, 5.0, seed=seed, front_unit=BodyIndex(1))
        context = sensor.CreateDefaultContext()
        sensor.GetInputPort("pile").FixValue(context, Value[object](pile))
        poses = AbstractValue.Make([RigidTransform(), X_WF])
        sensor.GetInputPort("body_poses").FixValue(context, poses)
        return sensor.GetOutputPort("height_field").Eval(context).h

    assert np.array_equal(see(heap, 3), see(heap, 3))
    assert not np.array_equal(see(heap, 3), see(heap, 4))
    # A rock moved far from the brow's floor: the floor's noise is new all the same.
    other = replace(heap, p_WRs=heap.p_WRs + [1e-9, 0, 0])
    assert not np.array_equal(see(heap, 3), see(other, 3))
