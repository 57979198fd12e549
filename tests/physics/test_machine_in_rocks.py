"""Machine and nonsmooth rocks in one step: weight, momentum, a jammed pile, restored contexts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity

from drakerock.rocks.config import RocksConfig, SiteConfig
from drakerock.rocks.engine.config import DynamicsConfig, NonsmoothConfig
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.site import make_site
from machine_rocks_helpers import Scene
from rock_helpers import draw_quaternion, make_engine, make_pile, run

G = 9.81
AWAKE = DynamicsConfig(nonsmooth=NonsmoothConfig(reduction="none"))


def make_heap(rng, n, x, size=(0.3, 0.4), z=(0.9, 4.0)):
    """Rocks in the air above x."""
    positions = np.column_stack([rng.uniform(x, x + 0.9, n), rng.uniform(-1.0, 1.0, n), rng.uniform(*z, n)])
    return make_pile(
        positions,
        shape=rng.integers(0, 6, n),
        size=rng.choice(size, n),
        quaternions=[draw_quaternion(rng) for _ in range(n)],
    )


def find_load(scene):
    """Rocks that are off the floor."""
    pile = scene.rocks.get_pile(scene.context)
    return pile.p_WRs[:, 2] > 0.6


def test_bucket_lifts_a_heap_and_the_boom_motor_feels_its_weight():
    rng = np.random.default_rng(0)
    pile = make_heap(rng, 40, -9.6)
    scene = Scene(pile, lambda t: (0, 0, 0), dynamics=AWAKE, x_tip=-8.0, z_tip=1.6, psi=0.5)
    for _ in range(350):
        scene.step()
    forces, torques = [], []
    for _ in range(100):
        scene.step()
        forces.append(scene.get_bucket_force())
        torques.append(scene.get_torque("boom_joint"))
    load = find_load(scene)
    mass = scene.rocks.engine.mass[load]
    assert mass.sum() > 1000.0
    force = np.mean(forces, axis=0)
    assert -force[5] == pytest.approx(mass.sum() * G, rel=0.01)
    assert np.abs(force[3:5]).max() < 0.01 * mass.sum() * G
    assert np.std(forces, axis=0)[5] < 0.01 * mass.sum() * G
    # The boom motor: the load's weight at its distance from the hinge, against the machine without a load.
    empty = Scene(
        make_pile([[3.0, 0, 0.3]], size=[0.4]),
        lambda t: (0, 0, 0),
        dynamics=AWAKE,
        x_tip=-8.0,
        z_tip=1.6,
        psi=0.5,
    )
    for _ in range(150):
        empty.step()
    hinge = scene.plant.EvalBodyPoseInWorld(
        scene.plant_context, scene.plant.GetBodyByName("boom")
    ).translation()
    centre = mass @ scene.rocks.get_pile(scene.context).p_WRs[load] / mass.sum()
    moment = mass.sum() * G * (centre[0] - hinge[0])
    difference = abs(np.mean(torques) - empty.get_torque("boom_joint"))
    assert difference == pytest.approx(moment, rel=0.01)


def test_momentum_of_machine_and_rocks_together():
    """All in free fall, the bucket shaking its load: gravity alone changes the sum, but for a rock that lands."""
    rng = np.random.default_rng(1)
    pile = make_heap(rng, 25, -9.4, z=(0.9, 3.0))
    scene = Scene(pile, lambda t: (0, 0, 0), dynamics=AWAKE, x_tip=-8.0, z_tip=1.6, psi=0.5)
    for _ in range(150):
        scene.step()
    # lift everything off the floor, below the roof
    plant, context = scene.plant, scene.plant_context
    front = plant.GetBodyByName("front_unit")
    X_WF = plant.EvalBodyPoseInWorld(context, front)
    up = np.array([0.0, 0.0, 0.3])
    state = scene.rocks.get_pile(scene.context)
    scene.rocks.set_pile(scene.context, replace(state, p_WRs=state.p_WRs + up))
    plant.SetFreeBodyPose(context, front, RigidTransform(X_WF.rotation(), X_WF.translation() + up))
    plant.SetFreeBodySpatialVelocity(
        context=context, body=front, V_JpJc=SpatialVelocity(np.zeros(3), np.array([0.5, 0.0, 1.0]))
    )
    masses = scene.rocks.engine.mass
    machine_mass = plant.CalcTotalMass(context, [scene.machine.instance])
    gravity = np.array([0.0, 0.0, -G * 0.01])
    exchanged = 0.0
    for _ in range(20):
        rocks, machine = (
            masses @ scene.rocks.get_pile(scene.context).V_WRs[:, 3:],
            scene.get_machine_momentum(),
        )
        report = scene.rocks.get_report(scene.context)
        impulse = 0.01 * report.F_Bs_W[:, 3:].sum(axis=0)
        scene.step()
        # what the machine got is what the rocks lost, to rounding
        after = scene.rocks.get_pile(scene.context)
        change = masses @ after.V_WRs[:, 3:] - rocks
        on_site = after.contacts.impulses[after.contacts.pairs[:, 1] < 0].sum(axis=0)
        np.testing.assert_allclose(
            change,
            masses.sum() * gravity - impulse - on_site,
            atol=1e-9 * machine_mass + 1e-6 * abs(on_site).max(),
        )
        # the plant's own discretisation moves its momentum a little as its joints turn
        change = scene.get_machine_momentum() - machine
        np.testing.assert_allclose(
            change, machine_mass * gravity + impulse, atol=0.5 + 1e-2 * np.abs(impulse).max()
        )
        exchanged = max(exchanged, np.abs(impulse).max())
    assert exchanged > 100.0


@pytest.fixture(scope="module")
def jammed():
    """Large rocks settled between the drift's walls and the rear wall."""
    rng = np.random.default_rng(0)
    n, site = 160, SiteConfig(void_depth=4.0)
    k = np.arange(n)
    pile = make_pile(
        np.column_stack(
            [
                0.5 + (k % 4) * 0.9 + rng.uniform(-0.05, 0.05, n),
                -2.7 + ((k // 4) % 6) * 1.05,
                0.6 + (k // 24) * 0.95,
            ]
        ),
        shape=rng.integers(0, 6, n),
        size=rng.choice([0.6, 0.8], n),
        quaternions=[draw_quaternion(rng) for _ in range(n)],
    )
    engine = make_engine(pile, load_rock_shapes(RocksConfig()), make_site(site))
    arrays, _ = run(engine, engine.make_arrays(pile), 4.0)
    return engine.make_pile(arrays), site


def test_bucket_pressed_into_a_jammed_pile(jammed):
    """The force is bounded by traction and motors, comes to rest, and nothing flies or overlaps deeply."""
    pile, site = jammed
    scene = Scene(
        pile, lambda t: (1.0 * min(t, 1.0), 0, 0), site=site, dynamics=AWAKE,
        x_tip=float(pile.p_WRs[:, 0].min()) - 0.7, z_tip=0.02,
    )  # fmt: skip
    front_unit = scene.plant.GetBodyByName("front_unit")

    def get_front_velocity():
        return scene.plant.EvalBodySpatialVelocityInWorld(scene.plant_context, front_unit).translational()

    forces, speeds, depth, fastest = [], [], 0.0, 0.0
    for k in range(2200):
        speeds.append(get_front_velocity()[0])
        scene.step()
        forces.append(scene.get_bucket_force())
        depth = max(depth, scene.get_summary()[2])
        if k % 5 == 0:
            fastest = max(fastest, np.abs(scene.rocks.get_pile(scene.context).V_WRs[:, 3:]).max())
    push = -np.array(forces)[:, 3]
    weight = scene.plant.CalcTotalMass(scene.plant_context, [scene.machine.instance]) * G
    # In the end the wheels push with what their motors and the floor give (friction 1.0), steadily.
    last = push[-100:]
    wheel = scene.machine.wheel.effort / 1.0
    assert 1e5 < last.mean() < min(1.1 * weight, 4 * wheel)
    assert last.std() < 0.02 * last.mean()
    # A step at full speed may hold the blow of the bucket on a rock, by which the machine loses some of its momentum.
    limit = min(weight, 4 * wheel)
    assert push[np.array(speeds) < 0.95].max() < 2.0 * limit
    assert np.convolve(push, np.full(10, 0.1), mode="valid").max() < 1.5 * limit
    assert push.max() * scene.dynamics.time_step < 0.5 * weight / G * 1.0
    assert depth < 0.04
    assert fastest < 10.0
    speed = scene.plant.GetVelocities(scene.plant_context)
    assert np.isfinite(speed).all()
    assert np.abs(get_front_velocity()).max() < 0.02


def test_the_solve_foresees_the_plants_motion(jammed):
    """Machine velocities as the contact solve left them, against the plant's own after the same step."""
    pile, site = jammed
    scene = Scene(
        pile, lambda t: (1.0, -0.1 * (t > 2.0), 0.1 * (t > 2.0)), site=site, dynamics=AWAKE,
        x_tip=float(pile.p_WRs[:, 0].min()) - 0.7, z_tip=0.02,
    )  # fmt: skip
    bucket = scene.plant.GetBodyByName("bucket")
    errors, pushes = [], []
    for k in range(500):
        foreseen = scene.rocks.get_report(scene.context).machine_velocity if k >= 200 else None
        scene.step()
        if foreseen is not None:
            context = scene.plant_context
            positions, actual = scene.plant.GetPositions(context), scene.plant.GetVelocities(context)
            other = scene.plant.CreateDefaultContext()
            scene.plant.SetPositions(other, positions)
            velocity = []
            for v in (actual, foreseen):
                scene.plant.SetVelocities(other, v)
                velocity.append(scene.plant.EvalBodySpatialVelocityInWorld(other, bucket).translational())
            errors.append(np.linalg.norm(velocity[0] - velocity[1]))
            pushes.append(-scene.get_bucket_force()[3])
    # Closely while it drives among the first rocks; less so in the jam, with saturated motors and sliding tyres.
    free = np.array(pushes) < 1.5e5
    assert free.sum() > 20
    assert np.median(np.array(errors)[free]) < 2e-3
    assert np.median(errors) < 0.06
    assert np.max(errors) < 0.3


def test_a_restored_context_repeats_bit_for_bit(jammed):
    pile, site = jammed
    x_tip = float(pile.p_WRs[:, 0].min()) - 0.7
    scene = Scene(pile, lambda t: (1.0, 0, 0), site=site, x_tip=x_tip, z_tip=0.02)
    for _ in range(150):
        scene.step()
    saved = scene.context.Clone()
    for _ in range(50):
        scene.step()
    end = _get_state(scene, scene.context)
    for _ in range(20):  # the engine's scratch memory has moved on
        scene.step()
    scene.context.SetTimeStateAndParametersFrom(saved)
    scene.simulator.Initialize()
    while scene.context.get_time() < 2.0 - 1e-9:
        scene.step()
    for one, two in zip(end, _get_state(scene, scene.context), strict=True):
        assert np.array_equal(one, two)


def _get_state(scene, root):
    pile = scene.rocks.get_pile(root)
    assert pile.contacts is not None
    plant = scene.plant.GetMyContextFromRoot(root)
    return [
        *(getattr(pile, name) for name in ("p_WRs", "q_WRs", "V_WRs")),
        *(getattr(pile.contacts, name) for name in ("pairs", "points", "impulses", "resting")),
        scene.plant.GetPositionsAndVelocities(plant).copy(),
    ]
