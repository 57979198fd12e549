"""Thinning a track of poses to the keyframes that a viewer needs to show it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def thin_keyframes(
    frames: NDArray[np.int64], poses: Array, reach: float, tolerance: float
) -> NDArray[np.int64]:
    """Return which keyframes of a track to keep, in order; the first and the last are among them.

    Between two keyframes a viewer moves the position along a straight line and the orientation at a constant rate.
    A keyframe is left out where this brings no point of the body farther than the tolerance from where it was.

    Args:
        frames: (k,) rising frame numbers.
        poses: (k, 7) unit quaternion (w, x, y, z) and position [m].
        reach: largest distance of the body's points from its origin [m].
        tolerance: [m].

    Returns:
        Indices into `frames`.
    """
    poses = poses.copy()
    # q and -q are the same turn: each next to its forerunner.
    signs = np.where(np.sum(poses[1:, :4] * poses[:-1, :4], axis=1) < 0.0, -1.0, 1.0)
    poses[1:, :4] *= np.cumprod(signs)[:, None]
    keep = np.zeros(len(frames), bool)
    keep[[0, -1]] = True
    spans = [(0, len(frames) - 1)]
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        inner = slice(first + 1, last)
        share = (frames[inner] - frames[first]) / (frames[last] - frames[first])
        between = interpolate_poses(poses[first], poses[last], share)
        distance = calc_distances(between, poses[inner], reach)
        worst = int(np.argmax(distance))
        if distance[worst] > tolerance:
            middle = first + 1 + worst
            keep[middle] = True
            spans += [(first, middle), (middle, last)]
    return np.flatnonzero(keep)


def calc_distances(poses: Array, others: Array, reach: float) -> Array:
    """Return how far (k,) points within `reach` of the origin get apart between poses (k, 7), at most [m]."""
    same = np.linalg.norm(poses[:, :4] - others[:, :4], axis=1)
    opposite = np.linalg.norm(poses[:, :4] + others[:, :4], axis=1)
    # Quaternions d apart, of either sign, turn a point at distance r by about 2 d r.
    turn = 2.0 * reach * np.minimum(same, opposite)
    shift: Array = np.linalg.norm(poses[:, 4:] - others[:, 4:], axis=1)
    return shift + turn


def interpolate_poses(start: Array, end: Array, share: Array) -> Array:
    """Return the poses (k, 7) at shares (k,) in [0, 1] of the way from one (7,) to another, as a viewer shows them."""
    cosine = float(np.clip(start[:4] @ end[:4], -1.0, 1.0))
    angle = np.arccos(cosine)
    if angle < 1e-6:
        before, after = 1.0 - share, share
    else:
        before, after = np.sin((1.0 - share) * angle) / np.sin(angle), np.sin(share * angle) / np.sin(angle)
    turns = before[:, None] * start[:4] + after[:, None] * end[:4]
    return np.hstack([turns, start[4:] + share[:, None] * (end[4:] - start[4:])])
