"""What is written into a replay's page: poses, arrays, numbers."""

import base64
import gzip
import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drakerock.errors import InputError
from drakerock.viewing.keyframes import calc_distances, interpolate_poses
from drakerock.viewing.packing import pack
from drakerock.viewing.replay import compare_results, write_replay
from drakerock.viewing.results import calc_fill_per_kg, make_results, make_title
from drakerock.viewing.scene_figures import calc_rock_poses
from drakerock.viewing.stored_cycle import load_cycle
from drakerock.viewing.tracks import ROCK_TOLERANCE, STILL_TOLERANCE, PoseGrid, join_tracks, make_rock_tracks
from tests.cycle_files import write_cycle


@pytest.fixture
def tumbling(recording):
    """The recording with two rocks on their ways, one of them now and then at rest, and one that only trembles."""
    rng = np.random.default_rng(1)
    frames, rocks, poses = [], [], []
    times = np.arange(60) * 0.04
    for rock, step in ((3, 0.05), (7, 0.02), (9, 0.001)):
        pose = recording.X_WRs[rock].copy()
        for frame in range(1, 60):
            if rock == 7 and 20 <= frame < 35:
                continue
            turn = Rotation.from_rotvec(rng.normal(0, step, 3)) * Rotation.from_quat(
                pose[:4], scalar_first=True
            )
            pose = np.concatenate([turn.as_quat(scalar_first=True), pose[4:] + rng.normal(0, step, 3) / 3])
            if rock == 9:
                pose[4:] = recording.X_WRs[rock, 4:]
            frames.append(frame)
            rocks.append(rock)
            poses.append(pose)
    order = np.argsort(frames, kind="stable")
    return replace(
        recording,
        times=times,
        modes=np.zeros(60, np.int64),
        X_WBs=np.repeat(recording.X_WBs[:1], 60, axis=0),
        move_frame=np.array(frames, np.int32)[order],
        move_rock=np.array(rocks, np.int32)[order],
        move_pose=np.array(poses, np.float32)[order],
    )


def show(track, frame):
    frames, poses = track
    k = min(max(int(np.searchsorted(frames, frame, side="right")) - 1, 0), len(frames) - 2)
    share = np.clip((frame - frames[k]) / (frames[k + 1] - frames[k]), 0.0, 1.0)
    end = poses[k + 1] * np.where(np.arange(7) < 4, np.sign(poses[k + 1, :4] @ poses[k, :4]), 1.0)
    return interpolate_poses(poses[k], end, np.array([share]))[0]


def test_rocks_are_shown_where_they_were_recorded(tumbling):
    tracks = make_rock_tracks(tumbling)
    assert set(tracks) == {3, 7}, "what gets nowhere is still"
    for frame in range(60):
        recorded = calc_rock_poses(tumbling, frame)
        for rock, track in tracks.items():
            radius = (
                max(np.linalg.norm(v, axis=1).max() for v, _ in tumbling.rock_shapes)
                * tumbling.rock_size[rock]
            )
            assert (
                calc_distances(show(track, frame)[None], recorded[rock][None], radius)[0]
                <= ROCK_TOLERANCE + 1e-6
            )
    assert calc_distances(tumbling.X_WRs[9:10], calc_rock_poses(tumbling, 59)[9:10], 0.3)[0] < STILL_TOLERANCE


def test_grid_keeps_poses_to_its_unit():
    rng = np.random.default_rng(0)
    poses = np.hstack([rng.normal(size=(200, 4)), rng.uniform(-32.0, 12.0, (200, 3))])
    poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
    grid = PoseGrid.fit(poses)
    assert grid.unit < 0.001
    rounded = grid.round(poses)
    assert np.abs(rounded[:, 4:] * grid.unit - poses[:, 4:]).max() <= 0.5 * grid.unit + 1e-12
    assert np.abs(rounded[:, :4] / 32767 - poses[:, :4]).max() <= 0.5 / 32767 + 1e-12
    assert PoseGrid.fit(np.zeros((0, 7))).round(np.zeros((0, 7))).shape == (0, 7)


def test_joined_tracks_are_found_by_their_starts():
    tracks = [(np.array([0, 3]), np.ones((2, 7))), (np.array([0, 1, 9]), 2 * np.ones((3, 7)))]
    start, frames, poses = join_tracks(tracks)
    assert start.tolist() == [0, 2, 5]
    assert frames[start[1] : start[2]].tolist() == [0, 1, 9]
    assert poses[start[1] : start[2]].tolist() == tracks[1][1].tolist()
    assert join_tracks([])[0].tolist() == [0]


def test_packed_arrays_are_flat_by_columns_and_aligned():
    a, b = np.arange(6, dtype=np.int16).reshape(3, 2), np.array([1.5, np.nan])
    text = pack({"name": "<é>"}, {"a": a, "b": b})
    data = gzip.decompress(base64.b64decode(text))
    size = int.from_bytes(data[:8], "little")
    head, rest = json.loads(data[8 : 8 + size]), data[8 + size :]
    assert size % 8 == 0
    assert head["values"] == {"name": "<é>"}
    for name, flat in (("a", [0, 2, 4, 1, 3, 5]), ("b", [1.5, np.nan])):
        place = head["arrays"][name]
        assert place["offset"] % 8 == 0
        found = np.frombuffer(rest, place["type"], place["count"], place["offset"])
        assert np.array_equal(found, flat, equal_nan=True)
    assert pack({"name": "<é>"}, {"a": a, "b": b}) == text


def test_results_are_those_of_the_outcome(folder):
    cycle = load_cycle(folder)
    results = {result.key: result for result in make_results(cycle)}
    assert results["load"].value == 8.4
    assert results["payload_share"].show() == "40"  # of 21 t
    # 8.4 t of rock of 2500 kg/m^3, loose with 40 % air, in a bucket of 8.8 / 1.1 = 8 m^3.
    assert results["fill_factor"].value == pytest.approx(8400 / 2500 / 0.58 / 8.0)
    assert "8.40 t (40 % of payload) in 6.00 s, damage 0.2500" in make_title(cycle)
    assert make_title(cycle).startswith("alpha 1.1, beta 0.6, gamma 1, kappa 0.6")


def test_fill_factor_is_the_outcome_s_where_it_has_one(tmp_path, plan, recording):
    cycle = load_cycle(write_cycle(tmp_path, plan, recording, {"mining": {"fill_factor": 0.77}}))
    assert calc_fill_per_kg(cycle) * 8400.0 == pytest.approx(0.77)


def test_a_loading_without_a_load_has_dashes(tmp_path, plan, recording):
    nothing = {
        "reason": "no candidate slice",
        "objectives": {},
        "bucket_mass_kg": None,
        "loading_time_s": None,
        "plan": {"reason": "none"},
    }
    cycle = load_cycle(write_cycle(tmp_path, plan, recording, nothing))
    assert calc_fill_per_kg(cycle) is None
    assert {result.show() for result in make_results(cycle) if result.key in ("load", "damage")} == {"–"}
    assert make_title(cycle).endswith("no candidate slice")
    rows = compare_results(make_results(cycle), make_results(cycle))
    assert next(row for row in rows if row["key"] == "load")["difference"] == "–"
    assert next(row for row in rows if row["key"] == "push_peak")["difference"] == "+0"


def test_pages_of_a_sequence_lead_to_each_other(tmp_path, plan, recording):
    folders = [write_cycle(tmp_path / f"loading_0{k}", plan, recording) for k in range(2)]
    write_cycle(tmp_path / "loading_02", plan, recording, {"status": "failed"})
    pages = [write_replay(folder, loadings=4).read_text() for folder in [*folders, tmp_path / "loading_02"]]
    links = [[f"../loading_0{k}/replay.html" in page for k in range(4)] for page in pages]
    assert links == [[False, True, False, False], [True, False, True, False], [False, True, False, False]]
    # One page links nowhere else, and is the same when made again.
    assert "http" not in pages[0].split('<script type="text/plain" id="meshcat">')[0]
    assert write_replay(folders[0], loadings=4).read_text() == pages[0]


def test_page_that_cannot_be_written_is_named(folder):
    with pytest.raises(InputError, match="nowhere"):
        write_replay(folder, folder / "nowhere" / "replay.html")
