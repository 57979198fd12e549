"""The machine over a step as the contact solve sees it: inertia, closed loops and rows (see `coupling`).

Products of whole matrices are numpy's: a few of them take no time in a step, but seconds each to compile.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.collision.geometry import make_tangents
from drakerock.rocks.engine.compiling import Array, kernel
from drakerock.rocks.engine.solver import (
    LOWER,
    MACHINE_ROW_WIDTH,
    NORMAL_ROW,
    ROW_COMPLIANCE,
    ROW_MASS,
    TARGET,
    UPPER,
    MachineArrays,
)

# Columns of a joint's law.
JOINT_VELOCITY = 0  # its place among the generalised velocities
JOINT_SIDE = 1  # 1, or -1: the row measures the velocity reversed
JOINT_TARGET = 2  # and so on as in `solver`: target, compliance, lower, upper
JOINT_COMPLIANCE = 3
JOINT_LOWER = 4
JOINT_UPPER = 5
JOINT_WIDTH = 6

# Columns of a contact of the plant's own, of a body with the world or with another body.
SITE_BODY = 0
SITE_NORMAL = 1  # 1..3 unit normal in W, into the body
SITE_POINT = 4  # 4..6 in W
SITE_DEPTH = 7
SITE_STIFFNESS = 8
SITE_FRICTION = 9
SITE_OTHER = 10  # the other body, NO_BODY: the world
SITE_WIDTH = 11

NO_BODY = -1

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
        joints: (j, JOINT_WIDTH) laws of motors and stops.
        contacts: (c, SITE_WIDTH).
        stiction_tolerance: slip at which friction is full [m/s].
        time_step: [s].
    """
    n_rows = len(joints) + 3 * len(contacts)
    rows, values = np.zeros((n_rows, len(inverse))), np.zeros((n_rows, MACHINE_ROW_WIDTH))
    values[:, NORMAL_ROW] = -1.0
    _set_rows(joints, contacts, jacobian, origins, stiction_tolerance, time_step, rows, values)
    row_response = rows @ inverse
    values[:, ROW_MASS] = 1.0 / (np.einsum("rv,rv->r", rows, row_response) + values[:, ROW_COMPLIANCE])
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
    n_joints = len(joints)
    for k in range(n_joints):
        rows[k, int(joints[k, JOINT_VELOCITY])] = joints[k, JOINT_SIDE]
        values[k, TARGET], values[k, ROW_COMPLIANCE] = joints[k, JOINT_TARGET], joints[k, JOINT_COMPLIANCE]
        values[k, LOWER], values[k, UPPER] = joints[k, JOINT_LOWER], joints[k, JOINT_UPPER]
    for c in range(len(contacts)):
        _set_site_rows(
            contacts[c], jacobian, origins, n_joints + 3 * c, stiction_tolerance, time_step, rows, values
        )


@kernel
def _set_site_rows(
    contact: Array,
    jacobian: Array,
    origins: Array,
    first: int,
    stiction_tolerance: float,
    time_step: float,
    rows: Array,
    values: Array,
) -> None:
    """Set the rows of a contact from `first` on, a normal one and two of friction: Drake's laws, see `coupling`."""
    body = int(contact[SITE_BODY])
    nx, ny, nz = contact[SITE_NORMAL], contact[SITE_NORMAL + 1], contact[SITE_NORMAL + 2]
    tx, ty, tz, ux, uy, uz = make_tangents(nx, ny, nz)
    x = contact[SITE_POINT] - origins[body, 0]
    y = contact[SITE_POINT + 1] - origins[body, 1]
    z = contact[SITE_POINT + 2] - origins[body, 2]
    axes = ((nx, ny, nz), (tx, ty, tz), (ux, uy, uz))
    for k in range(3):
        ax, ay, az = axes[k]
        # The velocity along an axis, of a point at an arm from the body's origin.
        turning = (y * az - z * ay, z * ax - x * az, x * ay - y * ax)
        for d in range(rows.shape[1]):
            rows[first + k, d] = (
                turning[0] * jacobian[body, 0, d]
                + turning[1] * jacobian[body, 1, d]
                + turning[2] * jacobian[body, 2, d]
                + ax * jacobian[body, 3, d]
                + ay * jacobian[body, 4, d]
                + az * jacobian[body, 5, d]
            )
        if contact[SITE_OTHER] != NO_BODY:
            _subtract_other(contact, jacobian, origins, ax, ay, az, rows[first + k])
    depth, stiffness, mu = contact[SITE_DEPTH], contact[SITE_STIFFNESS], contact[SITE_FRICTION]
    values[first, TARGET] = depth / time_step
    values[first, ROW_COMPLIANCE] = 1.0 / (time_step * time_step * stiffness)
    values[first, UPPER] = np.inf
    for k in range(first + 1, first + 3):
        # Drake's regularised friction is full at the stiction tolerance.
        values[k, ROW_COMPLIANCE] = stiction_tolerance / (mu * time_step * stiffness * depth)
        values[k, LOWER], values[k, UPPER] = -mu, mu
        values[k, NORMAL_ROW] = first


@kernel
def _subtract_other(
    contact: Array, jacobian: Array, origins: Array, ax: float, ay: float, az: float, row: Array
) -> None:
    """Subtract the other body's velocity at the contact along an axis."""
    other = int(contact[SITE_OTHER])
    x = contact[SITE_POINT] - origins[other, 0]
    y = contact[SITE_POINT + 1] - origins[other, 1]
    z = contact[SITE_POINT + 2] - origins[other, 2]
    turning = (y * az - z * ay, z * ax - x * az, x * ay - y * ax)
    for d in range(len(row)):
        row[d] -= (
            turning[0] * jacobian[other, 0, d]
            + turning[1] * jacobian[other, 1, d]
            + turning[2] * jacobian[other, 2, d]
            + ax * jacobian[other, 3, d]
            + ay * jacobian[other, 4, d]
            + az * jacobian[other, 5, d]
        )
