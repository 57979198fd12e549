"""Batches of contacts without a common rock, and their update in vectors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drakerock.rocks.engine import batches, contacts, solver
from drakerock.rocks.engine.engine import make_machineless_step


def draw_rows(rng, n_rows, n_rocks):
    """Contact rows between random pairs of rocks, a fifth of them with the ground, prepared for the solve."""
    body_a = rng.integers(0, n_rocks, n_rows)
    body_b = np.where(
        rng.random(n_rows) < 0.2, n_rocks, (body_a + rng.integers(1, n_rocks, n_rows)) % n_rocks
    )
    rows = np.zeros((n_rows, contacts.ROW_WIDTH))
    for row in rows:
        frame = Rotation.random(random_state=rng).as_matrix()
        row[contacts.NORMAL : contacts.NORMAL + 9] = frame.reshape(-1)
        row[contacts.ARM_A : contacts.ARM_A + 6] = rng.normal(0, 0.3, 6)
        row[contacts.FRICTION] = 0.8
        row[contacts.GAP] = rng.uniform(-2e-3, 1e-3)
        row[contacts.IMPULSE : contacts.IMPULSE + 3] = rng.uniform(0, 5.0), 0.5, -0.5
    bodies = np.zeros((n_rocks + 1, solver.BODY_WIDTH))
    bodies[:n_rocks, :6] = rng.normal(0, 0.2, (n_rocks, 6))
    bodies[:n_rocks, solver.INVERSE_MASS] = 0.01
    bodies[:n_rocks, solver.INVERSE_INERTIA : solver.INVERSE_INERTIA + 6] = [0.2, 0.02, 0.01, 0.3, 0.02, 0.25]
    machine = make_machineless_step().arrays
    softness = np.append(np.full(n_rocks, 2.0), 0.0)
    solver.prepare_rows(
        rows, n_rows, body_a, body_b, bodies, n_rocks, machine, np.zeros(0), softness, 7e8, False, 0.01, 0.05, 1.0, 10.0
    )  # fmt: skip
    return rows, body_a, body_b, bodies


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), n_rows=st.integers(0, 300), n_rocks=st.integers(2, 60))
def test_batches_hold_every_row_once_and_no_rock_twice(seed, n_rows, n_rocks):
    _, body_a, body_b, _ = draw_rows(np.random.default_rng(seed), n_rows, n_rocks)
    arrays = batches.make_batch_arrays(n_rows)
    marks = np.zeros(n_rocks + 1, np.int64)
    n = batches.make_batches(np.arange(n_rows), body_a, body_b, n_rocks, marks, arrays.members, 0)
    assert not marks.any()
    found = arrays.members[:n]
    assert sorted(found[found >= 0]) == list(range(n_rows))
    for batch in found:
        rows = batch[batch >= 0]
        rocks = np.concatenate([body_a[rows], body_b[rows]])
        rocks = rocks[rocks != n_rocks]
        assert len(rocks) == len(set(rocks))


def test_no_vector_of_a_batch_lies_across_two_lines_of_the_cache():
    for room in batches.make_batch_arrays(7):
        assert room.ctypes.data % 64 == 0
        assert not room.any()


def test_a_batch_is_updated_like_its_rows_one_by_one():
    """Sticking, sliding and parting contacts: sixteen at once in single precision, against the scalar update."""
    rng = np.random.default_rng(3)
    rows, body_a, body_b, bodies = draw_rows(rng, 400, 60)
    arrays = batches.make_batch_arrays(len(rows))
    n = batches.make_batches(
        np.arange(len(rows)), body_a, body_b, 60, np.zeros(61, np.int64), arrays.members, 0
    )
    batches.pack(rows, body_a, body_b, 60, arrays, n)
    single = bodies.astype(np.float32)
    change = 0.0
    for k in range(n):
        batches.solve_batch(arrays, k, single)
        for row in arrays.members[k][arrays.members[k] >= 0]:
            change += abs(solver.solve_contact(rows[row], bodies[body_a[row]], bodies[body_b[row]]))
    solved = rows.copy()
    batches.unpack_impulses(arrays, n, solved)
    impulses = slice(contacts.IMPULSE, contacts.IMPULSE + 3)
    np.testing.assert_allclose(solved[:, impulses], rows[:, impulses], atol=2e-3)
    np.testing.assert_allclose(single, bodies, atol=1e-3)
    assert arrays.changes.sum() == pytest.approx(change, rel=1e-3)
    normal, slip = (
        rows[:, contacts.IMPULSE],
        np.hypot(*rows[:, contacts.IMPULSE + 1 : contacts.IMPULSE + 3].T),
    )
    slides = slip > 0.799 * normal
    assert min((normal == 0).sum(), (slides & (normal > 0)).sum(), (~slides).sum()) > 20
