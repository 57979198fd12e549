"""From a stored loading to a page that replays it, alone or beside another one."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from numpy.typing import NDArray
from pydrake.common import FindResourceOrThrow

from drakerock.files import write_text
from drakerock.loading.folder import REPLAY
from drakerock.loading.recording import Recording
from drakerock.viewing.histories import make_histories
from drakerock.viewing.packing import compress, pack
from drakerock.viewing.results import Result, calc_fill_per_kg, make_results
from drakerock.viewing.scene import calc_moved_colors, calc_rock_colors
from drakerock.viewing.stored_cycle import WAYPOINTS, StoredCycle, load_cycle
from drakerock.viewing.tracks import PoseGrid, join_tracks, make_body_tracks, make_rock_tracks

Array = NDArray[np.float64]

# So much of the void is in the picture [m].
_BEHIND_BROW = 1.5
# So much of the machine is in the picture when the tip enters the pile [m].
_BEHIND_TIP = 4.5


def write_replay(folder: str | Path, path: Path | None = None, *, loadings: int = 1) -> Path:
    """Write a stored loading's replay, one page that opens without a network; return its path.

    Args:
        folder: of the loading, as `save_cycle` left it.
        path: of the page; replay.html in the loading's folder if None.
        loadings: how many the sequence has, if the folder is one of a sequence (loading_00, ...): the page leads to
            its neighbours.

    Raises:
        InputError: a file is missing or cannot be read, or the page cannot be written.
    """
    cycle = load_cycle(folder)
    run = _make_run(cycle) | _find_neighbours(cycle, loadings)
    path = path or cycle.folder / REPLAY
    _write_page(path, f"drakerock: {run['name']}", [run], [])
    return path


def write_comparison(folders: Sequence[str | Path], path: Path) -> list[dict[str, str]]:
    """Write a page that replays two stored loadings beside each other; return its table, see `compare_results`.

    Raises:
        InputError: a file is missing or cannot be read, or the page cannot be written.
    """
    cycles = [load_cycle(folder) for folder in folders]
    runs = [_make_run(cycle) for cycle in cycles]
    title = f"drakerock: {runs[0]['name']} and {runs[1]['name']}"
    rows = compare_results(*(make_results(cycle) for cycle in cycles))
    _write_page(path, title, runs, rows)
    return rows


def compare_results(first: Sequence[Result], second: Sequence[Result]) -> list[dict[str, str]]:
    """Return a row for each number of two loadings: key, label, unit, a, b, and the difference b - a, as text."""
    rows = []
    for a, b in zip(first, second, strict=True):
        known = a.value is not None and b.value is not None
        difference = f"{b.value - a.value:+.{a.digits}f}" if known else "–"  # type: ignore[operator]
        row = {"key": a.key, "label": a.label, "unit": a.unit, "a": a.show(), "b": b.show()}
        rows.append(row | {"difference": difference})
    return rows


def _write_page(path: Path, title: str, runs: list[dict[str, Any]], rows: list[dict[str, str]]) -> None:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("drakerock.viewing", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template("replay.html.jinja").render(
        title=title,
        runs=runs,
        rows=rows,
        meshcat=_read_meshcat(),
        **{
            name: files("drakerock.viewing").joinpath(file).read_text(encoding="utf-8")
            for name, file in (("style", "page.css"), ("script", "page.js"))
        },
    )
    write_text(path, page)


@cache
def _read_meshcat() -> str:
    """Return Drake's Meshcat, the viewer's JavaScript, compressed."""
    return compress(Path(FindResourceOrThrow("drake/geometry/meshcat.js")).read_bytes())


def _make_run(cycle: StoredCycle) -> dict[str, Any]:
    """Return what a page needs of a cycle: what is written in its corner, and its packed data."""
    results = {result.key: result for result in make_results(cycle)}
    corner = [
        results[key]
        for key in ("load", "payload_share", "fill_factor", "time", "production", "damage", "debris")
    ]
    said = {"load": "bucket load", "payload_share": "", "fill_factor": "fill factor", "time": "in"}
    numbers = ", ".join(
        " ".join(filter(None, (said.get(r.key, r.label), r.show(), r.unit)))
        for r in corner
        if r.value is not None
    )
    return {
        "name": cycle.folder.resolve().name,
        "strategy": ", ".join(f"{name} {value:g}" for name, value in cycle.outcome["strategy"].items()),
        "result": f"{cycle.outcome['reason']}: {numbers}" if numbers else cycle.outcome["reason"],
        "data": _pack_cycle(cycle),
        "previous": "",
        "next": "",
    }


def _find_neighbours(cycle: StoredCycle, loadings: int) -> dict[str, str]:
    """Return the addresses of the pages of the loadings before and after this one in its sequence, "" for none."""
    place = re.fullmatch(r"loading_(\d+)", cycle.folder.resolve().name)
    if not place:
        return {}
    number = int(place[1])
    # A failed loading is its sequence's last.
    later = number + 1 < loadings and cycle.outcome["status"] != "failed"
    return {
        "previous": f"../loading_{number - 1:02d}/{REPLAY}" if number else "",
        "next": f"../loading_{number + 1:02d}/{REPLAY}" if later else "",
    }


def _pack_cycle(cycle: StoredCycle) -> str:
    recording = cycle.recording
    rock_tracks = make_rock_tracks(recording)
    moving = np.array(sorted(rock_tracks), np.int64)
    body_start, body_frame, body_pose = join_tracks(make_body_tracks(recording))
    rock_start, rock_frame, rock_pose = join_tracks([rock_tracks[rock] for rock in moving.tolist()])
    grid = PoseGrid.fit(body_pose, rock_pose, recording.X_WRs)
    track_of_rock = np.full(len(recording.rock_size), -1, np.int16 if len(moving) < 32768 else np.int32)
    track_of_rock[moving] = np.arange(len(moving))
    histories = make_histories(cycle)
    s = cycle.signals
    values = {
        "bodies": recording.bodies,
        "visuals": [
            {
                "body": visual.body,
                "vertices": np.round(visual.vertices.astype(float), 4).ravel().tolist(),
                "triangles": visual.triangles.ravel().tolist(),
                "rgba": np.round(visual.rgba.astype(float), 3).tolist(),
            }
            for visual in recording.visuals
        ],
        "rock_shapes": [
            {"vertices": np.round(vertices, 4).tolist(), "triangles": triangles.tolist()}
            for vertices, triangles in recording.rock_shapes
        ],
        "moving": moving.tolist(),
        "unit": grid.unit,
        "site": _describe_site(recording),
        "focus": _find_focus(cycle),
        "histories": [
            {"key": h.key, "label": h.label, "unit": h.unit, "lines": list(h.lines), "limit": h.limit}
            for h in histories
        ],
        "fill_per_t": None if (fill := calc_fill_per_kg(cycle)) is None else 1e3 * fill,
        "ticks": [
            (name, time)
            for name, time in zip(WAYPOINTS, cycle.outcome["waypoint_times_s"], strict=True)
            if time is not None
        ],
        "events": [(item["event"], item["time_s"]) for item in cycle.outcome["events"]],
    } | _describe_paths(cycle)
    arrays: dict[str, NDArray[Any]] = {
        "times": recording.times,
        "body_start": body_start.astype(np.uint32),
        "body_frame": body_frame.astype(np.uint16),
        "body_pose": grid.round(body_pose),
        "rock_start": rock_start.astype(np.uint32),
        "rock_frame": rock_frame.astype(np.uint16),
        "rock_pose": grid.round(rock_pose),
        "rock_rest": grid.round(recording.X_WRs),
        "rock_shape": recording.rock_shape.astype(np.uint16),
        "rock_size": recording.rock_size.astype(np.float32),
        "rock_color": _calc_colors(recording, moving),
        "track_of_rock": track_of_rock,
        "step_times": s["time"],
        "modes": s["mode"].astype(np.uint8),
    }
    arrays |= {f"line_{name}": line.astype(np.float32) for h in histories for name, line in h.lines.items()}
    return pack(values, arrays)


def _calc_colors(recording: Recording, moving: NDArray[np.int64]) -> NDArray[np.uint8]:
    still, moved = calc_rock_colors(recording.rock_size), calc_moved_colors(recording.rock_size)
    colors = np.array([still[size] for size in recording.rock_size]).reshape(-1, 3)
    colors[moving] = np.array([moved[size] for size in recording.rock_size[moving]]).reshape(-1, 3)
    return np.rint(255 * colors).astype(np.uint8)


def _describe_site(recording: Recording) -> dict[str, Any]:
    site = recording.site
    half, roof = 0.5 * site.drift_width, site.drift_height
    lean = float(np.tan(np.deg2rad(site.wall_lean_deg)) * (site.void_height - roof))
    start = max(float(recording.X_WBs[:, :, 4].min()) - 7.0, -float(site.drift_length))
    brow = [[start, half, roof], [0, half, roof], [-lean, half, site.void_height]]
    near = [[x, -y, z] for x, y, z in reversed(brow)]
    return {
        "start": start,
        "end": site.void_depth,
        "roof": roof,
        "drift_width": site.drift_width,
        "brow": brow + near,
    }


def _find_focus(cycle: StoredCycle) -> dict[str, list[float]]:
    """Return the box that cameras show: the machine's front and the pile from where the tip enters to the brow."""
    recording, site = cycle.recording, cycle.recording.site
    bucket = recording.bodies.index("bucket") if "bucket" in recording.bodies else 0
    entry = (
        float(cycle.plan.waypoint_x[0])
        if cycle.plan is not None
        else float(recording.X_WBs[:, bucket, 4].min())
    )
    half = min(0.5 * site.drift_width, 1.6)
    y = cycle.plan.y if cycle.plan is not None else 0.0
    low = [entry - _BEHIND_TIP, y - half, 0.0]
    high = [min(site.void_depth, _BEHIND_BROW), y + half, site.drift_height]
    return {"low": low, "high": high}


def _describe_paths(cycle: StoredCycle) -> dict[str, Any]:
    """Return the tip's planned and actual path as [x y z x y z ...] [m], the latter's times, and the waypoints."""
    plan, s = cycle.plan, cycle.signals
    if plan is None:
        return {"y": 0.0, "planned": None, "waypoints": [], "actual": None, "actual_times": []}
    on_path = np.flatnonzero((s["mode"] >= 1) & (s["mode"] <= 4))[::4]
    planned = np.column_stack([plan.x, np.full(len(plan.x), plan.y), plan.z])
    planned = planned[np.append(np.any(np.diff(planned, axis=0) != 0, axis=1), True)]
    actual = np.column_stack([s[name][on_path] for name in ("x_T", "y_T", "z_T")])
    waypoints = zip(WAYPOINTS, plan.waypoint_x, plan.waypoint_z, strict=True)
    return {
        "y": plan.y,
        "planned": np.round(planned, 3).ravel().tolist(),
        "waypoints": [(name, round(float(x), 3), plan.y, round(float(z), 3)) for name, x, z in waypoints],
        "actual": np.round(actual, 3).ravel().tolist(),
        "actual_times": np.round(s["time"][on_path], 3).tolist(),
    }
