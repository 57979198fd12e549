"""Checks of what the bucket's hinge carries."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import Box

from drakerock.lhd.checks.bench import Obstacle
from drakerock.lhd.checks.rows import CheckRow, bound, compare, scale
from drakerock.lhd.checks.trials import Trials, calc_carry_pose, place, set_angles
from drakerock.lhd.kinematics import calc_joint_angles


def check_hinge(trials: Trials) -> list[CheckRow]:
    """Check the measured moment under a known load against statics."""
    kin = trials.kin
    bench = trials.make(hold_chassis=True, floor=False)
    angles = [float(angle) for angle in calc_joint_angles(kin, 0.3 * kin.bucket_length, 0.2)]
    set_angles(bench, *angles)
    p_BQ = np.array([*bench.bucket.profile[0], bench.bucket.outer_width / 2])[[0, 2, 1]]
    R_WB = bench.get_body("bucket").EvalPoseInWorld(bench.plant_context).rotation()
    weight = 9.81 * trials.payload
    force = weight * np.array([-0.5, 0.2, 0.7])
    bench.apply_force("bucket", p_BQ, force)
    record = trials.run(bench, 0.3)
    # Statics: the joint's reaction on the bucket balances the load about the hinge's mid-point.
    expected = -np.cross(p_BQ, R_WB.inverse().multiply(force))[[0, 2]]
    error = np.linalg.norm(record.moment[-1] - expected) / np.linalg.norm(expected)
    return [
        compare(
            "hinge moment under a known load at the corner",
            float(np.linalg.norm(record.moment[-1])) / 1e3,
            "kNm",
            float(np.linalg.norm(expected)) / 1e3,
            0.01,
        ),
        bound("  its vector's error", 100 * float(error), "%", 1.0),
    ]


def check_corner(trials: Trials) -> list[CheckRow]:
    """Measure the moment of a corner driven into a post."""
    kin = trials.kin
    half = trials.make().bucket.outer_width / 2
    size = 2 * kin.bucket_length
    # A post in the way of the bucket's left corner, a fifth of the half width inwards.
    post = Obstacle(
        Box(size, half, size), (size / 2 + 0.001, 1.3 * half, size / 2 + 0.02), trials.checks.floor_friction
    )
    bench = trials.make(obstacle=post)
    place(bench, x_tip=0.0, **calc_carry_pose(kin))
    record = trials.run(bench, 2.0, wheel=kin.wheel_speed)
    moment = np.linalg.norm(record.moment, axis=1) / 1e3
    late = record.time > record.time[-1] - 1.0
    expected = scale(trials.config.data.critical_moment, 1e-3)
    rule = "for comparison"
    return [
        CheckRow(
            "tau_c: corner at a post, full torque, steady", float(moment[late].mean()), "kNm", expected, rule
        ),
        CheckRow("tau_c: the same, largest", float(moment.max()), "kNm", expected, rule),
    ]
