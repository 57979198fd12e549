"""Broad phase: which pairs of bodies can touch within a step.

Rocks are sorted into uniform grids by the position of their centres, one grid per class of size, so that
small rocks are not searched in the cells of large ones. The order of the pairs follows from the positions
alone, so that a restored state repeats its pairs, and with them the solver's order, bit for bit.
"""

from __future__ import annotations

import numpy as np

from drakerock.rocks.engine.collision.geometry import get_corner, get_rotation
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, Rotation, allocating_kernel, kernel

# How a rock is treated.
AWAKE, RESTING, FIXED, LOST = 0, 1, 2, 3
# How its contacts are found in a step: all searched; from memory with those that move like it; with all that are calm.
SEARCHED, COMOVING, CALM = 0, 1, 2


@kernel
def _find_cell(value: float, origin: float, inverse_width: float, n_cells: int) -> int:
    if not value > origin:
        return 0
    return min(int((value - origin) * inverse_width), n_cells - 1)


@allocating_kernel
def find_region(seekers: Array, others: Array, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return the corners (3,) of the box around the boxes of rocks and of other bodies [m]."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for bodies in (seekers, others):
        for s in range(len(bodies)):
            for d in range(3):
                low[d] = min(low[d], lower[bodies[s], d])
                high[d] = max(high[d], upper[bodies[s], d])
    return low, high


@allocating_kernel
def find_near(
    rocks: Array, positions: Array, low: Array, high: Array, reach: float, near: Array
) -> tuple[int, Array, Array]:
    """Find the rocks within reach of a box: only they need to be sorted into a grid.

    Args:
        rocks: (m,) indices.
        positions: (n, 3) [m].
        low, high: (3,) corners of the box [m].
        reach: how far a rock reaches from its centre at most [m].
        near: (m,) set.

    Returns:
        their number, and the corners (3,) of the box around their centres [m].
    """
    n_near = 0
    first, last = np.full(3, np.inf), np.full(3, -np.inf)
    for k in range(len(rocks)):
        i = rocks[k]
        inside = True
        for d in range(3):
            if not low[d] - reach < positions[i, d] < high[d] + reach:
                inside = False
        if inside:
            near[n_near] = i
            n_near += 1
            for d in range(3):
                first[d] = min(first[d], positions[i, d])
                last[d] = max(last[d], positions[i, d])
    return n_near, first, last


@kernel
def sort_into_grid(
    rocks: Array,
    positions: Array,
    lower: Array,
    upper: Array,
    origin: Array,
    inverse_width: float,
    n_cells: Array,
    cell_start: Array,
    cells: Array,
    items: Array,
    boxes: Array,
) -> None:
    """Sort rocks by grid cell (counting sort, stable).

    Args:
        rocks: (m,) indices.
        positions: (n, 3) [m].
        lower, upper: (bodies, 3) bounding boxes, margins included [m].
        origin: (3,) corner of the grid [m]; rocks outside count to the cells at its border.
        inverse_width: of a cell [1/m].
        n_cells: (3,).
        cell_start: (number of cells + 1,) set: where a cell's rocks start in `items`; z runs fastest.
        cells: (m,) scratch.
        items: (m,) set: the rocks in the order of their cells.
        boxes: (m, 6) set: their bounding boxes in the same order, so that a search reads memory in line.
    """
    nx, ny, nz = n_cells[0], n_cells[1], n_cells[2]
    n_all = nx * ny * nz
    cell_start[: n_all + 1] = 0
    for k in range(len(rocks)):
        i = rocks[k]
        cx = _find_cell(positions[i, 0], origin[0], inverse_width, nx)
        cy = _find_cell(positions[i, 1], origin[1], inverse_width, ny)
        cz = _find_cell(positions[i, 2], origin[2], inverse_width, nz)
        cells[k] = (cx * ny + cy) * nz + cz
        cell_start[cells[k] + 1] += 1
    for c in range(n_all):
        cell_start[c + 1] += cell_start[c]
    for k in range(len(rocks) - 1, -1, -1):
        c = cells[k]
        cell_start[c + 1] -= 1
        items[cell_start[c + 1]] = rocks[k]
    for c in range(n_all):
        cell_start[c] = cell_start[c + 1]
    cell_start[n_all] = len(rocks)
    for k in range(len(rocks)):
        for d in range(3):
            boxes[k, d] = lower[items[k], d]
            boxes[k, 3 + d] = upper[items[k], d]


@kernel
def _boxes_meet(lower: Array, upper: Array, i: int, j: int) -> bool:
    return (
        lower[i, 0] < upper[j, 0]
        and upper[i, 0] > lower[j, 0]
        and lower[i, 1] < upper[j, 1]
        and upper[i, 1] > lower[j, 1]
        and lower[i, 2] < upper[j, 2]
        and upper[i, 2] > lower[j, 2]
    )


@kernel
def find_rock_pairs(
    seekers: Array,
    n_rocks: int,
    status: Array,
    seeks: Array,
    lower: Array,
    upper: Array,
    origin: Array,
    inverse_width: float,
    n_cells: Array,
    cell_start: Array,
    items: Array,
    boxes: Array,
    reach: float,
    pair_a: Array,
    pair_b: Array,
    n_pairs: int,
) -> int:
    """Add the pairs of seekers with the rocks of one grid.

    Args:
        seekers: rocks, and bodies of the machine (index >= n_rocks), whose neighbours are wanted.
        n_rocks: number of rocks.
        status: (n,) AWAKE, RESTING, FIXED or LOST.
        seeks: (n,) bool, the rocks that are among the seekers of some call.
        lower, upper: (bodies, 3) bounding boxes, margins included [m].
        origin, inverse_width, n_cells, cell_start, items, boxes: of the grid, see `sort_into_grid`.
        reach: how far a rock of this grid reaches from its centre at most [m].
        pair_a, pair_b: set; the rock with the lower index comes first, a machine body always second.
        n_pairs: number of pairs so far.

    Returns:
        the number of pairs; beyond the capacity they are counted but not stored.
    """
    nx, ny, nz = n_cells[0], n_cells[1], n_cells[2]
    for s in range(len(seekers)):
        i = seekers[s]
        low_x, low_y, low_z = lower[i, 0], lower[i, 1], lower[i, 2]
        high_x, high_y, high_z = upper[i, 0], upper[i, 1], upper[i, 2]
        x0 = _find_cell(lower[i, 0] - reach, origin[0], inverse_width, nx)
        x1 = _find_cell(upper[i, 0] + reach, origin[0], inverse_width, nx)
        y0 = _find_cell(lower[i, 1] - reach, origin[1], inverse_width, ny)
        y1 = _find_cell(upper[i, 1] + reach, origin[1], inverse_width, ny)
        z0 = _find_cell(lower[i, 2] - reach, origin[2], inverse_width, nz)
        z1 = _find_cell(upper[i, 2] + reach, origin[2], inverse_width, nz)
        for cx in range(x0, x1 + 1):
            for cy in range(y0, y1 + 1):
                column = (cx * ny + cy) * nz
                for k in range(cell_start[column + z0], cell_start[column + z1 + 1]):
                    if (
                        boxes[k, 0] >= high_x
                        or boxes[k, 3] <= low_x
                        or boxes[k, 1] >= high_y
                        or boxes[k, 4] <= low_y
                        or boxes[k, 2] >= high_z
                        or boxes[k, 5] <= low_z
                    ):
                        continue
                    j = items[k]
                    if j == i or status[j] == LOST:
                        continue
                    # Two seekers find each other twice.
                    if i < n_rocks and seeks[j] and i > j:
                        continue
                    if n_pairs < len(pair_a):
                        pair_a[n_pairs] = min(i, j)
                        pair_b[n_pairs] = max(i, j)
                    n_pairs += 1
    return n_pairs


@kernel
def find_static_pairs(
    seekers: Array,
    first_static: int,
    last_static: int,
    planes: Array,
    lower: Array,
    upper: Array,
    pair_a: Array,
    pair_b: Array,
    n_pairs: int,
) -> int:
    """Add the pairs of rocks with static pieces and planes.

    Args:
        seekers: rocks.
        first_static, last_static: range of the static pieces among the bodies; planes follow in the index.
        planes: (p, 4) unit normal out of the solid and offset.
        lower, upper, pair_a, pair_b, n_pairs: as for `find_rock_pairs`.

    Returns:
        as `find_rock_pairs`.
    """
    for s in range(len(seekers)):
        i = seekers[s]
        for j in range(first_static, last_static):
            if _boxes_meet(lower, upper, i, j):
                if n_pairs < len(pair_a):
                    pair_a[n_pairs] = i
                    pair_b[n_pairs] = j
                n_pairs += 1
        for p in range(len(planes)):
            nearest = -planes[p, 3]
            for d in range(3):
                nearest += planes[p, d] * (lower[i, d] if planes[p, d] > 0.0 else upper[i, d])
            if nearest < 0.0:
                if n_pairs < len(pair_a):
                    pair_a[n_pairs] = i
                    pair_b[n_pairs] = last_static + p
                n_pairs += 1
    return n_pairs


@kernel
def find_stale(
    status: Array,
    quaternions: Array,
    positions: Array,
    posed_quaternions: Array,
    posed_positions: Array,
    stale: Array,
) -> int:
    """Find the rocks whose pose has to be set: the awake ones, and all that are not where they were last.

    Args:
        status: (n,) AWAKE, RESTING, FIXED or LOST.
        quaternions, positions: (n, 4), (n, 3) [m].
        posed_quaternions, posed_positions: (n, 4), (n, 3) at least, those of the last call; set.
        stale: (n,) set: indices.

    Returns:
        their number.
    """
    n_stale = 0
    for i in range(len(status)):
        moved = status[i] == AWAKE
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
    geometry_shape: Array,
    scale: Array,
    quaternions: Array,
    positions: Array,
    velocities: Array,
    sweep: float,
    margin: float,
    shapes: ConvexShapes,
    bodies: Array,
    rotations: Array,
    lower: Array,
    upper: Array,
    inverse_inertia_local: Array,
    inverse_inertia: Array,
) -> None:
    """Set rotations, bounding boxes and world inertias of rocks.

    Args:
        geometry_shape, scale: (n,) shape and scale (sieve width).
        quaternions, positions: (n, 4) w x y z, (n, 3) [m].
        velocities: (n, 6) angular, translational.
        sweep: time by which boxes are extended along the velocity [s].
        margin: by which boxes are extended to all sides [m].
        shapes: all shapes.
        bodies: (m,) the rocks to do.
        rotations, lower, upper: (.., 3, 3), (.., 3), (.., 3) set.
        inverse_inertia_local: (n, 6) in the rock's frame: xx xy xz yy yz zz [1/(kg m^2)].
        inverse_inertia: (n, 6) set, in W's axes.
    """
    for s in range(len(bodies)):
        i = bodies[s]
        w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        r = (
            1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
            2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
            2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
        )  # fmt: skip
        shape = geometry_shape[i]
        first, last = shapes.vertex_start[shape], shapes.vertex_start[shape + 1]
        extra = scale[i] * shapes.rounding[shape] + margin
        spin = np.sqrt(velocities[i, 0] ** 2 + velocities[i, 1] ** 2 + velocities[i, 2] ** 2)
        extra += sweep * min(spin * scale[i] * shapes.radius[shape], 1.0)
        for axis in range(3):
            ra, rb, rc = r[3 * axis], r[3 * axis + 1], r[3 * axis + 2]
            rotations[i, axis, 0], rotations[i, axis, 1], rotations[i, axis, 2] = ra, rb, rc
            low, high = np.inf, -np.inf
            for k in range(first, last):
                value = ra * shapes.vertices[k, 0] + rb * shapes.vertices[k, 1] + rc * shapes.vertices[k, 2]
                low = min(low, value)
                high = max(high, value)
            travel = sweep * velocities[i, 3 + axis]
            lower[i, axis] = positions[i, axis] + scale[i] * low - extra + min(travel, 0.0)
            upper[i, axis] = positions[i, axis] + scale[i] * high + extra + max(travel, 0.0)
        rotate_inertia(r, inverse_inertia_local, inverse_inertia, i)


@kernel
def rotate_inertia(r: Rotation, local: Array, world: Array, i: int) -> None:
    """Set ``world[i] = R local[i] R^T`` (symmetric: xx xy xz yy yz zz)."""
    xx, xy, xz, yy, yz, zz = local[i, 0], local[i, 1], local[i, 2], local[i, 3], local[i, 4], local[i, 5]
    m00, m01, m02 = r[0] * xx + r[1] * xy + r[2] * xz, r[0] * xy + r[1] * yy + r[2] * yz, r[0] * xz + r[1] * yz + r[2] * zz  # noqa: E501  # fmt: skip
    m10, m11, m12 = r[3] * xx + r[4] * xy + r[5] * xz, r[3] * xy + r[4] * yy + r[5] * yz, r[3] * xz + r[4] * yz + r[5] * zz  # noqa: E501  # fmt: skip
    m20, m21, m22 = r[6] * xx + r[7] * xy + r[8] * xz, r[6] * xy + r[7] * yy + r[8] * yz, r[6] * xz + r[7] * yz + r[8] * zz  # noqa: E501  # fmt: skip
    world[i, 0] = m00 * r[0] + m01 * r[1] + m02 * r[2]
    world[i, 1] = m00 * r[3] + m01 * r[4] + m02 * r[5]
    world[i, 2] = m00 * r[6] + m01 * r[7] + m02 * r[8]
    world[i, 3] = m10 * r[3] + m11 * r[4] + m12 * r[5]
    world[i, 4] = m10 * r[6] + m11 * r[7] + m12 * r[8]
    world[i, 5] = m20 * r[6] + m21 * r[7] + m22 * r[8]


@kernel
def calc_piece_boxes(
    first: int,
    piece_body: Array,
    shape: Array,
    shapes: ConvexShapes,
    X_WBs: Array,
    V_WBs: Array,
    sweep: float,
    margin: float,
    positions: Array,
    rotations: Array,
    lower: Array,
    upper: Array,
) -> None:
    """Set poses and bounding boxes of the machine's pieces; a box covers the way of every corner over a step.

    Args:
        first: index of the first piece among the bodies.
        piece_body: (k,) body of the machine that each piece belongs to.
        shape: per body, its shape; shapes: all shapes.
        X_WBs, V_WBs: (b, 4, 4) poses and (b, 6) spatial velocities of the machine's bodies.
        sweep, margin: as for `calc_poses`.
        positions, rotations, lower, upper: per body, set.
    """
    for k in range(len(piece_body)):
        i, b = first + k, piece_body[k]
        for d in range(3):
            positions[i, d] = X_WBs[b, d, 3]
            lower[i, d], upper[i, d] = np.inf, -np.inf
            for e in range(3):
                rotations[i, d, e] = X_WBs[b, d, e]
        r = get_rotation(rotations, i)
        for corner in range(shapes.vertex_start[shape[i]], shapes.vertex_start[shape[i] + 1]):
            x, y, z = get_corner(shapes.vertices, corner, 1.0, r)
            vx = V_WBs[b, 3] + V_WBs[b, 1] * z - V_WBs[b, 2] * y
            vy = V_WBs[b, 4] + V_WBs[b, 2] * x - V_WBs[b, 0] * z
            vz = V_WBs[b, 5] + V_WBs[b, 0] * y - V_WBs[b, 1] * x
            for d, (here, way) in enumerate(((x, sweep * vx), (y, sweep * vy), (z, sweep * vz))):
                lower[i, d] = min(lower[i, d], positions[i, d] + here + min(way, 0.0) - margin)
                upper[i, d] = max(upper[i, d], positions[i, d] + here + max(way, 0.0) + margin)
