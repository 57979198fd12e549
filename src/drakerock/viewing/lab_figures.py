"""Pictures of the laboratory's tests: a specimen from the side, and the curves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull

from drakerock.errors import InputError
from drakerock.laboratory.results import LabResult, Panel, Snapshot
from drakerock.rocks.shapes import RockShape
from drakerock.viewing.pile_figures import draw_rocks

_STYLES: dict[str, dict[str, Any]] = {
    "line": {"lw": 1.0},
    "points": {"ls": "none", "marker": "o"},
    "dashed": {"ls": "--", "color": "k", "lw": 1.2},
}
# Around the rocks so much of the bench is shown [m].
MARGIN = 0.6


def draw_specimen(ax: Axes, snapshot: Snapshot, shapes: tuple[RockShape, ...]) -> Axes:
    """Draw a specimen's rocks from the side, and its bench and tool cut along y = 0."""
    draw_rocks(ax, snapshot.pile, shapes, "side")
    outlines = []
    for corners in snapshot.slabs:
        flat = corners[:, [0, 2]]
        outlines.append(flat[ConvexHull(flat).vertices])
    ax.add_collection(
        PolyCollection(outlines, facecolors=(0.75, 0.6, 0.35, 0.9), edgecolors="0.3", linewidths=0.5)
    )
    if len(snapshot.pile):
        reach = MARGIN + snapshot.pile.size.max()
        low, high = snapshot.pile.p_WRs.min(axis=0) - reach, snapshot.pile.p_WRs.max(axis=0) + reach
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[2], high[2])
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("z [m]")
    return ax


def draw_panel(ax: Axes, panel: Panel) -> Axes:
    """Draw a panel's curves; those of one label, which follow it without, in its colour."""
    color = "C0"
    number = -1
    for curve in panel.curves:
        if curve.style != "dashed" and (curve.label or number < 0):
            number += 1
            color = f"C{number % 10}"
        style: dict[str, Any] = {"color": color} | _STYLES[curve.style]
        ax.plot(curve.x, curve.y, label=curve.label or None, **style)
    ax.set_xlabel(panel.x_label)
    ax.set_ylabel(panel.y_label)
    if any(curve.label for curve in panel.curves):
        ax.legend(fontsize=8)
    ax.grid(alpha=0.3)
    return ax


def write_lab_picture(result: LabResult, shapes: tuple[RockShape, ...], path: str | Path) -> None:
    """Write the first specimen and all diagrams as one PNG.

    Raises:
        InputError: the file cannot be written.
    """
    number = len(result.panels) + bool(result.snapshots)
    figure = Figure(figsize=(5.2 * number, 4.2), layout="constrained")
    axes = list(np.atleast_1d(figure.subplots(1, number)))
    if result.snapshots:
        draw_specimen(axes.pop(0), result.snapshots[0], shapes).set_title(
            "specimen 1", loc="left", fontsize=9
        )
    for ax, panel in zip(axes, result.panels, strict=True):
        draw_panel(ax, panel)
    figure.suptitle(result.title, fontsize=11)
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
