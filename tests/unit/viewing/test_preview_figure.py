"""The picture of `drakerock plan`: nothing of it lies outside, and the legend beside the path."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from drakerock.loading.field import calc_pile_profile
from drakerock.viewing.cycle_figures import make_preview_figure
from tests.unit.loading.test_planning import make_wedge


def test_nothing_is_cut_off(plan):
    field = make_wedge()
    figure = make_preview_figure(field, calc_pile_profile(field, 0.3), plan, 2.7)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    for axes in figure.axes:
        box = axes.get_tightbbox(canvas.get_renderer())
        assert np.all(box.min >= figure.bbox.min)
        assert np.all(box.max <= figure.bbox.max)
    legend = figure.axes[0].get_legend().get_window_extent()
    assert not legend.overlaps(figure.axes[0].bbox)
