"""Rocks and machine of a recording drawn flat, from the side or from above."""

from __future__ import annotations

import matplotlib
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drakerock.loading.recording import Recording

Array = NDArray[np.float64]

# Horizontal, vertical and depth axis of a view, and the depth's sign towards the eye.
VIEWS = {"side": (0, 2, 1, -1.0), "top": (0, 1, 2, 1.0)}

# The machine's side view keeps boom and cylinders, this far before the cut; side plates and wheels are farther out [m].
CORE = 0.6


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
    across, up, depth, towards_eye = VIEWS[view]
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
