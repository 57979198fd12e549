from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial import ConvexHull

from drakerock.loading.config import SensingConfig
from drakerock.loading.sensing import PileSensor, calc_height_field, make_grid
from drakerock.pile.config import SiteConfig
from drakerock.pile.state import make_empty_pile


def find_height_by_half_spaces(pile, shapes, x, y):
    """Independent of ray casting: the highest point of the vertical line inside any rock."""
    from scipy.spatial.transform import Rotation

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
    sensor = builder.AddSystem(PileSensor(heap, shapes, site, SensingConfig(), 5.0))
    builder.ExportInput(sensor.GetInputPort("rock_poses"), "rock_poses")
    builder.ExportOutput(sensor.GetOutputPort("height_field"), "height_field")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    for shift in (0.0, -1.0):
        moved = replace(heap, p_WRs=heap.p_WRs + [shift, 0, 0])
        diagram.get_input_port().FixValue(context, np.hstack([moved.q_WRs, moved.p_WRs]).ravel())
        seen = diagram.get_output_port().Eval(context)
        assert np.array_equal(seen.h, calc_height_field(moved, shapes, site, 0.26, 5.0).h)
