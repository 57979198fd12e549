"""Pictures of a pile: every rock's outline, from the side, the front or above."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drakerock.errors import InputError
from drakerock.rocks.config import SiteConfig
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState

VIEWS = {"side": (0, 2, 1), "front": (1, 2, 0), "top": (0, 1, 2)}
"""Horizontal, vertical and depth axis (0 x, 1 y, 2 z) of each view."""
_TOWARDS_EYE = {"side": -1.0, "front": -1.0, "top": 1.0}


def draw_rocks(ax: Axes, pile: PileState, shapes: tuple[RockShape, ...], view: str) -> Axes:
    """Draw the rocks' outlines, the nearest last, darker the farther away.

    Args:
        ax: where to draw.
        pile: the rocks.
        shapes: the rock shapes.
        view: a key of `VIEWS`; side looks along +y, front along +x (from the machine), top down.
    """
    across, up, depth = VIEWS[view]
    nearness = _TOWARDS_EYE[view] * pile.p_WRs[:, depth]
    order = np.argsort(nearness)
    R_WRs = Rotation.from_quat(pile.q_WRs, scalar_first=True).as_matrix() if len(pile) else []
    outlines: list[NDArray[np.float64]] = []
    for rock in order:
        p_WVs = pile.size[rock] * shapes[pile.shape[rock]].vertices @ R_WRs[rock].T + pile.p_WRs[rock]
        flat = p_WVs[:, [across, up]]
        outlines.append(flat[ConvexHull(flat).vertices])
    rank = (nearness[order] - nearness.min()) / max(np.ptp(nearness), 1e-9) if len(pile) else np.zeros(0)
    colors = matplotlib.colormaps["Greys_r"](0.35 + 0.5 * rank)
    colors[pile.fixed[order], :3] *= np.array([0.75, 0.85, 1.0])
    ax.add_collection(PolyCollection(outlines, facecolors=colors, edgecolors="0.15", linewidths=0.3))
    return ax


def draw_pile(ax: Axes, pile: PileState, shapes: tuple[RockShape, ...], site: SiteConfig, view: str) -> Axes:
    """Draw the rocks (`draw_rocks`) in their drift, which is drawn as lines; otherwise as there."""
    draw_rocks(ax, pile, shapes, view)
    half, end, height = 0.5 * site.drift_width, site.void_depth, site.drift_height
    if view == "side":
        start = min(float(pile.p_WRs[:, 0].min()) - 2.0, -3.0) if len(pile) else -3.0
        lean = np.tan(np.deg2rad(site.wall_lean_deg)) * (site.void_height - height)
        ax.plot([start, end, end], [0, 0, site.void_height], "k-", lw=1)
        ax.plot([start, 0, -lean], [height, height, site.void_height], "k-", lw=1)
        ax.set_ylabel("z [m]")
    elif view == "front":
        y = np.linspace(-half, half, 40)
        roof = height - site.roof_sag * (y / half) ** 2
        ax.plot([-half, *y, half, -half], [0, *roof, 0, 0], "k-", lw=1)
        ax.set_ylabel("z [m]")
    else:
        ax.axhline(-half, color="k", lw=1)
        ax.axhline(half, color="k", lw=1)
        ax.set_ylabel("y [m]")
    ax.set_xlabel("y [m]" if view == "front" else "x [m]")
    ax.set_aspect("equal")
    ax.autoscale_view()
    return ax


def write_pile_picture(
    pile: PileState, shapes: tuple[RockShape, ...], site: SiteConfig, path: str | Path
) -> None:
    """Write side, front and top view as one PNG.

    Raises:
        InputError: the file cannot be written.
    """
    figure = Figure(figsize=(11, 8), layout="constrained")
    axes = figure.subplot_mosaic([["side", "front"], ["top", "top"]], width_ratios=[2, 1])
    for view, ax in axes.items():
        draw_pile(ax, pile, shapes, site, view)
        ax.set_title(f"{view} view", loc="left", fontsize=10)
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
