"""The machine on the bench: rolling, steering, standing, the hinge's moment, determinism."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import Box
from pydrake.math import RollPitchYaw

from drakerock.lhd.checks.bench import Bench, CheckConfig, Obstacle, make_bench
from drakerock.lhd.config import FunctionConfig, MachineConfig, WheelConfig
from drakerock.lhd.kinematics import calc_bucket_range, calc_joint_angles, calc_joint_rates, calc_tip
from drakerock.lhd.placement import set_machine_angles, set_machine_pose


def make(config: MachineConfig | None = None, **options) -> Bench:
    return make_bench(config or MachineConfig(), CheckConfig(), **options)


def place(bench: Bench, **pose) -> None:
    set_machine_pose(bench.plant, bench.plant_context, bench.machine, kin=bench.kin, **pose)


def get_heading(bench: Bench) -> tuple[np.ndarray, float]:
    X_WF = bench.get_body("front_unit").EvalPoseInWorld(bench.plant_context)
    return X_WF.translation().copy(), RollPitchYaw(X_WF.rotation()).yaw_angle()


def test_rolls_straight_at_its_wheels_speed():
    """Rolling is clean: speed r_w omega within 0.5 %, no bounce, no drift sideways, no noise in the hinge."""
    bench = make()
    place(bench, x_tip=0.0, z_tip=0.2)
    bench.run(1.0, wheel=1.3)
    start, _ = get_heading(bench)
    record = bench.run(4.0, wheel=1.3)
    end, yaw = get_heading(bench)
    assert (end - start)[0] == pytest.approx(4.0 * 1.3, rel=5e-3)
    assert abs(end[1]) < 1e-3
    assert abs(yaw) < 1e-3
    assert np.std(record.tyre_force[:, :, 2], axis=0).max() < 0.01 * record.tyre_force[:, :, 2].mean()
    assert np.abs(record.moment).max() < 1e3


def test_slides_on_its_pads_quietly():
    """Bucket on the floor: the pads carry it, the front wheels keep their load, the hinge stays quiet."""
    bench = make()
    place(bench, x_tip=0.0)
    bench.run(1.0, wheel=1.0)
    record = bench.run(3.0, wheel=1.0)
    assert record.tip[:, 2].min() > -2e-3
    assert record.tip[:, 2].max() < 2e-3
    assert record.tyre_force[:, :2, 2].sum(axis=1).min() > 1e5
    assert np.linalg.norm(record.moment, axis=1).max() < 5e3


def test_steered_machine_turns():
    bench = make(MachineConfig(steering_angle_deg=-20.0))
    place(bench, x_tip=0.0, z_tip=0.2)
    bench.run(4.0, wheel=1.0)
    position, yaw = get_heading(bench)
    angle = bench.plant.GetJointByName("articulation").get_angle(bench.plant_context)
    assert np.degrees(angle) == pytest.approx(-20.0, abs=0.1)
    # The rear unit's angle -20 deg puts the centre of the turn to the left.
    assert yaw > 0.2
    assert position[1] > 0.3


@pytest.mark.parametrize(("effort", "spins"), [(None, True), (100e3, False)])
def test_tyres_that_spin_give_way_sideways(effort, spins):
    """Bucket at a smooth wall, 60 kN sideways on it, a tenth of the grip: friction points along the slip.

    Tyres that spin oppose the side force only as far as they slide sideways too; tyres that grip hold it.
    """
    wall = Obstacle(Box(2.0, 20.0, 4.0), (1.05, 0.0, 0.0), 0.001)
    bench = make(MachineConfig(wheel=WheelConfig(effort=effort)), obstacle=wall)
    place(bench, x_tip=0.0, z_tip=0.2)
    bench.apply_force("bucket", np.array([1.9, 0.0, -0.3]), np.array([0.0, 60e3, 0.0]))
    bench.run(0.8, wheel=1.3)
    start, _ = get_heading(bench)
    record = bench.run(0.4, wheel=1.3)
    end, _ = get_heading(bench)
    wheel = bench.get_rate(record, "wheel_front_left_joint")[-1]
    assert (wheel > 0.1) == spins
    assert record.tyre_force[-1, :, 1].sum() == pytest.approx(-60e3, rel=0.1)
    if spins:
        assert (end - start)[1] / 0.4 > 0.01
    else:
        assert abs((end - start)[1]) / 0.4 < 0.001


@pytest.mark.parametrize("holds", [True, False])
def test_stands_still_and_at_equilibrium(holds):
    """Placed at its static equilibrium: nothing moves, but a boom that does not hold, by its motor's compliance."""
    bench = make(MachineConfig(boom=FunctionConfig(holds=holds)))
    place(bench, x_tip=0.0, z_tip=0.5)
    record = bench.run(1.0)
    q = record.q - record.q[0]
    front = bench.get_body("front_unit").floating_positions_start()
    assert np.abs(q[:, front : front + 7]).max() < 1e-4
    torque = np.abs(record.effort[:, bench.get_column("boom_joint")]).max()
    boom = q[-1, bench.plant.GetJointByName("boom_joint").position_start()]
    expected = 0.0 if holds else 1e-8 * torque * 0.99
    assert boom == pytest.approx(expected, rel=0.05, abs=5e-6)


def test_follows_the_inverse_kinematics():
    """The method's inverse, integrated in open loop, moves the tip along a straight line up a slope."""
    bench = make()
    place(bench, x_tip=0.0, z_tip=0.1)
    bench.run(0.2)
    start = bench.plant.GetFrameByName("tip").CalcPoseInWorld(bench.plant_context).translation().copy()
    v_x, slope, tips = 0.6, np.radians(35.0), []
    for _ in range(20):
        rates = calc_joint_rates(bench.kin, *bench.get_positions(), v_x, v_x * np.tan(slope), 0.15)
        tips.append(bench.run(0.1, wheel=rates[0], boom=rates[1], bucket=rates[2]).tip)
    path = np.vstack(tips) - start
    assert path[-1, 0] == pytest.approx(1.2, rel=0.05)
    across = path[:, 2] * np.cos(slope) - path[:, 0] * np.sin(slope)
    assert np.abs(across).max() < 0.04
    assert np.abs(path[:, 1]).max() < 1e-3


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (-0.5, 0.2, 0.7)])
@pytest.mark.parametrize("corner", [-1, 1])
@pytest.mark.parametrize(("z_tip", "psi"), [(0.2, 0.0), (1.8, 0.5)])
def test_hinge_carries_the_statics(direction, corner, z_tip, psi):
    """A known load on a corner of the held machine: reaction = -(p x F), the motor's axis left out."""
    bench = make(hold_chassis=True, floor=False)
    phi_l, phi_b = (float(a) for a in calc_joint_angles(bench.kin, z_tip, psi))
    set_machine_angles(
        bench.plant, bench.plant_context, bench.machine, phi_l=phi_l, phi_b=phi_b, kin=bench.kin
    )
    X_WB = bench.get_body("bucket").EvalPoseInWorld(bench.plant_context)
    p_BQ = np.array([1.9, corner * 1.5, -0.3])
    force = 1e5 * np.array(direction)
    bench.apply_force("bucket", p_BQ, force)
    record = bench.run(0.25)
    moment = np.cross(p_BQ, X_WB.rotation().inverse().multiply(force))
    np.testing.assert_allclose(record.moment[-1], -moment[[0, 2]], atol=0.01 * np.linalg.norm(moment))


def test_hinge_carries_nothing_about_its_axis_from_a_central_load():
    bench = make(hold_chassis=True, floor=False, payload=21e3)
    phi_l, phi_b = (float(a) for a in calc_joint_angles(bench.kin, 1.2, 0.4))
    set_machine_angles(
        bench.plant, bench.plant_context, bench.machine, phi_l=phi_l, phi_b=phi_b, kin=bench.kin
    )
    record = bench.run(0.2)
    motor = np.abs(record.effort[-1, bench.get_column("bucket_joint")])
    assert motor > 1e5
    assert np.linalg.norm(record.moment[-1]) < 1e-3 * motor


def test_stops_hold_the_motors():
    """At full torque into each stop the bucket goes no further than the table's range, within 10 mrad."""
    bench = make(hold_chassis=True, floor=False)
    kin = bench.kin
    phi_l = float(np.mean(kin.phi_l_range))
    low, high = (float(v) for v in calc_bucket_range(kin, phi_l))
    set_machine_angles(
        bench.plant, bench.plant_context, bench.machine, phi_l=phi_l, phi_b=(low + high) / 2, kin=kin
    )
    for sign in (-1, 1):
        record = bench.run(1.3 * (high - low), bucket=sign)
        boom, bucket = bench.get_positions()
        edge = calc_bucket_range(kin, boom)[0 if sign < 0 else 1]
        # The pump's torque, or what the check valve has trapped of the blow, up to the relief.
        assert (
            8e5 * (1 - 1e-6) <= abs(record.effort[-1, bench.get_column("bucket_joint")]) <= 1.07 * 8e5 + 1.0
        )
        assert bucket == pytest.approx(float(edge), abs=0.01)
        assert record.gap.max() < 1e-3


def test_repeats_bit_for_bit():
    records = []
    for _ in range(2):
        bench = make()
        place(bench, x_tip=0.0)
        records.append(bench.run(0.5, wheel=1.0, boom=-0.3, bucket=-0.2))
    np.testing.assert_array_equal(records[0].q, records[1].q)
    np.testing.assert_array_equal(records[0].moment, records[1].moment)


def test_tip_is_where_the_kinematics_say():
    """On rigid tyres the pure kinematics hold for the standing machine to a few millimetres."""
    bench = make()
    place(bench, x_tip=0.0, z_tip=1.0, psi=0.2)
    x_f = bench.get_body("front_unit").EvalPoseInWorld(bench.plant_context).translation()[0]
    tip = calc_tip(bench.kin, x_f, *bench.get_positions())
    np.testing.assert_allclose(tip, [0.0, 1.0], atol=5e-3)
