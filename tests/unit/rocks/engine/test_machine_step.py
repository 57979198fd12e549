"""The machine's side of the contact solve, against the equations of motion."""

from __future__ import annotations

import numpy as np
import pytest

from drakerock.rocks.engine.machine_step import (
    JOINT_WIDTH,
    NO_BODY,
    SITE_WIDTH,
    calc_free_motion,
    make_machine_arrays,
)

N_V, N_BODIES, H = 9, 3, 0.01


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.fixture
def inertia(rng):
    root = rng.normal(size=(N_V, N_V))
    return root @ root.T + np.eye(N_V)


@pytest.fixture
def jacobian(rng):
    return rng.normal(size=(N_BODIES, 6, N_V))


def test_free_motion_without_loops_is_newtons(rng, inertia):
    impulse, velocity = rng.normal(size=(2, N_V))
    inverse, change = calc_free_motion(inertia, impulse, velocity, np.zeros((0, N_V)))
    assert np.allclose(inverse @ inertia, np.eye(N_V), atol=1e-9)
    assert np.allclose(inertia @ change, impulse)


def test_closed_loops_stay_closed_whatever_pushes(rng, inertia):
    # The third row says nothing that the first two do not: a plane linkage has such rows.
    loop_rows = rng.normal(size=(2, N_V))
    loop_rows = np.vstack([loop_rows, loop_rows.sum(axis=0)])
    impulse, velocity = rng.normal(size=(2, N_V))
    inverse, change = calc_free_motion(inertia, impulse, velocity, loop_rows)
    assert np.allclose(loop_rows @ (velocity + change), 0.0, atol=1e-7)
    assert np.allclose(loop_rows @ inverse, 0.0, atol=1e-7)
    assert np.allclose(inverse, inverse.T)
    # What the loops do not forbid goes by Newton's law: D'Alembert's principle.
    _, _, free_directions = np.linalg.svd(loop_rows[:2])
    free_directions = free_directions[2:]
    missing = inertia @ change - impulse
    assert np.allclose(free_directions @ missing, 0.0, atol=1e-6)


def test_responses_follow_from_inertia_and_jacobians(inertia, jacobian):
    inverse = np.linalg.inv(inertia)
    arrays = make_machine_arrays(
        inverse,
        jacobian,
        np.zeros((N_BODIES, 3)),
        np.zeros((0, JOINT_WIDTH)),
        np.zeros((0, SITE_WIDTH)),
        1e-3,
        H,
    )
    for b in range(N_BODIES):
        assert np.allclose(arrays.response[b], inverse @ jacobian[b].T)
        assert np.allclose(arrays.mobility[b], jacobian[b] @ inverse @ jacobian[b].T)
    assert len(arrays.rows) == len(arrays.row_values) == len(arrays.row_response) == 0


def test_rows_measure_joints_and_points_on_the_site(rng, inertia, jacobian):
    inverse, origins, velocity = np.linalg.inv(inertia), rng.normal(size=(N_BODIES, 3)), rng.normal(size=N_V)
    joints = np.array([[4, 1.0, 0.3, 1e-3, -5.0, 6.0], [7, -1.0, -0.2, 0.0, 0.0, np.inf]])
    normal, point = np.array([0.6, 0.0, 0.8]), np.array([0.3, -1.0, 0.2])
    depth, stiffness, mu, tolerance, damping_time = 2e-3, 5e6, 0.7, 1e-3, 0.03
    contact = np.array([[1, *normal, *point, depth, stiffness, mu, NO_BODY, damping_time]])
    arrays = make_machine_arrays(inverse, jacobian, origins, joints, contact, tolerance, H)

    measured = arrays.rows @ velocity
    assert measured[:2] == pytest.approx([velocity[4], -velocity[7]])
    V_WB = jacobian[1] @ velocity
    v_WP = V_WB[3:] + np.cross(V_WB[:3], point - origins[1])
    assert measured[2] == pytest.approx(normal @ v_WP)
    assert np.linalg.norm(measured[2:]) == pytest.approx(np.linalg.norm(v_WP))

    values = arrays.row_values
    law = ["target", "compliance", "lower", "upper"]
    assert values[:2][law].tolist() == [tuple(joint) for joint in joints[:, 2:]]
    slowness = H + damping_time
    assert values[2][law].tolist() == pytest.approx(
        (depth / slowness, 1.0 / (H * slowness * stiffness), 0.0, np.inf)
    )
    # Full friction, mu times the load of the penetration, at the stiction tolerance.
    for row in values[3:5]:
        assert row["compliance"] * mu * H * stiffness * depth == pytest.approx(tolerance)
        assert row[["lower", "upper", "normal_row"]].tolist() == (-mu, mu, 2)
    assert values["normal_row"][:3].tolist() == [-1, -1, -1]
    assert np.allclose(arrays.row_response, arrays.rows @ inverse)
    diagonal = np.diag(arrays.rows @ inverse @ arrays.rows.T)
    assert np.allclose(values["mass"] * (diagonal + values["compliance"]), 1.0)


def test_a_contact_of_two_bodies_measures_one_against_the_other(rng, inertia, jacobian):
    inverse, origins, velocity = np.linalg.inv(inertia), rng.normal(size=(N_BODIES, 3)), rng.normal(size=N_V)
    normal, point = np.array([0.6, 0.0, 0.8]), np.array([0.3, -1.0, 0.2])
    contact = np.array([[1, *normal, *point, 2e-3, 5e6, 0.7, 2, 0.0]])
    arrays = make_machine_arrays(inverse, jacobian, origins, np.zeros((0, JOINT_WIDTH)), contact, 1e-3, H)
    V_WBs = [jacobian[b] @ velocity for b in (1, 2)]
    speeds = [V[3:] + np.cross(V[:3], point - origins[b]) for V, b in zip(V_WBs, (1, 2), strict=True)]
    measured = arrays.rows @ velocity
    assert measured[0] == pytest.approx(normal @ (speeds[0] - speeds[1]))
    assert np.linalg.norm(measured) == pytest.approx(np.linalg.norm(speeds[0] - speeds[1]))
