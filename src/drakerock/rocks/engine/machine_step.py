"""The machine over a step as the contact solve sees it: inertia, closed loops and rows (see `rocks.drake.plant_view`).

Products of whole matrices are numpy's: a few of them take no time in a step, but seconds each to compile.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.compiling import Array, Record, Vector, kernel
from drakerock.rocks.engine.records import (
    JOINT_LAW,
    MACHINE_ROW,
    NO_BODY,
    SITE_CONTACT,
    as_records,
    count_columns,
)
from drakerock.rocks.engine.solve.machine_rows import MachineArrays
from drakerock.rocks.engine.vectors import cross, get_vector, make_tangents, subtract

__all__ = ["JOINT_WIDTH", "NO_BODY", "SITE_WIDTH", "calc_free_motion", "make_machine_arrays"]

# Numbers of a joint's law and of a contact with the site.
JOINT_WIDTH = count_columns(JOINT_LAW)
SITE_WIDTH = count_columns(SITE_CONTACT)

# Of the linkage's closed loops, as a share of the mobility they take away.
LOOP_COMPLIANCE = 1e-10


def calc_free_motion(
    inertia: Array, impulse: Array, velocity: Array, loop_rows: Array
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the machine's inverse inertia (v, v) and its free change of velocity (v,), its loops held closed.

    Args:
        inertia: (v, v) mass matrix and the damping over the step.
        impulse: (v,) generalised, over the step, of all but rocks and rows.
        velocity: (v,) generalised velocities now.
        loop_rows: (l, v) what has no velocity as long as the linkage's loops are closed.
    """
    inverse = np.linalg.inv(inertia)
    free_change = inverse @ impulse
    if len(loop_rows) == 0:
        return inverse, free_change
    response = inverse @ loop_rows.T
    mobility = loop_rows @ response
    # A plane linkage has rows that say nothing: with a little compliance they have a solution, too.
    mobility[np.diag_indices_from(mobility)] += LOOP_COMPLIANCE * np.trace(mobility)
    hold = np.linalg.solve(mobility, response.T).T
    return inverse - hold @ response.T, free_change - hold @ (loop_rows @ (velocity + free_change))


def make_machine_arrays(
    inverse: Array,
    jacobian: Array,
    origins: Array,
    joints: Array,
    contacts: Array,
    stiction_tolerance: float,
    time_step: float,
) -> MachineArrays:
    """Return the machine's Jacobians, responses and rows: of joints first, then three per contact with the site.

    Args:
        inverse: (v, v) inverse inertia.
        jacobian: (b, 6, v) of the bodies that touch rocks, at their origins in W.
        origins: (b, 3) these [m].
        joints: (j, JOINT_WIDTH) laws of motors and stops, columns as of `JOINT_LAW`.
        contacts: (c, SITE_WIDTH) columns as of `SITE_CONTACT`.
        stiction_tolerance: slip at which friction is full [m/s].
        time_step: [s].
    """
    n_rows = len(joints) + 3 * len(contacts)
    rows, values = np.zeros((n_rows, len(inverse))), np.zeros(n_rows, MACHINE_ROW)
    values["normal_row"] = -1.0
    _set_rows(
        as_records(joints, JOINT_LAW), as_records(contacts, SITE_CONTACT), jacobian, origins, stiction_tolerance,
        time_step, rows, values,
    )  # fmt: skip
    row_response = rows @ inverse
    values["mass"] = 1.0 / (np.einsum("rv,rv->r", rows, row_response) + values["compliance"])
    response = inverse @ jacobian.transpose(0, 2, 1)
    return MachineArrays(jacobian, response, jacobian @ response, rows, row_response, values)


@kernel
def _set_rows(
    joints: Array,
    contacts: Array,
    jacobian: Array,
    origins: Array,
    stiction_tolerance: float,
    time_step: float,
    rows: Array,
    values: Array,
) -> None:
    """Set all rows but for what follows from inertia."""
    for k in range(len(joints)):
        joint, row = joints[k], values[k]
        rows[k, int(joint.velocity)] = joint.side
        row.target, row.compliance = joint.target, joint.compliance
        row.lower, row.upper = joint.lower, joint.upper
    for c in range(len(contacts)):
        first = len(joints) + 3 * c
        _set_site_rows(contacts[c], jacobian, origins, first, stiction_tolerance, time_step, rows, values)


@kernel
def _set_site_rows(
    contact: Record,
    jacobian: Array,
    origins: Array,
    first: int,
    stiction_tolerance: float,
    time_step: float,
    rows: Array,
    values: Array,
) -> None:
    """Set the rows of a contact from `first` on, a normal one and two of friction: Drake's laws, see `plant_view`."""
    body, normal = int(contact.body), get_vector(contact.normal)
    arm = subtract(get_vector(contact.point), get_vector(origins[body]))
    tangent_1, tangent_2 = make_tangents(normal)
    axes = (normal, tangent_1, tangent_2)
    for k in range(3):
        # The velocity along an axis, of a point at an arm from the body's origin.
        axis, turning = axes[k], cross(arm, axes[k])
        for d in range(rows.shape[1]):
            rows[first + k, d] = (
                turning[0] * jacobian[body, 0, d]
                + turning[1] * jacobian[body, 1, d]
                + turning[2] * jacobian[body, 2, d]
                + axis[0] * jacobian[body, 3, d]
                + axis[1] * jacobian[body, 4, d]
                + axis[2] * jacobian[body, 5, d]
            )
        if contact.other != NO_BODY:
            _subtract_other(contact, jacobian, origins, axis, rows[first + k])
    depth, stiffness, mu = contact.depth, contact.stiffness, contact.friction
    # The law h k (depth - (h + damping time) v): Drake's about v = 0, where bodies rest.
    slowness = time_step + contact.damping_time
    values[first].target = depth / slowness
    values[first].compliance = 1.0 / (time_step * slowness * stiffness)
    values[first].upper = np.inf
    for k in range(first + 1, first + 3):
        # Drake's regularised friction is full at the stiction tolerance.
        values[k].compliance = stiction_tolerance / (mu * time_step * stiffness * depth)
        values[k].lower, values[k].upper = -mu, mu
        values[k].normal_row = first


@kernel
def _subtract_other(contact: Record, jacobian: Array, origins: Array, axis: Vector, row: Array) -> None:
    """Subtract the other body's velocity at the contact along an axis."""
    other = int(contact.other)
    turning = cross(subtract(get_vector(contact.point), get_vector(origins[other])), axis)
    for d in range(len(row)):
        row[d] -= (
            turning[0] * jacobian[other, 0, d]
            + turning[1] * jacobian[other, 1, d]
            + turning[2] * jacobian[other, 2, d]
            + axis[0] * jacobian[other, 3, d]
            + axis[1] * jacobian[other, 4, d]
            + axis[2] * jacobian[other, 5, d]
        )
