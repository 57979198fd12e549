"""Checks of axle loads, traction and breakout force, and of the motors' reach and speed."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import Box, Sphere
from pydrake.multibody.plant import CoulombFriction

from drakerock.lhd import names
from drakerock.lhd.checks.bench import Bench, CheckConfig, Obstacle, Record
from drakerock.lhd.checks.rows import CheckRow, bound, compare, require, scale
from drakerock.lhd.checks.trials import MARGIN, Trials, calc_carry_pose, place, set_angles
from drakerock.lhd.kinematics import (
    Kinematics,
    calc_bucket_range,
    calc_full_tilt,
    calc_joint_angles,
    calc_tip,
)

Array = np.ndarray


def check_balance(trials: Trials) -> list[CheckRow]:
    """Check axle loads against the lever rule, and that the standing machine stays."""
    bench = trials.make()
    plant, machine = bench.plant, bench.machine
    place(bench, x_tip=0.0, **calc_carry_pose(bench.kin))
    start = _find_chassis(bench)
    record = trials.run(bench, 2.0)
    loads = record.tyre_force[-1, :, 2]
    context = bench.plant_context
    weight = plant.CalcTotalMass(context, [machine.instance]) * 9.81
    front, rear = (
        np.mean([bench.get_body(w).EvalPoseInWorld(context).translation()[0] for w in pair])
        for pair in (names.WHEELS[:2], names.WHEELS[2:])
    )
    center = plant.CalcCenterOfMassPositionInWorld(context, [machine.instance])[0]
    share = (center - rear) / (front - rear)
    drift = float(np.linalg.norm(_find_chassis(bench) - start))
    sag = float(record.tip[0, 2] - record.tip[-1, 2])
    return [
        compare("load of the front axle", loads[:2].sum() / 1e3, "kN", share * weight / 1e3, 0.01),
        compare("load of the rear axle", loads[2:].sum() / 1e3, "kN", (1 - share) * weight / 1e3, 0.01),
        bound("chassis' drift in 2 s of standing", 1e3 * drift, "mm", 1.0),
        CheckRow("tip's sag in 2 s", 1e3 * sag, "mm"),
    ]


def _find_chassis(bench: Bench) -> Array:
    return bench.get_body("front_unit").EvalPoseInWorld(bench.plant_context).translation().copy()


def check_traction(trials: Trials) -> list[CheckRow]:
    """Check the push against a wall without friction."""
    kin = trials.kin
    pose = calc_carry_pose(kin)
    # A frictionless wall across the lip: it takes the push and no weight.
    size = 2 * kin.bucket_length
    wall = Obstacle(Box(size, 20.0, size), (size / 2 + 0.02, 0.0, size / 2 + 0.02), 0.0)
    bench = trials.make(obstacle=wall)
    place(bench, x_tip=0.0, **pose)
    # Not for long: motors that do not hold let the push lower the boom, and a bucket on the floor takes weight.
    record = trials.run(bench, 1.5, wheel=kin.wheel_speed)
    late = record.time > record.time[-1] - 0.5
    push = record.tyre_force[late, :, 0].sum(axis=1).mean()
    normal = record.tyre_force[late, :, 2].sum(axis=1).mean()
    friction = _calc_tyre_friction(bench, trials.checks)
    rates = [bench.get_rate(record, joint)[late].mean() for joint in names.WHEEL_JOINTS]
    efforts = [np.abs(record.effort[late, bench.get_column(j)]).max() for j in names.WHEEL_JOINTS]
    motor = bench.machine.wheel
    # Where the torque curve meets what the most loaded slipping tyre takes; a motor without that would stall.
    heaviest = record.tyre_force[late, :, 2].mean(axis=0).max()
    slip_rate = motor.find_rate(friction * heaviest * kin.wheel_radius)
    slipping = min(kin.wheel_speed, slip_rate or kin.wheel_speed)
    return [
        compare("traction against a wall", push / 1e3, "kN", friction * normal / 1e3, 0.02),
        CheckRow("traction the motors could hold", 4 * motor.effort / kin.wheel_radius / 1e3, "kN"),
        require("wheels slip before they stall: slowest wheel", float(min(rates)), "rad/s", 0.9 * slipping),
        bound(
            "wheels slip before they stall: largest torque",
            float(max(efforts)) / 1e3,
            "kNm",
            motor.effort / 1e3,
        ),
    ]


def _calc_tyre_friction(bench: Bench, checks: CheckConfig) -> float:
    wheel = bench.get_body(names.WHEELS[0])
    inspector = bench.scene_graph.model_inspector()
    geometry = bench.plant.GetCollisionGeometriesForBody(wheel)[0]
    material: CoulombFriction = inspector.GetProximityProperties(geometry).GetProperty(  # type: ignore[assignment]
        "material", "coulomb_friction"
    )
    mu = material.dynamic_friction()
    return float(2 * mu * checks.floor_friction / (mu + checks.floor_friction))


def check_breakout(trials: Trials) -> list[CheckRow]:
    """Check the tip's force of the curling bucket, chassis held and free."""
    held, free = (_measure_breakout(trials, hold_chassis) for hold_chassis in (True, False))
    return [
        compare(
            "breakout force, chassis held",
            held / 1e3,
            "kN",
            scale(trials.config.data.breakout_force, 1e-3),
            0.05,
        ),
        CheckRow("breakout force, chassis free", free / 1e3, "kN"),
    ]


def _measure_breakout(trials: Trials, hold_chassis: bool) -> float:
    """Return the vertical force [N] on a ball without friction that stalls the tip of the curling bucket."""
    kin = trials.kin
    pose = {"z_tip": 0.02 * kin.bucket_length, "psi": 0.0}
    angles = [float(angle) for angle in calc_joint_angles(kin, **pose)]
    x_tip = float(calc_tip(kin, 0.0, *angles)[0])
    radius = 0.02 * kin.bucket_length
    ball = Obstacle(Sphere(radius), (x_tip - radius / 2, 0.0, pose["z_tip"] + 5 * radius), 0.0)
    bench = trials.make(hold_chassis=hold_chassis, floor=not hold_chassis, obstacle=ball)
    if hold_chassis:
        set_angles(bench, *angles)
    else:
        place(bench, x_tip=x_tip, **pose)
    record = trials.run(bench, 1.2, bucket=-0.2 * kin.bucket_speed)
    stalled = record.time > record.time[-1] - 0.2
    torque = np.abs(record.effort[stalled, bench.get_column("bucket_joint")]).mean()
    # A check valve may keep more than the pump gives, up to the relief: that share is no breakout force.
    share = min(1.0, bench.machine.bucket.effort / float(torque))
    return float(-record.bucket_force[stalled, 2].mean()) * share


def check_lift(trials: Trials) -> list[CheckRow]:
    """Check that the boom lifts the payload to its stop."""
    kin = trials.kin
    bench = trials.make(payload=trials.payload)
    phi_l = float(calc_joint_angles(kin, 0.0, 0.0)[0])
    psi = float(calc_full_tilt(kin, phi_l)) - 2 * MARGIN
    z_tip = float(calc_tip(kin, 0.0, phi_l, kin.phi_level - phi_l - psi)[1])
    place(bench, x_tip=0.0, z_tip=z_tip, psi=psi)
    # The bucket turns against the boom and so keeps its pitch.
    rate = min(kin.boom_speed, kin.bucket_speed)
    span = kin.phi_l_range[1] - kin.phi_l_range[0]
    record = trials.run(bench, 1.2 * span / rate, boom=-rate, bucket=rate)
    # Past the start's jerk and before the stop.
    angles = record.q[:, bench.plant.GetJointByName("boom_joint").position_start()]
    moving = (record.time > 0.2) & (angles > kin.phi_l_range[0] + 2 * MARGIN)
    boom = np.abs(record.effort[moving, bench.get_column("boom_joint")]).max()
    rear = record.tyre_force[moving, 2:, 2].sum(axis=1).min()
    return [
        bound(
            f"boom lifts {trials.payload / 1e3:g} t: angle reached",
            float(np.degrees(angles.min())),
            "deg",
            float(np.degrees(kin.phi_l_range[0] + MARGIN)),
        ),
        bound("largest boom torque on the way", float(boom) / 1e3, "kNm", bench.machine.boom.effort / 1e3),
        require("smallest load of the rear axle on the way", float(rear) / 1e3, "kN", 0.0),
    ]


def check_motion(trials: Trials) -> list[CheckRow]:
    """Check the times of boom and bucket from end to end."""
    kin, rows = trials.kin, []
    low, high = kin.phi_l_range[1] - MARGIN, kin.phi_l_range[0] + MARGIN
    bench = trials.make()
    set_angles(bench, low, kin.phi_level - low)
    place(bench, x_tip=0.0, z_tip=_find_lowest_tip(kin), psi=0.0)
    rate = min(kin.boom_speed, kin.bucket_speed)
    start = bench.get_positions()[0]
    for name, sign, goal in (("raised", -1.0, high), ("lowered", 1.0, start)):
        # The bucket turns against the boom and so keeps level.
        nominal = abs(goal - bench.get_positions()[0]) / rate
        record = trials.run(bench, 1.3 * nominal, boom=sign * rate, bucket=-sign * rate)
        time = _find_time(bench, record, "boom_joint", goal)
        rows.append(compare(f"boom {name} with a level bucket", time, "s", nominal, 0.05))
        bench.run(0.5)
    bench = trials.make()
    place(bench, x_tip=0.0, z_tip=float(calc_tip(kin, 0.0, high, kin.phi_level - high)[1]), psi=0.0)
    tilt, dump = (float(angle) for angle in calc_bucket_range(kin, high))
    trials.run(bench, 1.3 * (bench.get_positions()[1] - tilt) / kin.bucket_speed, bucket=-kin.bucket_speed)
    for name, sign, goal in (("dumped", 1.0, dump - MARGIN), ("tilted back", -1.0, tilt + MARGIN)):
        nominal = abs(goal - bench.get_positions()[1]) / kin.bucket_speed
        record = trials.run(bench, 1.3 * nominal, bucket=sign * kin.bucket_speed)
        time = _find_time(bench, record, "bucket_joint", goal)
        rows.append(compare(f"bucket {name}, boom up", time, "s", nominal, 0.05))
    return rows


def _find_lowest_tip(kin: Kinematics) -> float:
    """Return a tip height just above the floor that the level bucket can take."""
    return max(0.02 * kin.bucket_length, float(calc_tip(kin, 0.0, kin.phi_l_range[1], 0.0)[1]))


def _find_time(bench: Bench, record: Record, joint: str, goal: float) -> float:
    """Return when the joint passed `goal` [s since the run's start]; infinite if it never did."""
    angles = record.q[:, bench.plant.GetJointByName(joint, bench.machine.instance).position_start()]
    passed = np.nonzero((angles - goal) * (angles[0] - goal) <= 0)[0]
    return float(record.time[passed[0]] - record.time[0]) if len(passed) else float("inf")
