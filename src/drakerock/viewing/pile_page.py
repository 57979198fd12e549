"""A pile as a self-contained HTML page, to be turned and zoomed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams

from drakerock.rocks.config import SiteConfig
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState
from drakerock.viewing.scene import calc_rock_colors, draw_site, draw_still_rocks, write_scene

_STATIC_TINT = np.array([0.75, 0.85, 1.1])  # on the colours, below 1


def write_pile_page(
    pile: PileState, shapes: tuple[RockShape, ...], site: SiteConfig, path: str | Path
) -> None:
    """Write the pile as one HTML page that opens without a network; static rocks are bluish.

    Raises:
        InputError: the file cannot be written.
    """
    meshcat = Meshcat(MeshcatParams(show_stats_plot=False))
    top = max(float((pile.p_WRs[:, 2] + 0.5 * pile.size).max(initial=0.0)), site.drift_height)
    toe = min(float(pile.p_WRs[:, 0].min(initial=0.0)), 0.0)
    draw_site(meshcat, site, toe - 4.0, top)
    meshes = [(shape.vertices, shape.triangles) for shape in shapes]
    X_WRs = np.hstack([pile.q_WRs, pile.p_WRs])
    colors = calc_rock_colors(pile.size)
    static = {size: color * _STATIC_TINT for size, color in colors.items()}
    for name, chosen, shades in (("moving", ~pile.fixed, colors), ("static", pile.fixed, static)):
        draw_still_rocks(
            meshcat, f"rocks/{name}", meshes, pile.shape[chosen], pile.size[chosen], X_WRs[chosen], shades
        )
    target = np.array([0.5 * (toe + site.void_depth), 0.0, 0.4 * top])
    distance = 1.1 * (site.void_depth - toe)
    meshcat.SetCameraPose(target + distance * np.array([-0.55, -0.9, 0.35]), target)
    write_scene(meshcat, path)
