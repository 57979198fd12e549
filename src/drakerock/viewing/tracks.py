"""The motion of a recording's bodies and rocks as few, small keyframes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drakerock.loading.recording import Recording
from drakerock.viewing.keyframes import calc_distances, thin_keyframes, thin_tracks

Array = NDArray[np.float64]
Track = tuple[NDArray[np.int64], Array]
"""Rising frame numbers (k,), and the poses (k, 7) there: quaternion (w, x, y, z), position in W [m]."""

# Below one pixel of a screen's width of drift; the recording's own threshold by default [m].
ROCK_TOLERANCE = 0.01
MACHINE_TOLERANCE = 0.002
# Rocks that never get farther than this from where they were are shown as still [m].
STILL_TOLERANCE = 0.02

_FULL = 32767  # of 16 bits


def make_body_tracks(recording: Recording) -> list[Track]:
    """Return the track of each of the machine's bodies."""
    frames = np.arange(len(recording.times))
    tracks = []
    for b in range(len(recording.bodies)):
        looks = [visual.vertices for visual in recording.visuals if visual.body == b]
        reach = float(np.linalg.norm(np.concatenate(looks), axis=1).max()) if looks else 1.0
        poses = recording.X_WBs[:, b].astype(float)
        chosen = thin_keyframes(frames, poses, reach, MACHINE_TOLERANCE)
        tracks.append((frames[chosen], poses[chosen]))
    return tracks


def make_rock_tracks(recording: Recording) -> dict[int, Track]:
    """Return the track of each rock that moves, by its number."""
    radii = np.array([np.linalg.norm(vertices, axis=1).max() for vertices, _ in recording.rock_shapes])
    order = np.argsort(recording.move_rock, kind="stable")
    rocks, begins = np.unique(recording.move_rock[order], return_index=True)
    full: dict[int, Track] = {}
    reach: dict[int, float] = {}
    for rock, rows in zip(rocks.tolist(), np.split(order, begins)[1:], strict=True):
        moved = recording.move_frame[rows].astype(np.int64)
        moved_poses = recording.move_pose[rows].astype(float)
        # A rock is recorded in the frames in which it moved: in others it stays where it was.
        held = np.flatnonzero(np.diff(moved, prepend=0) > 1)
        before = np.vstack([recording.X_WRs[rock], moved_poses[:-1]])
        frames = np.concatenate([[0], np.insert(moved, held, moved[held] - 1)])
        poses = np.vstack([recording.X_WRs[rock], np.insert(moved_poses, held, before[held], axis=0)])
        reach[rock] = float(radii[recording.rock_shape[rock]] * recording.rock_size[rock])
        if calc_distances(poses, poses[:1], reach[rock]).max() > STILL_TOLERANCE:
            full[rock] = (frames, poses)
    starts, frames, poses = join_tracks(list(full.values()))
    reaches = np.array([reach[rock] for rock in full])
    keep = thin_tracks(starts, frames, poses, reaches, ROCK_TOLERANCE)
    return {
        rock: (frames[first:last][keep[first:last]], poses[first:last][keep[first:last]])
        for rock, first, last in zip(full, starts[:-1], starts[1:], strict=True)
    }


@dataclass(frozen=True, eq=False)
class PoseGrid:
    """Poses as whole numbers of 16 bits.

    Attributes:
        unit: of the positions [m].
    """

    unit: float

    @classmethod
    def fit(cls, *poses: Array) -> PoseGrid:
        """Return the grid that holds all positions of poses (k, 7): 1 mm for places up to 33 m from the brow."""
        farthest = max((float(np.abs(part[:, 4:]).max()) for part in poses if len(part)), default=0.0)
        return cls(max(farthest, 1e-3) / _FULL)

    def round(self, poses: Array) -> NDArray[np.int16]:
        """Return poses (k, 7) on the grid: quaternions in units of 1 / 32767, positions in those of `unit`."""
        turns = poses[:, :4] / np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
        rounded = np.hstack([turns * _FULL, poses[:, 4:] / self.unit])
        return np.rint(rounded).astype(np.int16)


def join_tracks(tracks: list[Track]) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return where each track starts in the joined ones (n + 1,), and their frames (k,) and poses (k, 7)."""
    starts = np.cumsum([0, *(len(frames) for frames, _ in tracks)])
    frames = np.concatenate([np.zeros(0, np.int64), *(frames for frames, _ in tracks)])
    poses = np.concatenate([np.zeros((0, 7)), *(poses for _, poses in tracks)])
    return starts, frames, poses
