"""Pictures of one loading cycle, from its stored files: plan, paths, forces, image sequences.

Functions of the form ``draw_x(ax, data) -> ax`` draw into the given Axes; `write_cycle_figures` reads a cycle's
folder and writes them all as PNG.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.transforms import blended_transform_factory
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drakerock.errors import InputError
from drakerock.files import read_json
from drakerock.loading.field import HeightField, PileProfile, calc_pile_profile
from drakerock.loading.plan import DigPlan
from drakerock.loading.plan_file import load_plan
from drakerock.loading.recording import Recording, load_recording
from drakerock.loading.signal_table import load_signals

Array = NDArray[np.float64]

WAYPOINTS = ("s0", "s1", "s2", "s3", "s4")
# Horizontal, vertical and depth axis of a view, and the depth's sign towards the eye.
_VIEWS = {"side": (0, 2, 1, -1.0), "top": (0, 1, 2, 1.0)}

# The machine's side view keeps boom and cylinders, this far before the cut; side plates and wheels are farther out [m].
CORE = 0.6
# So much of the void is shown [m].
BEHIND_BROW = 1.7


@dataclass(frozen=True, eq=False)
class StoredCycle:
    """A cycle's stored files, read.

    Attributes:
        outcome: outcome.json.
        scenario: scenario.json, the resolved configuration.
        plan: the dig plan; None if there was none.
        field: the height field it was made from.
        signals: columns (k,) of all steps.
        recording: the frames.
    """

    outcome: dict[str, Any]
    scenario: dict[str, Any]
    plan: DigPlan | None
    field: HeightField
    signals: dict[str, Array]
    recording: Recording


def load_cycle(folder: str | Path) -> StoredCycle:
    """Read what `drakerock load` wrote.

    Raises:
        InputError: a file is missing or cannot be read.
    """
    folder = Path(folder)
    plan, field = load_plan(folder / "plan.json")
    signals, _ = load_signals(folder / "signals.parquet")
    return StoredCycle(
        _read_object(folder / "outcome.json"),
        _read_object(folder / "scenario.json"),
        plan if isinstance(plan, DigPlan) else None,
        field,
        signals,
        load_recording(folder / "recording.npz"),
    )


def _read_object(path: Path) -> dict[str, Any]:
    data = read_json(path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a JSON object")
    return data


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


def draw_plan(ax: Axes, plan: DigPlan) -> Axes:
    """Draw a plan in the plane of x and z: the swept section, the tip's path and its waypoints."""
    ax.fill(*plan.swept.T, facecolor="C1", edgecolor="C1", alpha=0.25, lw=0)
    ax.plot(*np.vstack([plan.swept, plan.swept[:1]]).T, color="C1", lw=1.2, label="swept section")
    ax.plot(plan.x, plan.z, "k-", lw=1.8, label="planned tip path")
    _mark_waypoints(ax, plan)
    return ax


def draw_surface(ax: Axes, field: HeightField, y: float) -> Axes:
    """Draw the sensed surface of the slice nearest to `y` [m] as steps."""
    slice_ = int(np.argmin(np.abs(field.y - y)))
    edges = np.append(field.x - 0.5 * field.cell, field.x_end)
    ax.stairs(field.h[:, slice_], edges, color="C0", lw=1.8, label="sensed height")
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


def draw_scene(
    ax: Axes, recording: Recording, frame: int, view: str, *, y_cut: float = 0.0, machine: bool = True
) -> Axes:
    """Draw rocks and machine at a frame, from the side cut open along the drift, or from above.

    The side view looks along +y and leaves out whatever lies before the cut, so that the load in the bucket
    shows. Rocks are the darker, the farther from the eye.

    Args:
        ax: where to draw.
        recording: the cycle's.
        frame: index of the frame.
        view: ``side`` or ``top``.
        y_cut: where the side view cuts [m].
        machine: whether to draw it.
    """
    across, up, depth, towards_eye = _VIEWS[view]
    poses = calc_rock_poses(recording, frame)
    # Cut open along the drift; from above, what stands in the void would only set the greys.
    shown = np.flatnonzero(poses[:, 5] >= y_cut if view == "side" else poses[:, 4] < 0.6)
    R_WRs = Rotation.from_quat(poses[:, :4], scalar_first=True).as_matrix() if len(poses) else []
    polygons: list[Array] = []
    for rock in shown:
        vertices, _ = recording.rock_shapes[recording.rock_shape[rock]]
        flat = (recording.rock_size[rock] * vertices @ R_WRs[rock].T + poses[rock, 4:])[:, [across, up]]
        polygons.append(flat[ConvexHull(flat).vertices])
    nearness = towards_eye * poses[shown, 4 + depth]
    rank = np.argsort(np.argsort(nearness)) / max(len(shown) - 1, 1)
    colors = matplotlib.colormaps["Greys_r"](0.45 + 0.45 * rank)
    edges = np.tile([0.2, 0.2, 0.2, 1.0], (len(shown), 1))
    widths = np.full(len(shown), 0.25)
    if machine:
        for visual in recording.visuals:
            corners = _place_visual(recording, frame, visual.body, visual.vertices)[visual.triangles]
            middle = corners.mean(axis=1)
            if view == "side":
                kept = middle[:, 1] >= y_cut - CORE
                corners, middle = corners[kept], middle[kept]
            if len(corners) == 0:
                continue
            flats = corners[..., [across, up]]
            polygons += list(flats)
            nearness = np.concatenate([nearness, towards_eye * middle[:, depth]])
            tint = np.tile(visual.rgba.astype(float), (len(flats), 1))
            outlines = _find_outlines(flats)
            polygons += outlines
            # The bucket's outline shows through its load, other parts' where the part itself does.
            nearest = np.inf if recording.bodies[visual.body] == "bucket" else nearness[-len(flats) :].max()
            nearness = np.concatenate([nearness, np.full(len(outlines), nearest)])
            colors = np.vstack([colors, tint, np.zeros((len(outlines), 4))])
            edges = np.vstack([edges, tint, np.tile([0.0, 0.0, 0.0, 1.0], (len(outlines), 1))])
            widths = np.concatenate([widths, np.full(len(flats), 0.25), np.full(len(outlines), 0.7)])
    order = np.argsort(nearness, kind="stable")
    ax.add_collection(
        PolyCollection(
            [polygons[k] for k in order],
            facecolors=colors[order],
            edgecolors=edges[order],
            linewidths=widths[order],
        )
    )
    _draw_site(ax, recording, view)
    ax.set_aspect("equal")
    return ax


def _find_outlines(triangles: Array) -> list[Array]:
    """Return the outer outlines (k, 2) of flat triangles (m, 3, 2)."""
    flat = shapely.polygons(triangles)
    # Triangles seen edge-on have no area; half a millimetre more closes the seams between the others. (Their union on
    # a grid fails now and then.)
    wide = shapely.buffer(flat[shapely.area(flat) > 1e-5], 5e-4, join_style="mitre")
    union = shapely.buffer(shapely.union_all(wide), -5e-4, join_style="mitre")
    return [np.asarray(p.exterior.coords) for p in shapely.get_parts(union) if isinstance(p, shapely.Polygon)]


def calc_rock_poses(recording: Recording, frame: int) -> Array:
    """Return the rocks' poses (n, 7) at a frame: quaternion (w, x, y, z) and position in W [m]."""
    poses = np.array(recording.X_WRs, dtype=float)
    until = recording.move_frame <= frame
    # The rows are in the order of time, so that each rock keeps its latest.
    poses[recording.move_rock[until]] = recording.move_pose[until]
    return poses


def _place_visual(recording: Recording, frame: int, body: int, vertices: NDArray[np.float32]) -> Array:
    pose = recording.X_WBs[frame, body].astype(float)
    R_WB = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix()
    placed: Array = vertices.astype(float) @ R_WB.T + pose[4:]
    return placed


def _draw_site(ax: Axes, recording: Recording, view: str) -> None:
    site = recording.site
    half, height = 0.5 * site.drift_width, site.drift_height
    if view == "side":
        lean = np.tan(np.deg2rad(site.wall_lean_deg)) * (site.void_height - height)
        ax.plot([-site.drift_length, site.void_depth, site.void_depth], [0, 0, site.void_height], "k-", lw=1)
        ax.plot([-site.drift_length, 0, -lean], [height, height, site.void_height], "k-", lw=1)
    else:
        for y in (-half, half):
            ax.axhline(y, color="k", lw=1)
        ax.axvline(0.0, color="k", lw=1, ls="--")


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
        for view in _VIEWS:
            figures[view] = _make_sequence_figure(cycle, view)
    paths = []
    for name, figure in figures.items():
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
    draw_plan(ax, plan)
    draw_surface(ax, cycle.field, plan.y)
    site = cycle.recording.site
    ax.set_xlim(float(plan.swept[:, 0].min()) - 1.0, min(site.void_depth + 0.2, BEHIND_BROW))
    ax.set_ylim(-0.3, site.drift_height + 0.7)
    ax.set_xlabel("x [m]")
    ax.set_ylabel("z [m]")
    note = "" if plan.reached else ", the nearest that can be reached"
    ax.set_title(
        f"Plan at y = {plan.y:.2f} m: {plan.volume:.2f} of {plan.volume_wanted:.2f} m³{note}; "
        f"slope {np.rad2deg(plan.slope):.0f}°",
        loc="left", fontsize=11,
    )  # fmt: skip
    ax.legend(loc="upper left", fontsize=8)
    return figure


def make_preview_figure(field: HeightField, profile: PileProfile, plan: DigPlan | None) -> Figure:
    """Return a plan on a pile that is known by its height field only: from the side, and from above.

    Args:
        field: the pile as it is seen.
        profile: its curves.
        plan: what would be tried; None: there is none.
    """
    figure = Figure(figsize=(9, 9), layout="constrained")
    side, top = figure.subplots(2, 1)
    draw_height_field(top, field, profile, plan)
    side.set(xlabel="x [m]", ylabel="z [m]", aspect="equal")
    if plan is None:
        side.set_title("No plan", loc="left", fontsize=11)
        return figure
    draw_surface(side, field, plan.y)
    draw_plan(side, plan)
    side.axhline(0.0, color="k", lw=0.8)
    side.set_xlim(float(plan.x.min()) - 0.5, field.x_end + 0.2)
    note = "" if plan.reached else ", the nearest that can be reached"
    title = f"Plan at y = {plan.y:.2f} m: {plan.volume:.2f} of {plan.volume_wanted:.2f} m³{note}"
    side.set_title(title, loc="left", fontsize=11)
    side.legend(loc="upper left", fontsize=8)
    return figure


def _make_tip_path_figure(cycle: StoredCycle, plan: DigPlan) -> Figure:
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    ax = draw_tip_paths(figure.subplots(), plan, cycle.signals)
    ax.set_title("Bucket tip, planned and actual", loc="left", fontsize=11)
    return figure


def _make_histories_figure(cycle: StoredCycle) -> Figure:
    s, times = cycle.signals, cycle.outcome["waypoint_times_s"]
    tau_c = cycle.scenario["loading"]["performance"]["tau_c"]
    end = s["time"] <= (times[4] if times[4] is not None else s["time"][-1]) + 0.5
    t = s["time"][end]
    figure = Figure(figsize=(9.5, 9), layout="constrained")
    axes = figure.subplots(4, 1, sharex=True)
    forces = {
        "push, backwards": -s["bucket_force_x"][end] / 1e3,
        "load, downwards": -s["bucket_force_z"][end] / 1e3,
    }
    draw_history(axes[0], t, forces, "rocks on bucket [kN]", times)
    draw_history(axes[1], t, {"hinge": s["hinge_moment"][end] / 1e3}, "hinge moment [kN m]", times)
    axes[1].axhline(tau_c / 1e3, color="C3", ls="--", lw=1.2)
    axes[1].annotate(
        r"$\tau_c$", (1.0, tau_c / 1e3), xycoords=("axes fraction", "data"), xytext=(4, 0),
        textcoords="offset points", va="center", fontsize=10,
    )  # fmt: skip
    torques = {name: s[f"torque_{name}"][end] / 1e3 for name in ("wheels", "boom", "bucket")}
    draw_history(axes[2], t, torques, "motor torque [kN m]", times)
    speeds = {"machine": s["v_F"][end], "wheels": (s["v_F"] + s["wheel_slip"])[end]}
    draw_history(axes[3], t, speeds, "speed [m/s]", times)
    axes[3].set_xlabel("time [s]")
    return figure


def _make_sequence_figure(cycle: StoredCycle, view: str) -> Figure:
    frames = find_waypoint_frames(cycle)
    rows = (len(frames) + 1) // 2
    figure = Figure(figsize=(13, (2.9 if view == "side" else 3.4) * rows), layout="constrained")
    axes = figure.subplots(rows, 2, squeeze=False).ravel()
    for spare in axes[len(frames) :]:
        spare.set_axis_off()
    draw_image_sequence(list(axes[: len(frames)]), cycle, view, frames)
    return figure
