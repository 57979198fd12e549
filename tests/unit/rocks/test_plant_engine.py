from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drakerock.lhd.config import MachineConfig
from drakerock.lhd.geometry import collision_pieces
from drakerock.lhd.model import add_machine
from drakerock.rocks.config import RocksConfig, SiteConfig
from drakerock.rocks.contact_graph import find_contacts, find_loose
from drakerock.rocks.drake.add_rocks import AddRocks
from drakerock.rocks.drake.drift import AddDrift
from drakerock.rocks.drake.geometry import read_plant_geometry
from drakerock.rocks.drake.interface import ROCK_SUMMARY
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.drake.plant_engine import AddRockBodies
from drakerock.rocks.engine.config import DynamicsConfig, NonsmoothConfig
from drakerock.rocks.making.scatter import scatter_rocks
from drakerock.rocks.materials import calc_contact_stiffness, calc_pair_friction
from drakerock.rocks.site import make_site
from drakerock.rocks.state import make_empty_pile
from rock_helpers import make_engine


def build(pile, shapes):
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, DynamicsConfig())
    AddDrift(plant, make_site(SiteConfig(drift_width=3.9)))
    bodies = AddRockBodies(plant, pile, shapes=shapes)
    plant.Finalize()
    rocks = AddRocks(builder, plant, scene_graph, pile, engine=bodies)
    return builder.Build(), plant, rocks


def test_written_pile_is_read_back_and_shown_by_the_ports(heap, shapes):
    moving = replace(heap, V_WRs=np.random.default_rng(0).normal(size=(12, 6)))
    diagram, plant, rocks = build(heap, shapes)
    root = diagram.CreateDefaultContext()
    rocks.set_pile(root, moving)
    back = rocks.get_pile(root)
    assert np.allclose(back.p_WRs, heap.p_WRs, atol=1e-12)
    assert np.allclose(back.q_WRs, heap.q_WRs, atol=1e-12)
    assert np.allclose(back.V_WRs, moving.V_WRs, atol=1e-12)
    context = rocks.GetMyContextFromRoot(root)
    shown = rocks.GetOutputPort("pile").Eval(context)
    assert np.allclose(np.hstack([shown.q_WRs, shown.p_WRs]), np.hstack([heap.q_WRs, heap.p_WRs]), atol=1e-12)
    assert np.allclose(shown.V_WRs, moving.V_WRs, atol=1e-12)
    assert len(rocks.GetOutputPort("summary").Eval(context)) == len(ROCK_SUMMARY)
    body = plant.GetBodyByName("rock_7")
    assert np.allclose(
        plant.EvalBodyPoseInWorld(plant.GetMyContextFromRoot(root), body).translation(), heap.p_WRs[7]
    )


def test_rock_bodies_have_the_shapes_mass_and_inertia(heap, shapes):
    _, plant, _ = build(heap, shapes)
    rocks = RocksConfig()
    masses = heap.calc_masses(np.array([shape.volume for shape in shapes]), rocks.density)
    for rock in range(12):
        body = plant.GetBodyByName(f"rock_{rock}")
        assert body.default_mass() == pytest.approx(masses[rock], rel=1e-9)
        inertia = body.default_spatial_inertia().CalcRotationalInertia().CopyToFullMatrix3()
        assert np.allclose(inertia, rocks.density * heap.size[rock] ** 5 * shapes[heap.shape[rock]].inertia)


def test_fixed_rocks_do_not_move(heap, shapes):

    fixed = np.zeros(12, bool)
    fixed[:3] = True
    pile = replace(heap, fixed=fixed)
    diagram, _, rocks = build(pile, shapes)
    simulator = Simulator(diagram)
    rocks.set_pile(simulator.get_mutable_context(), pile)
    simulator.AdvanceTo(0.3)
    after = rocks.get_pile(simulator.get_context())
    assert np.array_equal(after.p_WRs[:3], pile.p_WRs[:3])
    assert np.linalg.norm(after.p_WRs[3:] - pile.p_WRs[3:], axis=1).max() > 0.01


def test_hundreds_of_fixed_rocks_are_no_trouble(heap, shapes):
    """On the world's body, beside the floor, they made Drake 1.58 read stray memory."""
    many = heap
    for k in range(1, 30):
        many = many.join(replace(heap, p_WRs=heap.p_WRs + [0.0, 0.0, 3.0 * k]))
    pile = replace(many, fixed=np.arange(len(many)) >= len(heap))
    diagram, plant, rocks = build(pile, shapes)
    simulator = Simulator(diagram)
    rocks.set_pile(simulator.get_mutable_context(), pile)
    simulator.AdvanceTo(0.1)
    after = rocks.get_pile(simulator.get_context())
    assert np.array_equal(after.p_WRs[pile.fixed], pile.p_WRs[pile.fixed])
    assert len(plant.GetCollisionGeometriesForBody(plant.GetBodyByName("fixed_rocks"))) == 29 * len(heap)


def test_effective_friction_of_every_pair_is_the_methods():
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, DynamicsConfig())
    machine = add_machine(plant, MachineConfig())
    plant.Finalize()
    pieces = collision_pieces(plant, scene_graph, machine)
    rock, drift = RocksConfig().friction, SiteConfig().friction
    tyre = pieces["wheel_front_left"][0].material.friction
    bucket = {piece.material.friction for piece in pieces["bucket"]}
    assert calc_pair_friction(rock, rock) == pytest.approx(0.9)
    assert calc_pair_friction(rock, drift) == pytest.approx(1.0)
    assert calc_pair_friction(tyre, drift) == pytest.approx(1.0)
    for mu in bucket:
        assert calc_pair_friction(rock, mu) == pytest.approx(1.0)


def test_contact_stiffness_reproduces_hertz_at_the_reference_overlap():
    E, nu, r, d = 1e9, 0.3, 0.2, 1e-3
    k = calc_contact_stiffness(E, nu, r, d)
    e_star = 1 / (2 * (1 - nu**2) / E)
    assert k * d == pytest.approx(4 / 3 * e_star * np.sqrt(r / 2) * d**1.5)


def test_contact_graph_finds_near_pairs_only(heap, shapes):
    far = replace(heap, p_WRs=np.column_stack([np.arange(12.0), np.zeros(12), np.zeros(12)]))
    assert len(find_contacts(far, shapes, 0.005)) == 0
    assert find_loose(far, shapes, 0.005).sum() == 11
    assert len(find_loose(make_empty_pile(), shapes, 0.005)) == 0
    # Two cube-like rocks brought together: within the gap they touch, a hair beyond it not.
    pair = heap.select(np.array([0, 6]))
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        moved = replace(pair, p_WRs=np.array([[0, 0, 0], [middle, 0, 0]], float))
        low, high = (middle, high) if len(find_contacts(moved, shapes, 0.0)) else (low, middle)
    touching = replace(pair, p_WRs=np.array([[0, 0, 0], [high + 0.004, 0, 0]]))
    apart = replace(pair, p_WRs=np.array([[0, 0, 0], [high + 0.02, 0, 0]]))
    assert len(find_contacts(touching, shapes, 0.005)) == 1
    assert len(find_contacts(apart, shapes, 0.005)) == 0


def test_only_the_floor_is_a_half_space(heap, shapes):
    """Several unbounded geometries beside convex pieces crash Drake's proximity engine now and then."""
    diagram, _, _ = build(heap, shapes)
    inspector = diagram.GetSubsystemByName("scene_graph").model_inspector()
    kinds = [type(inspector.GetShape(geometry)).__name__ for geometry in inspector.GetAllGeometryIds()]
    assert kinds.count("HalfSpace") == 1
    assert kinds.count("Box") == 3 + 6  # and what is drawn of them


def test_walls_hold_rocks_in(heap, shapes):
    """A rock thrown at each wall at 8 m/s comes back or stops, and none is beyond the wall's plane."""
    site = make_site(SiteConfig(drift_width=3.9))
    ways = np.array([[0, 8.0, 0], [0, -8.0, 0], [8.0, 0, 0]])
    p = np.array([[-2.0, 1.0, 1.5], [-2.0, -1.0, 1.5], [site.config.void_depth - 1.5, 0, 1.5]])
    three = heap.select(np.arange(3))
    pile = replace(three, p_WRs=p, V_WRs=np.hstack([np.zeros((3, 3)), ways]))
    diagram, _, rocks = build(pile, shapes)
    simulator = Simulator(diagram)
    rocks.set_pile(simulator.get_mutable_context(), pile)
    simulator.Initialize()
    simulator.AdvanceTo(0.5)
    after = rocks.get_pile(simulator.get_context())
    for plane in site.planes:
        assert (after.p_WRs @ plane.normal > plane.offset).all()
    assert (np.linalg.norm(after.V_WRs[:, 3:], axis=1) < 5.0).all()


def test_the_nonsmooth_engines_linear_law_has_the_plants_springs(heap, shapes):
    builder = DiagramBuilder()
    dynamics = DynamicsConfig(nonsmooth=NonsmoothConfig(linear_overlap=DynamicsConfig().reference_overlap))
    plant, scene_graph = add_plant(builder, dynamics)
    add_machine(plant, MachineConfig())
    geometries = AddRockBodies(plant, heap, shapes=shapes).geometries
    plant.Finalize()
    found = read_plant_geometry(plant, scene_graph, [-9.0] * 3, [9.0] * 3, geometries)
    engine = make_engine(
        heap, shapes, config=dynamics.nonsmooth, pieces=found.pieces, n_machine_bodies=len(found.bodies)
    )
    inspector = scene_graph.model_inspector()

    def get_compliance(geometry):
        return 1.0 / inspector.GetProximityProperties(geometry).GetProperty(
            "material", "point_contact_stiffness"
        )

    rocks, still, bodies = np.split(engine.contact_compliance, [len(heap), len(heap) + 1])
    assert rocks == pytest.approx([get_compliance(geometry) for geometry in geometries])
    assert still == 0.0
    for compliance, index in zip(bodies, found.bodies, strict=True):
        body = plant.get_body(index)
        assert compliance == get_compliance(plant.GetCollisionGeometriesForBody(body)[0])


@pytest.mark.parametrize("approximation", ["lagged", "sap"])
def test_rocks_do_not_sink_into_each_other_in_either_approximation(approximation):
    """With Drake's own relaxation time, 0.1 s, `sap` lets them: 8 mm on average, 25 at most."""
    dynamics = DynamicsConfig.model_validate({"contact_approximation": approximation})
    pile = scatter_rocks(20, (-2.5, -1.0, 0.3), (-0.5, 1.0, 3.0), seed=3)
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, dynamics)
    AddDrift(plant, make_site(SiteConfig(drift_width=3.9)), dynamics.plant)
    bodies = AddRockBodies(plant, pile, config=dynamics.plant)
    plant.Finalize()
    rocks = AddRocks(builder, plant, scene_graph, pile, engine=bodies)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(2.0)
    context = rocks.GetMyContextFromRoot(simulator.get_context())
    depth = rocks.GetOutputPort("contacts").Eval(context).depth
    assert len(depth) > 10
    assert depth.mean() < 0.0015
    assert depth.max() < 0.005


@pytest.mark.parametrize(
    ("given", "key"),
    [
        ({"contact_approximation": "sap", "stiction_tolerance": 1e-3}, "stiction_tolerance"),
        ({"contact_approximation": "sap", "plant": {"dissipation": 2.0}}, "plant.dissipation"),
        ({"plant": {"relaxation_time": 0.02}}, "plant.relaxation_time"),
        ({"plant": {"hydroelastic_modulus": 1e7}}, "hydroelastic_modulus"),
        ({"rocks": "plant", "nonsmooth": {"iterations": 7}}, "nonsmooth"),
        ({"plant": {"hydroelastic_resolution": 0.2}}, "hydroelastic_resolution"),
    ],
)
def test_a_key_without_effect_is_refused(given, key):
    with pytest.raises(ValidationError, match=key):
        DynamicsConfig.model_validate(given)
