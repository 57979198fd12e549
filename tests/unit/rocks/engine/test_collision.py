"""Collision against independent oracles: quadratic programs, hulls of Minkowski differences, brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.common.value import Value
from pydrake.geometry import (
    Convex,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    ProximityProperties,
    SceneGraph,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.solvers import ClarabelSolver, MathematicalProgram
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drakerock.rocks.config import RocksConfig
from drakerock.rocks.engine.collision.geometry import Core
from drakerock.rocks.engine.collision.gjk import (
    NEAR,
    OVERLAPPING,
    SEPARATED,
    calc_core_distance,
    decode_simplex,
    encode_simplex,
    make_gjk_workspace,
)
from drakerock.rocks.engine.collision.manifold import make_manifold, make_manifold_workspace
from drakerock.rocks.engine.collision.penetration import calc_core_penetration
from drakerock.rocks.engine.collision.shapes import make_convex_shapes
from drakerock.rocks.shapes import load_rock_shapes, sample_rock_points

seeds = st.integers(0, 2**31 - 1)


def get_vertices(shapes, k):
    return shapes.vertices[shapes.vertex_start[k] : shapes.vertex_start[k + 1]]


def flat(r):
    return tuple(float(x) for x in np.asarray(r).reshape(-1))


def draw_pair(rng, reach):
    points = [sample_rock_points(rng, int(rng.integers(6, 16))) for _ in range(2)]
    shapes = make_convex_shapes(points, [0.0, 0.0])
    r_a, r_b = (Rotation.random(random_state=int(rng.integers(2**31))).as_matrix() for _ in range(2))
    direction = rng.normal(size=3)
    p = direction / np.linalg.norm(direction) * rng.uniform(*reach)
    return shapes, r_a, r_b, p


def search_distance(shapes, r_a, r_b, p, max_distance=100.0, guess=None, simplex=0, scale_b=1.0):
    guess = p if guess is None else guess
    status, v, on_a, simplex = calc_core_distance(
        shapes, Core(0, 1.0, flat(r_a)), Core(1, scale_b, flat(r_b)), flat(p), flat(guess), simplex, max_distance,
        make_gjk_workspace(),
    )  # fmt: skip
    return status, *v, *on_a, simplex


def calc_distance(*args, **kwargs):
    return search_distance(*args, **kwargs)[:-1]


def calc_penetration(shapes, r_a, r_b, p, history=(0.0, 0.0, 0.0), min_cosine=0.5):
    a, b = Core(0, 1.0, flat(r_a)), Core(1, 1.0, flat(r_b))
    separation, n, on_a = calc_core_penetration(shapes, a, b, flat(p), flat(history), min_cosine)
    return separation, *n, *on_a


def calc_distance_by_program(a, b):
    """The distance of two hulls as a quadratic program over convex combinations of their corners."""
    program = MathematicalProgram()
    u, v = program.NewContinuousVariables(len(a)), program.NewContinuousVariables(len(b))
    program.AddBoundingBoxConstraint(0, 1, u)
    program.AddBoundingBoxConstraint(0, 1, v)
    program.AddLinearEqualityConstraint(np.ones((1, len(a))), [1.0], u)
    program.AddLinearEqualityConstraint(np.ones((1, len(b))), [1.0], v)
    x = np.concatenate([u, v])
    d = np.hstack([a.T, -b.T])
    program.AddQuadraticCost(2 * d.T @ d, np.zeros(len(x)), x, is_convex=True)
    return np.linalg.norm(d @ ClarabelSolver().Solve(program).GetSolution(x))


def calc_penetration_by_hull(a, b):
    """The depth of the origin in the Minkowski difference, from the hull of all differences of corners."""
    hull = ConvexHull((b[None] - a[:, None]).reshape(-1, 3))
    return -hull.equations[:, 3].max()


@pytest.mark.parametrize("seed", range(40))
def test_distance_agrees_with_a_quadratic_program(seed):
    rng = np.random.default_rng(seed)
    shapes, r_a, r_b, p = draw_pair(rng, (1.4, 3.0))
    a, b = get_vertices(shapes, 0) @ r_a.T, get_vertices(shapes, 1) @ r_b.T + p
    expected = calc_distance_by_program(a, b)
    status, *v, ax, ay, az = calc_distance(shapes, r_a, r_b, p)
    if expected < 1e-4:
        return
    assert status == NEAR
    assert np.linalg.norm(v) == pytest.approx(expected, rel=1e-5)
    # the nearest point lies on A and the plane through it separates the bodies
    n = np.array(v) / np.linalg.norm(v)
    assert (a @ n).max() == pytest.approx(np.dot(n, [ax, ay, az]), abs=1e-6)
    assert (b @ n).min() >= (a @ n).max() + expected - 1e-5


@settings(max_examples=150, deadline=None)
@given(seeds)
def test_penetration_agrees_with_the_hull_of_the_difference(seed):
    rng = np.random.default_rng(seed)
    shapes, r_a, r_b, p = draw_pair(rng, (0.0, 1.2))
    a, b = get_vertices(shapes, 0) @ r_a.T, get_vertices(shapes, 1) @ r_b.T + p
    expected = calc_penetration_by_hull(a, b)
    status = calc_distance(shapes, r_a, r_b, p)[0]
    if expected > 1e-4:
        assert status == OVERLAPPING
    if expected <= 0.0:
        return
    separation, *n, ax, ay, az = calc_penetration(shapes, r_a, r_b, p)
    assert -separation == pytest.approx(expected, abs=1e-5)
    n = np.array(n)
    assert np.linalg.norm(n) == pytest.approx(1.0)
    # moving B by the depth along the normal leaves the bodies just touching
    assert (b @ n).min() - separation == pytest.approx((a @ n).max(), abs=1e-5)
    assert np.dot(n, [ax, ay, az]) == pytest.approx((a @ n).max(), abs=1e-5)


@settings(max_examples=100, deadline=None)
@given(seeds)
def test_a_pair_and_its_reverse_agree(seed):
    rng = np.random.default_rng(seed)
    shapes, r_a, r_b, p = draw_pair(rng, (0.3, 2.5))
    turned = make_convex_shapes([get_vertices(shapes, 1), get_vertices(shapes, 0)], [0.0, 0.0])
    one, two = calc_distance(shapes, r_a, r_b, p), calc_distance(turned, r_b, r_a, -p)
    assert one[0] == two[0]
    if one[0] == NEAR:
        np.testing.assert_allclose(one[1:4], -np.array(two[1:4]), atol=1e-4)
    else:
        one, two = calc_penetration(shapes, r_a, r_b, p), calc_penetration(turned, r_b, r_a, -p)
        assert one[0] == pytest.approx(two[0], abs=1e-6)


@settings(max_examples=100, deadline=None)
@given(seeds)
def test_results_turn_with_the_frame(seed):
    rng = np.random.default_rng(seed)
    shapes, r_a, r_b, p = draw_pair(rng, (0.3, 2.5))
    r = Rotation.random(random_state=seed).as_matrix()
    one, two = calc_distance(shapes, r_a, r_b, p), calc_distance(shapes, r @ r_a, r @ r_b, r @ p)
    assert one[0] == two[0]
    if one[0] == NEAR:
        np.testing.assert_allclose(r @ np.array(one[1:4]), two[1:4], atol=1e-4)
    else:
        one, two = calc_penetration(shapes, r_a, r_b, p), calc_penetration(shapes, r @ r_a, r @ r_b, r @ p)
        assert one[0] == pytest.approx(two[0], abs=1e-6)


@settings(max_examples=100, deadline=None)
@given(seeds)
def test_distance_does_not_depend_on_the_guess(seed):
    rng = np.random.default_rng(seed)
    shapes, r_a, r_b, p = draw_pair(rng, (1.5, 2.5))
    one, two = (
        calc_distance(shapes, r_a, r_b, p),
        calc_distance(shapes, r_a, r_b, p, guess=rng.normal(size=3)),
    )
    assert one[0] == two[0]
    if one[0] == NEAR:
        np.testing.assert_allclose(one[1:4], two[1:4], atol=1e-4)


@settings(max_examples=200, deadline=None)
@given(seeds)
def test_a_search_goes_on_from_where_another_ended(seed):
    """From the simplex of a pose nearby, of another pose, or from a senseless one: the distance is the same."""
    rng = np.random.default_rng(seed)
    shapes, r_a, r_b, p = draw_pair(rng, (1.5, 3.0))
    expected = search_distance(shapes, r_a, r_b, p)
    assert expected[0] == NEAR
    turn = Rotation.from_rotvec(rng.normal(scale=rng.choice([1e-3, 0.1, 2.0]), size=3)).as_matrix()
    earlier = search_distance(shapes, r_a, turn @ r_b, p + rng.normal(scale=0.01, size=3))
    counts = np.diff(shapes.vertex_start)
    corners = np.column_stack([rng.integers(0, count, 4) for count in counts[:2]])
    n_points = int(rng.integers(1, 4))
    for simplex in (expected[-1], earlier[-1], encode_simplex(corners, n_points)):
        status, *numbers, _ = search_distance(shapes, r_a, r_b, p, simplex=simplex)
        assert status == NEAR
        np.testing.assert_allclose(numbers[:3], expected[1:4], atol=1e-4)


@given(st.lists(st.tuples(st.integers(0, 127), st.integers(0, 127)), min_size=1, max_size=3))
def test_a_simplex_is_a_number(pairs):
    corners = np.zeros((4, 2), np.int64)
    corners[: len(pairs)] = pairs
    code = encode_simplex(corners, len(pairs))
    assert int(float(code)) == code
    again = np.zeros((4, 2), np.int64)
    assert decode_simplex(code, again) == len(pairs)
    assert np.array_equal(again, corners)
    corners[0, 1] = 128
    assert encode_simplex(corners, len(pairs)) == 0


def test_far_pairs_are_proven_apart():
    rng = np.random.default_rng(1)
    shapes, r_a, r_b, p = draw_pair(rng, (5.0, 6.0))
    status, *axis, _, _, _ = calc_distance(shapes, r_a, r_b, p, max_distance=0.1)
    assert status == SEPARATED
    a, b = get_vertices(shapes, 0) @ r_a.T, get_vertices(shapes, 1) @ r_b.T + p
    axis = np.array(axis) / np.linalg.norm(axis)
    assert (b @ axis).min() - (a @ axis).max() > 0.1


@pytest.mark.parametrize("seed", range(20))
def test_distance_agrees_with_scene_graph(seed):
    """Drake's signed distance of two convex meshes, apart and overlapping."""
    rng = np.random.default_rng(seed)
    shapes, r_a, r_b, p = draw_pair(rng, (1.5, 2.2) if seed % 2 else (0.9, 1.1))
    scene_graph = SceneGraph()
    source = scene_graph.RegisterSource("s")
    ids = []
    for k in range(2):
        frame = scene_graph.RegisterFrame(source, GeometryFrame(f"f{k}"))
        geometry = GeometryInstance(
            RigidTransform(), Convex(get_vertices(shapes, k).T.copy(), f"c{k}"), f"g{k}"
        )
        geometry.set_proximity_properties(ProximityProperties())
        ids.append(scene_graph.RegisterGeometry(source, frame, geometry))
    context = scene_graph.CreateDefaultContext()
    poses = FramePoseVector()
    inspector = scene_graph.model_inspector()
    poses.set_value(inspector.GetFrameId(ids[0]), RigidTransform(RotationMatrix(r_a), [0, 0, 0]))
    poses.set_value(inspector.GetFrameId(ids[1]), RigidTransform(RotationMatrix(r_b), p))
    scene_graph.get_source_pose_port(source).FixValue(context, Value(poses))
    query = scene_graph.get_query_output_port().Eval(context)
    pair = query.ComputeSignedDistancePairClosestPoints(ids[0], ids[1])
    status, *v, _, _, _ = calc_distance(shapes, r_a, r_b, p)
    ours = np.linalg.norm(v) if status == NEAR else calc_penetration(shapes, r_a, r_b, p)[0]
    if status == NEAR:
        assert ours == pytest.approx(pair.distance, abs=1e-4)
    else:
        # Drake's depth comes from an expanding polytope and may stop early: never deeper than the least
        assert ours >= pair.distance - 1e-3


def calc_manifold(shapes, r_a, r_b, p, max_gap=0.005, scale_b=1.0, known=()):
    status, *v, ax, ay, az = calc_distance(shapes, r_a, r_b, p, max_distance=1.0, scale_b=scale_b)
    assert status == NEAR
    distance = np.linalg.norm(v)
    n = np.array(v) / distance
    gap = distance - shapes.rounding[0] - scale_b * shapes.rounding[1]
    points = np.zeros((4, 4))
    points[0] = [*(np.array([ax, ay, az]) + n * (shapes.rounding[0] + 0.5 * gap)), gap]
    count = make_manifold(
        shapes, Core(0, 1.0, flat(r_a)), Core(1, scale_b, flat(r_b)), flat(p), flat(n), max(max_gap, gap), 0.985,
        np.array(known, float).reshape(-1, 3), len(known), points, make_manifold_workspace(),
    )  # fmt: skip
    return n, points[:count]


BOX = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def test_box_on_box_rests_on_four_points():
    shapes = make_convex_shapes([BOX, 0.5 * BOX], [0.03, 0.015])
    n, points = calc_manifold(shapes, np.eye(3), np.eye(3), np.array([0.1, -0.05, 0.751]))
    np.testing.assert_allclose(n, [0, 0, 1], atol=1e-9)
    assert len(points) == 4
    np.testing.assert_allclose(points[:, 3], 0.001, atol=1e-9)
    np.testing.assert_allclose(points[:, 2], 0.5005, atol=1e-9)
    expected = {(x + 0.1, y - 0.05) for x in (-0.235, 0.235) for y in (-0.235, 0.235)}
    for x, y in expected:
        assert np.linalg.norm(points[:, :2] - [x, y], axis=1).min() < 1e-6


def test_points_of_the_last_step_are_kept():
    """A plate with bevelled corners, tilted a hair to and fro: the choice by depth alone would jump."""
    corners = [(x, y) for a, b in ((0.25, 0.22), (0.22, 0.25)) for x in (-a, a) for y in (-b, b)]
    plate = np.array([[x, y, z] for x, y in corners for z in (-0.1, 0.1)])
    shapes = make_convex_shapes([BOX, plate], [0.03, 0.01])
    p = np.array([0.0, 0.0, 0.599])

    def find(*tilt, known=()):
        r_b = Rotation.from_euler("xy", tilt).as_matrix()
        return calc_manifold(shapes, np.eye(3), r_b, p, known=known)[1]

    def find_jump(one, two):
        return np.linalg.norm(one[:, None, :3] - two[None, :, :3], axis=2).min(axis=1).max()

    first = find(1e-4, 1.1e-4)
    assert len(first) == 4
    assert find_jump(first, find(1.1e-4, 1e-4)) > 0.01
    assert find_jump(first, find(1.1e-4, 1e-4, known=first[:, :3])) < 1e-3
    # A corner that is clearly deeper is the first point all the same.
    deepest = find(0.02, 0.001)[0]
    np.testing.assert_allclose(find(0.02, 0.001, known=first[:, :3])[0], deepest)


@pytest.mark.parametrize("ridge_below", [True, False])
def test_faces_at_a_small_angle_make_one_manifold(ridge_below):
    """A slab rests on, or is, a roof of 1 degree: whichever side is the better face, the manifold spans both."""
    rise = 0.5 * np.tan(np.deg2rad(1.0))
    roof = np.array([[x, y, z] for x, z in ((-0.5, 0.5), (0, 0.5 + rise), (0.5, 0.5)) for y in (-0.5, 0.5)])
    roof = np.vstack([roof, BOX[BOX[:, 2] < 0]])
    slab = 0.5 * BOX
    below, above = (roof, slab) if ridge_below else (slab, -roof)
    shapes = make_convex_shapes([below, above], [0.01, 0.01])
    height = below[:, 2].max() - above[:, 2].min() + 0.004
    spans = []
    for tilt in np.deg2rad([-0.6, -0.2, 0.2, 0.6]):
        r_b = Rotation.from_euler("y", tilt).as_matrix()
        _, points = calc_manifold(shapes, np.eye(3), r_b, np.array([0.0, 0.0, height]), max_gap=0.02)
        assert len(points) == 4
        spans.append(np.ptp(points[:, 0]))
    assert min(spans) > 0.4


def test_overlapping_faces_keep_their_gaps():
    """Penetrating within the rounding: still the same four corners, gaps negative."""
    shapes = make_convex_shapes([BOX, 0.5 * BOX], [0.03, 0.03])
    _, points = calc_manifold(shapes, np.eye(3), np.eye(3), np.array([0.0, 0.0, 0.73]))
    assert len(points) == 4
    np.testing.assert_allclose(points[:, 3], -0.02, atol=1e-9)


def test_vertex_on_face_and_edge_on_edge_touch_in_one_point():
    shapes = make_convex_shapes([BOX, BOX], [0.01, 0.01])
    # the corner (1, 1, 1) of the second box looks down
    turn = Rotation.align_vectors([[0, 0, -1]], [[1, 1, 1]])[0].as_matrix()
    _, points = calc_manifold(shapes, np.eye(3), turn, np.array([0.1, 0.1, 0.5 + np.sqrt(0.75)]))
    assert len(points) == 1
    np.testing.assert_allclose(points[0, :2], [0.1, 0.1], atol=1e-3)
    edge = Rotation.from_euler("x", 45, degrees=True).as_matrix()
    other = Rotation.from_euler("y", 45, degrees=True).as_matrix()
    n, points = calc_manifold(shapes, edge, other, np.array([0.0, 0.0, 2 * np.sqrt(0.5)]))
    assert len(points) == 1
    np.testing.assert_allclose(n, [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(points[0, :2], [0, 0], atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_manifold_points_lie_between_the_surfaces(seed):
    """Along the pair's normal no manifold point claims to be deeper than the nearest point."""
    rng = np.random.default_rng(seed)
    vertices = [sample_rock_points(rng) for _ in range(2)]
    shapes = make_convex_shapes(vertices, [0.05, 0.05])
    r_a, r_b = (Rotation.random(random_state=int(rng.integers(2**31))).as_matrix() for _ in range(2))
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    # move B along the direction until the gap is 1 mm
    low, high = 0.5, 5.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        status, *v, _, _, _ = calc_distance(shapes, r_a, r_b, middle * direction)
        near = status == OVERLAPPING or np.linalg.norm(v) < 0.101
        low, high = (middle, high) if near else (low, middle)
    _, points = calc_manifold(shapes, r_a, r_b, high * direction)
    assert points[:, 3].min() >= points[0, 3] - 1e-9
    assert points[0, 3] == pytest.approx(0.001, abs=1e-3)
    assert (points[:, 3] <= 0.0051).all()


def test_history_keeps_a_pressed_rock_on_its_side_of_a_plate():
    """A rock whose centre has passed the middle of a plate is pushed back, not through."""
    plate = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-0.02, 0.02)])
    shapes = make_convex_shapes([BOX * 0.4, plate], [0.0, 0.0])
    # the rock came from above (the plate is below it, normal rock -> plate is -z) and is nearly through
    p = np.array([0.0, 0.0, 0.17])
    assert calc_penetration(shapes, np.eye(3), np.eye(3), p)[3] == pytest.approx(1.0)
    separation, *n, _, _, _ = calc_penetration(shapes, np.eye(3), np.eye(3), p, history=(0.0, 0.0, -1.0))
    np.testing.assert_allclose(n, [0, 0, -1], atol=1e-9)
    assert separation == pytest.approx(-(0.2 + 0.02 + 0.17), abs=1e-9)


def test_rounded_rocks_stay_close_to_their_hulls():
    """Core plus ball differs from the hull by less than the rounding, on all faces."""
    for item in load_rock_shapes(RocksConfig()):
        shapes = make_convex_shapes([item.vertices], [0.03])
        core = get_vertices(shapes, 0)
        hull = ConvexHull(item.vertices)
        inset = -hull.equations[:, 3] - (hull.equations[:, :3] @ core.T).max(axis=1)
        print(inset)
        assert abs(inset - 0.03).max() < 0.012
        assert inset.mean() == pytest.approx(0.03, abs=0.002)


def test_points_without_volume_are_rejected():
    with pytest.raises(ValueError, match="no volume"):
        make_convex_shapes([np.random.default_rng(0).normal(size=(6, 3)) * [1, 1, 0]], [0.0])
    with pytest.raises(ValueError, match="no core"):
        make_convex_shapes([BOX], [0.6])


def test_faces_and_edges_of_a_box():
    shapes = make_convex_shapes([BOX], [0.0])
    assert len(shapes.face_normals) == 6
    assert len(shapes.edge_vertices) == 12
    assert (np.diff(shapes.face_vertex_start) == 4).all()
    for face in range(6):
        outline = shapes.vertices[
            shapes.face_vertices[shapes.face_vertex_start[face] : shapes.face_vertex_start[face + 1]]
        ]
        normal = np.cross(outline[1] - outline[0], outline[2] - outline[1])
        np.testing.assert_allclose(normal / np.linalg.norm(normal), shapes.face_normals[face], atol=1e-12)
