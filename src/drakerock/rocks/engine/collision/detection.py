"""Collision detection of a step, from state arrays to contact rows: poses, pairs, contacts, in this order."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.collision import broad_phase, narrow_phase, persistence, poses, speculative
from drakerock.rocks.engine.collision.blocks import make_blocks, update_blocks
from drakerock.rocks.engine.collision.broad_phase import Grid
from drakerock.rocks.engine.collision.narrow_phase import CollisionGeometry, SearchSettings
from drakerock.rocks.engine.collision.poses import Boxes, CollisionBodies
from drakerock.rocks.engine.compiling import Array
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.contact_cache import CacheIndex, ContactCache, make_axis_cache
from drakerock.rocks.engine.records import FOLLOWED, SEARCHED
from drakerock.rocks.engine.solve.rows import ContactRows, make_contact_rows

IntArray = NDArray[np.int64]

# A cell of a grid is this wide [largest radius of its rocks]: a rock's neighbours are in few cells, and few rocks in
# each.
CELL_WIDTH = 1.3
# On the logarithm's argument: a rock twice as large as the smallest is in the next class, whatever rounding says.
CLASS_TOLERANCE = 1.0001


class SiteBox(NamedTuple):
    """The box outside of which a rock has left the site: its corners (3,) [m]."""

    lower: Array
    upper: Array


class ContactDetection:
    """Finds the contacts of all bodies, with the scratch memory for it, which never changes a result.

    Attributes:
        bodies, boxes: where all bodies are, and the boxes around them.
        modes: (bodies,) how the contacts of each are found, see `collision.persistence`.
        extra_speeds: (bodies,) see `collision.speculative` [m/s]; `forget_speeds` before a step.
        pairs: of the broad phase; `find_pairs` gives their number.
        rows: contact rows; `find_contacts` gives their number.
        inverse_inertia: (n, 6) of the rocks in W's axes.
        statistics: (4,) of the last step: pairs skipped, distances computed, overlapping cores, rows.
    """

    def __init__(
        self,
        bodies: CollisionBodies,
        geometry: CollisionGeometry,
        piece_body: IntArray,
        radius: Array,
        inverse_inertia_local: Array,
        site_box: SiteBox,
        time_step: float,
    ) -> None:
        """Make it for bodies at any poses.

        Args:
            bodies: rocks, static pieces, planes, pieces of the machine.
            geometry: shapes, planes, and which bodies are what.
            piece_body: (k,) body of the machine that each piece belongs to.
            radius: (n,) bounding spheres of the rocks [m].
            inverse_inertia_local: (n, 6) in the rocks' frames.
            site_box: rocks outside are in the outermost cells.
            time_step: [s].
        """
        n, n_bodies = len(radius), len(bodies.shape)
        self.bodies = bodies
        self.boxes = Boxes(np.full((n_bodies, 3), np.inf), np.full((n_bodies, 3), -np.inf))
        # What is no rock does not move, or is searched with what does.
        self.modes = np.full(n_bodies, SEARCHED, np.int8)
        self.modes[: geometry.first_piece] = FOLLOWED
        self.extra_speeds = np.zeros(n_bodies)
        self._is_driven = False
        self.inverse_inertia = np.zeros((n, 6))
        self.statistics = np.zeros(4, np.int64)
        self._geometry = geometry
        self._piece_body = piece_body
        self._pieces = np.arange(geometry.first_piece, geometry.first_piece + len(piece_body))
        self._inverse_inertia_local = inverse_inertia_local
        self._site_box = site_box
        self._time_step = time_step
        self._classes, self._reaches = _make_size_classes(radius)
        self.blocks = make_blocks(n)
        self._posed_quaternions = np.full((n, 4), np.nan)
        self._stale, self._near = np.zeros(n, np.int64), np.zeros(n, np.int64)
        self._seeks = np.zeros(n, np.bool_)
        # Places for the pairs that are near but apart; what is pushed out is searched anew, no more.
        self._axis_cache = make_axis_cache(max(4 * n, 1024))
        self._workspace = narrow_phase.make_narrow_workspace()
        self._allocate_pairs(20 * n + 256)
        self.rows = make_contact_rows(6 * n + 256)
        start, shapes = geometry.shapes.vertex_start, geometry.shapes
        for k in range(n, geometry.first_plane):
            vertices = shapes.vertices[start[bodies.shape[k]] : start[bodies.shape[k] + 1]]
            self.boxes.lower[k], self.boxes.upper[k] = vertices.min(axis=0), vertices.max(axis=0)

    def _allocate_pairs(self, capacity: int) -> None:
        self.pairs = broad_phase.make_pairs(capacity)
        self._look_up = narrow_phase.make_look_up(capacity)

    def find_stale(self, candidates: IntArray, quaternions: Array, positions: Array) -> IntArray:
        """Return which of some rocks are not where they were last; valid until the next call."""
        n_stale = poses.find_stale(
            candidates, quaternions, positions, self._posed_quaternions, self.bodies.positions, self._stale
        )
        stale = self._stale[:n_stale]
        update_blocks(stale, positions, self.blocks)
        return stale

    def update_poses(
        self,
        chosen: IntArray,
        awake: IntArray,
        quaternions: Array,
        positions: Array,
        velocities: Array,
        X_WBs: Array,
        V_WBs: Array,
        margin: float,
    ) -> None:
        """Set positions, rotations and boxes: of awake rocks, of others that were moved, of the machine.

        Args:
            chosen: all these rocks, see `find_stale`.
            awake: those of them that are awake.
            quaternions, positions, velocities: of all rocks.
            X_WBs, V_WBs: (b, 4, 4), (b, 6) poses and spatial velocities of the machine's bodies.
            margin: of the boxes [m].
        """
        poses.calc_poses(
            chosen, self._geometry.shapes, quaternions, positions, velocities, self._time_step, margin,
            self._inverse_inertia_local, self.bodies, self.boxes, self.inverse_inertia,
        )  # fmt: skip
        # Boxes of others are kept from step to step.
        if self._is_driven:
            driven = awake[self.extra_speeds[awake] > 0.0]
            self.boxes.lower[driven] -= self._time_step * self.extra_speeds[driven, None]
            self.boxes.upper[driven] += self._time_step * self.extra_speeds[driven, None]
        poses.calc_piece_poses(
            self._geometry.first_piece, self._piece_body, self._geometry.shapes, X_WBs, V_WBs,
            self._time_step, margin, self.bodies, self.boxes,
        )  # fmt: skip

    def find_pairs(self, awake: IntArray, sleep: np.ndarray) -> int:
        """Find the pairs whose boxes meet, of rocks that are awake and searched, and of the machine.

        Args:
            awake: rocks.
            sleep: (n,) records of all rocks; read are those of such as have left the site.

        Returns:
            their number.
        """
        n, geometry = len(sleep), self._geometry
        seekers = awake[self.modes[awake] != FOLLOWED]
        self._seeks[seekers] = True
        low, high = broad_phase.find_region(seekers, self._pieces, self.boxes)
        grids = [self._sort_grid(number, reach, low, high) for number, reach in enumerate(self._reaches)]
        while True:
            n_pairs = 0
            for one in grids:
                chosen = one.rocks[self._seeks[one.rocks]]
                for grid in grids:
                    n_pairs = self._search(chosen, sleep, grid, n_pairs)
            n_pairs = broad_phase.find_static_pairs(
                seekers, n, geometry.first_plane, geometry.planes, self.boxes, n_pairs, self.pairs
            )
            # The machine's pairs come last.
            for grid in grids:
                n_pairs = self._search(self._pieces, sleep, grid, n_pairs)
            if n_pairs <= len(self.pairs.a):
                break
            self._allocate_pairs(n_pairs + n_pairs // 4)
        self._seeks[seekers] = False
        return n_pairs

    def _sort_grid(self, number: int, reach: float, low: Array, high: Array) -> Grid:
        """Sort the rocks of one class of size that are within reach of the box into a grid."""
        inverse_width, positions = 1.0 / (CELL_WIDTH * reach), self.bodies.positions
        n_near, first, last = broad_phase.find_near(
            number, self._classes, positions, self.blocks, low, high, reach, self._near
        )
        origin = np.maximum(first, self._site_box.lower)
        extent = np.minimum(last, self._site_box.upper) - origin if n_near > 0 else np.zeros(3)
        n_cells = np.maximum(np.ceil(extent * inverse_width), 1).astype(np.int64)
        cell_start = np.empty(int(n_cells.prod()) + 1, np.int64)
        sorted_rocks = np.empty(n_near, np.int64)
        grid = Grid(sorted_rocks, np.empty((n_near, 6)), origin, inverse_width, n_cells, cell_start, reach)
        broad_phase.sort_into_grid(
            self._near[:n_near], positions, self.boxes, grid, np.empty_like(sorted_rocks)
        )
        return grid

    def _search(self, seekers: IntArray, sleep: np.ndarray, grid: Grid, n_pairs: int) -> int:
        if len(seekers) == 0 or len(grid.rocks) == 0:
            return n_pairs
        return int(
            broad_phase.find_rock_pairs(
                seekers, len(sleep), sleep, self._seeks, self.boxes, grid, n_pairs, self.pairs
            )
        )

    def find_contacts(
        self, n_pairs: int, cache: ContactCache, index: CacheIndex, velocities: Array, config: NonsmoothConfig
    ) -> int:
        """Set the contact rows: those that follow, then those of the pairs.

        Args:
            n_pairs: from `find_pairs`.
            cache, index: contact points of the last step.
            velocities: (bodies of the solve, 6).
            config: margins and tolerances.

        Returns:
            their number.
        """
        if n_pairs == 0 and index.n_active == 0:
            self.statistics[:] = 0
            return 0
        geometry = self._geometry
        settings = SearchSettings(
            self._time_step, config.contact_margin, config.manifold_gap, config.face_cosine, config.slow_speed
        )
        workspace = self._workspace._replace(points=self._workspace.points[: config.manifold_points])
        while True:
            n_rows = persistence.follow_contacts(
                cache, index.active, index.n_active, self.modes, self.bodies, geometry.restitution[0], self.rows
            )  # fmt: skip
            n_rows = narrow_phase.find_contacts(
                self.pairs, n_pairs, geometry, self.bodies, velocities, settings, self.modes,
                self.extra_speeds, cache, index.table, n_rows, self.rows, self._axis_cache, self._look_up,
                self.statistics, workspace,
            )  # fmt: skip
            if n_rows <= len(self.rows.values):
                return int(n_rows)
            self.rows = make_contact_rows(n_rows + n_rows // 4)

    def find_deep_overlaps(self, n_rows: int, rows: ContactRows, velocities: Array, depth: float) -> int:
        """Add to `extra_speeds` what drives loaded pairs deep into each other; return their number.

        Args:
            n_rows, rows: after the solve.
            velocities: (bodies of the solve, 6) after it.
            depth: see `collision.speculative` [m].
        """
        if n_rows == 0:
            return 0
        n_deep = speculative.find_deep_overlaps(
            n_rows, rows, self._geometry, self.bodies, velocities, self._time_step, depth, self.extra_speeds,
            self._workspace.gjk,
        )  # fmt: skip
        self._is_driven |= n_deep > 0
        return int(n_deep)

    def forget_speeds(self) -> None:
        """Set `extra_speeds` to 0."""
        if self._is_driven:
            self.extra_speeds[:] = 0.0
            self._is_driven = False


def _make_size_classes(radius: Array) -> tuple[IntArray, list[float]]:
    """Return the class of size of each rock (a factor of two each), and the largest radius of each class [m]."""
    if len(radius) == 0:
        return np.zeros(0, np.int64), []
    level = np.floor(np.log2(radius / radius.min() * CLASS_TOLERANCE)).astype(np.int64)
    _, classes = np.unique(level, return_inverse=True)
    return classes, [float(radius[classes == k].max()) for k in range(classes.max() + 1)]
