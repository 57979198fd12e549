"""Where bodies are, and the boxes that hold them over a step."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.collision.geometry import Core, get_corner
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Vector, kernel
from drakerock.rocks.engine.vectors import (
    dot,
    get_rotation,
    get_vector,
    make_rotation,
    rotate_symmetric,
    subtract,
)

# By how much a rock's turning extends its box at most [m/s]: a rock that spins faster is searched no farther around.
MAX_TURNING = 1.0


class CollisionBodies(NamedTuple):
    """All bodies that touch: rocks, static pieces, planes, pieces of the machine (n bodies).

    Attributes:
        shape, scale: (n,) number and scale of each one's shape.
        positions, rotations: (n, 3) [m], (n, 3, 3).
        solver_body: (n,) body of the solve: rocks are their own, all that stands still is the one after the last rock,
            machine bodies are beyond.
        friction: (n,) each one's coefficient; a pair has 2 a b / (a + b).
    """

    shape: NDArray[np.int64]
    scale: NDArray[np.float64]
    positions: NDArray[np.float64]
    rotations: NDArray[np.float64]
    solver_body: NDArray[np.int64]
    friction: NDArray[np.float64]


class Boxes(NamedTuple):
    """Bounding boxes of all bodies, margins and the way over the step included.

    Attributes:
        lower, upper: (n, 3) their corners [m].
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]


@kernel
def get_core(bodies: CollisionBodies, k: int) -> Core:
    """Return the core of a body, no plane."""
    return Core(bodies.shape[k], bodies.scale[k], get_rotation(bodies.rotations, k))


@kernel
def get_offset(bodies: CollisionBodies, a: int, b: int) -> Vector:
    """Return the way from A's origin to B's [m]."""
    return subtract(get_vector(bodies.positions[b]), get_vector(bodies.positions[a]))


@kernel
def find_stale(
    candidates: Array,
    quaternions: Array,
    positions: Array,
    posed_quaternions: Array,
    posed_positions: Array,
    stale: Array,
) -> int:
    """Find the rocks that are not where they were last.

    Reads:
        candidates: (m,) rocks that may be among them.
        quaternions, positions: (n, 4), (n, 3) [m].
    Writes:
        posed_quaternions, posed_positions: (n, 4), (n, 3) at least, those of the last call.
        stale: (n,) indices.

    Returns:
        their number.
    """
    n_stale = 0
    for s in range(len(candidates)):
        i, moved = candidates[s], False
        for d in range(4):
            if posed_quaternions[i, d] != quaternions[i, d]:
                posed_quaternions[i, d] = quaternions[i, d]
                moved = True
        for d in range(3):
            if posed_positions[i, d] != positions[i, d]:
                posed_positions[i, d] = positions[i, d]
                moved = True
        if moved:
            stale[n_stale] = i
            n_stale += 1
    return n_stale


@kernel
def calc_poses(
    chosen: Array,
    shapes: ConvexShapes,
    quaternions: Array,
    positions: Array,
    velocities: Array,
    time_step: float,
    margin: float,
    inverse_inertia_local: Array,
    bodies: CollisionBodies,
    boxes: Boxes,
    inverse_inertia: Array,
) -> None:
    """Set rotations, bounding boxes and world inertias of rocks.

    Reads:
        chosen: (m,) the rocks to do.
        shapes: all shapes.
        quaternions, positions: (n, 4) w x y z, (n, 3) [m].
        velocities: (n, 6) angular, translational.
        time_step: boxes are extended along the way over it [s].
        margin: by which boxes are extended to all sides [m].
        inverse_inertia_local: (n, 6) in the rock's frame: xx xy xz yy yz zz [1/(kg m^2)].
    Writes:
        bodies: rotations.
        boxes: of the rocks.
        inverse_inertia: (n, 6) in W's axes.
    """
    for s in range(len(chosen)):
        i = chosen[s]
        r = make_rotation((quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]))
        shape, scale = bodies.shape[i], bodies.scale[i]
        first, last = shapes.vertex_start[shape], shapes.vertex_start[shape + 1]
        extra = scale * shapes.rounding[shape] + margin
        spin = math.sqrt(velocities[i, 0] ** 2 + velocities[i, 1] ** 2 + velocities[i, 2] ** 2)
        extra += time_step * min(spin * scale * shapes.radius[shape], MAX_TURNING)
        for axis in range(3):
            row = (r[3 * axis], r[3 * axis + 1], r[3 * axis + 2])
            for d in range(3):
                bodies.rotations[i, axis, d] = row[d]
            low, high = np.inf, -np.inf
            for k in range(first, last):
                value = dot(row, get_vector(shapes.vertices[k]))
                low = min(low, value)
                high = max(high, value)
            travel = time_step * velocities[i, 3 + axis]
            boxes.lower[i, axis] = positions[i, axis] + scale * low - extra + min(travel, 0.0)
            boxes.upper[i, axis] = positions[i, axis] + scale * high + extra + max(travel, 0.0)
        inertia = rotate_symmetric(r, inverse_inertia_local[i])
        for d in range(6):
            inverse_inertia[i, d] = inertia[d]


@kernel
def calc_piece_poses(
    first: int,
    piece_body: Array,
    shapes: ConvexShapes,
    X_WBs: Array,
    V_WBs: Array,
    time_step: float,
    margin: float,
    bodies: CollisionBodies,
    boxes: Boxes,
) -> None:
    """Set poses and bounding boxes of the machine's pieces; a box covers the way of every corner over a step.

    Reads:
        first: index of the first piece among the bodies.
        piece_body: (k,) body of the machine that each piece belongs to.
        shapes: all shapes.
        X_WBs, V_WBs: (b, 4, 4) poses and (b, 6) spatial velocities of the machine's bodies.
        time_step, margin: as for `calc_poses`.
    Writes:
        bodies: positions and rotations.
        boxes: of the pieces.
    """
    positions, rotations, lower, upper = bodies.positions, bodies.rotations, boxes.lower, boxes.upper
    for k in range(len(piece_body)):
        i, b = first + k, piece_body[k]
        for d in range(3):
            positions[i, d] = X_WBs[b, d, 3]
            lower[i, d], upper[i, d] = np.inf, -np.inf
            for e in range(3):
                rotations[i, d, e] = X_WBs[b, d, e]
        core = Core(bodies.shape[i], 1.0, get_rotation(rotations, i))
        for corner in range(shapes.vertex_start[core.shape], shapes.vertex_start[core.shape + 1]):
            x, y, z = get_corner(shapes, corner, core)
            vx = V_WBs[b, 3] + V_WBs[b, 1] * z - V_WBs[b, 2] * y
            vy = V_WBs[b, 4] + V_WBs[b, 2] * x - V_WBs[b, 0] * z
            vz = V_WBs[b, 5] + V_WBs[b, 0] * y - V_WBs[b, 1] * x
            here, way = (x, y, z), (time_step * vx, time_step * vy, time_step * vz)
            for d in range(3):
                lower[i, d] = min(lower[i, d], positions[i, d] + here[d] + min(way[d], 0.0) - margin)
                upper[i, d] = max(upper[i, d], positions[i, d] + here[d] + max(way[d], 0.0) + margin)
