"""How the engine's data lie in memory: every record, its fields, their units and frames, in one place.

A record is a row of numbers of one type, so that arrays of records can be read and written as plain matrices, too
(`find_column`): vector instructions and a Drake context know numbers only. In kernels fields have names,
``row.normal[0]``; that compiles to the same instructions as ``row[0]``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

# Status of a rock.
AWAKE, SLEEPING, FIXED, LOST = 0, 1, 2, 3

# How the contacts of a body are found in a step, see `collision.persistence`.
SEARCHED, COMOVING, FOLLOWED = 0, 1, 2

# A contact point as the solve sees it. All vectors in W; impulses act on body B, and reversed on body A.
CONTACT_ROW = np.dtype(
    [
        ("normal", float, 3),  # unit, from A to B
        ("tangent_1", float, 3),
        ("tangent_2", float, 3),
        ("arm_a", float, 3),  # from A's origin to the point [m]
        ("arm_b", float, 3),  # from B's origin to the point [m]
        ("normal_mass", float),  # 1 / (normal mobility + compliance) [kg]
        ("coupling", float, 2),  # normal impulse -> velocity along either tangent [1/kg]
        ("tangent_mass", float, 3),  # inverse of the tangential mobility, 2 x 2: 11 12 22 [kg]
        ("bias", float),  # normal velocity aimed at [m/s]
        ("compliance", float),  # of the normal constraint [m/s per N s]
        ("friction", float),  # coefficient
        ("impulse", float, 3),  # along normal, tangent 1, tangent 2 [N s]
        ("gap", float),  # at the beginning of the step, negative: overlap [m]
        ("restitution", float),  # coefficient of Newton's law
        ("tangent_step", float),  # 2 / trace of the tangential mobility [kg]
        ("simplex", float),  # where the search for the nearest points ended, see `gjk.encode_simplex`; or 0
        ("unused", float),
    ]
)


def make_body_record(number: type) -> np.dtype[Any]:
    """Return the record of a rock in the solve, in double or single precision."""
    return np.dtype(
        [
            ("angular", number, 3),  # angular velocity in W [rad/s]
            ("linear", number, 3),  # velocity of the centre of mass in W [m/s]
            ("inverse_mass", number),  # [1/kg]
            ("inverse_inertia", number, 6),  # xx xy xz yy yz zz in W's axes [1/(kg m^2)]
            ("unused", number, 3),
        ]
    )


# All that is not awake stands still and is immovable: all zero.
BODY = make_body_record(np.float64)
SINGLE_BODY = make_body_record(np.float32)

# A row of the machine: motor, joint stop, contact with the site. Units are those of its generalised velocity.
MACHINE_ROW = np.dtype(
    [
        ("target", float),  # velocity aimed at
        ("compliance", float),  # velocity per impulse
        ("lower", float),  # least impulse; of a friction row times the normal impulse
        ("upper", float),  # greatest impulse; likewise
        ("mass", float),  # 1 / (mobility + compliance)
        ("impulse", float),
        ("normal_row", float),  # of a friction row, which come in pairs: its normal row; else -1
    ]
)

# The law of a joint's motor or stop, see `machine_step`.
JOINT_LAW = np.dtype(
    [
        ("velocity", float),  # place among the generalised velocities
        ("side", float),  # 1, or -1: the row measures the velocity reversed
        ("target", float),  # and so on as of a machine row
        ("compliance", float),
        ("lower", float),
        ("upper", float),
    ]
)

# A contact of the plant's own, of a body with the world or with another body, see `machine_step`.
SITE_CONTACT = np.dtype(
    [
        ("body", float),  # number among the bodies of the Jacobian
        ("normal", float, 3),  # unit, in W, into the body
        ("point", float, 3),  # in W [m]
        ("depth", float),  # [m]
        ("stiffness", float),  # [N/m]
        ("friction", float),  # coefficient
        ("other", float),  # the other body, NO_BODY: the world
        ("damping_time", float),  # by which dissipation slows it, beside the time step [s]
    ]
)
NO_BODY = -1

# A contact point between steps, in single precision: all of them are looked at in every step. An even number of
# numbers, as two take the room of one of a Drake context's.
CACHED_POINT = np.dtype(
    [
        ("point", np.float32, 3),  # in the frame of the pair's first rock [m]
        ("impulse", np.float32, 3),  # on the second body, in W [N s]
        ("simplex", np.float32, 2),  # see `CONTACT_ROW`: its lower and its upper bits
        ("normal", np.float32, 3),  # in the frame of the pair's first rock
        ("gap", np.float32),  # after the step [m]
    ]
)

# A rock's sleep, all of it stored in the context. What only awake and what only sleeping rocks need share their room.
SLEEP = np.dtype(
    {
        "names": ["status", "still_time", "changed_steps", "anchor", "reference", "moved", "way"],
        "formats": ["f8", "f8", "f8", ("f8", 3), ("f8", 3), "f8", "f8"],
        # status; of an awake rock: for how long it has been still [s], and where it was when that began [m].
        # Of a sleeping rock: for how many steps its load has been changed (`NEW`: its reference is not set yet), and
        # the sum of its contact impulses when it fell asleep [N s].
        # Of both: 1 if it has moved since the start; its way since its contacts were searched [m].
        "offsets": [0, 8, 8, 16, 16, 40, 48],
        "itemsize": 56,
    }
)
# In `changed_steps`: the rock has just fallen asleep.
NEW = -1.0

# A box in which no rock sleeps: rotation by rows and position in W, corners in its own frame [m].
SENSOR = np.dtype([("rotation", float, 9), ("position", float, 3), ("lower", float, 3), ("upper", float, 3)])

# A corner that may become a point of a contact manifold.
CANDIDATE = np.dtype([("point", float, 3), ("gap", float), ("known", float)])


def find_column(record: np.dtype[Any], field: str) -> int:
    """Return the first column of a field when records are looked at as rows of a matrix."""
    assert record.fields is not None
    return int(record.fields[field][1]) // record[0].base.itemsize


def count_columns(record: np.dtype[Any]) -> int:
    """Return how many numbers a record has."""
    return record.itemsize // record[0].base.itemsize


def as_matrix(records: np.ndarray) -> np.ndarray:
    """Return records (n,) as a matrix (n, columns), in the same memory."""
    return records.view(records.dtype[0].base).reshape(len(records), count_columns(records.dtype))


def as_records(matrix: np.ndarray, record: np.dtype[Any]) -> np.ndarray:
    """Return a matrix (n, columns) as records (n,), in the same memory if its rows lie in line."""
    return np.ascontiguousarray(matrix, record[0].base).reshape(-1).view(record)


def copy_records(source: np.ndarray, target: np.ndarray, rows: NDArray[np.int64] | None = None) -> None:
    """Copy records, or some rows of them, as bytes: where fields share their room, numpy is thirty times slower."""
    record = np.dtype((np.void, source.dtype.itemsize))
    chosen = slice(None) if rows is None else rows
    target.view(record)[chosen] = source.view(record)[chosen]
