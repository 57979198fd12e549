"""Batches of contacts without a common rock, and their update in vectors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drakerock.rocks.engine.contact_law import ContactLaw
from drakerock.rocks.engine.engine import make_machineless_step
from drakerock.rocks.engine.records import BODY
from drakerock.rocks.engine.solve import batches
from drakerock.rocks.engine.solve.bodies import copy_body
from drakerock.rocks.engine.solve.rows import make_contact_rows, prepare_rows, solve_contact

LAW = ContactLaw(
    hertz=7e8, linear=False, time_step=0.01, damping=0.05, max_recovery_speed=1.0, impact_threshold=10.0
)


def draw_rows(rng, n_rows, n_rocks):
    """Contact rows between random pairs of rocks, a fifth of them with the ground, prepared for the solve."""
    rows = make_contact_rows(n_rows)
    rows.body_a[:] = rng.integers(0, n_rocks, n_rows)
    rows.body_b[:] = np.where(
        rng.random(n_rows) < 0.2, n_rocks, (rows.body_a + rng.integers(1, n_rocks, n_rows)) % n_rocks
    )
    for row in rows.values:
        frame = Rotation.random(random_state=rng).as_matrix()
        row["normal"], row["tangent_1"], row["tangent_2"] = frame
        row["arm_a"], row["arm_b"] = rng.normal(0, 0.3, (2, 3))
        row["friction"] = 0.8
        row["gap"] = rng.uniform(-2e-3, 1e-3)
        row["impulse"] = rng.uniform(0, 5.0), 0.5, -0.5
    bodies = np.zeros(n_rocks + 1, BODY)
    rocks = bodies[:n_rocks]
    rocks["angular"], rocks["linear"] = rng.normal(0, 0.2, (2, n_rocks, 3))
    rocks["inverse_mass"] = 0.01
    rocks["inverse_inertia"] = [0.2, 0.02, 0.01, 0.3, 0.02, 0.25]
    compliance = np.append(np.full(n_rocks, 2.0), 0.0)
    prepare_rows(n_rows, bodies, compliance, make_machineless_step().arrays, np.zeros(0), LAW, rows)
    return rows, bodies


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), n_rows=st.integers(0, 300), n_rocks=st.integers(2, 60))
def test_batches_hold_every_row_once_and_no_rock_twice(seed, n_rows, n_rocks):
    drawn, _ = draw_rows(np.random.default_rng(seed), n_rows, n_rocks)
    arrays = batches.make_batch_arrays(n_rows)
    marks = np.zeros(n_rocks + 1, np.int64)
    n = batches.make_batches(np.arange(n_rows), drawn.body_a, drawn.body_b, n_rocks, 0, arrays.members, marks)
    assert not marks.any()
    found = arrays.members[:n]
    assert sorted(found[found >= 0]) == list(range(n_rows))
    for batch in found:
        rows = batch[batch >= 0]
        rocks = np.concatenate([drawn.body_a[rows], drawn.body_b[rows]])
        rocks = rocks[rocks != n_rocks]
        assert len(rocks) == len(set(rocks))


def test_no_vector_of_a_batch_lies_across_two_lines_of_the_cache():
    for room in batches.make_batch_arrays(7):
        assert room.ctypes.data % 64 == 0
        assert not room.any()


def test_a_batch_is_updated_like_its_rows_one_by_one():
    """Sticking, sliding and parting contacts: sixteen at once in single precision, against the scalar update."""
    rng = np.random.default_rng(3)
    rows, bodies = draw_rows(rng, 400, 60)
    arrays, marks = batches.make_batch_arrays(400), np.zeros(61, np.int64)
    n = batches.make_batches(np.arange(400), rows.body_a, rows.body_b, 60, 0, arrays.members, marks)
    batches.pack(rows, 60, n, arrays)
    single = batches.make_single_bodies(61)
    for k in range(61):
        copy_body(bodies[k], single.values[k])
    change = 0.0
    for k in range(n):
        batches.solve_batch(k, arrays, single.matrix)
        for row in arrays.members[k][arrays.members[k] >= 0]:
            a, b = bodies[rows.body_a[row]], bodies[rows.body_b[row]]
            change += abs(solve_contact(rows.values[row], a, b))
    solved = rows._replace(values=rows.values.copy())
    batches.unpack_impulses(arrays, n, solved)
    impulses = rows.values["impulse"]
    np.testing.assert_allclose(solved.values["impulse"], impulses, atol=2e-3)
    for name in ("angular", "linear"):
        np.testing.assert_allclose(single.values[name], bodies[name], atol=1e-3)
    assert arrays.changes.sum() == pytest.approx(change, rel=1e-3)
    normal, slip = impulses[:, 0], np.hypot(*impulses[:, 1:].T)
    slides = slip > 0.799 * normal
    assert min((normal == 0).sum(), (slides & (normal > 0)).sum(), (~slides).sum()) > 20
