"""The engine: one step of all rocks, from state arrays to state arrays.

`NonsmoothEngine` holds what does not change during a simulation (shapes, masses, the site, settings) and scratch
memory that never changes a result. All state is in a `RockArrays`, which callers own.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drakerock.errors import SimulationFailure
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.engine import contacts, motion, reduction, resting, solver
from drakerock.rocks.engine.batches import make_batch_arrays
from drakerock.rocks.engine.collision import broad_phase, foresight, narrow_phase
from drakerock.rocks.engine.collision.broad_phase import AWAKE, FIXED, LOST, RESTING
from drakerock.rocks.engine.collision.shapes import make_convex_shapes
from drakerock.rocks.engine.compiling import announce_compilation
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.lanes import make_zeros
from drakerock.rocks.engine.solver import MachineArrays
from drakerock.rocks.engine.surroundings import Surroundings
from drakerock.rocks.materials import calc_spring_stiffness
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import ContactMemory, PileState

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
# Rocks of one class of size by cells: items, boxes, origin, 1 / width, cells per axis, cell starts, reach.
Grid = tuple[IntArray, Array, Array, float, IntArray, IntArray, float]
_log = logging.getLogger(__name__)

# Drake's default [m/s^2].
GRAVITY = (0.0, 0.0, -9.81)
# Where there is no gravity, impulses are measured by this [m/s^2].
STANDARD_GRAVITY = 9.81
# Of `RockArrays`, what changes of awake rocks only.
MOTION = ("positions", "quaternions", "velocities")
# A step that failed is solved again with this many times the iterations and without momentum, from a cold start if need
# be; one that begins with an overlap beyond this share of the bound has as many at once. A light rock that the machine
# presses into a jammed pile passes on little of the machine's momentum per iteration, and is squeezed meanwhile.
RETRY_FACTOR = 4
DEEP_SHARE = 0.375
# One that would make an overlap beyond this share is solved again, with contacts where its own motion would lead.
FORESEEN_SHARE = 0.75


@dataclass(frozen=True)
class MachinePiece:
    """A convex piece of a machine body that touches rocks.

    Attributes:
        body: number of the body among the machine's bodies that touch rocks.
        vertices: (k, 3) in the body's frame [m].
        friction: its coefficient; a pair has 2 a b / (a + b).
        stiffness: of the linear law [N/m], see `NonsmoothConfig.linear_overlap`; the same for all pieces of a body.
    """

    body: int
    vertices: Array
    friction: float
    stiffness: float = np.inf


@dataclass(frozen=True, eq=False)
class MachineStep:
    """The machine over the coming step, as the contact solve needs it (v velocities, b bodies, m rows).

    Attributes:
        X_WBs: (b, 4, 4) poses of the bodies that touch rocks.
        velocity: (v,) generalised velocities now.
        free_change: (v,) their change over the step without rocks and without the forces of the rows.
        arrays: Jacobians, responses and rows.
        sensors: (k, 18) boxes that keep rocks awake: rotation by rows, position, lower, upper corner.
    """

    X_WBs: Array
    velocity: Array
    free_change: Array
    arrays: MachineArrays
    sensors: Array


@dataclass(eq=False)
class RockArrays:
    """All state of n rocks. The arrays of a step's result are new, or in the room that the step was given.

    Attributes:
        quaternions: (n, 4) w x y z.
        positions: (n, 3) [m].
        velocities: (n, 6) angular, translational in W.
        book: (n, reduction.BOOK_WIDTH) status and bookkeeping of the reduction.
        memory: of m contact points, loaded or about to touch; m changes from step to step.
        n_idle: so many of them, the first, are of rocks that were at rest in the last step; gaps among them.
        steps: how many have been taken.
    """

    quaternions: Array
    positions: Array
    velocities: Array
    book: Array
    memory: contacts.Memory
    n_idle: int = 0
    steps: int = 0


@dataclass(frozen=True, eq=False)
class StepReport:
    """What a step did.

    Attributes:
        F_Bs_W: (b, 6) spatial impulse over time step of the rocks on each machine body at its origin, in W:
            torque [N m], force [N].
        machine_velocity: (v,) the machine's generalised velocities as the contact solve left them.
        awake: (m,) the rocks awake in the step, the only ones that moved.
        n_kept: so many points of the memory, the first, are where they were, but for those that left gaps.
        freed: (g,) these.
        n_contacts: contact points; n_loaded of them carry load.
        n_sweeps: sweeps of the resting stage.
        residual: the last one's change of the normal impulses over their sum or the weight, see `solve_resting`.
        max_penetration, p99_penetration: of loaded points [m].
        n_woken, n_rested, n_lost: rocks that changed state (lost: left the site) in this step.
        n_foreseen: loaded pairs that the step drives deep into each other, see `foresight`.
        redone: the step was solved again, with more iterations.
        flagged: it had to be redone, or penetration is beyond the bound of the settings.
        overflow: loaded points that memory could not take.
    """

    F_Bs_W: Array
    machine_velocity: Array
    awake: IntArray
    n_kept: int
    freed: IntArray
    n_contacts: int
    n_loaded: int
    n_sweeps: int
    residual: float
    max_penetration: float
    p99_penetration: float
    n_woken: int
    n_rested: int
    n_lost: int
    n_foreseen: int
    redone: bool
    flagged: bool
    overflow: int

    @property
    def n_awake(self) -> int:
        """Number of rocks awake in the step."""
        return len(self.awake)


@dataclass(frozen=True, eq=False)
class ContactTable:
    """Contact points that carry load (c points).

    Attributes:
        first, second: (c,) the bodies in the engine's order: rocks, static pieces, half-spaces, pieces of machines.
        points: (c, 3) in W [m].
        impulses: (c, 3) on the second over the step, in W [N s].
        gaps: (c,) at its beginning [m].
    """

    first: IntArray
    second: IntArray
    points: Array
    impulses: Array
    gaps: Array


def make_machineless_step() -> MachineStep:
    """Return the machine of a simulation without one."""
    return MachineStep(
        np.zeros((0, 4, 4)),
        np.zeros(0),
        np.zeros(0),
        MachineArrays(
            np.zeros((0, 6, 0)),
            np.zeros((0, 0, 6)),
            np.zeros((0, 6, 6)),
            np.zeros((0, 0)),
            np.zeros((0, 0)),
            np.zeros((0, solver.MACHINE_ROW_WIDTH)),
        ),
        np.zeros((0, 18)),
    )


class NonsmoothEngine:
    """Steps a given set of rocks in given surroundings, with the pieces of a machine if there is one.

    Args:
        rocks: material.
        shapes: the rock shapes.
        surroundings: what is at rest.
        config: settings.
        time_step: [s].
        shape, size, fixed: (n,) of the rocks, as in a `PileState`.
        pieces: the machine's.
        n_machine_bodies: number of machine bodies.
        gravity: (3,) in W [m/s^2].
    """

    def __init__(
        self,
        rocks: RocksConfig,
        shapes: Sequence[RockShape],
        surroundings: Surroundings,
        config: NonsmoothConfig,
        time_step: float,
        shape: IntArray,
        size: Array,
        fixed: NDArray[np.bool_],
        pieces: Sequence[MachinePiece] = (),
        n_machine_bodies: int = 0,
        gravity: Sequence[float] = GRAVITY,
    ) -> None:
        announce_compilation()
        self.config = config
        self.time_step = time_step
        self.n_rocks = n = len(size)
        self.shape_index = np.asarray(shape, np.int64)
        self.size = np.asarray(size, float)
        self.fixed = np.asarray(fixed, bool)
        self.gravity = np.asarray(gravity, float)
        # What impulses are measured by.
        self._strength = float(np.linalg.norm(self.gravity)) or STANDARD_GRAVITY
        n_shapes, n_static, n_planes = (
            len(shapes), len(surroundings.pieces), len(surroundings.half_spaces),
        )  # fmt: skip
        self.convex = make_convex_shapes(
            [item.vertices for item in shapes]
            + [item.vertices for item in surroundings.pieces]
            + [item.vertices for item in pieces],
            [config.rounding] * n_shapes + [0.0] * (n_static + len(pieces)),
        )
        self.planes = surroundings.half_space_array

        # Bodies: rocks, static pieces, planes, pieces of the machine.
        self.first_plane = n + n_static
        self.first_piece = n + n_static + n_planes
        n_bodies = self.first_piece + len(pieces)
        if n_bodies >= contacts.KEY_STEP:
            raise ValueError(f"{n_bodies} bodies: more than {contacts.KEY_STEP - 1} cannot be told apart")
        self.piece_body = np.array([piece.body for piece in pieces], np.int64)
        shape = np.zeros(n_bodies, np.int64)
        shape[:n] = self.shape_index
        shape[n : self.first_plane] = n_shapes + np.arange(n_static)
        shape[self.first_piece :] = n_shapes + n_static + np.arange(len(pieces))
        scale = np.ones(n_bodies)
        scale[:n] = self.size
        friction = np.empty(n_bodies)
        friction[:n] = rocks.friction
        friction[n : self.first_plane] = [piece.friction for piece in surroundings.pieces]
        friction[self.first_plane : self.first_piece] = [plane.friction for plane in surroundings.half_spaces]
        friction[self.first_piece :] = [piece.friction for piece in pieces]
        solver_body = np.full(n_bodies, n, np.int64)
        solver_body[:n] = np.arange(n)
        solver_body[self.first_piece :] = n + 1 + self.piece_body
        self._collision_bodies = narrow_phase.CollisionBodies(
            shape, scale, np.zeros((n_bodies, 3)), np.tile(np.eye(3), (n_bodies, 1, 1)), solver_body, friction
        )
        self.restitution = np.array([rocks.restitution, rocks.restitution_machine])
        self.n_machine_bodies = n_machine_bodies

        # Masses and inertias of the true shapes, not of the rounded ones.
        volume = np.array([item.volume for item in shapes])
        inertia = np.array([np.linalg.inv(item.inertia) for item in shapes])
        self.mass = rocks.density * volume[self.shape_index] * self.size**3
        self.inverse_mass = 1.0 / self.mass
        inverse = inertia[self.shape_index] / (rocks.density * self.size**5)[:, None, None]
        self.inverse_inertia_local = np.ascontiguousarray(inverse.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]])
        self.radius = self.size * self.convex.radius[self.shape_index]
        effective_modulus = 0.5 * rocks.elastic_modulus / (1.0 - rocks.poisson_ratio**2)
        self.hertz = config.stiffness_factor * 4.0 / 3.0 * effective_modulus
        self.softness = np.zeros(n + 1 + n_machine_bodies)
        if config.linear_overlap > 0.0:
            # As the plant engine has it: springs in series.
            stiffness = [
                config.stiffness_factor
                * calc_spring_stiffness(
                    rocks.elastic_modulus, rocks.poisson_ratio, mass / rocks.density, config.linear_overlap
                )
                for mass in self.mass
            ]
            self.softness[:n] = np.reciprocal(stiffness)
            for piece in pieces:
                self.softness[n + 1 + piece.body] = 1.0 / piece.stiffness
        else:
            self.softness[:n] = 1.0 / self.size

        self._lower_site, self._upper_site = surroundings.lower, surroundings.upper
        self._grids = _make_grid_classes(self.radius)
        self._make_scratch(n_bodies)

    def _make_scratch(self, n_bodies: int) -> None:
        n = self.n_rocks
        self.capacity = self.config.memory_per_rock * n + 1024
        self._lower = np.full((n_bodies, 3), np.inf)
        self._upper = np.full((n_bodies, 3), -np.inf)
        self._inverse_inertia = np.zeros((n, 6))
        self._posed_quaternions = np.full((n, 4), np.nan)
        self._stale = np.zeros(n, np.int64)
        self._near = np.zeros(n, np.int64)
        self._bodies = np.zeros((n + 1, solver.BODY_WIDTH))
        self._bodies_32 = make_zeros((n + 1, solver.BODY_WIDTH), np.float32)
        # Zero between steps, for the rocks.
        self._velocities = np.zeros((n + 1 + self.n_machine_bodies, 6))
        self._marks = np.zeros(n + 1 + self.n_machine_bodies, np.int64)
        self._active = np.zeros(self.capacity, np.int64)
        self._table = np.zeros(contacts.calc_places(2 * self.capacity), np.int64)
        # Places for the pairs that are near but apart; what is pushed out is searched anew, no more.
        self._axis_cache = contacts.make_axis_cache(max(4 * n, 1024))
        self._statistics = np.zeros(4, np.int64)
        self._narrow_workspace = narrow_phase.make_workspace()
        self._movers, self._by_movers = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        # What is no rock does not move, or is searched with what does.
        self._calm = np.full(n_bodies, broad_phase.SEARCHED, np.int8)
        self._calm[n : self.first_piece] = broad_phase.CALM
        self._seeks = np.zeros(n, np.bool_)
        # Set by a solve, for one that repeats it.
        self._foreseen = np.zeros(n_bodies)
        self._allocate_pairs(20 * n + 256)
        self._allocate_rows(6 * n + 256)
        for k in range(n, self.first_plane):
            vertices = self._get_vertices(self._collision_bodies.shape[k])
            self._lower[k], self._upper[k] = vertices.min(axis=0), vertices.max(axis=0)

    def _get_vertices(self, shape: int) -> Array:
        start = self.convex.vertex_start
        return self.convex.vertices[start[shape] : start[shape + 1]]

    def _allocate_pairs(self, capacity: int) -> None:
        self._pair_a = np.zeros(capacity, np.int64)
        self._pair_b = np.zeros(capacity, np.int64)
        self._remembered = np.zeros(capacity, np.int64)
        self._known_axes = np.zeros((capacity, 3), np.float32)

    def _allocate_rows(self, capacity: int) -> None:
        self._rows = contacts.make_contact_rows(capacity)
        self._impacts = np.zeros((capacity, 3))
        self._depths = np.zeros(capacity)
        self._batches = make_batch_arrays(capacity)

    # ---- state in and out

    def make_arrays(self, pile: PileState) -> RockArrays:
        """Return the state arrays of a pile; rocks that are marked as resting in its contacts stay resting.

        Raises:
            ValueError: not the rocks this engine was made for.
        """
        if not (
            np.array_equal(pile.shape, self.shape_index)
            and np.array_equal(pile.size, self.size)
            and np.array_equal(pile.fixed, self.fixed)
        ):
            raise ValueError("the pile's rocks are not those this engine was made for")
        n = self.n_rocks
        book = np.zeros((n, reduction.BOOK_WIDTH))
        book[:, reduction.STATUS] = np.where(self.fixed, FIXED, AWAKE)
        book[:, reduction.ANCHOR : reduction.ANCHOR + 3] = pile.p_WRs
        # A pile's contacts don't tell normals and gaps.
        book[:, reduction.WAY] = np.inf
        memory = contacts.make_memory(0)
        if pile.contacts is not None:
            memory = self._make_memory(pile.contacts)
            if self.config.reduction == "rest":
                at_rest = pile.contacts.resting & ~self.fixed
                book[at_rest, reduction.STATUS] = RESTING
                sums = np.zeros((n, 3))
                contacts.sum_impulses(memory, n, sums)
                book[at_rest, reduction.REFERENCE : reduction.REFERENCE + 3] = sums[at_rest]
        velocities = pile.V_WRs.copy()
        velocities[book[:, reduction.STATUS] != AWAKE] = 0.0
        # Stored unit quaternions keep their bits.
        length = np.linalg.norm(pile.q_WRs, axis=1, keepdims=True)
        arrays = RockArrays(
            np.where(np.abs(length - 1.0) < 1e-14, pile.q_WRs, pile.q_WRs / length),
            pile.p_WRs.copy(),
            velocities,
            book,
            memory,
        )
        book[self._find_lost(arrays.positions) & ~self.fixed, reduction.STATUS] = LOST
        return arrays

    def make_pile(self, arrays: RockArrays, provenance: dict[str, object] | None = None) -> PileState:
        """Return the pile of state arrays, contact memory included."""
        pairs, rows = arrays.memory.pairs.astype(np.int64), arrays.memory.values
        # The machine's are not the pile's, and what carries no load is found again.
        loaded = rows[:, contacts.MEMORY_IMPULSE : contacts.MEMORY_IMPULSE + 3].any(axis=1)
        kept = loaded & (pairs[:, 0] >= 0) & (pairs[:, 1] < self.first_piece)
        pairs, rows = pairs[kept], rows[kept]
        # Surfaces of the site are -1, -2, ...: independent of the number of rocks.
        surface = pairs[:, 1] >= self.n_rocks
        pairs[surface, 1] = self.n_rocks - 1 - pairs[surface, 1]
        memory = ContactMemory(
            pairs,
            rows[:, contacts.MEMORY_POINT : contacts.MEMORY_POINT + 3].copy(),
            rows[:, contacts.MEMORY_IMPULSE : contacts.MEMORY_IMPULSE + 3].copy(),
            arrays.book[:, reduction.STATUS] == RESTING,
        )
        return PileState(
            arrays.positions.copy(),
            arrays.quaternions.copy(),
            arrays.velocities.copy(),
            self.shape_index,
            self.size,
            self.fixed,
            dict(provenance or {}),
            memory,
        )

    def _make_memory(self, stored: ContactMemory) -> contacts.Memory:
        second = np.where(stored.pairs[:, 1] < 0, self.n_rocks - 1 - stored.pairs[:, 1], stored.pairs[:, 1])
        known = np.flatnonzero(second < self.first_piece)[: self.capacity]
        memory = contacts.make_memory(len(known))
        memory.pairs[:, 0], memory.pairs[:, 1] = stored.pairs[known, 0], second[known]
        memory.values[:, contacts.MEMORY_POINT : contacts.MEMORY_POINT + 3] = stored.points[known]
        memory.values[:, contacts.MEMORY_IMPULSE : contacts.MEMORY_IMPULSE + 3] = stored.impulses[known]
        return memory

    def _find_lost(self, positions: Array) -> NDArray[np.bool_]:
        outside = (positions < self._lower_site) | (positions > self._upper_site)
        return np.asarray(outside.any(axis=1))

    def place(self, arrays: RockArrays, rocks: IntArray, p_WRs: Array, V_WRs: Array) -> RockArrays:
        """Return the state with rocks put at positions (m, 3) with velocities (m, 6), awake, contacts forgotten."""
        kept = ~np.isin(arrays.memory.pairs, rocks).any(axis=1)
        new = replace(
            arrays,
            positions=arrays.positions.copy(),
            velocities=arrays.velocities.copy(),
            book=arrays.book.copy(),
            memory=arrays.memory.select(kept),
            n_idle=int(kept[: arrays.n_idle].sum()),
        )
        new.positions[rocks] = p_WRs
        new.velocities[rocks] = V_WRs
        for rock in rocks:
            reduction.wake_rock(new.book, new.positions, rock)
        return new

    # ---- the step

    def advance(self, arrays: RockArrays) -> tuple[RockArrays, StepReport]:
        """Step without a machine; see `step`."""
        return self.step(arrays, make_machineless_step())

    def make_room(self) -> RockArrays:
        """Return arrays that can hold any state of these rocks, memory of full capacity; contents undefined."""
        n = self.n_rocks
        return RockArrays(
            np.empty((n, 4)),
            np.empty((n, 3)),
            np.empty((n, 6)),
            np.empty((n, reduction.BOOK_WIDTH)),
            contacts.make_memory(self.capacity),
        )

    def step(
        self, arrays: RockArrays, machine: MachineStep, room: RockArrays | None = None
    ) -> tuple[RockArrays, StepReport]:
        """Advance all rocks by one time step, solved together with the machine.

        Args:
            arrays: state at t_n; not changed.
            machine: the machine at t_n, see `MachineStep`.
            room: where the result is written, see `make_room`; new if None. What the step does not change of poses,
                velocities and memory is left as it is in it, see `write_changes`. To copy it in every step would take
                as long as all passes over resting rocks.

        Returns:
            state at t_n + dt, and the report.

        Raises:
            SimulationFailure: poses, or velocities of awake rocks, are not finite; or the result is not finite or has
                not converged, also when solved again with `RETRY_FACTOR` times the iterations and without momentum.
        """
        iterations, momentum = self.config.iterations, self.config.momentum
        self._foreseen[:] = 0.0
        if room is None:
            room = self.make_room()
            for name in MOTION:
                getattr(room, name)[:] = getattr(arrays, name)
            for old, copied in zip(arrays.memory, room.memory, strict=True):
                copied[: len(old)] = old
        new, report = self._try_step(arrays, machine, room, iterations, momentum, warm=True, search_all=False)
        if new is not None and report is not None and report.residual <= self.config.max_residual:
            if report.n_foreseen == 0:
                return new, report
            new, report = self._try_step(
                arrays, machine, room, RETRY_FACTOR * iterations, momentum, warm=True, search_all=True
            )
            if new is not None and report is not None and report.residual <= self.config.max_residual:
                return new, _mark_redone(report)
        again, better = self._try_step(
            arrays, machine, room, RETRY_FACTOR * iterations, 0.0, warm=new is not None, search_all=True
        )
        if again is None or better is None:
            raise SimulationFailure("rocks: the contact solve gave values that are not finite")
        if better.residual > self.config.max_residual:
            raise SimulationFailure(
                f"rocks: the contact solve did not converge: residual {better.residual:.2g} after "
                f"{better.n_sweeps} iterations (max_residual {self.config.max_residual:g})"
            )
        return again, _mark_redone(better)

    def find_loaded_contacts(self, arrays: RockArrays, machine: MachineStep) -> ContactTable:
        """Return the contact points that carry load in the coming step; arguments and errors as of `step`."""
        _, report = self.step(arrays, machine)
        rows, n_rows = self._rows, report.n_contacts
        values = rows.values[:n_rows]
        loaded = values[:, contacts.IMPULSE] > 0.0
        values, keys = values[loaded], rows.key[:n_rows][loaded]
        first, second = keys // contacts.KEY_STEP, keys % contacts.KEY_STEP
        axes = values[:, contacts.NORMAL : contacts.NORMAL + 9].reshape(-1, 3, 3)
        impulses = np.einsum("kij,ki->kj", axes, values[:, contacts.IMPULSE : contacts.IMPULSE + 3])
        # A row's arms are from where the bodies were when the step began.
        points = arrays.positions[first] + values[:, contacts.ARM_A : contacts.ARM_A + 3]
        return ContactTable(first, second, points, impulses, values[:, contacts.GAP].copy())

    def write_changes(self, new: RockArrays, report: StepReport, target: RockArrays) -> None:
        """Write what a step has changed into a copy of the state before it.

        Args:
            new, report: what `step` gave.
            target: changed, all but `n_idle` and `steps`; the memory has its full capacity.
        """
        for name in MOTION:
            getattr(target, name)[report.awake] = getattr(new, name)[report.awake]
        target.book[:] = new.book
        target.memory.pairs[report.freed] = -1
        changed = slice(report.n_kept, len(new.memory.pairs))
        for before, after in zip(target.memory, new.memory, strict=True):
            before[changed] = after[changed]

    def _try_step(
        self,
        arrays: RockArrays,
        machine: MachineStep,
        room: RockArrays,
        iterations: int,
        momentum: float,
        warm: bool,
        search_all: bool,
    ) -> tuple[RockArrays, StepReport] | tuple[None, None]:
        config, n, dt = self.config, self.n_rocks, self.time_step
        new = replace(room, steps=arrays.steps + 1)
        book, memory = new.book, arrays.memory
        book[:] = arrays.book
        n_woken = 0
        if config.reduction == "rest":
            reduction.mark_by_movers(
                book, arrays.velocities, memory, arrays.n_idle, config.rest.mover_speed,
                self._movers, self._by_movers,
            )  # fmt: skip
            n_woken = reduction.wake(
                book,
                arrays.positions,
                self.radius,
                self.mass,
                memory,
                arrays.n_idle,
                machine.sensors,
                self._by_movers,
                config.rest.wake_load * self._strength * dt,
                config.rest.wake_share,
                config.rest.wake_near_movers,
                config.rest.wake_steps,
            )
            if new.steps % max(round(config.rest.recheck_period / dt), 1) == 0:
                n_woken += reduction.wake_all(book, arrays.positions, True)
        else:
            reduction.wake_all(book, arrays.positions, False)
        status = book[:, reduction.STATUS].astype(np.int64)
        awake = np.flatnonzero(status == AWAKE)
        search_all = search_all or config.search_period == 1
        reduction.mark_calm(
            book, arrays.positions, arrays.velocities, self.radius, machine.sensors, dt, config.slow_speed,
            -1.0 if search_all else config.search_distance, search_all or arrays.steps % config.search_period == 0,
            self._calm,
        )  # fmt: skip
        self._velocities[n + 1 :] = machine.arrays.jacobian @ machine.velocity
        self._pose(arrays, machine, status)
        motion.set_bodies(
            awake,
            arrays.velocities,
            self.inverse_mass,
            self._inverse_inertia,
            self._bodies,
            self._velocities,
        )

        n_pairs = self._find_pairs(status)
        places, n_active, n_gaps = contacts.index_memory(memory, n, status, self._active, self._table)
        n_rows = self._find_contacts(n_pairs, memory, self._table[:places], n_active)
        rows, body_a, body_b, *_ = self._rows
        if contacts.find_deepest(self._rows, n_rows) > DEEP_SHARE * config.max_penetration:
            iterations *= RETRY_FACTOR
        if not warm:
            rows[:n_rows, contacts.IMPULSE : contacts.IMPULSE + 3] = 0.0

        velocity = machine.velocity.copy()
        machine.arrays.row_values[:, solver.ROW_IMPULSE] = 0.0
        upsilon = 1.0 / (1.0 + 4.0 * config.damping_time)
        n_impacts = solver.prepare_rows(
            rows, n_rows, body_a, body_b, self._bodies, n, machine.arrays, velocity, self.softness, self.hertz,
            config.linear_overlap > 0.0, dt, upsilon, config.max_recovery_speed, config.impact_threshold,
        )  # fmt: skip
        if n_impacts > 0:
            solver.solve_impacts(
                rows, n_rows, body_a, body_b, self._bodies, n, machine.arrays, velocity, dt,
                config.impact_threshold, config.impact_iterations, self._marks, self._impacts,
            )  # fmt: skip
        if config.spin_damping > 0.0:
            solver.damp_spin(rows, n_rows, body_a, body_b, self._bodies, n, config.spin_damping * dt)
        motion.add_gravity(awake, self._bodies, self.gravity * dt)
        velocity += machine.free_change
        residual = resting.solve_resting(
            rows, n_rows, body_a, body_b, awake, self._bodies, n, machine.arrays, velocity,
            iterations, config.machine_sweeps, momentum, self._batches, self._bodies_32, self._marks,
            float(self.mass[awake].sum()) * self._strength * dt,
        )  # fmt: skip

        sane = motion.move(
            awake, self._bodies, self.inverse_inertia_local, dt, arrays.quaternions, arrays.positions,
            new.quaternions, new.positions, new.velocities, self._velocities,
        )  # fmt: skip
        if not sane or not np.isfinite(velocity).all():
            # The rows of bodies that are not awake have to stay zero.
            self._bodies[:] = 0.0
            self._bodies_32[:] = 0.0
            self._velocities[:] = 0.0
            return None, None
        n_memory, n_idle, n_kept = contacts.write_memory(
            n, memory, arrays.n_idle, self._active, n_active, n_gaps, self._rows, n_rows,
            self._collision_bodies.rotations, self._velocities, dt,
            2.0 * config.search_distance, new.memory,
        )  # fmt: skip
        new.memory, new.n_idle = new.memory.select(slice(n_memory)), n_idle
        self._velocities[n + 1 :] = machine.arrays.jacobian @ velocity
        n_foreseen = foresight.foresee_overlaps(
            self._rows, n_rows, self.first_plane, self.first_piece, self.planes, self.convex, self._collision_bodies,
            self._velocities, dt, FORESEEN_SHARE * config.max_penetration, self._foreseen, self._narrow_workspace,
        )  # fmt: skip
        self._velocities[awake] = 0.0
        if config.reduction == "rest":
            reduction.mark_by_movers(
                book, new.velocities, new.memory, n_idle, config.rest.mover_speed,
                self._movers, self._by_movers,
            )  # fmt: skip
        n_rested, n_lost = reduction.rest(
            book, new.positions, new.velocities, self.radius, machine.sensors, self._by_movers, dt,
            config.rest.displacement, config.rest.time, config.rest.speed, self._lower_site, self._upper_site,
            config.reduction == "rest",
        )  # fmt: skip
        n_loaded = contacts.find_depths(self._rows, n_rows, self._depths)
        depths = self._depths[:n_loaded]
        max_penetration = float(depths.max(initial=0.0))
        report = StepReport(
            F_Bs_W=solver.sum_machine_impulses(
                rows, n_rows, body_b, n, self.n_machine_bodies, self._impacts, n_impacts > 0
            )
            / dt,
            machine_velocity=velocity,
            awake=awake,
            n_kept=n_kept,
            freed=self._active[: np.searchsorted(self._active[:n_active], n_kept)].copy(),
            n_contacts=n_rows,
            n_loaded=n_loaded,
            n_sweeps=iterations,
            residual=residual,
            max_penetration=max_penetration,
            p99_penetration=float(_calc_percentile(depths, 0.99)),
            n_woken=n_woken,
            n_rested=n_rested,
            n_lost=n_lost,
            n_foreseen=n_foreseen,
            redone=False,
            flagged=max_penetration > config.max_penetration,
            overflow=n_memory - len(new.memory.pairs),
        )
        return new, report

    def _pose(self, arrays: RockArrays, machine: MachineStep, status: IntArray) -> None:
        """Set positions, rotations and boxes: of awake rocks, of others that were moved, of the machine."""
        n, dt, margin = self.n_rocks, self.time_step, self.config.contact_margin
        bodies = self._collision_bodies
        n_stale = broad_phase.find_stale(
            status,
            arrays.quaternions,
            arrays.positions,
            self._posed_quaternions,
            bodies.positions,
            self._stale,
        )
        # What is not finite differs from itself, so it is among these.
        for name in MOTION:
            if not motion.are_finite(getattr(arrays, name), self._stale[:n_stale]):
                raise SimulationFailure(f"rocks: {name} that are not finite")
        broad_phase.calc_poses(
            bodies.shape, bodies.scale, arrays.quaternions, arrays.positions, arrays.velocities, dt, margin,
            self.convex, self._stale[:n_stale], bodies.rotations, self._lower, self._upper,
            self.inverse_inertia_local, self._inverse_inertia,
        )  # fmt: skip
        # Boxes of others are kept from step to step.
        if self._foreseen.any():
            driven = np.flatnonzero((self._foreseen[:n] > 0.0) & (status == AWAKE))
            self._lower[driven] -= dt * self._foreseen[driven, None]
            self._upper[driven] += dt * self._foreseen[driven, None]
        broad_phase.calc_piece_boxes(
            self.first_piece, self.piece_body, bodies.shape, self.convex, machine.X_WBs,
            self._velocities[n + 1 :], dt, margin, bodies.positions, bodies.rotations, self._lower, self._upper,
        )  # fmt: skip

    def _find_pairs(self, status: IntArray) -> int:
        n = self.n_rocks
        pieces = np.arange(self.first_piece, self.first_piece + len(self.piece_body))
        self._seeks[:] = (status == AWAKE) & (self._calm[:n] != broad_phase.CALM)
        all_seekers = np.flatnonzero(self._seeks)
        low, high = broad_phase.find_region(all_seekers, pieces, self._lower, self._upper)
        grids = [self._sort_grid(rocks, reach, low, high) for rocks, reach in self._grids]
        while True:
            n_pairs = 0
            for items, *_ in grids:
                seekers = items[self._seeks[items]]
                for grid in grids:
                    n_pairs = self._search(seekers, status, grid, n_pairs)
            n_pairs = broad_phase.find_static_pairs(
                all_seekers, n, self.first_plane, self.planes, self._lower, self._upper,
                self._pair_a, self._pair_b, n_pairs,
            )  # fmt: skip
            # The machine's pairs come last.
            for grid in grids:
                n_pairs = self._search(pieces, status, grid, n_pairs)
            if n_pairs <= len(self._pair_a):
                return n_pairs
            self._allocate_pairs(n_pairs + n_pairs // 4)

    def _sort_grid(self, rocks: IntArray, reach: float, low: Array, high: Array) -> Grid:
        """Sort the rocks of one class of size that are within reach of the box into a grid."""
        inverse_width, positions = 1.0 / (1.3 * reach), self._collision_bodies.positions
        n_near, first, last = broad_phase.find_near(rocks, positions, low, high, reach, self._near)
        rocks = self._near[:n_near]
        origin = np.maximum(first, self._lower_site)
        extent = np.minimum(last, self._upper_site) - origin if n_near > 0 else np.zeros(3)
        n_cells = np.maximum(np.ceil(extent * inverse_width), 1).astype(np.int64)
        cell_start = np.empty(int(n_cells.prod()) + 1, np.int64)
        items = np.empty(len(rocks), np.int64)
        boxes = np.empty((len(rocks), 6))
        broad_phase.sort_into_grid(
            rocks, positions, self._lower, self._upper, origin, inverse_width, n_cells, cell_start,
            np.empty_like(items), items, boxes,
        )  # fmt: skip
        return items, boxes, origin, inverse_width, n_cells, cell_start, reach

    def _search(
        self,
        seekers: IntArray,
        status: IntArray,
        grid: Grid,
        n_pairs: int,
    ) -> int:
        items, boxes, origin, inverse_width, n_cells, cell_start, reach = grid
        return int(
            broad_phase.find_rock_pairs(
                seekers, self.n_rocks, status, self._seeks, self._lower, self._upper, origin, inverse_width, n_cells,
                cell_start, items, boxes, reach, self._pair_a, self._pair_b, n_pairs,
            )
        )  # fmt: skip

    def _find_contacts(self, n_pairs: int, memory: contacts.Memory, table: IntArray, n_active: int) -> int:
        config = self.config
        while True:
            n_rows = narrow_phase.follow_contacts(
                memory,
                self._active,
                n_active,
                self._calm,
                self._collision_bodies,
                self.restitution,
                self._rows,
            )
            n_rows = narrow_phase.find_contacts(
                self._pair_a, self._pair_b, n_pairs, self.n_rocks, self.first_plane, self.first_piece,
                self.planes, self.convex, self._collision_bodies, self._velocities, self.restitution,
                self.time_step, config.contact_margin, config.manifold_gap, config.face_cosine,
                config.manifold_points, self._calm, config.slow_speed, self._foreseen, memory, table,
                self._axis_cache, self._remembered, self._known_axes, self._rows, n_rows, self._statistics,
                self._narrow_workspace,
            )  # fmt: skip
            if n_rows <= len(self._rows.values):
                return int(n_rows)
            self._allocate_rows(n_rows + n_rows // 4)


def _mark_redone(report: StepReport) -> StepReport:
    return replace(report, redone=True, flagged=True)


def _calc_percentile(values: Array, share: float) -> float:
    """Return the value that `share` of the values are below (0 if there are none)."""
    if len(values) == 0:
        return 0.0
    place = min(int(share * len(values)), len(values) - 1)
    return float(np.partition(values, place)[place])


def _make_grid_classes(radius: Array) -> list[tuple[IntArray, float]]:
    """Return the rocks by classes of size (a factor of two each) with the largest radius of each class [m]."""
    if len(radius) == 0:
        return []
    level = np.floor(np.log2(radius / radius.min() * 1.0001)).astype(np.int64)
    classes = [np.flatnonzero(level == k) for k in np.unique(level)]
    return [(rocks, float(radius[rocks].max())) for rocks in classes]
