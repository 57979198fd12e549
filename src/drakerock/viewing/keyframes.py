"""Thinning tracks of poses to the keyframes that a viewer needs to show them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def thin_keyframes(
    frames: NDArray[np.int64], poses: Array, reach: float, tolerance: float
) -> NDArray[np.int64]:
    """Return which keyframes of a track to keep, as `thin_tracks` finds them: indices into `frames`, in order."""
    starts = np.array([0, len(frames)])
    return np.flatnonzero(thin_tracks(starts, frames, poses, np.array([reach]), tolerance))


def thin_tracks(
    starts: NDArray[np.int64], frames: NDArray[np.int64], poses: Array, reach: Array, tolerance: float
) -> NDArray[np.bool_]:
    """Return which keyframes of tracks to keep (k,); the first and the last of each are among them.

    Between two keyframes a viewer moves the position along a straight line and the orientation at a constant rate.
    A keyframe is left out where this brings no point of the body farther than the tolerance from where it was.

    Args:
        starts: (n + 1,) where each track, of at least one keyframe, begins in the joined ones, and their number.
        frames: (k,) frame numbers, rising within a track.
        poses: (k, 7) unit quaternion (w, x, y, z) and position [m].
        reach: (n,) largest distance of each body's points from its origin [m].
        tolerance: [m].
    """
    poses = poses.copy()
    # q and -q are the same turn: each next to its forerunner.
    signs = np.ones(len(poses))
    signs[1:] = np.where(np.sum(poses[1:, :4] * poses[:-1, :4], axis=1) < 0.0, -1.0, 1.0)
    poses[:, :4] *= np.cumprod(signs)[:, None]
    first, last = starts[:-1], starts[1:] - 1
    keep = np.zeros(len(frames), bool)
    keep[first] = keep[last] = True
    # All spans of all tracks are split at once at what they miss most, until none misses anything.
    while True:
        long = last - first >= 2
        first, last, reach = first[long], last[long], reach[long]
        if len(first) == 0:
            return keep
        count = last - first - 1
        begin = np.cumsum(count) - count
        span = np.repeat(np.arange(len(first)), count)
        inner = np.arange(len(span)) - begin[span] + first[span] + 1
        share = (frames[inner] - frames[first[span]]) / (frames[last[span]] - frames[first[span]])
        between = interpolate_poses(poses[first[span]], poses[last[span]], share)
        distance = calc_distances(between, poses[inner], reach[span])
        largest = np.maximum.reduceat(distance, begin)
        at_largest = np.flatnonzero(distance == largest[span])
        worst = at_largest[np.unique(span[at_largest], return_index=True)[1]]
        split = largest > tolerance
        middle = inner[worst][split]
        keep[middle] = True
        first, last = np.concatenate([first[split], middle]), np.concatenate([middle, last[split]])
        reach = np.tile(reach[split], 2)


def calc_distances(poses: Array, others: Array, reach: float | Array) -> Array:
    """Return how far (k,) points within `reach` of the origin get apart between poses (k, 7), at most [m]."""
    same = np.linalg.norm(poses[:, :4] - others[:, :4], axis=1)
    opposite = np.linalg.norm(poses[:, :4] + others[:, :4], axis=1)
    # Quaternions d apart, of either sign, turn a point at distance r by about 2 d r.
    turn = 2.0 * reach * np.minimum(same, opposite)
    shift: Array = np.linalg.norm(poses[:, 4:] - others[:, 4:], axis=1)
    return shift + turn


def interpolate_poses(start: Array, end: Array, share: Array) -> Array:
    """Return the poses (k, 7) at shares (k,) in [0, 1] of the way between others, (7,) or (k, 7), as a viewer does."""
    start, end = np.atleast_2d(start), np.atleast_2d(end)
    angle = np.arccos(np.clip(np.sum(start[:, :4] * end[:, :4], axis=1), -1.0, 1.0))
    # Turns too small to divide by are made along a straight line.
    sine = np.where(angle < 1e-6, 1.0, np.sin(angle))
    before = np.where(angle < 1e-6, 1.0 - share, np.sin((1.0 - share) * angle) / sine)
    after = np.where(angle < 1e-6, share, np.sin(share * angle) / sine)
    turns = before[:, None] * start[:, :4] + after[:, None] * end[:, :4]
    return np.hstack([turns, start[:, 4:] + share[:, None] * (end[:, 4:] - start[:, 4:])])
