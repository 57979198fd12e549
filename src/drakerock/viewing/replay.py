"""From a recording to a self-contained HTML replay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Meshcat, MeshcatAnimation, MeshcatParams, Rgba
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from drakerock.errors import InputError
from drakerock.loading.recording import Recording
from drakerock.pile.config import SiteConfig

Array = NDArray[np.float64]

# Warm greys by size class, told apart by lightness alone; the floor is darker than any rock.
_ROCK_LIGHTNESS = (0.42, 0.78)
_MOVED_TINT = np.array([0.10, 0.04, -0.06])


def write_replay(recording: Recording, path: str | Path) -> None:
    """Write the replay as one HTML file that opens without a network.

    Rocks that never move are merged into one mesh per size; the others are animated. The camera shows the
    draw point from the side, the near wall and the roof are left out, and the animation plays with a time
    slider (Open Controls, Animations).

    Raises:
        InputError: the file cannot be written.
    """
    meshcat = Meshcat(MeshcatParams(show_stats_plot=False))
    _draw_site(meshcat, recording.site, _find_view_start(recording))
    for k, visual in enumerate(recording.visuals):
        body = f"machine/{visual.body}_{recording.bodies[visual.body]}"
        meshcat.SetTriangleMesh(f"{body}/{k}", visual.vertices.T, visual.triangles.T, Rgba(*visual.rgba))
    moving = np.unique(recording.move_rock)
    _draw_rocks(meshcat, recording, moving)

    rate = 1.0 / float(np.median(np.diff(recording.times))) if len(recording.times) > 1 else 25.0
    animation = MeshcatAnimation(frames_per_second=rate)
    for b, name in enumerate(recording.bodies):
        if not any(visual.body == b for visual in recording.visuals):
            continue
        last = None
        for frame in range(len(recording.times)):
            pose = recording.X_WBs[frame, b].astype(float)
            # A body that stands still needs its first and last keyframe only.
            if last is None or frame == len(recording.times) - 1 or np.abs(pose - last).max() > 1e-4:
                animation.SetTransform(frame, f"machine/{b}_{name}", _to_transform(pose))
                last = pose
    for rock in moving:
        _animate_rock(animation, recording, int(rock))
    animation.set_autoplay(True)
    animation.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    meshcat.SetAnimation(animation)
    _set_camera(meshcat, recording)
    try:
        Path(path).write_text(meshcat.StaticHtml(), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def _animate_rock(animation: MeshcatAnimation, recording: Recording, rock: int) -> None:
    rows = np.flatnonzero(recording.move_rock == rock)
    frames, poses = recording.move_frame[rows], recording.move_pose[rows].astype(float)
    path = f"rocks/moving/{rock}"
    animation.SetTransform(0, path, _to_transform(recording.X_WRs[rock]))
    previous_frame, previous = 0, recording.X_WRs[rock]
    for frame, pose in zip(frames, poses, strict=True):
        # The viewer interpolates between keyframes: a rock that rested needs one before it moves on.
        if frame > previous_frame + 1:
            animation.SetTransform(int(frame) - 1, path, _to_transform(previous))
        animation.SetTransform(int(frame), path, _to_transform(pose))
        previous_frame, previous = frame, pose


def _draw_rocks(meshcat: Meshcat, recording: Recording, moving: NDArray[np.int32]) -> None:
    sizes = np.unique(recording.rock_size)
    shade = dict(zip(sizes, np.linspace(*_ROCK_LIGHTNESS, len(sizes)), strict=True))
    is_moving = np.zeros(len(recording.rock_size), bool)
    is_moving[moving] = True
    for rock in np.flatnonzero(is_moving):
        vertices, triangles = recording.rock_shapes[recording.rock_shape[rock]]
        color = np.clip(np.array([1.0, 0.96, 0.9]) * shade[recording.rock_size[rock]] + _MOVED_TINT, 0, 1)
        meshcat.SetTriangleMesh(
            f"rocks/moving/{rock}", (recording.rock_size[rock] * vertices).T, triangles.T, Rgba(*color, 1.0)
        )
        meshcat.SetTransform(f"rocks/moving/{rock}", _to_transform(recording.X_WRs[rock]))
    for size in sizes:
        group = np.flatnonzero((recording.rock_size == size) & ~is_moving)
        if len(group) == 0:
            continue
        corners, faces, offset = [], [], 0
        for rock in group:
            vertices, triangles = recording.rock_shapes[recording.rock_shape[rock]]
            R_WR = Rotation.from_quat(recording.X_WRs[rock, :4], scalar_first=True).as_matrix()
            corners.append(size * vertices @ R_WR.T + recording.X_WRs[rock, 4:])
            faces.append(triangles + offset)
            offset += len(vertices)
        color = np.array([1.0, 0.96, 0.9]) * shade[size]
        meshcat.SetTriangleMesh(
            f"rocks/resting/{size:g}", np.concatenate(corners).T, np.concatenate(faces).T, Rgba(*color, 1.0)
        )


def _draw_site(meshcat: Meshcat, site: SiteConfig, x_start: float) -> None:
    """Draw floor, far wall, rear wall and the rock above the brow; the near wall would hide the machine."""
    half, end, height = 0.5 * site.drift_width, site.void_depth, site.drift_height
    floor = np.array([[x_start, -half, 0], [end, -half, 0], [end, half, 0], [x_start, half, 0]], float)
    far = np.array([[x_start, half, 0], [end, half, 0], [end, half, height], [x_start, half, height]], float)
    rear = np.array([[end, -half, 0], [end, half, 0], [end, half, height], [end, -half, height]], float)
    quads = np.array([[0, 1, 2], [0, 2, 3]])
    for name, corners, rgba in (
        ("floor", floor, Rgba(0.30, 0.29, 0.28)),
        ("far_wall", far, Rgba(0.45, 0.44, 0.43, 0.55)),
        ("rear_wall", rear, Rgba(0.38, 0.37, 0.36, 0.55)),
    ):
        # Both sides, so that a wall shows from wherever the camera is turned to.
        meshcat.SetTriangleMesh(f"site/{name}", corners.T, np.vstack([quads, quads[:, ::-1]]).T, rgba)
    lean = np.tan(np.deg2rad(site.wall_lean_deg)) * (site.void_height - height)
    brow = np.array([[x_start, half, height], [0, half, height], [-lean, half, site.void_height]], float)
    outline = np.vstack([brow, brow[::-1] * [1, -1, 1]])
    meshcat.SetLine("site/brow", outline.T, 2.0, Rgba(0.2, 0.2, 0.2))
    meshcat.SetProperty("/Background/<object>", "top_color", [0.93, 0.94, 0.96])
    meshcat.SetProperty("/Background/<object>", "bottom_color", [0.75, 0.76, 0.78])
    meshcat.SetProperty("/Grid/<object>", "visible", False)
    meshcat.SetProperty("/Axes/<object>", "visible", False)
    # Even light over a scene of tens of metres: the viewer's own lamps light one of a few metres.
    for lamp in ("PointLightNegativeX", "PointLightPositiveX", "SpotLight"):
        meshcat.SetProperty(f"/Lights/{lamp}/<object>", "intensity", 0.0)
    meshcat.SetProperty("/Lights/AmbientLight/<object>", "intensity", 1.3)
    meshcat.SetProperty("/Lights/FillLight/<object>", "intensity", 2.2)
    meshcat.SetProperty("/Lights/FillLight/<object>", "position", [-6.0, 14.0, 9.0])


def _find_view_start(recording: Recording) -> float:
    """Return the smallest x worth drawing: a little behind the machine's hindmost position."""
    return min(float(recording.X_WBs[:, :, 4].min()) - 7.0, -8.0)


def _set_camera(meshcat: Meshcat, recording: Recording) -> None:
    """Look at the draw point from the side, a little from above, with the digging in the middle."""
    target = np.array([-3.6, 0.0, 1.4])
    distance = 10.0
    meshcat.SetCameraPose(target + np.array([-0.1 * distance, -distance, 0.30 * distance]), target)


def _to_transform(pose: Array) -> RigidTransform:
    return RigidTransform(Quaternion(pose[:4] / np.linalg.norm(pose[:4])), pose[4:])
