"""The pure kinematics against Drake and against finite differences, over the whole working range."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform
from pydrake.multibody.tree import JacobianWrtVariable

from drakerock.errors import InputError
from drakerock.lhd.kinematics import (
    calc_bucket_pose,
    calc_bucket_range,
    calc_full_tilt,
    calc_jacobian,
    calc_joint_angles,
    calc_joint_rates,
    calc_pitch,
    calc_reach,
    calc_tip,
)
from drakerock.lhd.linkage import Linkage
from drakerock.lhd.placement import set_machine_angles

share = st.floats(0, 1)
rate = st.floats(-1, 1)
fast = settings(
    deadline=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    derandomize=True,
)


def pick(kin, boom, bucket):
    """Return angles at these shares of the boom's and the bucket's range."""
    phi_l = kin.phi_l_range[0] + boom * np.ptp(kin.phi_l_range)
    low, high = calc_bucket_range(kin, phi_l)
    return float(phi_l), float(low + bucket * (high - low))


def place(model, kin, x, phi_l, phi_b):
    """Put the machine level at height r_w, without the linkage: only the tree's kinematics count here."""
    diagram, plant, _, _ = model
    root = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    plant.SetFreeBodyPose(
        context, plant.GetBodyByName("front_unit"), RigidTransform(np.array([x, 0, kin.wheel_radius]))
    )
    plant.GetJointByName("boom_joint").set_angle(context, phi_l)
    plant.GetJointByName("bucket_joint").set_angle(context, phi_b)
    return root, plant, context


def test_lengths_are_the_methods(kin):
    assert kin.wheel_radius == pytest.approx(1.0)
    assert kin.boom_length == pytest.approx(2.5)
    assert kin.bucket_length == pytest.approx(2.0, abs=1e-4)


@fast
@given(share, share, st.floats(-5, 5))
def test_poses_agree_with_drake(model, kin, boom, bucket, x):
    phi_l, phi_b = pick(kin, boom, bucket)
    _root, plant, context = place(model, kin, x, phi_l, phi_b)
    p_WT = plant.GetFrameByName("tip").CalcPoseInWorld(context).translation()
    np.testing.assert_allclose(calc_tip(kin, x, phi_l, phi_b), p_WT[[0, 2]], atol=1e-9)
    X_WB = plant.GetBodyByName("bucket").EvalPoseInWorld(context)
    floor = X_WB.rotation().matrix()[:, 0]
    psi = np.arctan2(floor[2], floor[0])
    np.testing.assert_allclose(
        calc_bucket_pose(kin, x, phi_l, phi_b), [*X_WB.translation()[[0, 2]], psi], atol=1e-9
    )


@fast
@given(share, share, rate, rate, rate)
def test_jacobian_agrees_with_drake(model, kin, boom, bucket, w_wheel, w_boom, w_bucket):
    """Wheels roll: the front unit moves on with r_w times their rate."""
    phi_l, phi_b = pick(kin, boom, bucket)
    _root, plant, context = place(model, kin, 0.0, phi_l, phi_b)
    v = np.zeros(plant.num_velocities())
    front = plant.GetBodyByName("front_unit")
    v[front.floating_velocities_start_in_v() + 3] = kin.wheel_radius * w_wheel
    for name, value in (("boom_joint", w_boom), ("bucket_joint", w_bucket)):
        v[plant.GetJointByName(name).velocity_start()] = value
    J = plant.CalcJacobianSpatialVelocity(
        context,
        JacobianWrtVariable.kV,
        plant.GetFrameByName("tip"),
        np.zeros(3),
        plant.world_frame(),
        plant.world_frame(),
    )
    V_WT = J @ v
    expected = [V_WT[3], V_WT[5], -V_WT[1]]
    rates = [w_wheel, w_boom, w_bucket]
    np.testing.assert_allclose(calc_jacobian(kin, phi_l, phi_b) @ rates, expected, atol=1e-9)


@fast
@given(share, share)
def test_jacobian_agrees_with_finite_differences(kin, boom, bucket):
    phi_l, phi_b = pick(kin, boom, bucket)
    h = 1e-6

    def measure(wheel, d_boom, d_bucket):
        tip = calc_tip(kin, kin.wheel_radius * wheel, phi_l + d_boom, phi_b + d_bucket)
        return np.array([*tip, calc_pitch(kin, phi_l + d_boom, phi_b + d_bucket)])

    columns = [(measure(*(h * e)) - measure(*(-h * e))) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(calc_jacobian(kin, phi_l, phi_b), np.array(columns).T, atol=1e-7)


@fast
@given(share, share, st.floats(-1.3, 1.3), st.floats(0, 1.5), st.floats(-0.5, 0.5))
def test_joint_rates_invert_the_jacobian(kin, boom, bucket, v_x, v_z, omega_b):
    phi_l, phi_b = pick(kin, boom, bucket)
    rates = calc_joint_rates(kin, phi_l, phi_b, v_x, v_z, omega_b)
    velocity = calc_jacobian(kin, phi_l, phi_b) @ rates
    assert rates[1] <= 0, "the boom only raises"
    assert velocity[[0, 2]] == pytest.approx([v_x, omega_b], abs=1e-9)
    if rates[1] < 0:
        assert velocity[1] == pytest.approx(v_z, abs=1e-9)


@fast
@given(share, share)
def test_joint_angles_invert_the_tip(kin, boom, bucket):
    phi_l, phi_b = pick(kin, boom, bucket)
    z_tip, psi = calc_tip(kin, 0.0, phi_l, phi_b)[1], calc_pitch(kin, phi_l, phi_b)
    assert calc_joint_angles(kin, z_tip, psi) == pytest.approx((phi_l, phi_b), abs=1e-9)


def test_functions_broadcast(kin):
    phi_l = np.linspace(*kin.phi_l_range, 7)
    assert calc_tip(kin, 0.0, phi_l, 0.0).shape == (7, 2)
    assert calc_bucket_pose(kin, 0.0, phi_l, np.zeros((3, 1))).shape == (3, 7, 3)
    assert calc_full_tilt(kin, phi_l).shape == (7,)


def test_heights_out_of_reach_are_nan(kin):
    assert np.isnan(calc_joint_angles(kin, 50.0, 0.0)[0])


@fast
@given(share, st.booleans())
def test_tabulated_range_ends_at_a_stop(model, kin, boom, tilted):
    """Just inside the range no stop is touched, just outside one is.

    The table errs by less than 2 mrad, 4 where two stops meet.
    """
    diagram, plant, _, machine = model
    root = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    phi_l, edge = pick(kin, 0.002 + 0.996 * boom, 0.0 if tilted else 1.0)
    inwards = (
        2e-3 if tilted else -4e-3
    )  # dumped it meets the cylinder's stop, or the bucket's with the boom up
    set_machine_angles(plant, context, machine, phi_l=phi_l, phi_b=edge + inwards, kin=kin)
    linkage = Linkage(plant, context, machine.instance, machine.loops)
    assert linkage.move(0.0, phi_l, edge + inwards)
    assert linkage.calc_margin() > 0
    assert linkage.move(0.0, phi_l, edge - inwards)
    assert linkage.calc_margin() < 0


def test_workspace_is_a_loaders(kin):
    """The boom lifts, the bucket tilts back for carrying at any height, and dumps when up."""
    tilt = np.degrees(calc_full_tilt(kin, kin.phi_l_grid))
    assert tilt.min() > 33
    assert tilt.max() < 60
    dump = calc_pitch(kin, kin.phi_l_range[0], calc_bucket_range(kin, kin.phi_l_range[0])[1])
    assert np.degrees(dump) == pytest.approx(-38, abs=2)
    floor_l, floor_b = calc_joint_angles(kin, 0.0, 0.0)
    low, high = calc_bucket_range(kin, floor_l)
    assert kin.phi_l_range[0] < floor_l < kin.phi_l_range[1]
    assert low < floor_b < high


def test_reach_is_the_methods(kin):
    assert calc_reach(kin, np.radians(40)) == pytest.approx(4.24, rel=0.01)
    longer = dataclasses.replace(kin, bucket_length=kin.bucket_length + 0.3)
    assert calc_reach(longer, np.radians(40)) > 4.4
    with pytest.raises(InputError, match="slope of 89 deg"):
        calc_reach(dataclasses.replace(kin, bucket_length=0.5), np.radians(89))
