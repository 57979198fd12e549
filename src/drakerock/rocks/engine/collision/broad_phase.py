"""Broad phase: which pairs of bodies can touch within a step.

Rocks are sorted into uniform grids by the position of their centres, one grid per class of size, so that
small rocks are not searched in the cells of large ones. The order of the pairs follows from the positions
alone, so that a restored state repeats its pairs, and with them the solver's order, bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.collision.blocks import BLOCK, Blocks, is_block_near
from drakerock.rocks.engine.collision.poses import Boxes
from drakerock.rocks.engine.compiling import Array, allocating_kernel, kernel
from drakerock.rocks.engine.records import LOST


class Pairs(NamedTuple):
    """Room for pairs of bodies whose boxes meet (capacity n); first a rock, the one with the lower index.

    Attributes:
        a, b: (n,) bodies.
    """

    a: NDArray[np.int64]
    b: NDArray[np.int64]


def make_pairs(capacity: int) -> Pairs:
    """Return room for so many pairs."""
    return Pairs(np.zeros(capacity, np.int64), np.zeros(capacity, np.int64))


class Grid(NamedTuple):
    """Rocks of one class of size by cells (m rocks).

    Attributes:
        rocks: (m,) in the order of their cells.
        boxes: (m, 6) their bounding boxes, so that a search reads memory in line [m].
        origin: (3,) corner of the grid [m]; rocks outside count to the cells at its border.
        inverse_width: of a cell [1/m].
        n_cells: (3,).
        cell_start: (number of cells + 1,) where a cell's rocks start; z runs fastest.
        reach: how far a rock reaches from its centre at most [m].
    """

    rocks: NDArray[np.int64]
    boxes: NDArray[np.float64]
    origin: NDArray[np.float64]
    inverse_width: float
    n_cells: NDArray[np.int64]
    cell_start: NDArray[np.int64]
    reach: float


@kernel
def _find_cell(value: float, origin: float, inverse_width: float, n_cells: int) -> int:
    if not value > origin:
        return 0
    return min(int((value - origin) * inverse_width), n_cells - 1)


@allocating_kernel
def find_region(seekers: Array, others: Array, boxes: Boxes) -> tuple[Array, Array]:
    """Return the corners (3,) of the box around the boxes of rocks and of other bodies [m]."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for bodies in (seekers, others):
        for s in range(len(bodies)):
            for d in range(3):
                low[d] = min(low[d], boxes.lower[bodies[s], d])
                high[d] = max(high[d], boxes.upper[bodies[s], d])
    return low, high


@allocating_kernel
def find_near(
    number: int,
    classes: Array,
    positions: Array,
    blocks: Blocks,
    low: Array,
    high: Array,
    reach: float,
    near: Array,
) -> tuple[int, Array, Array]:
    """Find the rocks of a class of size within reach of a box: only they need to be sorted into a grid.

    Reads:
        number, classes: of the class, and (n,) that of each rock.
        positions: (n, 3) [m].
        blocks: of all rocks.
        low, high: (3,) corners of the box [m].
        reach: how far a rock reaches from its centre at most [m].
    Writes:
        near: (n,) their indices, in ascending order.

    Returns:
        their number, and the corners (3,) of the box around their centres [m].
    """
    n_near = 0
    first, last = np.full(3, np.inf), np.full(3, -np.inf)
    for block in range(len(blocks.lower)):
        if not is_block_near(block, low, high, reach, blocks):
            continue
        for i in range(BLOCK * block, min(BLOCK * (block + 1), len(classes))):
            inside = classes[i] == number
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
def sort_into_grid(rocks: Array, positions: Array, boxes: Boxes, grid: Grid, cells: Array) -> None:
    """Sort rocks by grid cell (counting sort, stable).

    Reads:
        rocks: (m,) indices.
        positions: (n, 3) [m].
        boxes: of all bodies.
    Writes:
        grid: with origin, width and number of cells; the others are set.
        cells: (m,) scratch.
    """
    nx, ny, nz = grid.n_cells[0], grid.n_cells[1], grid.n_cells[2]
    origin, inverse_width, cell_start = grid.origin, grid.inverse_width, grid.cell_start
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
        grid.rocks[cell_start[c + 1]] = rocks[k]
    for c in range(n_all):
        cell_start[c] = cell_start[c + 1]
    cell_start[n_all] = len(rocks)
    for k in range(len(rocks)):
        for d in range(3):
            grid.boxes[k, d] = boxes.lower[grid.rocks[k], d]
            grid.boxes[k, 3 + d] = boxes.upper[grid.rocks[k], d]


@kernel
def _boxes_meet(boxes: Boxes, i: int, j: int) -> bool:
    lower, upper = boxes.lower, boxes.upper
    return (
        lower[i, 0] < upper[j, 0]
        and upper[i, 0] > lower[j, 0]
        and lower[i, 1] < upper[j, 1]
        and upper[i, 1] > lower[j, 1]
        and lower[i, 2] < upper[j, 2]
        and upper[i, 2] > lower[j, 2]
    )


@kernel
def _add_pair(a: int, b: int, n_pairs: int, pairs: Pairs) -> int:
    """Add a pair; beyond the capacity it is counted but not stored. Return the number of pairs."""
    if n_pairs < len(pairs.a):
        pairs.a[n_pairs] = a
        pairs.b[n_pairs] = b
    return n_pairs + 1


@kernel
def _find_range(low: float, high: float, axis: int, grid: Grid) -> tuple[int, int]:
    """Return the first and the last cell along an axis whose rocks may reach between two values [m]."""
    origin, n_cells = grid.origin[axis], grid.n_cells[axis]
    return (
        _find_cell(low - grid.reach, origin, grid.inverse_width, n_cells),
        _find_cell(high + grid.reach, origin, grid.inverse_width, n_cells),
    )


@kernel
def find_rock_pairs(
    seekers: Array,
    n_rocks: int,
    sleep: Array,
    seeks: Array,
    boxes: Boxes,
    grid: Grid,
    n_pairs: int,
    pairs: Pairs,
) -> int:
    """Add the pairs of seekers with the rocks of one grid.

    Reads:
        seekers: rocks, and bodies of the machine (index >= n_rocks), whose neighbours are wanted.
        n_rocks: number of rocks.
        sleep: (n,) records `SLEEP` of the rocks.
        seeks: (n,) bool, the rocks that are among the seekers of some call.
        boxes: of all bodies.
        grid: some of the rocks, sorted.
        n_pairs: number of pairs so far.
    Writes:
        pairs: more of them; a machine body is always second.

    Returns:
        the number of pairs; beyond the capacity they are counted but not stored.
    """
    others = grid.boxes
    for s in range(len(seekers)):
        i = seekers[s]
        low_x, low_y, low_z = boxes.lower[i, 0], boxes.lower[i, 1], boxes.lower[i, 2]
        high_x, high_y, high_z = boxes.upper[i, 0], boxes.upper[i, 1], boxes.upper[i, 2]
        x0, x1 = _find_range(low_x, high_x, 0, grid)
        y0, y1 = _find_range(low_y, high_y, 1, grid)
        z0, z1 = _find_range(low_z, high_z, 2, grid)
        for cx in range(x0, x1 + 1):
            for cy in range(y0, y1 + 1):
                column = (cx * grid.n_cells[1] + cy) * grid.n_cells[2]
                for k in range(grid.cell_start[column + z0], grid.cell_start[column + z1 + 1]):
                    if (
                        others[k, 0] >= high_x
                        or others[k, 3] <= low_x
                        or others[k, 1] >= high_y
                        or others[k, 4] <= low_y
                        or others[k, 2] >= high_z
                        or others[k, 5] <= low_z
                    ):
                        continue
                    j = grid.rocks[k]
                    if _is_new_pair(i, j, n_rocks, sleep, seeks):
                        n_pairs = _add_pair(min(i, j), max(i, j), n_pairs, pairs)
    return n_pairs


@kernel
def _is_new_pair(i: int, j: int, n_rocks: int, sleep: Array, seeks: Array) -> bool:
    """Return whether seeker i and rock j are a pair; two seekers, which find each other twice, are one once."""
    if j == i or sleep[j].status == LOST:
        return False
    return not (i < n_rocks and seeks[j] and i > j)


@kernel
def find_static_pairs(
    seekers: Array,
    first_static: int,
    first_plane: int,
    planes: Array,
    boxes: Boxes,
    n_pairs: int,
    pairs: Pairs,
) -> int:
    """Add the pairs of rocks with static pieces and planes.

    Reads:
        seekers: rocks.
        first_static, first_plane: where static pieces and planes start among the bodies.
        planes: (p, 4) unit normal out of the solid and offset.
        boxes, n_pairs: as for `find_rock_pairs`.
    Writes:
        pairs: as of `find_rock_pairs`.

    Returns:
        as `find_rock_pairs`.
    """
    for s in range(len(seekers)):
        i = seekers[s]
        for j in range(first_static, first_plane):
            if _boxes_meet(boxes, i, j):
                n_pairs = _add_pair(i, j, n_pairs, pairs)
        for p in range(len(planes)):
            nearest = -planes[p, 3]
            for d in range(3):
                nearest += planes[p, d] * (boxes.lower[i, d] if planes[p, d] > 0.0 else boxes.upper[i, d])
            if nearest < 0.0:
                n_pairs = _add_pair(i, first_plane + p, n_pairs, pairs)
    return n_pairs
