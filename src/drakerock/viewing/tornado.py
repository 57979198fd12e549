"""Tornado charts: what each variable changes of each objective, the largest on top."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drakerock.errors import InputError
from drakerock.exploration.one_at_a_time import Effect
from drakerock.exploration.problem import Objective

Describe = Callable[[str, float], str]
"""From a variable's name and value to what a person reads."""


def draw_tornado(ax: Axes, effects: Sequence[Effect], objective: Objective, describe: Describe) -> Axes:
    """Draw one objective's effects as bars from the centre's value, with one standard error of the change.

    Args:
        ax: where to draw.
        effects: of this objective and one block.
        objective: its name and unit.
        describe: of a variable's value.
    """
    ranked = sorted(effects, key=lambda effect: effect.size)
    for row, effect in enumerate(ranked):
        # A bar each, side by side: changes often go the same way.
        height = 0.8 / max(len(effect.changes), 1)
        for k, (value, change, error) in enumerate(
            zip(effect.values[1:], effect.changes, effect.errors, strict=True)
        ):
            below = value < effect.values[0]
            place = row - 0.4 + (k + 0.5) * height
            if not np.isfinite(change):
                ax.text(effect.centre, place, " no result", va="center", fontsize=7, color="0.5")
                continue
            ax.barh(
                place, change, left=effect.centre, height=0.9 * height, color="C0" if below else "C1", alpha=0.85,
                xerr=error if np.isfinite(error) else None, ecolor="0.3",
            )  # fmt: skip
            ax.annotate(
                describe(effect.variable, value), (effect.centre + change, place), fontsize=7, va="bottom",
                ha="left" if change >= 0 else "right", xytext=(3 if change >= 0 else -3, 0),
                textcoords="offset points",
            )  # fmt: skip
    centre = ranked[0].centre if ranked else 0.0
    ax.axvline(centre, color="k", lw=0.8)
    ax.set_yticks(
        range(len(ranked)),
        [f"{e.variable} ({describe(e.variable, e.values[0])})" for e in ranked],
        fontsize=8,
    )
    ax.margins(x=0.25)
    ax.set_xlabel(objective.label)
    return ax


def write_tornado(
    effects: Sequence[Effect],
    objectives: Sequence[Objective],
    describe: Describe,
    describe_block: Callable[[float], str],
    path: Path,
) -> None:
    """Write a chart for each block (a row) and objective (a column) as one PNG.

    Raises:
        InputError: the file cannot be written.
    """
    blocks = sorted({effect.block for effect in effects})
    n = max(len({effect.variable for effect in effects}), 1)
    figure = Figure(figsize=(5.2 * len(objectives), (0.42 * n + 1.2) * len(blocks)), layout="constrained")
    axes = figure.subplots(len(blocks), len(objectives), squeeze=False)
    for row, block in zip(axes, blocks, strict=True):
        for ax, objective in zip(row, objectives, strict=True):
            chosen = [e for e in effects if e.block == block and e.objective == objective.name]
            draw_tornado(ax, chosen, objective, describe)
            ax.set_title(describe_block(block), fontsize=9, loc="left")
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
