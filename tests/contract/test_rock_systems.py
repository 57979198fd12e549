"""Contract of `RockSystem`, held by both engines: what every port says, of which instant, and with which sign.

A plate of 2 t lies on eight rocks on a floor, so that all forces are known: what rocks carry is weight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from pydrake.geometry import AddContactMaterial, Box, ProximityProperties
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import RigidBody, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from drakerock import AddRockBodies, AddRocks, scatter_rocks
from drakerock.rocks.drake.interface import ROCK_SUMMARY, RockContacts, RockSystem

ENGINES = ("nonsmooth", "plant")
PLATE = 2000.0
EARTH = 9.81


@dataclass
class Scene:
    plant: MultibodyPlant
    plate: RigidBody
    rocks: RockSystem
    diagram: Diagram
    simulator: Simulator

    @property
    def root(self) -> Context:
        return self.simulator.get_mutable_context()

    def read(self, port: str, root: Context | None = None):
        return self.rocks.GetOutputPort(port).Eval(self.rocks.GetMyContextFromRoot(root or self.root))

    def read_plate_force(self) -> np.ndarray:
        port = self.rocks.get_body_force_output_port(self.plate.index())
        return np.array(port.Eval(self.rocks.GetMyContextFromRoot(self.root)))

    def get_plate_state(self) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) and translational velocity (3,)."""
        context = self.plant.GetMyContextFromRoot(self.root)
        velocity = self.plate.EvalSpatialVelocityInWorld(context).translational()
        return self.plate.EvalPoseInWorld(context).translation(), velocity

    def calc_masses(self) -> np.ndarray:
        return self.rocks.pile.calc_masses(np.array([shape.volume for shape in self.rocks.shapes]), 2500.0)


def build(engine: str, gravity: float = EARTH, time_step: float = 0.01, plate_height: float = 1.3) -> Scene:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -gravity])
    rough = ProximityProperties()
    # With Drake's default dissipation a plant's own rocks sink into what they lie on.
    AddContactMaterial(
        dissipation=1.0, point_stiffness=1e9, friction=CoulombFriction(1.0, 1.0), properties=rough
    )
    floor = RigidTransform([0.0, 0.0, -0.5])
    plant.RegisterCollisionGeometry(plant.world_body(), floor, Box(20.0, 20.0, 1.0), "floor", rough)
    plate = plant.AddRigidBody("plate", SpatialInertia.SolidBoxWithMass(PLATE, 2.0, 2.0, 0.2))
    plant.RegisterCollisionGeometry(plate, RigidTransform(), Box(2.0, 2.0, 0.2), "plate", rough)
    plant.SetDefaultFloatingBaseBodyPose(plate, RigidTransform([0.0, 0.0, plate_height]))
    pile = scatter_rocks(8, [-0.9, -0.9, 0.0], [0.9, 0.9, 0.9], seed=1)
    bodies = AddRockBodies(plant, pile) if engine == "plant" else None
    plant.Finalize()
    rocks = AddRocks(builder, plant, scene_graph, pile, engine=bodies)
    diagram = builder.Build()
    return Scene(plant, plate, rocks, diagram, Simulator(diagram))


@pytest.fixture(scope="module", params=ENGINES)
def resting(request) -> Scene:
    """The plate rests on the rocks."""
    scene = build(request.param)
    scene.simulator.AdvanceTo(2.5)
    return scene


def test_all_ports_have_their_sizes_and_forces_are_zero_at_the_start():
    for engine in ENGINES:
        scene = build(engine)
        scene.simulator.Initialize()
        pile = scene.read("pile")
        assert len(pile) == 8
        assert pile.contacts is None
        assert np.array_equal(pile.p_WRs, scene.rocks.pile.p_WRs)
        poses = scene.read("poses")
        assert all(np.array_equal(X.translation(), p) for X, p in zip(poses, pile.p_WRs, strict=True))
        assert len(scene.read("summary")) == len(ROCK_SUMMARY)
        assert not scene.read("summary").any()
        assert not scene.read_plate_force().any()
        forces = scene.read("body_spatial_forces")
        assert len(forces) == scene.plant.num_bodies()
        assert not any(force.get_coeffs().any() for force in forces)


def test_pile_and_poses_are_of_the_instant(resting):
    pile = resting.read("pile")
    kept = resting.rocks.get_pile(resting.root)
    for name in ("p_WRs", "q_WRs", "V_WRs"):
        assert np.array_equal(getattr(pile, name), getattr(kept, name))
    for X_WR, p_WR, q_WR in zip(resting.read("poses"), pile.p_WRs, pile.q_WRs, strict=True):
        assert np.allclose(X_WR.translation(), p_WR, atol=1e-15)
        assert np.allclose(X_WR.rotation().ToQuaternion().wxyz() @ q_WR, 1.0, atol=1e-12) or np.allclose(
            X_WR.rotation().ToQuaternion().wxyz() @ q_WR, -1.0, atol=1e-12
        )


def test_mean_force_on_the_plate_is_its_weight(resting):
    forces = []

    def collect(root):
        forces.append(resting.read_plate_force())

    start = resting.root.get_time()
    resting.simulator.set_monitor(collect)
    resting.simulator.AdvanceTo(start + 0.5)
    resting.simulator.clear_monitor()
    assert np.mean(forces, axis=0)[5] == pytest.approx(PLATE * EARTH, rel=0.02)


@pytest.mark.parametrize("engine", ENGINES)
def test_force_over_a_step_is_the_change_of_momentum_in_that_step(engine):
    """Whatever happens, also while the plate comes down: m (v' - v) = h (F - m g), for the step that ended."""
    scene = build(engine)
    h = scene.plant.time_step()
    scene.simulator.Initialize()
    for k in range(60):
        before = scene.get_plate_state()[1]
        scene.simulator.AdvanceTo((k + 1) * h)
        after = scene.get_plate_state()[1]
        expected = PLATE * (after - before) / h + [0.0, 0.0, PLATE * EARTH]
        assert np.allclose(scene.read_plate_force()[3:], expected, atol=1e-3 * PLATE * EARTH)
    assert scene.read_plate_force()[5] > 0.0


def test_list_of_body_forces_holds_the_same(resting):
    forces = resting.read("body_spatial_forces")
    assert np.array_equal(forces[int(resting.plate.index())].get_coeffs(), resting.read_plate_force())
    assert not forces[0].get_coeffs().any()


def test_contacts_say_what_the_coming_step_does(resting):
    contacts: RockContacts = resting.read("contacts")
    ours = contacts.body == int(resting.plate.index())
    arms = contacts.p_WCs[ours] - resting.get_plate_state()[0]
    force = contacts.f_WCs[ours].sum(axis=0)
    torque = (contacts.t_WCs[ours] + np.cross(arms, contacts.f_WCs[ours])).sum(axis=0)
    resting.simulator.AdvanceTo(resting.root.get_time() + resting.plant.time_step())
    assert np.allclose(resting.read_plate_force(), [*torque, *force], rtol=1e-3, atol=1e-3 * PLATE * EARTH)


def test_contacts_obey_the_third_law_and_hold_every_rock(resting):
    """Each point's force is on the counterpart; its opposite on the rock. At rest they carry the rocks' weight."""
    total, n = np.zeros((8, 3)), 40
    for _ in range(n):
        contacts: RockContacts = resting.read("contacts")
        assert ((contacts.other >= 0) != (contacts.body >= 0)).all()
        np.add.at(total, contacts.rock, -contacts.f_WCs / n)
        between = contacts.other >= 0
        np.add.at(total, contacts.other[between], contacts.f_WCs[between] / n)
        resting.simulator.AdvanceTo(resting.root.get_time() + resting.plant.time_step())
    weights = resting.calc_masses() * EARTH
    assert np.allclose(total[:, 2], weights, atol=0.02 * PLATE * EARTH)
    assert np.allclose(total[:, :2], 0.0, atol=0.02 * PLATE * EARTH)


def test_summary_counts_what_there_is(resting):
    summary = dict(zip(ROCK_SUMMARY, resting.read("summary"), strict=True))
    assert 0 <= summary["n_awake"] <= 8
    assert summary["n_contacts"] >= 8
    assert 0.0 <= summary["penetration_p99"] <= summary["penetration_max"] < 0.02
    assert summary["n_lost"] == 0


def test_pile_is_written_and_read_back(resting):
    root = resting.diagram.CreateDefaultContext()
    rng = np.random.default_rng(0)
    pile = replace(
        resting.rocks.pile, p_WRs=resting.rocks.pile.p_WRs + [0.0, 0.0, 5.0], V_WRs=rng.normal(size=(8, 6))
    )
    resting.rocks.set_pile(root, pile)
    for back in (resting.rocks.get_pile(root), resting.read("pile", root)):
        for name in ("p_WRs", "q_WRs", "V_WRs"):
            assert np.allclose(getattr(back, name), getattr(pile, name), atol=1e-14)
    assert not resting.read("summary", root).any()


@pytest.mark.parametrize("engine", ENGINES)
def test_saved_context_goes_on_bit_for_bit(engine):
    scene = build(engine)
    scene.simulator.AdvanceTo(0.4)
    saved = scene.root.Clone()
    ends = []
    for _ in range(2):
        scene.root.SetTimeStateAndParametersFrom(saved)
        scene.simulator.Initialize()
        scene.simulator.AdvanceTo(0.6)
        pile = scene.rocks.get_pile(scene.root)
        ends.append((pile.p_WRs, pile.V_WRs, scene.read_plate_force(), *scene.get_plate_state()))
    assert all(np.array_equal(first, second) for first, second in zip(*ends, strict=True))


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("gravity", "time_step"), [(1.62, 0.01), (9.81, 0.005)])
def test_gravity_and_step_are_the_plants(engine, gravity, time_step):
    scene = build(engine, gravity, time_step)
    high = replace(scene.rocks.pile, p_WRs=scene.rocks.pile.p_WRs + [0.0, 0.0, 9.0])
    scene.rocks.set_pile(scene.root, high)
    n = 20
    scene.simulator.AdvanceTo(n * time_step)
    fallen = high.p_WRs - scene.rocks.get_pile(scene.root).p_WRs
    assert np.allclose(fallen[:, 2], 0.5 * gravity * n * (n + 1) * time_step**2, rtol=1e-9)
    assert np.allclose(fallen[:, :2], 0.0, atol=1e-12)
