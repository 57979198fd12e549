"""The picture of a calibration: measured against fitted curves, and what is known of the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drakerock.errors import InputError
from drakerock.exploration.problem import Array, Problem


@dataclass(frozen=True, eq=False)
class CurveView:
    """One curve: labels, abscissae (m,), measured means and their noise (m,), fit (m,), simulations (n, m)."""

    label: str
    over_label: str
    over: Array
    measured: Array
    noise: Array
    predicted: Array
    simulated: Array


def draw_curve(ax: Axes, view: CurveView) -> Axes:
    """Draw the simulations in grey, the measurement with two standard deviations, and the fit."""
    ax.plot(view.over, view.simulated.T, color="0.8", lw=0.6, zorder=1)
    ax.errorbar(
        view.over, view.measured, 2 * view.noise, fmt="ko", ms=3, lw=1, label="measured, +- 2 sd", zorder=3
    )
    ax.plot(view.over, view.predicted, "C3", lw=1.5, label="fit", zorder=2)
    ax.set_xlabel(view.over_label)
    ax.set_ylabel(view.label)
    ax.legend(fontsize=8)
    return ax


def draw_pair(
    ax: Axes, problem: Problem, i: int, j: int, draws: Array, weights: Array, best: Array, X: Array
) -> Axes:
    """Draw the posterior of the parameters i (across) and j (up); with i = j its density."""
    a, b = problem.variables[i], problem.variables[j]
    if i == j:
        ax.hist(draws[:, i], bins=np.linspace(a.low, a.high, 60).tolist(), weights=weights, color="C0")
        ax.set_yticks([])
    else:
        chosen = np.random.default_rng(0).choice(len(draws), 1500, p=weights)
        ax.plot(X[:, i], X[:, j], "x", color="0.6", ms=4, label="simulated")
        ax.plot(draws[chosen, i], draws[chosen, j], ".", color="C0", ms=2, alpha=0.3)
        ax.plot(best[i], best[j], "C3+", ms=10, mew=2, label="best")
        ax.set_ylim(b.low, b.high)
        ax.set_ylabel(_label(b.label, b.unit))
    ax.set_xlim(a.low, a.high)
    ax.set_xlabel(_label(a.label, a.unit))
    return ax


def _label(name: str, unit: str) -> str:
    return name if unit == "-" else f"{name} [{unit}]"


def write_calibration_picture(
    problem: Problem, draws: Array, weights: Array, best: Array, X: Array, views: list[CurveView], path: Path
) -> None:
    """Write curves on the left, posterior on the right, as one PNG.

    Raises:
        InputError: the file cannot be written.
    """
    d = len(problem.variables)
    figure = Figure(figsize=(6 + 2.4 * max(d, 2), 2.4 * max(d, len(views), 2)), layout="constrained")
    left, right = figure.subfigures(1, 2, width_ratios=[5, 2.4 * max(d, 2)], squeeze=False)[0]
    for ax, view in zip(np.ravel(left.subplots(len(views), 1, squeeze=False)), views, strict=True):
        draw_curve(ax, view)
    axes = right.subplots(d, d, squeeze=False)
    for row in range(d):
        for column in range(d):
            ax = axes[row, column]
            if column > row:
                ax.set_axis_off()
            else:
                draw_pair(ax, problem, column, row, draws, weights, best, X)
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
