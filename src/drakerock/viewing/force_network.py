"""The force network of a pile: which rocks carry which load."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from drakerock.rocks.state import PileState


def draw_force_network(
    ax: Axes, pile: PileState, time_step: float, *, half_width: float = 0.6, reference: float | None = None
) -> Axes:
    """Draw the contact forces of a slice along the drift as lines between the rocks' centres, in side view.

    Lines are as wide and as dark as their forces are large; dots are the rocks.

    Args:
        ax: where to draw.
        pile: with its contacts.
        time_step: of the simulation that the contacts come from [s]; force = impulse / time step.
        half_width: rocks with |y| up to this are shown [m].
        reference: force drawn with the full width [N]; the 99th percentile of those shown if not given.

    Raises:
        ValueError: the pile holds no contacts.
    """
    if pile.contacts is None or len(pile.contacts.pairs) == 0:
        raise ValueError("the pile holds no contacts")
    shown = np.abs(pile.p_WRs[:, 1]) <= half_width
    first, second = pile.contacts.pairs.T
    inner = second >= 0
    # A pair's points act together.
    keys, number = np.unique(first[inner] * len(pile) + second[inner], return_inverse=True)
    sums = np.zeros((len(keys), 3))
    np.add.at(sums, number, pile.contacts.impulses[inner] / time_step)
    a, b = keys // len(pile), keys % len(pile)
    visible = shown[a] & shown[b]
    forces = np.linalg.norm(sums[visible], axis=1)
    lines = np.stack([pile.p_WRs[a[visible]][:, [0, 2]], pile.p_WRs[b[visible]][:, [0, 2]]], axis=1)
    full = reference if reference is not None else float(np.percentile(forces, 99)) if len(forces) else 1.0
    share = np.clip(forces / full, 0.0, 1.0)
    order = np.argsort(share)
    places = pile.p_WRs[shown]
    ax.scatter(places[:, 0], places[:, 2], s=40.0 * pile.size[shown] ** 2, color="0.85", zorder=1)
    colors = [(0.0, 0.0, 0.0, 0.15 + 0.85 * value) for value in share[order]]
    widths = 0.2 + 4.0 * share[order]
    ax.add_collection(LineCollection(list(lines[order]), linewidths=widths, colors=colors, zorder=2))
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("z [m]")
    ax.set_title(f"contact forces, |y| < {half_width:g} m; full width {full / 1e3:.0f} kN")
    return ax
