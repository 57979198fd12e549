"""The motors in Drake's own solver: they hold 21 t, yield at the relief, drive along their curve, load the wheels."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import Box
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from drakerock.config import parse_config
from drakerock.errors import InputError
from drakerock.lhd.checks.bench import Bench, CheckConfig, Obstacle, make_bench
from drakerock.lhd.config import MachineConfig
from drakerock.lhd.kinematics import calc_joint_angles
from drakerock.lhd.model import add_machine
from drakerock.lhd.motors import add_motors
from drakerock.lhd.placement import set_machine_angles, set_machine_pose

PAYLOAD = 21e3


def make(text: str = "{}", **options) -> Bench:
    return make_bench(parse_config(text, MachineConfig), CheckConfig(), **options)


def hang(text: str = "{}") -> Bench:
    """Return the machine with its front unit held and the payload in its tilted bucket."""
    bench = make(text, hold_chassis=True, floor=False, payload=PAYLOAD)
    phi_l, phi_b = (float(a) for a in calc_joint_angles(bench.kin, 1.2, 0.4))
    set_machine_angles(
        bench.plant, bench.plant_context, bench.machine, phi_l=phi_l, phi_b=phi_b, kin=bench.kin
    )
    return bench


def get_torque(bench: Bench, record, joint: str = "boom_joint") -> np.ndarray:
    return record.effort[:, bench.get_column(joint)]


def test_boom_at_zero_command_holds_its_load():
    """Below a millimetre at once, and no drift (`test_motor_law` has the ten seconds)."""
    bench = hang()
    start = bench.plant.GetFrameByName("tip").CalcPoseInWorld(bench.plant_context).translation().copy()
    record = bench.run(1.5)
    sag = np.linalg.norm(record.tip - start, axis=1)
    assert sag.max() < 1e-3
    assert np.ptp(sag[75:]) < 1e-6
    assert np.abs(get_torque(bench, record)[-1]) > 5e5


def test_boom_slides_at_its_relief():
    """At 0.9 of what its load takes, the torque stays at the relief and the boom falls; at 1.1 it holds."""
    load = abs(get_torque(bench := hang(), bench.run(0.3))[-1])
    for share in (0.9, 1.1):
        bench = hang(f"{{boom: {{relief: {share * load}}}}}")
        record = bench.run(0.3)
        torque = np.abs(get_torque(bench, record))
        fall = record.tip[0, 2] - record.tip[-1, 2]
        if share < 1.0:
            assert torque[2:] == pytest.approx(share * load)
            assert fall > 0.01
        else:
            assert torque[-1] == pytest.approx(load, rel=1e-3)
            assert fall < 1e-3


def test_wheels_stall_with_the_stall_torque_and_run_along_the_curve():
    """Afloat, nothing loads the wheels: they start with the stall torque, fall along the curve, and end at no load."""
    text = "{wheel: {effort: 1.9e+5, velocity: 3.0, no_load_speed: 2.0}}"
    bench = make(text, floor=False, gravity=False)
    set_machine_pose(bench.plant, bench.plant_context, bench.machine, kin=bench.kin, x_tip=0.0, z_tip=1.0)
    record = bench.run(0.6, wheel=3.0)
    joint = "wheel_front_left_joint"
    rate, torque = bench.get_rate(record, joint), get_torque(bench, record, joint)
    assert torque == pytest.approx(1.9e5 * (1.0 - rate / 2.0), abs=0.004 * 1.9e5)
    assert rate[0] > 0.01
    assert rate[-1] == pytest.approx(2.0, rel=1e-3)
    assert torque[-1] == pytest.approx(0.0, abs=300.0)


def calc_obstacle_load(bench: Bench, x: float) -> tuple[float, float]:
    """Return what the obstacle presses on the bucket with, downwards [N], and its moment about the floor at x [N m]."""
    results = bench.plant.get_contact_results_output_port().Eval(bench.plant_context)
    bucket = bench.get_body("bucket").index()
    down, moment = 0.0, 0.0
    for k in range(results.num_point_pair_contacts()):
        contact = results.point_pair_contact_info(k)
        if bucket not in (contact.bodyA_index(), contact.bodyB_index()):
            continue
        sign = 1.0 if contact.bodyB_index() == bucket else -1.0
        force, point = sign * contact.contact_force(), contact.contact_point()
        down -= force[2]
        moment += -force[2] * (point[0] - x) + force[0] * point[2]
    return down, moment


def test_raising_the_boom_loads_the_front_wheels():
    """Under an overhang, the boom raised as for a weight transfer: by the lever rule, and the valve keeps it."""
    bench = make("{boom: {effort: 6.0e+5}}", obstacle=Obstacle(Box(2.0, 1.0, 0.5), (0.9, 0.0, 0.55), 0.0))
    set_machine_pose(bench.plant, bench.plant_context, bench.machine, kin=bench.kin, x_tip=0.0, z_tip=0.2)
    before = bench.run(0.3).tyre_force[-1, :2, 2].sum()
    bench.run(1.1, boom=-0.02)
    record = bench.run(0.4)
    front, rear = (
        bench.get_body(name).EvalPoseInWorld(bench.plant_context).translation()[0]
        for name in ("wheel_front_left", "wheel_rear_left")
    )
    down, moment = calc_obstacle_load(bench, rear)
    expected = moment / (front - rear)
    assert down > 5e4
    assert expected > down
    assert record.tyre_force[-1, :2, 2].sum() - before == pytest.approx(expected, rel=0.02)
    assert np.ptp(record.tyre_force[20:, :2, 2].sum(axis=1)) < 0.02 * expected


def test_repeats_from_a_saved_context_bit_for_bit():
    """The trapped pressure is state: a context saved while a boom holds goes on as it would have."""
    bench = hang()
    bench.run(0.1)
    saved = bench.context.Clone()
    first = bench.run(0.1, bucket=0.2).q
    bench.context.SetTimeStateAndParametersFrom(saved)
    bench.simulator.Initialize()
    np.testing.assert_array_equal(bench.run(0.1, bucket=0.2).q, first)


def test_a_plant_with_sampled_ports_is_refused():
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(0.01))
    machine = add_machine(plant, MachineConfig())
    plant.Finalize()
    with pytest.raises(InputError, match="sampled"):
        add_motors(builder, plant, machine)
