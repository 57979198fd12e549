"""Parsing, names, motors, placement, geometry."""

from __future__ import annotations

import itertools
import re
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from pydrake.multibody.plant import MultibodyPlant

from drakerock.config import parse_config
from drakerock.errors import InputError
from drakerock.lhd import names
from drakerock.lhd.config import MachineConfig
from drakerock.lhd.geometry import (
    calc_area,
    calc_heaped_capacity,
    collision_pieces,
    make_bucket_geometry,
)
from drakerock.lhd.linkage import Linkage, find_passive_joints
from drakerock.lhd.model import add_machine
from drakerock.lhd.placement import set_machine_angles, set_machine_pose
from drakerock.resources import find_data


def test_mass_table(model):
    """Section 2: the table's total; rods and cylinders come out of front unit and boom."""
    _, plant, _, machine = model
    context = plant.CreateDefaultContext()
    masses = {
        plant.get_body(i).name(): plant.get_body(i).get_mass(context)
        for i in plant.GetBodyIndices(machine.instance)
    }
    assert sum(masses.values()) == pytest.approx(60580)
    assert [masses[w] for w in names.WHEELS] == [1900] * 4
    assert masses["rear_unit"] == 27000
    assert masses["bucket"] == 6400
    assert masses["bell_crank"] == 880
    assert masses["boom"] + masses["z_bar_rod"] == pytest.approx(3700)
    cylinders = sum(
        m for name, m in masses.items() if name.endswith(("_barrel", "_rod")) and name != "z_bar_rod"
    )
    assert masses["front_unit"] + cylinders == pytest.approx(15000)


def test_mechanism(model):
    """Two units, wheels, boom, bucket, the Z-bar's crank and rod, five cylinders: 20 bodies, 6 loops."""
    _, plant, _, machine = model
    assert len(plant.GetBodyIndices(machine.instance)) == 20
    assert len(machine.loops) == plant.num_constraints() == 6
    assert len(find_passive_joints(plant, machine.instance)) == 12


def test_motors_are_the_methods(model):
    _, plant, _, machine = model
    limits = {"boom_joint": 2.0e6, "bucket_joint": 8.0e5} | dict.fromkeys(names.WHEEL_JOINTS, 1.9e5)
    for joint, limit in limits.items():
        actuator = plant.GetJointActuatorByName(joint, machine.instance)
        assert actuator.effort_limit() == limit
        gains = actuator.get_controller_gains()
        assert (gains.p, gains.d) == (0.0, 1e8)
    assert (machine.wheel.velocity, machine.boom.velocity, machine.bucket.velocity) == (1.3, 1.0, 1.0)


def test_config_overrides_the_file(build):
    config = parse_config("{wheel: {effort: 1.0e+5, velocity: 2.0}, motor_damping: 1.0e+7}", MachineConfig)
    _, plant, _, machine = build(config)
    actuator = plant.GetJointActuatorByName("wheel_rear_left_joint", machine.instance)
    assert (actuator.effort_limit(), actuator.get_controller_gains().d) == (1e5, 1e7)
    assert (machine.wheel.effort, machine.wheel.velocity) == (1e5, 2.0)
    assert machine.boom.effort == 2e6


def test_motors_follow_the_configuration(build):
    text = "{boom: {relief: 2.5e+6}, bucket: {holds: false}, wheel: {no_load_speed: 2.0}}"
    _, plant, _, machine = build(parse_config(text, MachineConfig))
    assert machine.boom.peak == machine.boom.relief == 2.5e6
    assert plant.GetJointActuatorByName("boom_joint", machine.instance).effort_limit() == 2e6
    assert (machine.boom.effort, machine.boom.holds, machine.boom.check_valve) == (2e6, True, True)
    assert (machine.bucket.peak, machine.bucket.holds) == (8e5, False)
    assert machine.wheel.curve == ((0.0, 1.9e5), (2.0, 0.0))
    assert machine.wheel.inertia == pytest.approx(948.475)
    _, plant, _, machine = build(parse_config("{wheel: {torque_curve: null}}", MachineConfig))
    assert machine.wheel.curve == ()


@pytest.mark.parametrize(
    "curve",
    ["[]", "[[0, 1]]", "[[0, 1], [0.5, 0]]", "[[0, 1], [0.5, 0.4], [0.6, 0.5], [1, 0]]",
     "[[0, 1], [0.5, 0.4], [0.5, 0.2], [1, 0]]", "[[0.1, 1], [1, 0]]"],
)  # fmt: skip
def test_torque_curves_that_make_no_sense_are_refused(curve):
    with pytest.raises(InputError, match=r"wheel\.torque_curve: expected"):
        parse_config(f"wheel: {{torque_curve: {curve}}}", MachineConfig)


def test_missing_file_and_steering_out_of_range():
    with pytest.raises(InputError, match=r"nowhere\.sdf: no such file"):
        add_machine(MultibodyPlant(0.01), MachineConfig(model="nowhere.sdf"))
    with pytest.raises(InputError, match="lhd"):
        add_machine(MultibodyPlant(0.01), MachineConfig(model="package://drakerock/lhd/other.sdf"))
    with pytest.raises(InputError, match="steering_angle_deg"):
        add_machine(MultibodyPlant(0.01), MachineConfig(steering_angle_deg=44))


@pytest.mark.parametrize(
    ("x_tip", "z_tip", "psi", "y"), [(0, 0, 0, 0), (-3, 0.8, 0.3, 1.0), (2, 2.5, -0.2, -0.5)]
)
@pytest.mark.parametrize("steering", [0.0, 20.0])
def test_pose_is_met_with_closed_loops(build, x_tip, z_tip, psi, y, steering):
    diagram, plant, _, machine = build(MachineConfig(steering_angle_deg=steering))
    root = diagram.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    set_machine_pose(plant, context, machine, x_tip=x_tip, z_tip=z_tip, psi=psi, y=y)
    p_WT = plant.GetFrameByName("tip").CalcPoseInWorld(context).translation()
    np.testing.assert_allclose(p_WT, [x_tip, y, z_tip], atol=1e-4)
    floor = plant.GetBodyByName("bucket").EvalPoseInWorld(context).rotation().matrix()[:, 0]
    assert np.arctan2(floor[2], floor[0]) == pytest.approx(psi, abs=1e-4)
    linkage = Linkage(plant, context, machine.instance, machine.loops)
    assert np.abs(linkage.calc_gap()).max() < 1e-5
    assert plant.GetJointByName("articulation").get_angle(context) == pytest.approx(np.radians(steering))


def test_pose_out_of_reach_is_refused(model, kin):
    diagram, plant, _, machine = model
    context = plant.GetMyMutableContextFromRoot(diagram.CreateDefaultContext())
    with pytest.raises(InputError, match="can't reach"):
        set_machine_pose(plant, context, machine, x_tip=0, z_tip=9.0, kin=kin)
    with pytest.raises(InputError, match="can't reach"):
        set_machine_pose(plant, context, machine, x_tip=0, psi=1.2, kin=kin)
    with pytest.raises(InputError, match="can't reach"):
        set_machine_angles(plant, context, machine, phi_l=3.0, phi_b=0.0, kin=kin)


def test_bucket_holds_eight_cubic_metres(model):
    _, plant, scene_graph, machine = model
    bucket = make_bucket_geometry(plant, scene_graph, machine)
    assert calc_heaped_capacity(bucket) == pytest.approx(8.0, rel=0.01)
    assert bucket.outer_width == pytest.approx(3.1)
    assert bucket.inner_width < bucket.outer_width
    assert calc_area(bucket.load_region) > 1.5 * calc_area(bucket.profile)


def test_heaped_capacity_against_a_grid():
    """SAE's heap is a roof of slope 1:2 over the strike rectangle: integrated numerically."""
    from drakerock.lhd.geometry import BucketGeometry

    profile = np.array([[2.0, 0.0], [0.0, 0.0], [0.0, 1.5]])
    bucket = BucketGeometry(profile, profile, inner_width=3.0, outer_width=3.0)
    length = np.hypot(2.0, 1.5)
    s, y = np.meshgrid((np.arange(800) + 0.5) / 800 * length, (np.arange(800) + 0.5) / 800 * 3.0)
    roof = np.minimum.reduce([s, length - s, y, 3.0 - y]) / 2
    expected = 3.0 * 1.5 + roof.mean() * length * 3.0
    assert calc_heaped_capacity(bucket) == pytest.approx(expected, rel=1e-3)


def test_bucket_is_open_and_closed_where_it_should_be(model):
    """No contact piece reaches into the inside; every way out of it but the open front is blocked."""
    _, plant, scene_graph, machine = model
    bucket = make_bucket_geometry(plant, scene_graph, machine)
    hulls = [
        trimesh.convex.convex_hull(p.vertices)
        for p in collision_pieces(plant, scene_graph, machine)["bucket"]
    ]
    inside = np.array([*bucket.profile.mean(axis=0), 0.0])[[0, 2, 1]]
    assert not any(hull.contains([inside])[0] for hull in hulls)

    def blocked(direction) -> bool:
        ray = np.asarray(direction, dtype=float)
        return any(hull.ray.intersects_any([inside], [ray])[0] for hull in hulls)

    for direction in ([-1, 0, 0], [0, 0, -1], [0, 1, 0], [0, -1, 0], [-1, 0, 0.5], [-1, 0, -1]):
        assert blocked(direction), direction
    for direction in ([1, 0, 0.5], [0.5, 0, 1]):
        assert not blocked(direction), direction


def test_pieces_are_convex_and_carry_friction(model):
    """2 mu1 mu2 / (mu1 + mu2) gives the method's pairs: rock 0.9, drift and bucket 1.125, tyre 0.9."""
    _, plant, scene_graph, machine = model
    pieces = collision_pieces(plant, scene_graph, machine)
    every = {plant.get_body(k).name() for k in plant.GetBodyIndices(machine.instance)}
    assert set(pieces) == every, "each body has contact shapes"
    for body, parts in pieces.items():
        mu = 0.9 if body in names.WHEELS else 1.125
        for piece in parts:
            assert piece.material.friction == mu
            assert piece.vertices.shape[1] == 3
            hull = trimesh.convex.convex_hull(piece.vertices)
            assert hull.volume > 1e-4
            # All given points are corners of the hull: nothing is inside it.
            assert len(hull.vertices) == len(np.unique(piece.vertices.round(6), axis=0))
    assert pytest.approx(1.0) == 2 * 0.9 * 1.125 / (0.9 + 1.125)


def test_tyres_stand_on_the_floor_frame(model, kin):
    _, plant, scene_graph, machine = model
    for wheel in names.WHEELS:
        (tyre,) = collision_pieces(plant, scene_graph, machine)[wheel]
        assert np.hypot(*tyre.vertices[:, [0, 2]].T).max() == pytest.approx(kin.wheel_radius)


@pytest.mark.parametrize("name", ["lhd", "lhd_small"])
def test_files_are_what_the_design_gives(tmp_path, name):
    source = find_data("models", name)
    (tmp_path / "design.yaml").write_text((source / "design.yaml").read_text())
    script = find_data("models", "make_machine.py")
    subprocess.run([sys.executable, str(script), str(tmp_path / "design.yaml")], check=True)
    made = {file.name: file.read_text() for file in tmp_path.iterdir()}
    kept = {file.name: file.read_text() for file in source.iterdir()}
    assert made.keys() == kept.keys()
    for file in made:
        if file.endswith(".obj"):
            # Hulls may be triangulated in another order elsewhere: compare extents.
            boxes = [
                np.array(
                    [line.split()[1:] for line in text.splitlines() if line.startswith("v ")], dtype=float
                )
                for text in (made[file], kept[file])
            ]
            np.testing.assert_allclose(np.ptp(boxes[0], axis=0), np.ptp(boxes[1], axis=0), atol=1e-4)
        else:
            numbers = [
                [float(n) for n in re.findall(r"-?\d+\.?\d*(?:e[-+]?\d+)?", text)]
                for text in (made[file], kept[file])
            ]
            np.testing.assert_allclose(*numbers, rtol=1e-4, atol=1e-3)


def test_inertias_are_physical(model):
    """Principal moments obey the triangle inequality, and bodies balance left to right."""
    _, plant, _, machine = model
    context = plant.CreateDefaultContext()
    for index in plant.GetBodyIndices(machine.instance):
        inertia = plant.get_body(index).CalcSpatialInertiaInBodyFrame(context)
        assert abs(inertia.get_com()[1]) < 1e-6
        moments = np.linalg.eigvalsh(
            inertia.Shift(inertia.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
        )
        assert moments.min() > 0
        assert all(a + b >= c for a, b, c in itertools.permutations(moments))
