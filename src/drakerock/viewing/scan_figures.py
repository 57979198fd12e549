"""Pictures of a measured pile: the scan, the rocks that fill it, and where their surface differs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drakerock.errors import InputError
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState
from drakerock.rocks.surveying.surface import FLOOR_HEIGHT, Array, Surface, calc_rms, view_pile
from drakerock.rocks.surveying.survey import Survey


def draw_difference(ax: Axes, surface: Surface, h: Array, limit: float) -> Axes:
    """Draw from above by how much heights (nx, ny) are over the scan's, where it was seen and there is pile."""
    held = surface.seen & ((surface.h > FLOOR_HEIGHT) | (h > FLOOR_HEIGHT))
    shown = np.where(held, h - surface.h, np.nan)
    edge = 0.5 * surface.cell
    image = ax.imshow(
        shown.T, origin="lower", cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="equal",
        extent=(surface.x[0] - edge, surface.x[-1] + edge, surface.y[0] - edge, surface.y[-1] + edge),
    )  # fmt: skip
    figure = ax.get_figure()
    assert figure is not None
    figure.colorbar(image, ax=ax, label="rocks over scan [m]", shrink=0.8)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    return ax


def draw_section(
    ax: Axes, survey: Survey, pile: PileState, shapes: tuple[RockShape, ...], h: Array, y: float
) -> Axes:
    """Draw the rocks cut near a plane y, the scan's points there, and both surfaces."""
    surface = survey.surface
    near = np.flatnonzero(np.abs(pile.p_WRs[:, 1] - y) < 0.35)
    outlines = []
    for rock in near[np.argsort(-pile.p_WRs[near, 1])]:
        turn = Rotation.from_quat(pile.q_WRs[rock], scalar_first=True).as_matrix()
        flat = (pile.size[rock] * shapes[pile.shape[rock]].vertices @ turn.T + pile.p_WRs[rock])[:, [0, 2]]
        outlines.append(flat[ConvexHull(flat).vertices])
    ax.add_collection(PolyCollection(outlines, facecolors="0.8", edgecolors="0.35", linewidths=0.5))
    points = survey.points[np.abs(survey.points[:, 1] - y) < 0.13]
    ax.plot(points[:, 0], points[:, 2], ".", color="C0", ms=1, label="scan")
    j = int(np.argmin(np.abs(surface.y - y)))
    ax.step(surface.x, h[:, j], where="mid", color="C3", lw=1.2, label="rocks, sensed")
    ax.plot(surface.x, surface.h[:, j], color="C0", lw=1)
    ax.axhline(0, color="k", lw=0.8)
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel(f"z [m] at y = {y:.1f} m")
    ax.legend(fontsize=8, loc="upper left")
    return ax


def write_scan_picture(
    survey: Survey, pile: PileState, shapes: tuple[RockShape, ...], path: str | Path, title: str = ""
) -> None:
    """Write scan, two sections and the difference from above as one PNG.

    Raises:
        InputError: the file cannot be written.
    """
    surface = survey.surface
    h = view_pile(pile, shapes, surface).h
    rms, bias = calc_rms(h, surface)
    figure = Figure(figsize=(12, 6.5), layout="constrained")
    axes = figure.subplots(2, 2)
    ax = axes[0, 0]
    chosen = survey.points[:: max(len(survey.points) // 20_000, 1)]
    cloud = ax.scatter(chosen[:, 0], chosen[:, 1], c=chosen[:, 2], s=1.5, lw=0)
    figure.colorbar(cloud, ax=ax, label="scan [m]", shrink=0.8)
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    draw_difference(axes[0, 1], surface, h, 0.6)
    quarter = 0.25 * float(np.ptp(surface.y))
    draw_section(axes[1, 0], survey, pile, shapes, h, 0.0)
    draw_section(axes[1, 1], survey, pile, shapes, h, quarter)
    figure.suptitle(
        f"{title + ': ' if title else ''}{len(pile)} rocks, surface {rms:.2f} m rms, {bias:+.2f} m mean off the scan"
    )
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
