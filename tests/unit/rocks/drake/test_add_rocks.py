"""`AddRocks`: what it refuses, each with one message that names the body or port, and how it wires a Diagram."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from pydrake.common.value import Value
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    HalfSpace,
    Mesh,
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    ProximityProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    ExternallyAppliedSpatialForce,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import PdControllerGains, PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder, ConstantValueSource, ConstantVectorSource, MatrixGain

from drakerock import AddDrift, AddRockBodies, AddRocks, RockContactVisualizer, RocksConfig
from drakerock.errors import InputError, SimulationFailure
from drakerock.rocks.config import SiteConfig
from drakerock.rocks.drake.geometry import read_plant_geometry
from drakerock.rocks.site import calc_bounds, make_site, make_surroundings
from drakerock.rocks.state import PileState
from rock_helpers import make_pile


def make_material(friction: float) -> ProximityProperties:
    """With Drake's default dissipation bodies sink into each other."""
    properties = ProximityProperties()
    AddContactMaterial(
        dissipation=1.0,
        point_stiffness=1e8,
        friction=CoulombFriction(friction, friction),
        properties=properties,
    )
    return properties


ROUGH = make_material(1.0)


class World:
    """A plant with a floor, and rocks of 0.4 m at given places."""

    def __init__(
        self, time_step: float = 0.01, floor: bool = True, surface: ProximityProperties = ROUGH, **options
    ) -> None:
        self.builder = DiagramBuilder()
        self.plant, self.scene_graph = AddMultibodyPlant(
            MultibodyPlantConfig(time_step=time_step, **options), self.builder
        )
        if floor:
            self.add_geometry(
                "floor", Box(20.0, 20.0, 1.0), [0.0, 0.0, -0.5], self.plant.world_body(), surface
            )

    def add_geometry(self, name, shape, p, body, friction=ROUGH):
        return self.plant.RegisterCollisionGeometry(body, RigidTransform(p), shape, name, friction)

    def add_body(self, name, shape, mass=500.0, rail=None, gains=None, friction=ROUGH):
        """A body with one shape, free, or on a prismatic joint with a motor along `rail`."""
        inertia = SpatialInertia.SolidBoxWithMass(mass, 0.5, 0.5, 0.5) if mass else SpatialInertia.Zero()
        body = self.plant.AddRigidBody(name, inertia)
        # On a rail it hovers over the floor.
        self.add_geometry(name, shape, [0.0, 0.0, 0.0 if rail is None or rail[2] else 0.27], body, friction)
        if rail is not None:
            joint = self.plant.AddJoint(
                PrismaticJoint(f"{name}_rail", self.plant.world_frame(), body.body_frame(), rail)
            )
            motor = self.plant.AddJointActuator(f"{name}_motor", joint)
            if gains:
                motor.set_controller_gains(PdControllerGains(p=gains[0], d=gains[1]))
        return body

    def add_rocks(self, places=((0.0, 0.0, 0.3),), **options):
        self.pile = make_pile(places, size=np.full(len(places), 0.4))
        self.rocks = AddRocks(self.builder, self.plant, self.scene_graph, self.pile, **options)
        return self.rocks

    def run(self, time: float) -> PileState:
        self.simulator = Simulator(self.builder.Build())
        self.root = self.simulator.get_mutable_context()
        self.simulator.AdvanceTo(time)
        return self.rocks.get_pile(self.root)

    def place(self, body, p):
        self.plant.SetDefaultFloatingBaseBodyPose(body, RigidTransform(p))

    def read_pose(self, body) -> np.ndarray:
        return body.EvalPoseInWorld(self.plant.GetMyContextFromRoot(self.root)).translation()


def finalized(world: World) -> World:
    world.plant.Finalize()
    return world


# Bad input


def test_unfinalized_plant():
    with pytest.raises(InputError, match="not finalized"):
        World().add_rocks()


def test_continuous_plant():
    with pytest.raises(InputError, match="continuous"):
        finalized(World(time_step=0.0)).add_rocks()


def test_plant_without_scene_graph():
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(0.01))
    plant.Finalize()
    with pytest.raises(InputError, match="no SceneGraph"):
        AddRocks(builder, plant, builder.AddSystem(SceneGraph()), make_pile([0.0, 0.0, 1.0]))


def test_finalized_plant_for_rock_bodies():
    with pytest.raises(InputError, match="finalized"):
        AddRockBodies(finalized(World()).plant, make_pile([0.0, 0.0, 1.0]))


def test_rocks_twice():
    world = finalized(World())
    world.add_rocks()
    with pytest.raises(InputError, match="rocks already"):
        world.add_rocks()


def test_half_space_on_a_moving_body():
    world = World()
    world.add_body("shovel", HalfSpace())
    with pytest.raises(InputError, match=r"shovel.*HalfSpace.*cannot move"):
        finalized(world).add_rocks()


def test_mesh_that_is_not_convex(tmp_path):
    pieces = [trimesh.creation.box((1.0, 0.2, 0.2)), trimesh.creation.box((0.2, 0.2, 1.0))]
    pieces[1].apply_translation([0.4, 0.0, 0.6])
    trimesh.util.concatenate(pieces).export(tmp_path / "corner.obj")
    world = World()
    world.add_body("hook", Mesh(str(tmp_path / "corner.obj"), 1.0))
    with pytest.raises(InputError, match=r"hook.*not convex"):
        finalized(world).add_rocks()


def test_body_without_mass():
    world = World()
    ghost = world.add_body("ghost", Box(0.5, 0.5, 0.5), mass=0.0)
    rail = PrismaticJoint("rail", world.plant.world_frame(), ghost.body_frame(), [1.0, 0.0, 0.0])
    world.plant.AddJoint(rail)
    with pytest.raises(InputError, match=r"ghost.*no mass"):
        finalized(world).add_rocks()


@pytest.mark.parametrize("size", [0.4, 0.08])
def test_body_that_starts_inside_the_pile(size):
    world = World()
    world.place(world.add_body("shovel", Box(size, size, size)), [0.3 * size, 0.0, 5.0])
    finalized(world)
    pile = make_pile([0.0, 0.0, 5.0], size=[size])
    AddRocks(world.builder, world.plant, world.scene_graph, pile)
    with pytest.raises(InputError, match=r"shovel.*inside a rock"):
        Simulator(world.builder.Build()).Initialize()


def test_motor_with_gains_that_nothing_drives():
    world = World()
    world.add_body("plough", Box(0.5, 0.5, 0.5), rail=[1.0, 0.0, 0.0], gains=(1e5, 1e4))
    with pytest.raises(InputError, match=r"desired_state"):
        finalized(world).add_rocks()


def test_exported_applied_force():
    world = finalized(World())
    world.builder.ExportInput(world.plant.get_applied_spatial_force_input_port())
    with pytest.raises(InputError, match=r"applied_spatial_force.*exported"):
        world.add_rocks()


def test_pose_that_is_not_finite():
    with pytest.raises(ValueError, match="p_WRs: not finite"):
        make_pile([0.0, np.nan, 1.0])


def test_robot_pose_that_is_not_finite():
    world = World()
    shovel = world.add_body("shovel", Box(0.5, 0.5, 0.5))
    world.place(shovel, [3.0, 0.0, 2.0])
    finalized(world).add_rocks()
    simulator = Simulator(world.builder.Build())
    context = world.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    context.get_mutable_discrete_state_vector().SetAtIndex(6, np.nan)
    with pytest.raises(SimulationFailure, match=r"shovel.*not finite"):
        simulator.Initialize()


def test_body_that_rocks_do_not_meet_has_no_port():
    world = World()
    ghost = world.plant.AddRigidBody("ghost", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    rocks = finalized(world).add_rocks()
    with pytest.raises(KeyError, match="ghost"):
        rocks.get_body_force_output_port(ghost.index())


# Geometry


def test_drift_in_a_plant_is_the_site():
    """`AddDrift` and `read_plant_geometry` give back the surfaces that `make_surroundings` makes of the site."""
    for config in (SiteConfig(), SiteConfig(void_taper_deg=3.0, wall_lean_deg=-5.0, drift_width=4.0)):
        world = World(floor=False)
        AddDrift(world.plant, make_site(config))
        finalized(world)
        lower, upper = calc_bounds(config)
        found = read_plant_geometry(world.plant, world.scene_graph, lower, upper).surroundings
        expected = make_surroundings(make_site(config))
        assert len(found.half_spaces) == len(expected.half_spaces)
        for ours in expected.half_spaces:
            row = np.array([*ours.normal, ours.offset, ours.friction])
            rows = [np.array([*other.normal, other.offset, other.friction]) for other in found.half_spaces]
            assert min(np.abs(row - other).max() for other in rows) < 1e-12
        assert len(found.pieces) == len(expected.pieces)
        for ours, other in zip(expected.pieces, found.pieces, strict=True):
            gaps = np.linalg.norm(ours.vertices[:, None] - other.vertices, axis=2)
            assert gaps.min(axis=1).max() < 1e-12
            assert gaps.min(axis=0).max() < 1e-12
            assert ours.friction == other.friction


# Physics of the coupling


def test_rock_rests_on_a_table_of_another_model():
    world = World()
    table = world.plant.AddRigidBody(
        "table",
        world.plant.AddModelInstance("furniture"),
        SpatialInertia.SolidBoxWithMass(50.0, 2.0, 2.0, 0.1),
    )
    world.add_geometry("top", Box(2.0, 2.0, 0.1), [0.0, 0.0, 0.75], table)
    world.plant.WeldFrames(world.plant.world_frame(), table.body_frame())
    finalized(world).add_rocks([[0.0, 0.0, 1.2]])
    end = world.run(1.5)
    assert 0.8 < end.p_WRs[0, 2] < 1.1
    assert np.linalg.norm(end.V_WRs[0, 3:]) < 0.01


def test_two_robots_push_from_both_sides():
    """Blocks on rails on either side, one with 3 kN, one that holds its place: the rock between carries 3 kN."""
    world = World()
    shape = Box(0.2, 1.0, 0.5)
    left = world.add_body("left", shape, rail=[1.0, 0.0, 0.0])
    right = world.add_body("right", shape, rail=[1.0, 0.0, 0.0], gains=(1e8, 1e7))
    for body, x in ((left, -0.8), (right, 0.8)):
        world.plant.GetJointByName(f"{body.name()}_rail").set_default_translation(x)
    finalized(world)
    force = world.builder.AddSystem(ConstantVectorSource([3e3, 0.0]))
    world.builder.Connect(force.get_output_port(), world.plant.get_actuation_input_port())
    place = world.builder.AddSystem(ConstantVectorSource([0.0, 0.8, 0.0, 0.0]))
    world.builder.Connect(
        place.get_output_port(), world.plant.get_desired_state_input_port(left.model_instance())
    )
    rocks = world.add_rocks([[0.0, 0.0, 0.25]])
    end = world.run(2.0)
    assert 0.2 < end.p_WRs[0, 0] < 0.6
    assert np.linalg.norm(end.V_WRs[0, 3:]) < 0.02
    context = rocks.GetMyContextFromRoot(world.root)
    for body, sign in ((left, -1.0), (right, 1.0)):
        F_B_W = rocks.get_body_force_output_port(body.index()).Eval(context)
        assert F_B_W[3] == pytest.approx(sign * 3e3, rel=0.05)


def test_motor_feels_rocks_through_the_plain_actuation_port():
    """A blade with a constant force against a rock on a wall: it stands, and the rock carries the force."""
    world = World()
    world.add_geometry("wall", Box(1.0, 4.0, 2.0), [1.0, 0.0, 1.0], world.plant.world_body())
    blade = world.add_body("blade", Box(0.2, 1.0, 0.5), rail=[1.0, 0.0, 0.0])
    world.plant.GetJointByName("blade_rail").set_default_translation(-0.8)
    finalized(world)
    force = world.builder.AddSystem(ConstantVectorSource([2e3]))
    world.builder.Connect(force.get_output_port(), world.plant.get_actuation_input_port())
    rocks = world.add_rocks([[0.2, 0.0, 0.25]])
    world.run(2.0)
    F_B_W = rocks.get_body_force_output_port(blade.index()).Eval(rocks.GetMyContextFromRoot(world.root))
    assert F_B_W[3] == pytest.approx(-2e3, rel=0.02)


@pytest.mark.parametrize("late", [False, True])
def test_applied_force_of_others_still_acts_and_rocks_feel_it(late):
    """A plate on a rock, pressed down by others: the rock carries weight and press, the plate does not creep."""
    world = World()
    plate = world.add_body("plate", Box(0.6, 0.6, 0.1), mass=100.0, rail=[0.0, 0.0, 1.0])
    world.plant.GetJointByName("plate_rail").set_default_translation(0.8)
    finalized(world)
    press = ExternallyAppliedSpatialForce()
    press.body_index = plate.index()
    press.F_Bq_W = SpatialForce(np.zeros(3), np.array([0.0, 0.0, -20e3]))
    others = world.builder.AddSystem(ConstantValueSource(Value[list[ExternallyAppliedSpatialForce]]([press])))
    port = world.plant.get_applied_spatial_force_input_port()
    if not late:
        world.builder.Connect(others.get_output_port(), port)
    rocks = world.add_rocks()
    if late:
        world.builder.Connect(others.get_output_port(), rocks.GetInputPort("applied_spatial_force"))
    world.run(1.5)
    F_B_W = rocks.get_body_force_output_port(plate.index()).Eval(rocks.GetMyContextFromRoot(world.root))
    assert F_B_W[5] == pytest.approx(20e3 + 100.0 * 9.81, rel=1e-3)
    # What the rocks take the plate's coming velocity to be, and what it is; 2 m/s apart if they did not know.
    foreseen = rocks.get_report(world.root).machine_velocity
    world.simulator.AdvanceTo(1.51)
    velocity = world.plant.GetVelocities(world.plant.GetMyContextFromRoot(world.root))
    assert np.allclose(foreseen, velocity, atol=1e-4)


@pytest.mark.parametrize("friction", [0.0, 1.0])
def test_bodies_that_touch_each_other_carry_a_rock_together(friction):
    """A block on a block, a rock on top: contacts between two moving bodies are in the solve, smooth ones too."""
    world = World()
    smooth = make_material(friction)
    up = [0.0, 0.0, 1.0]
    lower = world.add_body("lower", Box(1.0, 1.0, 0.5), mass=800.0, rail=up, friction=smooth)
    upper = world.add_body("upper", Box(1.0, 1.0, 0.5), mass=300.0, rail=up, friction=smooth)
    for body, z in ((lower, 0.25), (upper, 0.75)):
        world.plant.GetJointByName(f"{body.name()}_rail").set_default_translation(z)
    finalized(world)
    rocks = world.add_rocks([[0.0, 0.0, 1.25]])
    end = world.run(1.0)
    mass = world.pile.calc_masses(np.array([shape.volume for shape in rocks.shapes]), 2500.0)[0]
    F_B_W = rocks.get_body_force_output_port(upper.index()).Eval(rocks.GetMyContextFromRoot(world.root))
    assert F_B_W[5] == pytest.approx(-mass * 9.81, rel=0.05)
    assert 1.0 < end.p_WRs[0, 2] < 1.3
    assert world.read_pose(upper)[2] == pytest.approx(0.75, abs=0.01)


def make_soft(compliant: bool) -> ProximityProperties:
    properties = make_material(1.0)
    if compliant:
        AddCompliantHydroelasticProperties(0.1, 1e6, properties)
    else:
        AddRigidHydroelasticProperties(0.5, properties)
    return properties


@pytest.mark.parametrize("approximation", ["sap", "lagged", "similar"])
@pytest.mark.parametrize("surface", ["default", "soft on rigid", "soft on soft"])
def test_rocks_foresee_what_drakes_contact_laws_do(approximation, surface):
    """A block on the floor is pressed by a rock: its coming velocity is foreseen whatever its surface is like."""
    floor, block = ProximityProperties(), ProximityProperties()
    if surface != "default":
        floor, block = make_soft(compliant=surface == "soft on soft"), make_soft(compliant=True)
    world = World(surface=floor, discrete_contact_approximation=approximation)
    body = world.add_body("block", Box(1.0, 1.0, 0.5), mass=300.0, rail=[0.0, 0.0, 1.0], friction=block)
    world.plant.GetJointByName("block_rail").set_default_translation(0.25)
    finalized(world)
    rocks = world.add_rocks([[0.0, 0.0, 0.8]])
    world.run(1.5)
    mass = world.pile.calc_masses(np.array([shape.volume for shape in rocks.shapes]), 2500.0)[0]
    F_B_W = rocks.get_body_force_output_port(body.index()).Eval(rocks.GetMyContextFromRoot(world.root))
    assert F_B_W[5] == pytest.approx(-mass * 9.81, rel=0.01)
    foreseen = rocks.get_report(world.root).machine_velocity
    world.simulator.AdvanceTo(1.51)
    velocity = world.plant.GetVelocities(world.plant.GetMyContextFromRoot(world.root))
    assert np.allclose(foreseen, velocity, atol=1e-3)


def test_surface_that_says_nothing_has_drakes_default_friction():
    """The friction of SceneGraphConfig, 0.5 if nobody sets it, is also the one that rocks meet."""
    world = finalized(World(surface=ProximityProperties()))
    lower, upper = np.full(3, -5.0), np.full(3, 5.0)
    (floor,) = read_plant_geometry(world.plant, world.scene_graph, lower, upper).surroundings.pieces
    assert floor.friction == 0.5


def test_momentum_is_kept_without_gravity():
    """Nothing rests in free fall: no rock is asleep and takes a blow like a wall."""
    world = World(floor=False)
    world.plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    finalized(world)
    velocities = np.zeros((2, 6))
    velocities[0, 3] = 1.0
    pile = make_pile([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], size=[0.4, 0.4], velocities=velocities)
    world.rocks = AddRocks(world.builder, world.plant, world.scene_graph, pile)
    end = world.run(1.5)
    assert end.V_WRs[1, 3] > 0.1
    assert end.V_WRs[:, 3:].sum(axis=0) == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)


def test_rock_that_rests_moves_on_when_it_is_given_a_velocity():
    world = finalized(World(surface=make_material(1e-4)))
    rocks = world.add_rocks([[0.0, 0.0, 0.18]])
    rest = world.run(1.2)
    assert rocks.GetOutputPort("status").Eval(rocks.GetMyContextFromRoot(world.root)) == [1.0]
    velocities = np.zeros((1, 6))
    velocities[0, 3] = 2.0
    rocks.set_pile(world.root, replace(rest, V_WRs=velocities))
    world.simulator.AdvanceTo(1.5)
    assert rocks.get_pile(world.root).p_WRs[0, 0] > 0.4


def test_motor_connected_late_is_refused():
    """Rocks would not feel it; Drake ends the process where a port is connected twice, so only look."""
    world = World()
    plough = world.add_body("plough", Box(0.5, 0.5, 0.5), rail=[1.0, 0.0, 0.0])
    finalized(world).add_rocks([[3.0, 0.0, 0.3]])
    for port in (
        world.plant.get_actuation_input_port(),
        world.plant.get_actuation_input_port(plough.model_instance()),
        world.plant.get_applied_generalized_force_input_port(),
    ):
        assert world.builder.IsConnectedOrExported(port)


def test_second_source_of_geometry_in_the_scene_graph():
    """Another system's geometry in the same SceneGraph does not stop the plant from finding its contacts."""
    world = World()
    ball = world.add_body("ball", Sphere(0.3), mass=50.0)
    world.place(ball, [2.0, 0.0, 0.5])
    finalized(world)
    other = world.builder.AddNamedSystem("other", MultibodyPlant(0.01))
    other.RegisterAsSourceForSceneGraph(world.scene_graph)
    body = other.AddRigidBody("satellite", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    other.RegisterVisualGeometry(body, RigidTransform(), Sphere(0.1), "satellite", [1.0, 0.0, 0.0, 1.0])
    other.Finalize()
    world.builder.Connect(
        other.get_geometry_pose_output_port(), world.scene_graph.get_source_pose_port(other.get_source_id())
    )
    world.add_rocks()
    world.run(0.5)
    assert world.read_pose(ball)[2] == pytest.approx(0.3, abs=0.01)


def test_rocks_and_contact_forces_are_drawn():
    world = finalized(World())
    rocks = world.add_rocks()
    meshcat = Meshcat(MeshcatParams(show_stats_plot=False))
    RockContactVisualizer.AddToBuilder(world.builder, rocks, meshcat, newtons_per_meter=1e3)
    MeshcatVisualizer.AddToBuilder(world.builder, world.scene_graph, meshcat)
    world.run(0.5)
    paths = [f"/drake/visualizer/{name}" for name in ("rock_0", "rocks/rock_0", "rocks")]
    assert any(meshcat.HasPath(path) for path in paths)
    assert meshcat.HasPath("/drake/rock_contacts/bodies")
    assert meshcat.HasPath("/drake/rock_contacts/rocks")


def test_controller_that_is_unstable_ends_in_a_failure_that_names_the_body():
    """Velocities that grow without bound reach the search for rocks, which once read memory that is not its own."""
    world = World()
    world.add_body("plough", Box(0.2, 1.0, 0.5), rail=[1.0, 0.0, 0.0])
    world.plant.GetJointByName("plough_rail").set_default_translation(-2.0)
    finalized(world)
    gain = world.builder.AddSystem(MatrixGain([[0.0, -1e6]]))
    offset = world.builder.AddSystem(Adder(2, 1))
    push = world.builder.AddSystem(ConstantVectorSource([1e3]))
    world.builder.Connect(world.plant.get_state_output_port(), gain.get_input_port())
    world.builder.Connect(gain.get_output_port(), offset.get_input_port(0))
    world.builder.Connect(push.get_output_port(), offset.get_input_port(1))
    world.builder.Connect(offset.get_output_port(), world.plant.get_actuation_input_port())
    world.add_rocks()
    with pytest.raises(SimulationFailure, match="plough"):
        world.run(10.0)


def test_rocks_of_any_size_keep_their_gaps():
    """Rocks of 3 cm come to rest on a floor as rocks of 40 cm do: nothing sinks in by a share of its size."""
    world = finalized(World())
    config = RocksConfig(gradation=({"size_m": 0.03, "mass_fraction": 1.0},))
    pile = replace(make_pile([[0.0, 0.0, 0.05], [0.1, 0.0, 0.05]]), size=np.full(2, 0.03))
    world.rocks = AddRocks(world.builder, world.plant, world.scene_graph, pile, config)
    end = world.run(1.0)
    lowest = [
        float((replace_pose(end, k) @ (0.03 * world.rocks.shapes[0].vertices).T)[2].min() + end.p_WRs[k, 2])
        for k in range(2)
    ]
    assert np.abs(lowest).max() < 1.5e-3
    assert np.abs(end.V_WRs).max() < 1e-3


def replace_pose(pile: PileState, k: int) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(pile.q_WRs[k], scalar_first=True).as_matrix()
