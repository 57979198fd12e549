"""Pictures of one loading cycle, from its stored files: plan, paths, forces, image sequences.

Functions of the form ``draw_x(ax, data) -> ax`` draw into the given Axes; `write_cycle_figures` reads a cycle's
folder and writes them all as PNG.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import blended_transform_factory
from numpy.typing import NDArray

from drakerock.errors import InputError
from drakerock.loading.field import HeightField, PileProfile, calc_pile_profile
from drakerock.loading.plan import DigPlan
from drakerock.loading.recording import Recording
from drakerock.viewing.histories import History, make_histories
from drakerock.viewing.results import make_title
from drakerock.viewing.scene_figures import VIEWS, draw_scene
from drakerock.viewing.stored_cycle import WAYPOINTS, StoredCycle, load_cycle

Array = NDArray[np.float64]

# So much of the void is shown [m].
BEHIND_BROW = 1.7


def draw_height_field(ax: Axes, field: HeightField, profile: PileProfile, plan: DigPlan | None) -> Axes:
    """Draw the height field from above, with front curve, centre-of-mass curve and entry point.

    Args:
        ax: where to draw.
        field: the sensed field.
        profile: its curves.
        plan: whose entry point and lane are marked.
    """
    half = 0.5 * field.cell
    extent = (field.x[0] - half, field.x[-1] + half, field.y[0] - half, field.y[-1] + half)
    picture = ax.imshow(
        field.h.T, origin="lower", extent=extent, cmap="Greys", vmin=0.0, vmax=1.4 * max(field.h.max(), 0.1)
    )
    # The darkest greys are left to the lines; the bar ends with the heights there are.
    bar = ax.figure.colorbar(picture, ax=ax, label="height h [m]", shrink=0.7)
    bar.ax.set_ylim(0.0, max(field.h.max(), 0.1))
    ax.plot(profile.x_front, profile.y, "-", color="C0", lw=2, label="front $x_f$")
    ax.plot(profile.x_mass, profile.y, "--", color="C3", lw=2, label="centre of mass $x_m$")
    if plan is not None:
        ax.axhline(plan.y, color="k", lw=0.8, ls=":")
        ax.plot(plan.waypoint_x[0], plan.y, "k>", ms=9, label="entry point")
    seen = profile.x_front[np.isfinite(profile.x_front)]
    ax.set_xlim((float(seen.min()) if len(seen) else -8.0) - 2.5, extent[1])
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("y [m]")
    ax.legend(loc="lower left", fontsize=8)
    return ax


def calc_cut(plan: DigPlan, field: HeightField, width: float) -> shapely.Geometry:
    """Return the pile that a plan cuts, in the plane of x and z: under the mean surface of the bucket's lane [m].

    Its area times the width is the plan's volume but for what the surface varies across the lane.

    Args:
        plan: the plan.
        field: what it was made from.
        width: of the bucket [m].
    """
    columns = shapely.box(
        field.x - 0.5 * field.cell, 0.0, field.x + 0.5 * field.cell, calc_lane(field, plan.y, width)
    )
    return shapely.union_all(shapely.intersection(columns, shapely.Polygon(plan.swept)))


def calc_lane(field: HeightField, y: float, width: float) -> Array:
    """Return the heights (nx,) averaged over a lane of some width about `y` [m]."""
    half = 0.5 * field.cell
    overlap = np.minimum(field.y + half, y + 0.5 * width) - np.maximum(field.y - half, y - 0.5 * width)
    weights = np.maximum(overlap, 0.0)
    return field.h @ (weights / weights.sum())


def calc_bucket_width(recording: Recording) -> float:
    """Return the bucket's width as it is seen [m]."""
    looks = [v.vertices[:, 1] for v in recording.visuals if recording.bodies[v.body] == "bucket"]
    return float(np.ptp(np.concatenate(looks)))


def draw_plan(ax: Axes, plan: DigPlan, cut: shapely.Geometry) -> Axes:
    """Draw a plan in the plane of x and z: the pile that is cut, the bucket's sweep, the tip's path, its waypoints."""
    for k, part in enumerate(part for part in shapely.get_parts(cut) if isinstance(part, shapely.Polygon)):
        ax.fill(
            *np.asarray(part.exterior.coords).T,
            fc="C1",
            ec="none",
            alpha=0.45,
            label=None if k else "pile cut",
        )
    ax.plot(*np.vstack([plan.swept, plan.swept[:1]]).T, color="C1", lw=1.0, ls="--", label="bucket's sweep")
    ax.plot(plan.x, plan.z, "k-", lw=1.8, label="planned tip path")
    _mark_waypoints(ax, plan)
    return ax


def draw_surface(ax: Axes, field: HeightField, heights: Array) -> Axes:
    """Draw heights (nx,) of the field's columns as steps."""
    edges = np.append(field.x - 0.5 * field.cell, field.x_end)
    ax.stairs(heights, edges, color="C0", lw=1.8, label="sensed height, mean over the bucket's width")
    return ax


def draw_tip_paths(ax: Axes, plan: DigPlan, signals: dict[str, Array]) -> Axes:
    """Draw the planned and the actual tip path from s0 on, in the plane of x and z."""
    on_path = (signals["mode"] >= 1) & (signals["mode"] <= 4)
    ax.plot(plan.x, plan.z, "-", color="0.6", lw=5, label="planned", solid_capstyle="round")
    ax.plot(signals["x_T"][on_path], signals["z_T"][on_path], "k-", lw=1.3, label="actual")
    _mark_waypoints(ax, plan)
    ax.axhline(0.0, color="k", lw=0.8)
    ax.set_aspect("equal")
    ax.set_xlabel("x [m]")
    ax.set_ylabel("z [m]")
    ax.margins(x=0.06, y=0.18)
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, fontsize=8, frameon=False)
    return ax


def _mark_waypoints(ax: Axes, plan: DigPlan) -> None:
    seen: dict[tuple[float, float], list[str]] = {}
    for name, x, z in zip(WAYPOINTS, plan.waypoint_x, plan.waypoint_z, strict=True):
        seen.setdefault((round(float(x), 2), round(float(z), 2)), []).append(name)
    for (x, z), names in seen.items():
        ax.plot(x, z, "o", color="k", mfc="w", ms=6, zorder=5)
        # s1 and s2 may be near each other: their labels go to different sides.
        side = -17 if names == ["s1"] else 5
        ax.annotate(
            ", ".join(names), (x, z), xytext=(side, 7), textcoords="offset points", fontsize=9, zorder=6,
            bbox={"boxstyle": "round,pad=0.1", "fc": "w", "ec": "none", "alpha": 0.8},
        )  # fmt: skip


def draw_history(
    ax: Axes,
    time: Array,
    lines: dict[str, Array],
    label: str,
    waypoint_times: Sequence[float | None],
) -> Axes:
    """Draw quantities over time with the waypoints' times; lines differ in shade and in dash.

    Args:
        ax: where to draw.
        time: (k,) [s].
        lines: (k,) each, by the name in the legend.
        label: of the vertical axis.
        waypoint_times: t0 to t4 [s], None where not passed.
    """
    styles = [("k", "-", 1.0), ("C1", "-", 1.6), ("C0", "--", 1.4)]
    for (name, values), (color, dash, width) in zip(lines.items(), styles, strict=False):
        ax.plot(time, values, color=color, ls=dash, lw=width, label=name)
    ax.set_ylabel(label)
    ax.margins(x=0.0)
    ax.grid(axis="y", color="0.9")
    above = blended_transform_factory(ax.transData, ax.transAxes)
    last = -np.inf
    for name, at in zip(WAYPOINTS, waypoint_times, strict=True):
        if at is None:
            continue
        ax.axvline(at, color="0.5", lw=0.8, ls=":")
        # Waypoints close in time share a line of text.
        ax.text(max(at, last + 0.03 * np.ptp(time)), 1.01, name, transform=above, fontsize=8, ha="center",
                va="bottom")  # fmt: skip
        last = max(at, last + 0.03 * np.ptp(time))
    if len(lines) > 1:
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8, frameon=False)
    return ax


def draw_image_sequence(
    axes: Sequence[Axes], cycle: StoredCycle, view: str, frames: Sequence[tuple[str, int]]
) -> None:
    """Draw the scene at several frames, one in each of the Axes.

    Args:
        axes: as many as frames.
        cycle: the stored cycle.
        view: ``side`` or ``top``.
        frames: title and index of each frame.
    """
    site = cycle.recording.site
    plan = cycle.plan
    bucket = cycle.recording.bodies.index("bucket")
    start = float(plan.waypoint_x[4]) - 4.5 if plan is not None else -12.0
    for ax, (title, frame) in zip(axes, frames, strict=True):
        # The cut goes through the bucket's middle, wherever the rocks have pushed it.
        y_cut = float(cycle.recording.X_WBs[frame, bucket, 5])
        draw_scene(ax, cycle.recording, frame, view, y_cut=y_cut)
        ax.set_title(f"{title}, {cycle.recording.times[frame]:.2f} s", fontsize=9, loc="left")
        if view == "side":
            ax.set_xlim(start, min(site.void_depth + 0.2, BEHIND_BROW))
            ax.set_ylim(-0.3, site.drift_height + 0.7)
            ax.set_ylabel("z [m]")
        else:
            ax.set_xlim(start, 0.5)
            ax.set_ylim(-0.5 * site.drift_width - 0.2, 0.5 * site.drift_width + 0.2)
            ax.set_ylabel("y [m]")
        ax.set_xlabel("x [m]")
        ax.label_outer()


def find_waypoint_frames(cycle: StoredCycle) -> list[tuple[str, int]]:
    """Return title and frame index of the start and of each waypoint; waypoints of one frame share it."""
    found: dict[int, list[str]] = {0: ["start"]}
    for name, time in zip(WAYPOINTS, cycle.outcome["waypoint_times_s"], strict=True):
        if time is not None:
            frame = int(np.argmin(np.abs(cycle.recording.times - time)))
            found.setdefault(frame, []).append(name)
    return [(", ".join(names), frame) for frame, names in sorted(found.items())]


def write_cycle_figures(folder: str | Path) -> list[Path]:
    """Write a stored cycle's pictures as PNG into its folder.

    ``figure_height_field.png``, and where there was a plan ``figure_plan.png``, ``figure_tip_path.png``,
    ``figure_histories.png``, ``figure_side.png`` and ``figure_top.png``.

    Returns:
        The paths written.

    Raises:
        InputError: a file of the cycle is missing, or the folder cannot be written.
    """
    folder = Path(folder)
    cycle = load_cycle(folder)
    figures = {"height_field": _make_height_field_figure(cycle)}
    if cycle.plan is not None:
        figures["plan"] = _make_plan_figure(cycle, cycle.plan)
        figures["tip_path"] = _make_tip_path_figure(cycle, cycle.plan)
        figures["histories"] = _make_histories_figure(cycle)
        for view in VIEWS:
            figures[view] = _make_sequence_figure(cycle, view)
    paths = []
    for name, figure in figures.items():
        figure.suptitle(make_title(cycle), fontsize=9, x=0.01, ha="left")
        path = folder / f"figure_{name}.png"
        try:
            figure.savefig(path, dpi=130)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        paths.append(path)
    return paths


def _make_height_field_figure(cycle: StoredCycle) -> Figure:
    figure = Figure(figsize=(8, 6), layout="constrained")
    front_height = cycle.scenario["loading"]["sensing"]["front_height"]
    profile = calc_pile_profile(cycle.field, front_height)
    ax = draw_height_field(figure.subplots(), cycle.field, profile, cycle.plan)
    ax.set_title("Sensed height field", loc="left", fontsize=11)
    return figure


def _make_plan_figure(cycle: StoredCycle, plan: DigPlan) -> Figure:
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    ax = figure.subplots()
    draw_scene(ax, cycle.recording, 0, "side", y_cut=plan.y, machine=False)
    width = calc_bucket_width(cycle.recording)
    cut = calc_cut(plan, cycle.field, width)
    draw_plan(ax, plan, cut)
    draw_surface(ax, cycle.field, calc_lane(cycle.field, plan.y, width))
    site = cycle.recording.site
    ax.set_xlim(float(plan.swept[:, 0].min()) - 1.0, min(site.void_depth + 0.2, BEHIND_BROW))
    ax.set_ylim(-0.3, site.drift_height + 0.7)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("z [m]")
    note = "" if plan.reached else ", the nearest that can be reached"
    ax.set_title(
        f"Plan at y = {plan.y:.2f} m, slope {np.rad2deg(plan.slope):.0f}°: cuts {plan.volume:.2f} of "
        f"{plan.volume_wanted:.2f} m³{note}\n(shaded: {cut.area:.2f} m² times {width:.2f} m)",
        loc="left", fontsize=10,
    )  # fmt: skip
    ax.legend(loc="upper left", fontsize=8)
    return figure


def make_preview_figure(
    field: HeightField, profile: PileProfile, plan: DigPlan | None, width: float
) -> Figure:
    """Return a plan on a pile that is known by its height field only: from the side, and from above.

    Args:
        field: the pile as it is seen.
        profile: its curves.
        plan: what would be tried; None: there is none.
        width: of the bucket [m].
    """
    # matplotlib's layout for axes of a fixed aspect.
    figure = Figure(figsize=(9, 9), layout="compressed")
    side, top = figure.subplots(2, 1)
    draw_height_field(top, field, profile, plan)
    side.set(xlabel="x [m]", ylabel="z [m]", aspect="equal")
    if plan is None:
        side.set_title("No plan", loc="left", fontsize=11)
        return figure
    draw_surface(side, field, calc_lane(field, plan.y, width))
    draw_plan(side, plan, calc_cut(plan, field, width))
    side.axhline(0.0, color="k", lw=0.8)
    side.set_xlim(float(plan.x.min()) - 0.5, field.x_end + 0.2)
    note = "" if plan.reached else ", the nearest that can be reached"
    title = f"Plan at y = {plan.y:.2f} m: {plan.volume:.2f} of {plan.volume_wanted:.2f} m³{note}"
    side.set_title(title, loc="left", fontsize=11)
    side.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=8, frameon=False)
    return figure


def _make_tip_path_figure(cycle: StoredCycle, plan: DigPlan) -> Figure:
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    ax = draw_tip_paths(figure.subplots(), plan, cycle.signals)
    ax.set_title("Bucket tip, planned and actual", loc="left", fontsize=11)
    return figure


def _make_histories_figure(cycle: StoredCycle) -> Figure:
    histories, times = make_histories(cycle), cycle.outcome["waypoint_times_s"]
    figure = Figure(figsize=(9.5, 10.5), layout="constrained")
    axes = figure.subplots(len(histories), 1, sharex=True)
    for ax, history in zip(axes, histories, strict=True):
        _draw_history_of(ax, cycle, history, times)
    axes[-1].set_xlabel("time [s]")
    return figure


def _draw_history_of(ax: Axes, cycle: StoredCycle, history: History, times: Sequence[float | None]) -> None:
    time = cycle.signals["time"]
    # Half a second more than the loading: the load rocks in the bucket.
    shown = time <= (times[4] if times[4] is not None else time[-1]) + 0.5
    lines = {name: values[shown] for name, values in history.lines.items()}
    draw_history(ax, time[shown], lines, f"{history.label} [{history.unit}]", times)
    if history.limit:
        name, level = history.limit
        ax.axhline(level, color="C3", ls="--", lw=1.2)
        ax.annotate(
            name, (1.0, level), xycoords=("axes fraction", "data"), xytext=(4, 0), textcoords="offset points",
            va="center", fontsize=9,
        )  # fmt: skip


def _make_sequence_figure(cycle: StoredCycle, view: str) -> Figure:
    frames = find_waypoint_frames(cycle)
    rows = (len(frames) + 1) // 2
    figure = Figure(figsize=(13, (2.9 if view == "side" else 3.4) * rows), layout="constrained")
    axes = figure.subplots(rows, 2, squeeze=False).ravel()
    for spare in axes[len(frames) :]:
        spare.set_axis_off()
    draw_image_sequence(list(axes[: len(frames)]), cycle, view, frames)
    return figure
