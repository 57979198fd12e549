"""The contact law against Hertz, Signorini and Coulomb."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drakerock.rocks.engine.contact_law import MIN_OVERLAP, ContactLaw, calc_normal_law
from drakerock.rocks.engine.engine import make_machineless_step
from drakerock.rocks.engine.records import BODY
from drakerock.rocks.engine.solve.rows import make_contact_rows, prepare_rows, solve_contact

H = 0.01
HERTZ = 7e8


def make_law(linear=False, damping_time=4.5):
    return ContactLaw(HERTZ, linear, H, 1.0 / (1.0 + 4.0 * damping_time), 1.0, 0.1)


@given(st.floats(1e-6, 0.01), st.floats(0.5, 10.0), st.floats(0.0, 20.0))
def test_a_contact_at_rest_carries_hertzs_force(overlap, curvature, damping_time):
    """At rest the constraint is c p = b: the force p / h is that of the law, whatever the damping."""
    law = make_law(damping_time=damping_time)._replace(max_recovery_speed=np.inf)
    bias, compliance = calc_normal_law(-overlap, 0.0, 0.0, curvature, law)
    expected = HERTZ * np.sqrt(max(overlap, MIN_OVERLAP) / curvature) * overlap
    assert bias / compliance / H == pytest.approx(expected)
    bias, compliance = calc_normal_law(-overlap, 0.0, 0.0, 1e-8, law._replace(linear=True))
    assert bias / compliance / H == pytest.approx(overlap / 1e-8)


@given(st.floats(1e-6, 0.02), st.floats(-0.09, 0.5), st.floats(0.0, 1e4))
def test_the_bound_on_recovery_takes_nothing_from_what_is_carried(overlap, approach, load):
    law = make_law()
    bias, compliance = calc_normal_law(-overlap, approach, load, 2.0, law)
    free, _ = calc_normal_law(-overlap, approach, load, 2.0, law._replace(max_recovery_speed=np.inf))
    assert bias <= free
    # With the load of the last step it still parts at the bound, if the overlap would part it faster.
    closing = min(approach, 0.0)
    if bias < free:
        assert bias - compliance * load == pytest.approx(
            law.max_recovery_speed - 3.0 * law.damping * closing, abs=1e-9
        )


@given(st.floats(1e-6, 0.1), st.floats(-0.09, 1.0))
def test_what_is_apart_may_just_meet(gap, approach):
    assert calc_normal_law(gap, approach, 0.0, 2.0, make_law()) == (-gap / H, 0.0)


@given(
    st.integers(0, 1000),
    st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3),
    st.floats(-0.003, 0.003),
    st.floats(0.0, 1.5),
)
def test_an_update_of_a_lone_contact_is_its_solution(seed, velocity, gap, mu):
    """Two balls touch between their centres: Signorini's condition and Coulomb's law hold after one update."""
    rows, bodies = make_contact_rows(1), np.zeros(3, BODY)
    bodies["inverse_mass"][:2] = 0.01, 0.02
    bodies["linear"][1] = velocity
    row = rows.values[0]
    frame = Rotation.random(random_state=seed).as_matrix()
    row["normal"], row["tangent_1"], row["tangent_2"] = frame
    row["gap"], row["friction"] = gap, mu
    rows.body_b[0] = 1
    machine, compliance = make_machineless_step().arrays, np.array([2.0, 3.0, 0.0])
    prepare_rows(1, bodies, compliance, machine, np.zeros(0), make_law(), rows)
    solve_contact(rows.values[0], bodies[0], bodies[1])
    u, *slip = frame @ (bodies["linear"][1] - bodies["linear"][0])
    p, *friction = row["impulse"]
    excess = u + row["compliance"] * p - row["bias"]
    assert p >= 0.0
    assert excess >= -1e-9
    assert p * excess == pytest.approx(0.0, abs=1e-7)
    size = np.hypot(*friction)
    assert size <= mu * p + 1e-9
    if size < mu * p - 1e-6:
        np.testing.assert_allclose(slip, 0.0, atol=1e-9)
    elif p > 0.0:
        # It slides, and friction is against the slip.
        assert np.dot(slip, friction) == pytest.approx(-np.hypot(*slip) * size, abs=1e-6)
