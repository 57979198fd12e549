from dataclasses import replace
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
import shapely
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from drakerock.errors import InputError
from drakerock.loading.field import calc_pile_profile
from drakerock.loading.plan import NoPlan
from drakerock.loading.plan_file import load_plan, save_plan
from drakerock.loading.signal_table import load_signals
from drakerock.viewing.cycle_figures import (
    calc_cut,
    calc_lane,
    draw_height_field,
    draw_tip_paths,
    write_cycle_figures,
)
from drakerock.viewing.scene_figures import _find_outlines, calc_rock_poses, draw_scene
from tests.cycle_files import COLUMNS
from tests.unit.loading.test_planning import make_wedge


def test_rocks_are_where_they_were_last_seen(recording, heap):
    last = len(heap) - 1
    assert np.array_equal(calc_rock_poses(recording, 0), recording.X_WRs)
    assert calc_rock_poses(recording, 1)[4, 5] == 0.0
    assert calc_rock_poses(recording, 2)[last, 5] == 1.0
    assert calc_rock_poses(recording, 2)[4, 5] == 0.0
    assert calc_rock_poses(recording, 4)[4, 5] == 2.0


def count_polygons(recording, view, **options):
    ax = Figure().subplots()
    draw_scene(ax, recording, 0, view, **options)
    (collection,) = [item for item in ax.collections if isinstance(item, PolyCollection)]
    return len(collection.get_paths())


def test_side_view_is_cut_open_and_top_view_is_whole(recording, heap):
    behind = int(np.sum(heap.p_WRs[:, 1] >= 0.1))
    assert 0 < behind < len(heap)
    assert count_polygons(recording, "side", y_cut=0.1, machine=False) == behind
    assert count_polygons(recording, "top", machine=False) == len(heap)
    # Seen from above, the box's two faces are four triangles with one outline.
    assert count_polygons(recording, "top") == len(heap) + 4 + 1


def test_outline_of_a_turned_cylinder():
    """Slivers side by side, whose union on a grid failed."""
    triangles = np.loadtxt(Path(__file__).with_name("cylinder_from_above.txt")).reshape(-1, 3, 2)
    covered = shapely.union_all(shapely.polygons(triangles))
    outlines = shapely.union_all([shapely.Polygon(outline) for outline in _find_outlines(triangles)])
    assert shapely.area(shapely.symmetric_difference(outlines, covered)) < 0.01 * covered.area


def test_curves_and_entry_point_are_drawn_where_they_are(plan):
    field = make_wedge()
    profile = calc_pile_profile(field, 0.15)
    ax = draw_height_field(Figure().subplots(), field, profile, plan)
    lines = {line.get_label(): line for line in ax.lines}
    assert np.array_equal(lines["front $x_f$"].get_xdata(), profile.x_front)
    assert np.array_equal(lines["centre of mass $x_m$"].get_xdata(), profile.x_mass)
    assert lines["entry point"].get_xdata()[0] == plan.waypoint_x[0]
    assert lines["entry point"].get_ydata()[0] == plan.y


def test_shaded_area_times_width_is_the_planned_volume(plan, digger):
    width = digger.bucket.outer_width
    assert calc_cut(plan, make_wedge(), width).area * width == pytest.approx(plan.volume, rel=0.02)


def test_lane_is_the_mean_over_the_width():
    field = make_wedge()
    field = replace(field, h=np.broadcast_to(field.y**2, field.h.shape))
    expected = np.mean(np.linspace(-1.0, 2.0, 3001) ** 2)
    assert calc_lane(field, 0.5, 3.0) == pytest.approx(np.full(len(field.x), expected), rel=0.05)


def test_actual_path_is_that_from_s0_to_s4(plan):
    signals = {"mode": np.array([0, 1, 2, 5]), "x_T": np.arange(4.0), "z_T": np.arange(4.0)}
    ax = draw_tip_paths(Figure().subplots(), plan, signals)
    lines = {line.get_label(): line for line in ax.lines}
    assert list(lines["actual"].get_xdata()) == [1.0, 2.0]
    assert np.array_equal(lines["planned"].get_xdata(), plan.x)


def test_all_pictures_of_a_stored_cycle(folder):
    paths = write_cycle_figures(folder)
    names = {path.stem.removeprefix("figure_") for path in paths}
    assert names == {"height_field", "plan", "tip_path", "histories", "side", "top"}
    for path in paths:
        picture = matplotlib.image.imread(path)[..., :3].mean(axis=2)
        assert min(picture.shape) > 400
        assert picture.std() > 0.03  # not blank, and not by colour alone


def test_cycle_without_a_plan_has_its_height_field_only(folder):
    save_plan(NoPlan("nothing there"), make_wedge(), folder / "plan.json")
    assert [path.name for path in write_cycle_figures(folder)] == ["figure_height_field.png"]


@pytest.mark.parametrize(
    "name", ["plan.json", "signals.parquet", "recording.npz", "outcome.json", "scenario.json"]
)
def test_missing_or_broken_file_is_named(folder, name):
    (folder / name).write_bytes(b"broken")
    with pytest.raises(InputError, match=name):
        write_cycle_figures(folder)
    (folder / name).unlink()
    with pytest.raises(
        InputError, match=f"{name} is missing" if name == "outcome.json" else f"{name}: no such file"
    ):
        write_cycle_figures(folder)


def test_plan_and_signals_come_back_as_stored(folder, plan):
    back, field = load_plan(folder / "plan.json")
    assert back.to_dict() == plan.to_dict()
    assert np.allclose(field.h, make_wedge().h, atol=1e-4)
    assert replace(field, h=field.h).x_end == make_wedge().x_end
    signals, units = load_signals(folder / "signals.parquet")
    assert set(signals) == {"time", "mode", *COLUMNS}
    assert set(units.values()) == {"1"}
    assert signals["time"][-1] == pytest.approx(7.99)
