"""From a recording to a self-contained HTML replay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Meshcat, MeshcatAnimation, MeshcatParams, Rgba
from pydrake.math import RigidTransform

from drakerock.loading.recording import Recording
from drakerock.viewing.scene import calc_rock_colors, draw_site, draw_still_rocks, write_scene

Array = NDArray[np.float64]

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
    draw_site(meshcat, recording.site, _find_view_start(recording))
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
    write_scene(meshcat, path)


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
    colors = calc_rock_colors(recording.rock_size)
    still = np.ones(len(recording.rock_size), bool)
    still[moving] = False
    for rock in np.flatnonzero(~still):
        vertices, triangles = recording.rock_shapes[recording.rock_shape[rock]]
        color = np.clip(colors[recording.rock_size[rock]] + _MOVED_TINT, 0, 1)
        meshcat.SetTriangleMesh(
            f"rocks/moving/{rock}", (recording.rock_size[rock] * vertices).T, triangles.T, Rgba(*color, 1.0)
        )
        meshcat.SetTransform(f"rocks/moving/{rock}", _to_transform(recording.X_WRs[rock]))
    draw_still_rocks(
        meshcat, "rocks/resting", recording.rock_shapes, recording.rock_shape[still], recording.rock_size[still],
        recording.X_WRs[still], colors,
    )  # fmt: skip


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
