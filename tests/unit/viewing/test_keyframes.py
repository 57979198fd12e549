import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drakerock.viewing.keyframes import calc_distances, interpolate_poses, thin_keyframes

REACH = 0.5


def make_track(times, positions, turns):
    return np.hstack([turns.as_quat(scalar_first=True), positions(times[:, None])])


def play(frames, poses, at):
    """The poses at frames `at`, as a viewer shows them; quaternions turned to the shorter way as it does."""
    shown = []
    for frame in at:
        k = min(int(np.searchsorted(frames, frame, side="right")) - 1, len(frames) - 2)
        end = poses[k + 1].copy()
        if end[:4] @ poses[k, :4] < 0:
            end[:4] *= -1
        share = (frame - frames[k]) / (frames[k + 1] - frames[k])
        shown.append(interpolate_poses(poses[k], end, np.array([share]))[0])
    return np.array(shown)


def test_even_motion_needs_its_ends_only():
    times = np.linspace(0, 1, 101)
    poses = make_track(
        times, lambda t: t * [3.0, -1.0, 0.5], Rotation.from_rotvec(np.outer(times, [0, 0, 2.5]))
    )
    assert list(thin_keyframes(np.arange(101), poses, REACH, 1e-6)) == [0, 100]


def test_a_stop_keeps_its_keyframes():
    times = np.concatenate([np.zeros(50), np.linspace(0, 1, 51)])
    poses = make_track(times, lambda t: t * [1.0, 0, 0], Rotation.identity(101))
    assert list(thin_keyframes(np.arange(101), poses, REACH, 1e-6)) == [0, 50, 100]


@pytest.mark.parametrize("tolerance", [0.002, 0.01, 0.05])
def test_what_is_shown_stays_within_the_tolerance(tolerance):
    rng = np.random.default_rng(0)
    times = np.linspace(0, 1, 200)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.002, (200, 3)), axis=0))
    poses = make_track(times, lambda t: np.hstack([t**2, np.sin(9 * t), -4.9 * t**2]), turns)
    poses[::3, :4] *= -1  # the sign of a quaternion means nothing
    frames = np.arange(0, 400, 2)
    kept = thin_keyframes(frames, poses, REACH, tolerance)
    assert kept[0] == 0
    assert kept[-1] == 199
    assert len(kept) < 200
    shown = play(frames[kept], poses[kept], frames)
    assert calc_distances(shown, poses, REACH).max() <= tolerance + 1e-12


def test_distance_is_that_of_the_farthest_point():
    turns = Rotation.from_rotvec([[0, 0, 0], [0, 0, 0.01]])
    poses = make_track(np.zeros(2), lambda t: t * [1.0, 0, 0], turns)
    poses[1, 4:] = [0.0, 0.003, 0.0]
    assert calc_distances(poses[:1], poses[1:], REACH)[0] == pytest.approx(0.003 + REACH * 0.01, rel=1e-3)


def test_one_pose_is_one_keyframe():
    assert list(thin_keyframes(np.array([0]), np.array([[1.0, 0, 0, 0, 0, 0, 0]]), REACH, 0.01)) == [0]
