"""The exploration's figures (method section 6): functions from data and Axes to Axes.

Colour is never the only carrier: the map (cividis) rises evenly in lightness, and kinds of points differ in
marker, so that everything reads in grey. `make_figures` puts them on pages, for PNG, PDF and the report.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from drakerock.errors import InputError
from drakerock.exploration.analysis import Exploration
from drakerock.exploration.confirmation import Confirmation
from drakerock.exploration.pareto import ParetoFront
from drakerock.exploration.problem import Array, Problem, Variable
from drakerock.exploration.sensitivity import Sensitivity
from drakerock.exploration.table import ResponseTable
from drakerock.exploration.validation import Accuracy
from drakerock.files import make_folder

COLORMAP = "cividis"
_DARK, _MIDDLE, _LIGHT = "#1b2a41", "#6c757d", "#c9ced3"
_ACCENT = "#b5400b"
# Projections drawn for a problem with many objectives or variables; beyond it pages get unreadable.
_MAX_PANELS = 6


def draw_literally(text: str) -> str:
    """Return a user's text as matplotlib has to be given it: it would read what stands between dollars as formulas."""
    return text.replace("$", r"\$")


def draw_nested_contours(
    ax: Axes,
    predict: Callable[[Array], Array],
    problem: Problem,
    objective: int,
    fixed: Array,
    n_outer: int = 5,
    n_inner: int = 31,
) -> Axes:
    """Draw one objective over the first two variables, in a grid over the next two.

    Args:
        ax: where to draw; each cell of the outer grid is one contour map of the inner variables.
        predict: from points (n, d) to objectives (n, k).
        problem: variables and objectives; with one variable a curve is drawn, with two a single map.
        objective: index of the objective.
        fixed: (d,) values of the variables beyond the fourth.
        n_outer, n_inner: cells per outer variable, grid points per inner variable and cell.
    """
    d, variables = len(problem.variables), problem.variables
    label = draw_literally(problem.objectives[objective].label)
    names = [draw_literally(variable.label) for variable in variables]
    t = np.linspace(0.0, 1.0, n_inner)
    if d == 1:
        x = problem.low + t[:, None] * (problem.high - problem.low)
        ax.plot(x[:, 0], predict(x)[:, objective], color=_DARK)
        ax.set(xlabel=names[0], ylabel=label)
        return ax
    columns = np.linspace(0.0, 1.0, n_outer) if d > 2 else np.array([0.5])
    rows = np.linspace(0.0, 1.0, n_outer) if d > 3 else np.array([0.5])
    cells = []
    for column in columns:
        for row in rows:
            share = np.tile((fixed - problem.low) / (problem.high - problem.low), (n_inner**2, 1))
            share[:, 0], share[:, 1] = np.tile(t, n_inner), np.repeat(t, n_inner)
            if d > 2:
                share[:, 2] = column
            if d > 3:
                share[:, 3] = row
            y = predict(problem.low + share * (problem.high - problem.low))[:, objective]
            cells.append(y.reshape(n_inner, n_inner))
    low, high = min(c.min() for c in cells), max(c.max() for c in cells)
    levels = MaxNLocator(14).tick_values(low, high if high > low else low + 1.0)
    size = 0.92  # of a cell; the rest is the gap between neighbours
    for index, cell in enumerate(cells):
        i, j = divmod(index, len(rows))
        place = (i + size * (t - 0.5), j + size * (t - 0.5))
        shades = ax.contourf(*place, cell, levels=levels, cmap=COLORMAP)
        ax.contour(*place, cell, levels=levels, colors="white", linewidths=0.35)
    ax.figure.colorbar(shades, ax=ax, label=label, pad=0.02)
    ax.set_aspect("equal")
    ax.set_xlim(-0.5, len(columns) - 0.5)
    ax.set_ylim(-0.5, len(rows) - 0.5)
    if d == 2:
        _set_ticks(ax, variables[0], variables[1], size)
        ax.set(xlabel=names[0], ylabel=names[1])
        return ax
    ax.set_xticks(range(len(columns)), [f"{variables[2].low + c * _span(variables[2]):.3g}" for c in columns])
    if d > 3:
        ax.set_yticks(range(len(rows)), [f"{variables[3].low + r * _span(variables[3]):.3g}" for r in rows])
    else:
        ax.set_yticks([])
    inner = " and ".join(
        f"{name} {v.low:g} to {v.high:g} {way}"
        for name, v, way in zip(names[:2], variables[:2], "→↑", strict=True)
    )
    ax.set_xlabel(f"{names[2]}     (in each cell: {inner})")
    ax.set_ylabel(names[3] if d > 3 else "", rotation=0, labelpad=10)
    return ax


def draw_front(
    ax: Axes,
    front: ParetoFront,
    pair: tuple[int, int],
    shade: int | None = None,
    simulated: Array | None = None,
    marks: dict[str, Array] | None = None,
) -> Axes:
    """Draw a projection of the Pareto front onto two objectives.

    Args:
        ax: where to draw.
        front: the front; the fronts of the surrogate's draws lie behind it, where they are known.
        pair: indices of the objectives on x and y.
        shade: index of the objective that colours the points; None: no colour.
        simulated: (n, k) simulated responses, for comparison.
        marks: objectives (k,) to point out, by their label.
    """
    x, y = pair
    labels = [draw_literally(objective.label) for objective in front.problem.objectives]
    if simulated is not None:
        ax.scatter(
            simulated[:, x], simulated[:, y], s=10, marker="x", lw=0.6, color=_LIGHT, label="simulated"
        )
    if front.uncertainty:
        cloud = np.vstack(front.uncertainty.fronts[:20])
        ax.scatter(cloud[:, x], cloud[:, y], s=3, lw=0, color=_MIDDLE, alpha=0.12, rasterized=True)
        ax.scatter([], [], s=12, lw=0, color=_MIDDLE, label="fronts of draws")  # visible in the legend
    colour: dict[str, Any] = (
        {"c": front.Y[:, shade], "cmap": COLORMAP} if shade is not None else {"color": _DARK}
    )
    points = ax.scatter(
        front.Y[:, x], front.Y[:, y], s=16, edgecolors=_DARK, linewidths=0.3, label="front", **colour
    )
    if shade is not None:
        ax.figure.colorbar(points, ax=ax, label=labels[shade], orientation="horizontal", pad=0.03)
    for label, value in (marks or {}).items():
        ax.scatter(
            value[x], value[y], s=95, marker="D", facecolors="white", edgecolors=_ACCENT, linewidths=1.4
        )
        ax.annotate(
            draw_literally(label),
            (value[x], value[y]),
            fontsize=7,
            ha="center",
            va="center_baseline",
            color=_ACCENT,
            weight="bold",
        )
    ax.set(xlabel=labels[x], ylabel=labels[y])
    return ax


def draw_coverage(ax: Axes, table: ResponseTable, pair: tuple[int, int]) -> Axes:
    """Draw sample points (dots) and validation points (crosses) in two variables."""
    i, j = pair
    for role, marker, size in (("sample", "o", 10), ("validation", "x", 18)):
        X = table.select(role).X
        colour = _DARK if role == "sample" else _ACCENT
        ax.scatter(X[:, i], X[:, j], s=size, marker=marker, color=colour, lw=0.9, label=role)
    a, b = table.problem.variables[i], table.problem.variables[j]
    ax.set(xlabel=draw_literally(a.label), ylabel=draw_literally(b.label))
    ax.set_xlim(a.low - 0.04 * _span(a), a.high + 0.04 * _span(a))
    ax.set_ylim(b.low - 0.04 * _span(b), b.high + 0.04 * _span(b))
    return ax


def draw_predicted(ax: Axes, accuracy: Accuracy, label: str) -> Axes:
    """Draw predicted against simulated values: leave-one-out and validation, with one standard deviation."""
    loo, val = accuracy.leave_one_out, accuracy.validation
    values = np.concatenate([loo.simulated, loo.predicted, val.simulated, val.predicted])
    ends = np.array([values.min(), values.max()])
    ax.plot(ends, ends, color=_MIDDLE, lw=0.8, zorder=0)
    ax.scatter(
        loo.simulated, loo.predicted, s=9, color=_LIGHT, edgecolors=_MIDDLE, lw=0.4, label="leave-one-out"
    )
    if len(val.simulated):
        bars: dict[str, Any] = {"fmt": "x", "ms": 4, "lw": 0.7, "color": _ACCENT}
        ax.errorbar(val.simulated, val.predicted, yerr=val.std, label="validation", **bars)
    shown = [f"leave-one-out NRMSE {100 * accuracy.loo_nrmse:.1f} %"]
    if np.isfinite(accuracy.validation_nrmse):
        shown.append(f"validation NRMSE {100 * accuracy.validation_nrmse:.1f} %")
    if np.isfinite(accuracy.noise_floor):
        shown.append(f"noise floor {100 * accuracy.noise_floor:.1f} %")
    ax.text(0.04, 0.96, "\n".join(shown), transform=ax.transAxes, va="top", fontsize=7.5)
    label = draw_literally(label)
    ax.set(xlabel=f"simulated {label}", ylabel=f"predicted {label}")
    ax.legend(loc="lower right", fontsize=7.5, frameon=False)
    return ax


def draw_sensitivity(ax: Axes, sensitivity: Sensitivity, labels: Sequence[str]) -> Axes:
    """Draw first-order and total Sobol' indices with their intervals, one pair of bars per variable."""
    place = np.arange(len(labels))
    bars: dict[str, Any] = {"capsize": 2.5, "error_kw": {"lw": 0.9}, "width": 0.38, "edgecolor": _DARK}
    ax.bar(
        place - 0.2,
        sensitivity.first,
        yerr=sensitivity.first_half,
        color=_DARK,
        label="first order",
        ecolor=_MIDDLE,
        **bars,
    )
    ax.bar(
        place + 0.2,
        sensitivity.total,
        yerr=sensitivity.total_half,
        color="white",
        hatch="///",
        label="total",
        **bars,
    )
    ax.set_xticks(place, [draw_literally(label) for label in labels])
    ax.set_ylim(0.0, max(1.0, 1.05 * float(np.max(sensitivity.total + sensitivity.total_half))))
    ax.set_ylabel("Sobol' index")
    ax.set_title(sensitivity.objective, fontsize=9)
    ax.legend(fontsize=7.5, frameon=False)
    return ax


def draw_convergence(ax: Axes, front: ParetoFront) -> Axes:
    """Draw the hypervolume over the evaluations of the search, and the 90 % band of the draws."""
    ax.plot(front.evaluations, front.hypervolume, color=_DARK, lw=1.2, label="best estimate")
    if front.uncertainty:
        low, high = np.quantile(front.uncertainty.hypervolumes, [0.05, 0.95])
        ax.axhspan(low, high, color=_LIGHT, alpha=0.6, lw=0, label="90 % of draws, final front")
    ax.set(xlabel="evaluations of the surrogate", ylabel="hypervolume (share of the box)")
    ax.legend(loc="lower right", fontsize=7.5, frameon=False)
    return ax


def draw_learning(
    ax: Axes, sizes: Array, nrmse: Array, problem: Problem, accuracy: Sequence[Accuracy]
) -> Axes:
    """Draw the validation NRMSE over the number of sample points, noise floors dotted."""
    for j, (name, style) in enumerate(
        zip(problem.objective_names, _styles(len(problem.objectives)), strict=True)
    ):
        ax.plot(sizes, 100 * nrmse[:, j], label=name, **style)
        if np.isfinite(accuracy[j].noise_floor):
            ax.axhline(100 * accuracy[j].noise_floor, lw=0.7, ls=":", color=style["color"])
    ax.set(xlabel="sample points", ylabel="validation NRMSE [%]  (dotted: noise floor)")
    ax.set_ylim(bottom=0.0)
    ax.legend(fontsize=7.5, frameon=False)
    return ax


def draw_confirmation(ax: Axes, confirmation: Confirmation, objective: int) -> Axes:
    """Draw predicted against re-simulated values of one objective, both with one standard deviation."""
    x, y = confirmation.simulated[:, objective], confirmation.predicted[:, objective]
    good = np.isfinite(x)
    x, y = x[good], y[good]
    xerr = np.nan_to_num(confirmation.simulated_se[good, objective])
    ax.errorbar(x, y, confirmation.predicted_std[good, objective], xerr, fmt="o", ms=4, lw=0.8, color=_DARK)
    if len(x):
        ends = np.array([min(x.min(), y.min()), max(x.max(), y.max())])
        ax.plot(ends, ends, color=_MIDDLE, lw=0.8, zorder=0)
    label = draw_literally(confirmation.problem.objectives[objective].label)
    ax.set(xlabel=f"re-simulated {label}", ylabel=f"predicted {label}")
    return ax


def make_figures(exploration: Exploration) -> dict[str, Figure]:
    """Return all figures of an exploration by name; the names are those of the files."""
    table, front = exploration.table, exploration.front
    problem = table.problem
    d, k = len(problem.variables), len(problem.objectives)
    figures: dict[str, Figure] = {}
    fixed = exploration.strategies["knee"].x
    for j, name in enumerate(problem.objective_names):
        figure, axes = _make_page(1, 1, 6.4, 5.4)
        draw_nested_contours(axes[0], exploration.surrogate.predict, problem, j, fixed)
        figures[f"contours_{name}"] = figure
    if k > 1:
        pairs = list(combinations(range(k), 2))[:_MAX_PANELS]
        figure, axes = _make_page(len(pairs), 3, 3.9, 4.3)
        marks = {str(i + 1): y for i, (_, y, _) in enumerate(exploration.references.values())}
        marks["K"] = exploration.strategies["knee"].y
        for ax, pair in zip(axes, pairs, strict=True):
            rest = [i for i in range(k) if i not in pair]
            draw_front(ax, front, pair, rest[0] if rest else None, table.Y, marks)
        axes[0].legend(fontsize=7.5, loc="best", framealpha=0.85)
        figures["pareto"] = figure
    pairs = list(combinations(range(d), 2))[:_MAX_PANELS]
    if pairs:
        figure, axes = _make_page(len(pairs), 3, 3.2, 2.9)
        for ax, pair in zip(axes, pairs, strict=True):
            draw_coverage(ax, table, pair)
        figure.legend(
            *axes[0].get_legend_handles_labels(),
            loc="outside upper center",
            ncols=2,
            frameon=False,
            fontsize=8,
        )
        figures["coverage"] = figure
    figure, axes = _make_page(k, 3, 3.7, 3.5)
    for ax, accuracy, objective in zip(axes, exploration.accuracy, problem.objectives, strict=True):
        draw_predicted(ax, accuracy, objective.label)
    figures["predicted"] = figure
    figure, axes = _make_page(k, 3, 3.7, 2.9)
    for ax, sensitivity in zip(axes, exploration.sensitivity, strict=True):
        draw_sensitivity(ax, sensitivity, [v.label for v in problem.variables])
    figures["sensitivity"] = figure
    learned = len(exploration.learning_sizes) > 1
    figure, axes = _make_page(1 + learned, 2, 4.4, 3.3)
    draw_convergence(axes[0], front)
    if learned:
        draw_learning(
            axes[1], exploration.learning_sizes, exploration.learning_nrmse, problem, exploration.accuracy
        )
    figures["convergence"] = figure
    if exploration.confirmation is not None:
        figure, axes = _make_page(k, 3, 3.7, 3.5)
        for j, ax in enumerate(axes):
            draw_confirmation(ax, exploration.confirmation, j)
        figures["confirmation"] = figure
    return figures


def save_figures(
    figures: dict[str, Figure], folder: Path, formats: Sequence[str] = ("png", "pdf")
) -> list[Path]:
    """Write every figure in every format into `folder`, which is made if needed; returns the paths."""
    make_folder(folder)
    paths = []
    for name, figure in figures.items():
        for suffix in formats:
            path = folder / f"{name}.{suffix}"
            # Dates and program versions would make equal figures differ.
            metadata = {"CreationDate": None} if suffix == "pdf" else {"Software": None}
            try:
                figure.savefig(path, dpi=150, metadata=metadata)
            except OSError as error:
                raise InputError(f"{path}: cannot be written: {error.strerror}") from None
            # Finding the places takes longer than drawing; they are the same in every format.
            figure.set_layout_engine("none")
            paths.append(path)
    return paths


def _make_page(n: int, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with n axes of the given size [inch]; matplotlib's global state is not touched."""
    columns = min(n, columns)
    rows = -(-n // columns)
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = [figure.add_subplot(rows, columns, i + 1) for i in range(n)]
    for ax in axes:
        ax.tick_params(labelsize=8)
        ax.xaxis.label.set_fontsize(9)
        ax.yaxis.label.set_fontsize(9)
    return figure, axes


def _set_ticks(ax: Axes, a: Variable, b: Variable, size: float) -> None:
    share = np.linspace(0.0, 1.0, 5)
    place = size * (share - 0.5)
    ax.set_xticks(place, [f"{a.low + s * _span(a):.3g}" for s in share])
    ax.set_yticks(place, [f"{b.low + s * _span(b):.3g}" for s in share])


def _span(variable: Variable) -> float:
    return variable.high - variable.low


def _styles(n: int) -> list[dict[str, Any]]:
    """Return line styles that differ in dash and lightness."""
    colours, dashes, markers = (_DARK, _ACCENT, _MIDDLE), ("-", "--", "-."), ("o", "s", "^", "v", "D")
    return [
        {"color": colours[i % 3], "ls": dashes[i % 3], "marker": markers[i % 5], "ms": 4} for i in range(n)
    ]
