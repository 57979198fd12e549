"""A stored loading made by hand: twelve rocks, a box for a bucket, noise for signals."""

import json

import numpy as np

from drakerock.loading.plan_file import save_plan
from drakerock.loading.recording import Recording, Visual, save_recording
from drakerock.loading.scenario import Scenario
from drakerock.loading.signal_table import save_signals
from drakerock.rocks.config import SiteConfig
from tests.unit.loading.test_planning import make_wedge

COLUMNS = (
    "x_T", "y_T", "z_T", "bucket_load", "bucket_force_x", "bucket_force_z", "hinge_moment", "torque_wheels",
    "torque_boom", "torque_bucket", "v_F", "wheel_slip",
)  # fmt: skip
OUTCOME = {
    "status": "done", "reason": "s4 reached", "objectives": {"production": 800.0, "damage": 0.25, "debris": 120.0},
    "strategy": {"alpha": 1.1, "beta": 0.6, "gamma": 1.0, "kappa": 0.6}, "bucket_mass_kg": 8400.0,
    "loading_time_s": 6.0, "waypoint_times_s": [1.5, 3.0, 3.0, 6.0, 7.5], "plan": {"volume_wanted_m3": 8.8},
    "peak_push_force_N": 300e3, "mean_push_force_N": 150e3, "energy_J": 2e6,
    "events": [{"event": "slip", "time_s": 2.5, "duration_s": 0.5}],
}  # fmt: skip


def write_cycle(folder, plan, recording, changes=()):
    """Write the files of a loading; `changes` are of its outcome."""
    folder.mkdir(parents=True, exist_ok=True)
    save_plan(plan, make_wedge(), folder / "plan.json")
    time = np.arange(0, 8, 0.01)
    rng = np.random.default_rng(0)
    signals = {"time": time, "mode": np.minimum(time // 1.5, 5)}
    signals |= {name: 1e3 * rng.normal(size=len(time)) for name in COLUMNS}
    save_signals(signals, dict.fromkeys(signals, "1"), folder / "signals.parquet")
    save_recording(recording, folder / "recording.npz")
    (folder / "outcome.json").write_text(json.dumps(OUTCOME | dict(changes)))
    (folder / "scenario.json").write_text(Scenario().resolve().model_dump_json())
    return folder


def make_recording(heap, shapes):
    """Return five frames of a heap of rocks and a box that drives towards it."""
    box = np.array([[x, y, z] for x in (0, 1) for y in (-1, 1) for z in (0, 1)], np.float32)
    triangles = np.array([[0, 2, 6], [0, 6, 4], [1, 3, 7], [1, 7, 5]], np.int32)
    poses = np.tile(np.array([1, 0, 0, 0, -6.0, 0, 0.5], np.float32), (5, 1, 1))
    poses[:, 0, 4] += np.arange(5)
    n = len(heap)
    return Recording(
        times=np.arange(5) * 2.0,
        modes=np.arange(5),
        bodies=("bucket",),
        X_WBs=poses,
        visuals=(Visual(0, box, triangles, np.array([0.9, 0.7, 0.1, 1.0], np.float32)),),
        rock_shapes=tuple((shape.vertices, shape.triangles) for shape in shapes),
        rock_shape=heap.shape,
        rock_size=heap.size,
        rock_fixed=heap.fixed,
        X_WRs=np.hstack([heap.q_WRs, heap.p_WRs]),
        move_frame=np.array([1, 2, 3], np.int32),
        move_rock=np.array([4, n - 1, 4], np.int32),
        move_pose=np.array([[1, 0, 0, 0, -3.0, k, 1.0] for k in range(3)], np.float32),
        site=SiteConfig(drift_width=3.9),
        notes={},
    )
