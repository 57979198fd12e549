"""Which rocks touch, against Drake's distances."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.geometry import FramePoseVector, GeometryFrame, GeometryInstance, ProximityProperties, SceneGraph
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from drakerock.resources import find_data
from drakerock.rocks.contact_graph import find_contacts, find_loose
from drakerock.rocks.drake.drift import make_convex
from drakerock.rocks.drake.poses import make_pose
from drakerock.rocks.state import PileState, load_pile

GAP = 0.005


def calc_distances(pile, shapes):
    """Signed distance of every pair of rocks, by Drake; {(a, b): distance}, far pairs left out."""
    scene_graph = SceneGraph()
    source = scene_graph.RegisterSource("rocks")
    vector, geometries = FramePoseVector(), []
    for rock in range(len(pile)):
        frame = scene_graph.RegisterFrame(source, GeometryFrame(f"rock_{rock}"))
        shape = shapes[pile.shape[rock]]
        convex = make_convex(shape.vertices, shape.name, float(pile.size[rock]))
        geometry = GeometryInstance(RigidTransform(), convex, f"rock_{rock}")
        geometry.set_proximity_properties(ProximityProperties())
        geometries.append(scene_graph.RegisterGeometry(source, frame, geometry))
        vector.set_value(frame, make_pose(pile.q_WRs[rock], pile.p_WRs[rock]))
    context = scene_graph.CreateDefaultContext()
    scene_graph.get_source_pose_port(source).FixValue(context, vector)
    query = scene_graph.get_query_output_port().Eval(context)
    reach = np.array([shape.radius for shape in shapes])[pile.shape] * pile.size
    return {
        (a, b): query.ComputeSignedDistancePairClosestPoints(geometries[a], geometries[b]).distance
        for a, b in itertools.combinations(range(len(pile)), 2)
        if np.linalg.norm(pile.p_WRs[a] - pile.p_WRs[b]) < reach[a] + reach[b] + 2 * GAP
    }


def find_loose_by_walking(pile, pairs):
    """The rocks that cannot be reached from the heaviest body, nor from a fixed rock, from touch to touch."""
    neighbours = {rock: set() for rock in range(len(pile))}
    for a, b in pairs:
        neighbours[a].add(b)
        neighbours[b].add(a)
    bodies, seen = [], set()
    for start in range(len(pile)):
        if start in seen:
            continue
        body, new = set(), {start}
        while new:
            body |= new
            new = set().union(*(neighbours[rock] for rock in new)) - body
        seen |= body
        bodies.append(sorted(body))
    heaviest = max(bodies, key=lambda body: sum(pile.size[body] ** 3))
    loose = np.ones(len(pile), bool)
    for body in bodies:
        loose[body] = not (body is heaviest or pile.fixed[body].any())
    return loose


def check(pile, shapes):
    """Contacts and loose rocks are those of Drake's distances; pairs at the very gap may be either."""
    distances = calc_distances(pile, shapes)
    contacts = {(min(pair), max(pair)) for pair in find_contacts(pile, shapes, GAP).tolist()}
    assert {pair for pair, distance in distances.items() if distance < GAP - 1e-6} <= contacts
    assert contacts <= {pair for pair, distance in distances.items() if distance < GAP + 1e-6}
    loose = find_loose(pile, shapes, GAP)
    np.testing.assert_array_equal(loose, find_loose_by_walking(pile, contacts))
    return loose


@settings(max_examples=40)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 25), spread=st.floats(0.0, 1.5))
def test_contacts_and_loose_rocks_are_those_of_drakes_distances(shapes, seed, n, spread):
    rng = np.random.default_rng(seed)
    pile = PileState(
        p_WRs=spread * rng.uniform(-1.0, 1.0, size=(n, 3)),
        q_WRs=Rotation.random(n, rng=rng).as_quat(scalar_first=True),
        V_WRs=np.zeros((n, 6)),
        shape=rng.integers(len(shapes), size=n),
        size=rng.choice([0.3, 0.4, 0.6], size=n),
        fixed=rng.random(n) < 0.1,
    )
    check(pile, shapes)


@pytest.fixture(scope="module")
def shipped():
    return load_pile(find_data("data", "default_pile.npz"))


def test_front_of_the_shipped_pile_after_a_hole_is_dug(shipped, shapes):
    front = shipped.p_WRs[:, 0] < -0.5
    dug = np.linalg.norm(shipped.p_WRs - [-2.5, 0.0, 0.5], axis=1) < 1.0
    thinned = np.random.default_rng(0).random(len(shipped)) < 0.5
    pile = shipped.select(front & ~dug & thinned)
    assert len(pile) > 100
    loose = check(pile, shapes)
    assert 0 < loose.sum() < len(pile)


def test_what_bears_load_in_the_shipped_pile_touches(shipped, shapes):
    loaded = shipped.contacts.pairs[shipped.contacts.pairs[:, 1] >= 0]
    touching = {(min(pair), max(pair)) for pair in find_contacts(shipped, shapes, GAP).tolist()}
    assert {tuple(pair) for pair in loaded.tolist()} <= touching
