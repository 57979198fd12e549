"""From a recording to a self-contained HTML replay."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import Meshcat, MeshcatAnimation, MeshcatParams, Rgba
from pydrake.math import RigidTransform

from drakerock.loading.recording import Recording
from drakerock.viewing.keyframes import calc_distances, thin_keyframes
from drakerock.viewing.scene import calc_rock_colors, draw_site, draw_still_rocks, write_scene

Array = NDArray[np.float64]

_MOVED_TINT = np.array([0.10, 0.04, -0.06])
# Below one pixel of a screen's width of drift; the recording's own threshold by default [m].
_ROCK_TOLERANCE = 0.01
_MACHINE_TOLERANCE = 0.002
# Rocks that never get farther than this from where they were are drawn as still [m].
_STILL_TOLERANCE = 0.02


def write_replay(recording: Recording, path: str | Path) -> None:
    """Write the replay as one HTML file that opens without a network.

    Rocks that don't move are merged into one mesh per size; the others are animated by as few keyframes as show
    their motion. The camera shows the draw point from the side, the near wall and the roof are left out, and the
    animation plays with a time slider (Open Controls, Animations).

    Raises:
        InputError: the file cannot be written.
    """
    meshcat = Meshcat(MeshcatParams(show_stats_plot=False))
    draw_site(meshcat, recording.site, _find_view_start(recording))
    for k, visual in enumerate(recording.visuals):
        body = f"machine/{visual.body}_{recording.bodies[visual.body]}"
        meshcat.SetTriangleMesh(f"{body}/{k}", visual.vertices.T, visual.triangles.T, Rgba(*visual.rgba))
    tracks = _make_rock_tracks(recording)
    _draw_rocks(meshcat, recording, np.array(sorted(tracks), np.int64))

    rate = 1.0 / float(np.median(np.diff(recording.times))) if len(recording.times) > 1 else 25.0
    animation = MeshcatAnimation(frames_per_second=rate)
    for b, name in enumerate(recording.bodies):
        looks = [visual.vertices for visual in recording.visuals if visual.body == b]
        if looks:
            frames, poses = np.arange(len(recording.times)), recording.X_WBs[:, b].astype(float)
            reach = float(np.linalg.norm(np.concatenate(looks), axis=1).max())
            chosen = thin_keyframes(frames, poses, reach, _MACHINE_TOLERANCE)
            _animate(animation, f"machine/{b}_{name}", frames[chosen], poses[chosen])
    for rock, (frames, poses) in tracks.items():
        _animate(animation, f"rocks/moving/{rock}", frames, poses)
    animation.set_autoplay(True)
    animation.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
    meshcat.SetAnimation(animation)
    _set_camera(meshcat, recording)
    write_scene(meshcat, path)


def _make_rock_tracks(recording: Recording) -> dict[int, tuple[NDArray[np.int64], Array]]:
    """Return the keyframes (k,) and poses (k, 7) of each rock that moves."""
    radii = np.array([np.linalg.norm(vertices, axis=1).max() for vertices, _ in recording.rock_shapes])
    order = np.argsort(recording.move_rock, kind="stable")
    rocks, starts = np.unique(recording.move_rock[order], return_index=True)
    tracks = {}
    for rock, rows in zip(rocks.tolist(), np.split(order, starts)[1:], strict=True):
        moved, moved_poses = (
            recording.move_frame[rows].astype(np.int64),
            recording.move_pose[rows].astype(float),
        )
        # A rock is recorded in the frames in which it moved: in others it stays where it was.
        held = np.flatnonzero(np.diff(moved, prepend=0) > 1)
        before = np.vstack([recording.X_WRs[rock], moved_poses[:-1]])
        frames = np.concatenate([[0], np.insert(moved, held, moved[held] - 1)])
        poses = np.vstack([recording.X_WRs[rock], np.insert(moved_poses, held, before[held], axis=0)])
        reach = float(radii[recording.rock_shape[rock]] * recording.rock_size[rock])
        chosen = thin_keyframes(frames, poses, reach, _ROCK_TOLERANCE)
        if calc_distances(poses, np.broadcast_to(poses[0], poses.shape), reach).max() > _STILL_TOLERANCE:
            tracks[rock] = (frames[chosen], poses[chosen])
    return tracks


def _animate(animation: MeshcatAnimation, path: str, frames: NDArray[np.int64], poses: Array) -> None:
    for frame, pose in zip(frames.tolist(), poses, strict=True):
        animation.SetTransform(frame, path, _to_transform(pose))


def _draw_rocks(meshcat: Meshcat, recording: Recording, moving: NDArray[np.int64]) -> None:
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
