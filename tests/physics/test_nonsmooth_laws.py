"""The nonsmooth engine against closed forms: free fall, friction, impact, stacks, spin, arch, tower."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from drakerock.rocks.config import RocksConfig
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.engine import MachinePiece
from rock_helpers import (
    make_ball,
    make_box,
    make_engine,
    make_machine_step,
    make_pile,
    make_plane_site,
    make_shape,
    run,
)

G = 9.81


def test_free_fall():
    pile = make_pile([[0, 0, 30.0]], velocities=[[0, 0, 0, 1.0, 2.0, 3.0]])
    engine = make_engine(pile, [make_box(0.5, 0.4, 0.3)])
    arrays, _ = run(engine, engine.make_arrays(pile), 1.0)
    dt = engine.time_step
    np.testing.assert_allclose(arrays.velocities[0], [0, 0, 0, 1, 2, 3 - G], atol=1e-9)
    # semi-implicit Euler: z = v t - g t (t + dt) / 2
    np.testing.assert_allclose(arrays.positions[0], [1, 2, 30 + 3 - 0.5 * G * (1 + dt)], atol=1e-9)


@pytest.mark.parametrize(("excess_deg", "slides"), [(-1.0, False), (1.0, True)])
def test_block_on_a_slope_around_the_friction_angle(excess_deg, slides):
    """The pair's coefficient is 2 a b / (a + b)."""
    a, b = 0.9, 0.5
    mu = 2 * a * b / (a + b)
    slope = np.arctan(mu) + np.deg2rad(excess_deg)
    turn = Rotation.from_euler("y", slope)
    pile = make_pile(
        [turn.apply([0, 0, 0.15])], quaternions=[turn.as_quat(scalar_first=True)], velocities=np.zeros((1, 6))
    )
    engine = make_engine(pile, [make_box(0.8, 0.6, 0.3)], make_plane_site(b, slope), RocksConfig(friction=a))
    arrays, _ = run(engine, engine.make_arrays(pile), 1.0)
    travelled = np.linalg.norm(arrays.positions[0] - pile.p_WRs[0])
    expected = 0.5 * G * (np.sin(slope) - mu * np.cos(slope)) if slides else 0.0
    assert travelled == pytest.approx(expected, rel=0.05, abs=1e-3)


def test_sliding_distance():
    """A block with initial speed v stops after v^2 / (2 mu g)."""
    pile = make_pile([[0, 0, 0.15]], velocities=[[0, 0, 0, 3.0, 0, 0]])
    engine = make_engine(pile, [make_box(0.8, 0.6, 0.3)], make_plane_site(0.5), RocksConfig(friction=0.5))
    arrays, _ = run(engine, engine.make_arrays(pile), 2.0)
    assert arrays.positions[0, 0] == pytest.approx(9.0 / (2 * 0.5 * G), rel=0.02)
    assert np.abs(arrays.velocities).max() < 1e-3


def calc_spring(engine, overlap):
    """Stiffness of the first rock's own spring at each corner: twice Hertz's for two like spheres of its volume."""
    radius = np.cbrt(3 * engine.mass[0] / (4 * np.pi * RocksConfig().density))
    return 2 * engine.hertz * np.sqrt(0.5 * radius * overlap)


@pytest.mark.parametrize("time_step", [0.002, 0.0005])
@pytest.mark.parametrize("height", [0.0003, 0.0013])
def test_an_impact_by_the_linear_law_is_that_of_springs(time_step, height):
    """Without rigid impacts a block at speed v goes v sqrt(m / k) deep and, undamped, leaves as fast as it came."""
    speed, size = 0.5, 0.5
    pile = make_pile([[0, 0, 0.5 * size + height]], size=[size], velocities=[[0, 0, 0, 0, 0, -speed]])
    config = NonsmoothConfig(
        reduction="none", linear_overlap=0.001, stiffness_factor=0.02, damping_time=0.0, impact_threshold=50
    )
    engine = make_engine(
        pile, [make_box(1.0, 1.0, 1.0)], config=config, time_step=time_step, gravity=np.zeros(3)
    )
    stiffness = 4 * calc_spring(engine, config.linear_overlap)
    arrays, depth = engine.make_arrays(pile), 0.0
    for _ in range(round(0.2 / time_step)):
        arrays, _ = engine.advance(arrays)
        depth = max(depth, 0.5 * size - arrays.positions[0, 2])
    assert depth == pytest.approx(speed * np.sqrt(engine.mass[0] / stiffness), rel=0.05)
    # The first step of a contact is an implicit one, which takes a share of h / 2 sqrt(k / m) of the speed at most.
    loss = 0.5 * time_step * np.sqrt(stiffness / engine.mass[0])
    assert speed * (1 - loss - 1e-3) < arrays.velocities[0, 5] < speed * 1.001


@pytest.mark.parametrize("time_step", [0.01, 0.002])
def test_a_load_is_carried_however_slow_overlaps_may_be_pushed_apart(time_step):
    """What bounds the speed of overlaps that are pushed apart bounds no force: the overlap is weight over stiffness."""
    pile = make_pile([[0, 0, 0.25]], size=[0.5])
    config = NonsmoothConfig(
        reduction="none",
        linear_overlap=0.001,
        stiffness_factor=2e-3,
        max_recovery_speed=0.1,
        impact_threshold=50,
    )
    engine = make_engine(pile, [make_box(1.0, 1.0, 1.0)], config=config, time_step=time_step)
    stiffness = 4 * calc_spring(engine, config.linear_overlap)
    arrays, _ = run(engine, engine.make_arrays(pile), 3.0)
    overlap = engine.mass[0] * G / stiffness
    assert overlap > 5 * config.max_recovery_speed * 0.002
    assert 0.25 - arrays.positions[0, 2] == pytest.approx(overlap, rel=0.01)


def make_still_machine(pose, n_bodies=1):
    """A machine that cannot move: no velocities at all."""
    return make_machine_step(
        np.tile(pose, (n_bodies, 1, 1)), np.zeros(1), np.zeros((n_bodies, 6, 1)), np.zeros((n_bodies, 1, 6))
    )


@pytest.mark.parametrize("restitution", [0.0, 0.1, 0.5])
def test_impact_against_the_machine_has_its_restitution(restitution):
    vertices = np.array([[x, y, z] for x in (-2, 2) for y in (-2, 2) for z in (-1.0, 0)], float)
    pile = make_pile([[0, 0, 3.0]])
    engine = make_engine(
        pile, [make_ball()], rocks=RocksConfig(restitution_machine=restitution),
        pieces=[MachinePiece(0, vertices, 1.125)], n_machine_bodies=1,
    )  # fmt: skip
    pose = np.eye(4)
    pose[2, 3] = 1.0
    machine = make_still_machine(pose)
    arrays = engine.make_arrays(pile)
    down, up, impulse = 0.0, 0.0, 0.0
    for _ in range(120):
        before = arrays.velocities[0, 5]
        arrays, report = engine.step(arrays, machine)
        down = min(down, before)
        if up == 0.0 and down < -1.0 and arrays.velocities[0, 5] > before + 1.0:
            up = arrays.velocities[0, 5]
        impulse -= report.F_Bs_W[0, 5] * engine.time_step
    assert up == pytest.approx(-restitution * down, abs=0.11)
    # the machine got what the rock lost, gravity added
    assert impulse == pytest.approx(engine.mass[0] * (arrays.velocities[0, 5] + G * 1.2), rel=1e-6)
    assert arrays.positions[0, 2] > 1.49


def test_rock_on_rock_impact_is_plastic_and_keeps_momentum():
    """Two boxes meet face to face in free flight: they go on together."""
    pile = make_pile(
        [[0, 0, 20.0], [1.5, 0, 20.0]],
        velocities=[[0, 0, 0, 2.0, 0, 0], [0, 0, 0, -1.0, 0, 0]],
        size=[1.0, 0.8],
    )
    engine = make_engine(pile, [make_box(1, 1, 1)], gravity=np.zeros(3))
    arrays, _ = run(engine, engine.make_arrays(pile), 1.0)
    m = engine.mass
    common = (2.0 * m[0] - m[1]) / m.sum()
    np.testing.assert_allclose(arrays.velocities[:, 3], common, atol=1e-3)
    np.testing.assert_allclose(m @ arrays.velocities[:, 3:], [2.0 * m[0] - m[1], 0, 0], atol=1e-9 * m.sum())


def test_stack_carries_its_weight():
    """Ten boxes: the impulses between them sum to the weight above, and the stack stands still."""
    n = 10
    pile = make_pile([[0, 0, 0.25 + 0.5 * k] for k in range(n)])
    engine = make_engine(pile, [make_box(0.8, 0.8, 0.5)])
    arrays, report = run(engine, engine.make_arrays(pile), 3.0)
    stored = engine.make_pile(arrays)
    m = engine.mass[0]
    for k in range(n):
        below = (stored.contacts.pairs[:, 0] == k - 1) & (stored.contacts.pairs[:, 1] == k)
        if k == 0:
            below = (stored.contacts.pairs[:, 0] == 0) & (stored.contacts.pairs[:, 1] < 0)
        force = abs(stored.contacts.impulses[below, 2].sum()) / engine.time_step
        assert force == pytest.approx((n - k) * m * G, rel=0.01)
    assert np.abs(arrays.velocities).max() < 3e-3
    assert report.max_penetration < 2e-3
    assert np.abs(arrays.positions[:, :2]).max() < 1e-3


def test_tall_tower_stands():
    """40 cubes, cold start: no lean, and they sink as far as Hertz's law says."""
    n = 40
    pile = make_pile([[0, 0, 0.5 + k] for k in range(n)])
    engine = make_engine(pile, [make_box(1.0, 1.0, 1.0)])
    arrays, report = run(engine, engine.make_arrays(pile), 5.0)
    assert np.abs(arrays.positions[:, :2]).max() < 0.02
    assert np.abs(arrays.velocities).max() < 0.02
    # Hertz: four corners under 980 kN give 6.1 + ... mm; the tower's sum follows from the law
    radius, modulus = 0.5, 0.5 * 1e9 / (1 - 0.3**2)
    loads = engine.mass[0] * G * np.arange(n, 0, -1) / 4
    sinking = (loads / (4 / 3 * modulus * np.sqrt(np.r_[2 * radius, np.full(n - 1, radius)]))) ** (2 / 3)
    assert pile.p_WRs[-1, 2] - arrays.positions[-1, 2] == pytest.approx(sinking.sum(), rel=0.1)
    assert report.max_penetration == pytest.approx(sinking.max(), rel=0.2)


def test_linear_contacts_sink_in_proportion_to_the_load():
    """One cube and two on the floor: the overlap doubles with the load."""
    overlaps = []
    for n in (1, 2):
        pile = make_pile([[0, 0, 0.5 + k] for k in range(n)])
        config = NonsmoothConfig(linear_overlap=1e-3, reduction="none", rounding=0.01)
        engine = make_engine(pile, [make_box(1.0, 1.0, 1.0)], config=config)
        arrays, _ = run(engine, engine.make_arrays(pile), 3.0)
        overlaps.append(0.5 - arrays.positions[0, 2])
        assert overlaps[-1] == pytest.approx(n * engine.mass[0] * G / 4 / calc_spring(engine, 1e-3), rel=0.02)
    assert overlaps[1] == pytest.approx(2 * overlaps[0], rel=0.02)


def test_arch_of_blocks_stands_and_thrusts():
    """A semicircular arch of nine voussoirs stands by friction and geometry alone."""
    n, inner, outer, width = 9, 2.0, 3.0, 1.0
    angles = np.linspace(0, np.pi, n + 1)
    meshes, centres = [], []
    for a0, a1 in itertools.pairwise(angles):
        points = [
            [r * np.cos(a), y, r * np.sin(a)] for r in (inner, outer) for a in (a0, a1) for y in (0, width)
        ]
        mesh = trimesh.convex.convex_hull(np.array(points))
        centres.append(mesh.center_mass.copy())
        meshes.append(make_shape(mesh))
    pile = make_pile(centres, shape=np.arange(n))
    engine = make_engine(pile, meshes, make_plane_site(1.125), RocksConfig(friction=0.9))
    arrays, report = run(engine, engine.make_arrays(pile), 4.0)
    assert np.abs(arrays.positions - pile.p_WRs).max() < 0.05
    assert np.abs(arrays.velocities).max() < 0.01
    stored = engine.make_pile(arrays)
    feet = stored.contacts.pairs[:, 1] < 0
    forces = stored.contacts.impulses[feet] / engine.time_step
    # the floor carries the whole weight, and the feet push outwards against friction
    assert -forces[:, 2].sum() == pytest.approx(engine.mass.sum() * -G * -1, rel=0.02)
    assert np.abs(forces[:, 0]).sum() > 0.02 * engine.mass.sum() * G
    assert report.max_penetration < 0.01


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_free_spin_keeps_energy_and_momentum(axis):
    """A spinning body near each principal axis (the middle one tumbles)."""
    rate = np.array([0.1, 0.1, 0.1])
    rate[axis] = 6.0
    pile = make_pile([[0, 0, 20.0]], velocities=[[*rate, 0, 0, 0]])
    engine = make_engine(pile, [make_box(0.4, 0.7, 1.0)], gravity=np.zeros(3))
    inertia_local = np.linalg.inv(_full(engine.inverse_inertia_local[0]))

    def calc(arrays):
        r = Rotation.from_quat(arrays.quaternions[0], scalar_first=True).as_matrix()
        inertia = r @ inertia_local @ r.T
        w = arrays.velocities[0, :3]
        return inertia @ w, 0.5 * w @ inertia @ w

    arrays = engine.make_arrays(pile)
    momentum, energy = calc(arrays)
    arrays, _ = run(engine, arrays, 10.0)
    momentum_1, energy_1 = calc(arrays)
    np.testing.assert_allclose(momentum_1, momentum, rtol=1e-9)
    assert energy_1 == pytest.approx(energy, rel=0.01)


def _full(m):
    return np.array([[m[0], m[1], m[2]], [m[1], m[3], m[4]], [m[2], m[4], m[5]]])


def test_bullet_does_not_tunnel_through_a_thin_plate():
    """Small rocks at 5 to 20 m/s against a plate of 20 mm."""
    vertices = np.array([[x, y, z] for x in (-9, 9) for y in (-9, 9) for z in (-0.01, 0.01)], float)
    rng = np.random.default_rng(0)
    for _ in range(10):
        speed = rng.uniform(5, 20)
        pile = make_pile(
            [[*rng.uniform(-0.5, 0.5, 2), 3.0 + rng.uniform(0, 0.3)]], size=[0.3],
            velocities=[[*rng.normal(size=3) * 3, 0, 0, -speed]],
        )  # fmt: skip
        engine = make_engine(
            pile, [make_box(1, 0.8, 0.6)], pieces=[MachinePiece(0, vertices, 1.125)], n_machine_bodies=1
        )
        pose = np.eye(4)
        pose[2, 3] = 1.0
        arrays = engine.make_arrays(pile)
        for _ in range(100):
            arrays, _ = engine.step(arrays, make_still_machine(pose))
            assert arrays.positions[0, 2] > 1.0


def test_same_input_same_bits():
    rng = np.random.default_rng(3)
    pile = make_pile(
        rng.uniform([-1, -1, 0.5], [1, 1, 5], (30, 3)), size=rng.uniform(0.2, 0.5, 30),
    )  # fmt: skip
    shapes = [make_box(1, 0.8, 0.6)]
    results = []
    for _ in range(2):
        engine = make_engine(pile, shapes, config=NonsmoothConfig())
        arrays, _ = run(engine, engine.make_arrays(pile), 1.0)
        results.append(arrays)
    # a third engine takes over in mid-course, with nothing but the state
    engine = make_engine(pile, shapes, config=NonsmoothConfig())
    half, _ = run(engine, engine.make_arrays(pile), 0.5)
    engine = make_engine(pile, shapes, config=NonsmoothConfig())
    results.append(run(engine, half, 0.5)[0])
    for other in results[1:]:
        for name in ("positions", "quaternions", "velocities", "sleep"):
            assert np.array_equal(getattr(results[0], name), getattr(other, name)), name
        for name in ("pairs", "points"):
            assert np.array_equal(getattr(results[0].cache, name), getattr(other.cache, name)), name
