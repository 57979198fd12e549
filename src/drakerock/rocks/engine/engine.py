"""The engine: one step of all rocks, from state arrays to state arrays.

A step wakes rocks (`sleeping`), finds the contacts of those that are awake (`collision.detection`), solves them
together with the machine (`solve`), moves the rocks (`motion`), keeps the contacts for the next step
(`contact_cache`) and lets rocks fall asleep. `NonsmoothEngine` holds what does not change during a simulation
(shapes, masses, the site, settings) and scratch memory that never changes a result. All state is in a `RockArrays`,
which callers own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeGuard

import numpy as np
from numpy.typing import NDArray

from drakerock.errors import SimulationFailure
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.engine import contact_cache, motion, sleeping
from drakerock.rocks.engine.collision.detection import ContactDetection, SiteBox
from drakerock.rocks.engine.collision.narrow_phase import CollisionGeometry
from drakerock.rocks.engine.collision.persistence import choose_search_modes
from drakerock.rocks.engine.collision.poses import CollisionBodies
from drakerock.rocks.engine.collision.shapes import make_convex_shapes
from drakerock.rocks.engine.compiling import announce_compilation
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.contact_cache import CacheIndex, ContactCache
from drakerock.rocks.engine.contact_law import ContactLaw
from drakerock.rocks.engine.records import (
    AWAKE,
    BODY,
    FIXED,
    LOST,
    SENSOR,
    SLEEP,
    SLEEPING,
    as_records,
    copy_records,
)
from drakerock.rocks.engine.solve.batches import make_batch_arrays, make_single_bodies
from drakerock.rocks.engine.solve.gauss_seidel import IterationSettings, solve_contacts
from drakerock.rocks.engine.solve.impacts import solve_impacts
from drakerock.rocks.engine.solve.rows import (
    KEY_STEP,
    find_deepest,
    find_depths,
    prepare_rows,
    sum_machine_impulses,
)
from drakerock.rocks.engine.solve.spin_damping import damp_spin
from drakerock.rocks.engine.state import (
    MOTION,
    ContactTable,
    MachinePiece,
    MachineStep,
    RockArrays,
    StepReport,
    make_machineless_step,
)
from drakerock.rocks.engine.surroundings import Surroundings
from drakerock.rocks.materials import calc_spring_stiffness
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import ContactMemory, PileState

__all__ = [
    "ContactTable",
    "MachinePiece",
    "MachineStep",
    "NonsmoothEngine",
    "RockArrays",
    "StepReport",
    "make_machineless_step",
]

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Drake's default [m/s^2].
GRAVITY = (0.0, 0.0, -9.81)
# Where there is no gravity, impulses are measured by this [m/s^2].
STANDARD_GRAVITY = 9.81
# Quaternions are taken for unit ones within this, and keep their bits.
UNIT_TOLERANCE = 1e-14
# A step that failed is solved again with this many times the iterations and without acceleration, from a cold start
# if need be; one that begins with an overlap beyond this share of the bound has as many at once. A light rock that
# the machine presses into a jammed pile passes on little of the machine's momentum per iteration, and is squeezed
# meanwhile.
RETRY_FACTOR = 4
DEEP_SHARE = 0.375
# One that would make an overlap beyond this share is solved again, with contacts where its own motion would lead.
DEEPENED_SHARE = 0.75


class _Attempt(NamedTuple):
    """How a step is tried: iterations, acceleration, from the last impulses or cold, whether all is searched."""

    iterations: int
    acceleration: float
    warm: bool
    search_all: bool


class _Solution(NamedTuple):
    """What the contact solve gave: the machine's velocities, iterations, residual, whether there were impacts."""

    velocity: Array
    n_iterations: int
    residual: float
    has_impacts: bool


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
        if n_bodies >= KEY_STEP:
            raise ValueError(f"{n_bodies} bodies: more than {KEY_STEP - 1} cannot be told apart")
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
        self._collision_bodies = CollisionBodies(
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
        self.contact_compliance = np.zeros(n + 1 + n_machine_bodies)
        if config.linear_overlap > 0.0:
            # As the plant engine has it: springs in series.
            stiffness = [
                config.stiffness_factor
                * calc_spring_stiffness(
                    rocks.elastic_modulus, rocks.poisson_ratio, mass / rocks.density, config.linear_overlap
                )
                for mass in self.mass
            ]
            self.contact_compliance[:n] = np.reciprocal(stiffness)
            for piece in pieces:
                self.contact_compliance[n + 1 + piece.body] = 1.0 / piece.stiffness
        else:
            self.contact_compliance[:n] = 1.0 / self.size

        self._lower_site, self._upper_site = surroundings.lower, surroundings.upper
        self._make_scratch(n_bodies)

    def _make_scratch(self, n_bodies: int) -> None:
        n = self.n_rocks
        self.capacity = self.config.memory_per_rock * n + 1024
        self.detection = ContactDetection(
            self._collision_bodies,
            CollisionGeometry(
                n, self.first_plane, self.first_piece, self.planes, self.convex, self.restitution
            ),
            self.piece_body,
            self.radius,
            self.inverse_inertia_local,
            SiteBox(self._lower_site, self._upper_site),
            self.time_step,
        )
        self._bodies = np.zeros(n + 1, BODY)
        self._single_bodies = make_single_bodies(n + 1)
        # Zero between steps, for the rocks.
        self._velocities = np.zeros((n + 1 + self.n_machine_bodies, 6))
        self._marks = np.zeros(n + 1 + self.n_machine_bodies, np.int64)
        self._active = np.zeros(self.capacity, np.int64)
        self._table = np.zeros(contact_cache.calc_places(2 * self.capacity), np.int64)
        self._movers, self._by_movers = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        self._allocate_rows()

    def _allocate_rows(self) -> None:
        capacity = len(self.detection.rows.values)
        self._impacts = np.zeros((capacity, 3))
        self._depths = np.zeros(capacity)
        self._batches = make_batch_arrays(capacity)

    # ---- state in and out

    def make_arrays(self, pile: PileState) -> RockArrays:
        """Return the state arrays of a pile; rocks that are marked as resting in its contacts stay asleep,
        unless they have been given a velocity.

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
        sleep = np.zeros(n, SLEEP)
        sleep["status"] = np.where(self.fixed, FIXED, AWAKE)
        sleep["anchor"] = pile.p_WRs
        # A pile's contacts don't tell normals and gaps.
        sleep["way"] = np.inf
        cache = contact_cache.make_contact_cache(0)
        if pile.contacts is not None:
            cache = self._make_cache(pile.contacts)
            if self.config.reduction == "rest":
                still = (np.abs(pile.V_WRs) < self.config.rest.speed).all(axis=1)
                asleep = pile.contacts.resting & still & ~self.fixed
                sleep["status"][asleep] = SLEEPING
                sums = np.zeros((n, 3))
                contact_cache.sum_impulses(cache, n, sums)
                sleep["reference"][asleep] = sums[asleep]
        velocities = pile.V_WRs.copy()
        velocities[sleep["status"] != AWAKE] = 0.0
        length = np.linalg.norm(pile.q_WRs, axis=1, keepdims=True)
        arrays = RockArrays(
            np.where(np.abs(length - 1.0) < UNIT_TOLERANCE, pile.q_WRs, pile.q_WRs / length),
            pile.p_WRs.copy(),
            velocities,
            sleep,
            cache,
        )
        sleep["status"][self._find_lost(arrays.positions) & ~self.fixed] = LOST
        return arrays

    def make_pile(self, arrays: RockArrays, provenance: dict[str, object] | None = None) -> PileState:
        """Return the pile of state arrays, loaded contacts included."""
        pairs, points = arrays.cache.pairs.astype(np.int64), arrays.cache.points
        # The machine's are not the pile's, and what carries no load is found again.
        loaded = points["impulse"].any(axis=1)
        kept = loaded & (pairs[:, 0] >= 0) & (pairs[:, 1] < self.first_piece)
        pairs, points = pairs[kept], points[kept]
        # Surfaces of the site are -1, -2, ...: independent of the number of rocks.
        surface = pairs[:, 1] >= self.n_rocks
        pairs[surface, 1] = self.n_rocks - 1 - pairs[surface, 1]
        memory = ContactMemory(
            pairs,
            points["point"].copy(),
            points["impulse"].copy(),
            arrays.sleep["status"] == SLEEPING,
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

    def _make_cache(self, stored: ContactMemory) -> ContactCache:
        second = np.where(stored.pairs[:, 1] < 0, self.n_rocks - 1 - stored.pairs[:, 1], stored.pairs[:, 1])
        known = np.flatnonzero(second < self.first_piece)[: self.capacity]
        cache = contact_cache.make_contact_cache(len(known))
        cache.pairs[:, 0], cache.pairs[:, 1] = stored.pairs[known, 0], second[known]
        cache.points["point"] = stored.points[known]
        cache.points["impulse"] = stored.impulses[known]
        return cache

    def _find_lost(self, positions: Array) -> NDArray[np.bool_]:
        outside = (positions < self._lower_site) | (positions > self._upper_site)
        return np.asarray(outside.any(axis=1))

    def place(self, arrays: RockArrays, rocks: IntArray, p_WRs: Array, V_WRs: Array) -> RockArrays:
        """Return the state with rocks put at positions (m, 3) with velocities (m, 6), awake, contacts forgotten."""
        kept = ~np.isin(arrays.cache.pairs, rocks).any(axis=1)
        new = replace(
            arrays,
            positions=arrays.positions.copy(),
            velocities=arrays.velocities.copy(),
            sleep=arrays.sleep.copy(),
            cache=arrays.cache.select(kept),
            n_sleeping=int(kept[: arrays.n_sleeping].sum()),
        )
        new.positions[rocks] = p_WRs
        new.velocities[rocks] = V_WRs
        for rock in rocks:
            sleeping.wake_rock(rock, new.positions, new.sleep)
        return new

    def make_room(self) -> RockArrays:
        """Return arrays that can hold any state of these rocks, the cache of full capacity; contents undefined."""
        n = self.n_rocks
        return RockArrays(
            np.empty((n, 4)),
            np.empty((n, 3)),
            np.empty((n, 6)),
            np.empty(n, SLEEP),
            contact_cache.make_contact_cache(self.capacity),
        )

    def write_changes(self, new: RockArrays, report: StepReport, target: RockArrays) -> None:
        """Write what a step has changed into a copy of the state before it.

        Args:
            new, report: what `step` gave.
            target: changed, all but `n_sleeping` and `steps`; the cache has its full capacity.
        """
        for name in MOTION:
            getattr(target, name)[report.awake] = getattr(new, name)[report.awake]
        copy_records(new.sleep, target.sleep)
        target.cache.pairs[report.freed] = -1
        changed = slice(report.n_kept, len(new.cache.pairs))
        for before, after in zip(target.cache, new.cache, strict=True):
            before[changed] = after[changed]

    # ---- the step

    def advance(self, arrays: RockArrays) -> tuple[RockArrays, StepReport]:
        """Step without a machine; see `step`."""
        return self.step(arrays, make_machineless_step())

    def step(
        self, arrays: RockArrays, machine: MachineStep, room: RockArrays | None = None
    ) -> tuple[RockArrays, StepReport]:
        """Advance all rocks by one time step, solved together with the machine.

        Args:
            arrays: state at t_n; not changed.
            machine: the machine at t_n, see `MachineStep`.
            room: where the result is written, see `make_room`; new if None. What the step does not change of poses,
                velocities and cache is left as it is in it, see `write_changes`. To copy it in every step would take
                as long as all passes over sleeping rocks.

        Returns:
            state at t_n + dt, and the report.

        Raises:
            SimulationFailure: poses, or velocities of awake rocks, are not finite; or the result is not finite or has
                not converged, also when solved again with `RETRY_FACTOR` times the iterations and without
                acceleration.
        """
        iterations, acceleration = self.config.iterations, self.config.momentum
        self.detection.extra_speeds[:] = 0.0
        if room is None:
            room = self.make_room()
            for name in MOTION:
                getattr(room, name)[:] = getattr(arrays, name)
            for old, copied in zip(arrays.cache, room.cache, strict=True):
                copied[: len(old)] = old
        result = self._try_step(arrays, machine, room, _Attempt(iterations, acceleration, True, False))
        if self._has_converged(result):
            if result[1].n_deep == 0:
                return result
            more = _Attempt(RETRY_FACTOR * iterations, acceleration, True, True)
            result = self._try_step(arrays, machine, room, more)
            if self._has_converged(result):
                return _mark_redone(result)
        plain = _Attempt(RETRY_FACTOR * iterations, 0.0, result is not None, True)
        result = self._try_step(arrays, machine, room, plain)
        if result is None:
            raise SimulationFailure("rocks: the contact solve gave values that are not finite")
        if not self._has_converged(result):
            raise SimulationFailure(
                f"rocks: the contact solve did not converge: residual {result[1].residual:.2g} after "
                f"{result[1].n_iterations} iterations (max_residual {self.config.max_residual:g})"
            )
        return _mark_redone(result)

    def find_loaded_contacts(self, arrays: RockArrays, machine: MachineStep) -> ContactTable:
        """Return the contact points that carry load in the coming step; arguments and errors as of `step`."""
        _, report = self.step(arrays, machine)
        rows, n_rows = self.detection.rows, report.n_contacts
        impacts = self._impacts[:n_rows] if report.has_impacts else np.zeros((n_rows, 3))
        loaded = (rows.values["impulse"][:n_rows, 0] > 0.0) | impacts.any(axis=1)
        values, keys = rows.values[:n_rows][loaded], rows.key[:n_rows][loaded]
        first, second = keys // KEY_STEP, keys % KEY_STEP
        axes = np.stack([values["normal"], values["tangent_1"], values["tangent_2"]], axis=1)
        impulses = np.einsum("kij,ki->kj", axes, values["impulse"]) + impacts[loaded]
        # A row's arms are from where the bodies were when the step began.
        points = arrays.positions[first] + values["arm_a"]
        return ContactTable(first, second, points, impulses, values["gap"].copy())

    def _has_converged(
        self, result: tuple[RockArrays, StepReport] | None
    ) -> TypeGuard[tuple[RockArrays, StepReport]]:
        return result is not None and result[1].residual <= self.config.max_residual

    def _try_step(
        self, arrays: RockArrays, machine: MachineStep, room: RockArrays, attempt: _Attempt
    ) -> tuple[RockArrays, StepReport] | None:
        """Return state and report of a step; None if they are not finite."""
        dt = self.time_step
        new = replace(room, steps=arrays.steps + 1)
        copy_records(arrays.sleep, new.sleep)
        sensors = as_records(machine.sensors, SENSOR)
        n_woken = self._wake(arrays, new, sensors)
        status = new.sleep["status"].astype(np.int64)
        awake = np.flatnonzero(status == AWAKE)

        self._velocities[self.n_rocks + 1 :] = machine.arrays.jacobian @ machine.velocity
        self._update_poses(arrays, new, machine, status, sensors, attempt.search_all)
        motion.set_bodies(
            awake, arrays.velocities, self.inverse_mass, self.detection.inverse_inertia, self._bodies,
            self._velocities,
        )  # fmt: skip
        n_rows, index = self._find_contacts(arrays, status)
        solution = self._solve(n_rows, awake, machine, attempt)

        sane = motion.move(
            awake, self._bodies, self.inverse_inertia_local, dt, arrays.quaternions, arrays.positions,
            new.quaternions, new.positions, new.velocities, self._velocities,
        )  # fmt: skip
        motion.clear_bodies(awake, self._bodies)
        if not sane or not np.isfinite(solution.velocity).all():
            # The rows of bodies that are not awake have to stay zero.
            self._single_bodies.matrix[:] = 0.0
            self._velocities[:] = 0.0
            return None
        n_points, n_sleeping, n_kept = contact_cache.write_cache(
            self.n_rocks, arrays.cache, arrays.n_sleeping, index, n_rows, self.detection.rows,
            self.detection.bodies.rotations, self._velocities, dt, 2.0 * self.config.search_distance, new.cache,
        )  # fmt: skip
        new.cache, new.n_sleeping = new.cache.select(slice(n_points)), n_sleeping
        self._velocities[self.n_rocks + 1 :] = machine.arrays.jacobian @ solution.velocity
        n_deep = self.detection.find_deep_overlaps(
            n_rows, self.detection.rows, self._velocities, DEEPENED_SHARE * self.config.max_penetration
        )
        self._velocities[awake] = 0.0
        n_asleep, n_lost = self._fall_asleep(new, sensors)
        n_loaded = find_depths(n_rows, self.detection.rows, self._depths)
        depths = self._depths[:n_loaded]
        max_penetration = float(depths.max(initial=0.0))
        report = StepReport(
            F_Bs_W=sum_machine_impulses(
                n_rows, self.detection.rows, self.n_rocks, self.n_machine_bodies, self._impacts,
                solution.has_impacts,
            )
            / dt,
            machine_velocity=solution.velocity,
            awake=awake,
            n_kept=n_kept,
            freed=self._active[: np.searchsorted(self._active[: index.n_active], n_kept)].copy(),
            n_contacts=n_rows,
            n_loaded=n_loaded,
            n_iterations=solution.n_iterations,
            residual=solution.residual,
            max_penetration=max_penetration,
            p99_penetration=float(_calc_percentile(depths, 0.99)),
            n_woken=n_woken,
            n_asleep=n_asleep,
            n_lost=n_lost,
            n_deep=n_deep,
            redone=False,
            flagged=max_penetration > self.config.max_penetration,
            overflow=n_points - len(new.cache.pairs),
            n_distances=int(self.detection.statistics[1]),
            has_impacts=solution.has_impacts,
        )  # fmt: skip
        return new, report

    def _wake(self, arrays: RockArrays, new: RockArrays, sensors: np.ndarray) -> int:
        """Wake rocks of the new state; return their number."""
        if self.config.reduction != "rest":
            return sleeping.wake_all(arrays.positions, False, new.sleep)
        rest, dt = self.config.rest, self.time_step
        self._mark_by_movers(new.sleep, arrays.velocities, arrays.cache, arrays.n_sleeping)
        thresholds = sleeping.WakeThresholds(
            rest.wake_load * self._strength * dt, rest.wake_share, rest.wake_near_movers, rest.wake_steps
        )
        n_woken = sleeping.wake(
            arrays.positions, self.radius, self.mass, arrays.cache, arrays.n_sleeping, sensors, self._by_movers,
            thresholds, new.sleep,
        )  # fmt: skip
        if new.steps % max(round(rest.recheck_period / dt), 1) == 0:
            n_woken += sleeping.wake_all(arrays.positions, True, new.sleep)
        return n_woken

    def _mark_by_movers(
        self, sleep: np.ndarray, velocities: Array, cache: ContactCache, n_sleeping: int
    ) -> None:
        sleeping.mark_by_movers(
            sleep, velocities, cache, n_sleeping, self.config.rest.mover_speed, self._movers, self._by_movers
        )

    def _fall_asleep(self, new: RockArrays, sensors: np.ndarray) -> tuple[int, int]:
        """Take lost rocks out of the new state, let others fall asleep; return the numbers of those asleep and lost."""
        rest, may_sleep = self.config.rest, self.config.reduction == "rest"
        if may_sleep:
            self._mark_by_movers(new.sleep, new.velocities, new.cache, new.n_sleeping)
        n_lost = sleeping.take_out_lost(
            self._lower_site, self._upper_site, new.positions, new.sleep, new.velocities
        )
        if not may_sleep:
            return 0, n_lost
        n_asleep = sleeping.fall_asleep(
            new.positions, self.radius, sensors, self._by_movers, self.time_step,
            sleeping.SleepLimits(rest.displacement, rest.time, rest.speed), new.sleep, new.velocities,
        )  # fmt: skip
        return n_asleep, n_lost

    def _update_poses(
        self,
        arrays: RockArrays,
        new: RockArrays,
        machine: MachineStep,
        status: IntArray,
        sensors: np.ndarray,
        search_all: bool,
    ) -> None:
        """Choose how contacts are searched, and set poses and boxes of what has moved."""
        config, dt = self.config, self.time_step
        search_all = search_all or config.search_period == 1
        choose_search_modes(
            arrays.positions, arrays.velocities, self.radius, sensors, dt, config.slow_speed,
            -1.0 if search_all else config.search_distance, search_all or arrays.steps % config.search_period == 0,
            new.sleep, self.detection.modes,
        )  # fmt: skip
        stale = self.detection.find_stale(status, arrays.quaternions, arrays.positions)
        # What is not finite differs from itself, so it is among these.
        for name in MOTION:
            if not motion.are_finite(getattr(arrays, name), stale):
                raise SimulationFailure(f"rocks: {name} that are not finite")
        self.detection.update_poses(
            stale, status, arrays.quaternions, arrays.positions, arrays.velocities, machine.X_WBs,
            self._velocities[self.n_rocks + 1 :], config.contact_margin,
        )  # fmt: skip

    def _find_contacts(self, arrays: RockArrays, status: IntArray) -> tuple[int, CacheIndex]:
        """Set the contact rows; return their number, and what of the cache was looked up."""
        n_pairs = self.detection.find_pairs(status)
        places, n_active, n_gaps = contact_cache.index_cache(
            arrays.cache, self.n_rocks, status, self._active, self._table
        )
        index = CacheIndex(self._active, self._table[:places], n_active, n_gaps)
        n_rows = self.detection.find_contacts(n_pairs, arrays.cache, index, self._velocities, self.config)
        if n_rows > len(self._depths):
            self._allocate_rows()
        return n_rows, index

    def _solve(self, n_rows: int, awake: IntArray, machine: MachineStep, attempt: _Attempt) -> _Solution:
        """Change the bodies' velocities by gravity and contacts."""
        config, dt, rows = self.config, self.time_step, self.detection.rows
        iterations = attempt.iterations
        if find_deepest(n_rows, rows) > DEEP_SHARE * config.max_penetration:
            iterations *= RETRY_FACTOR
        if not attempt.warm:
            rows.values["impulse"][:n_rows] = 0.0
        velocity = machine.velocity.copy()
        machine.arrays.row_values["impulse"] = 0.0
        law = ContactLaw(
            self.hertz, config.linear_overlap > 0.0, dt, 1.0 / (1.0 + 4.0 * config.damping_time),
            config.max_recovery_speed, config.impact_threshold,
        )  # fmt: skip
        n_impacts = prepare_rows(
            n_rows, self._bodies, self.contact_compliance, machine.arrays, velocity, law, rows
        )
        if n_impacts > 0:
            solve_impacts(
                n_rows, law, config.impact_iterations, machine.arrays, rows, self._bodies, velocity,
                self._impacts, self._marks,
            )  # fmt: skip
        if config.spin_damping > 0.0:
            damp_spin(n_rows, rows, config.spin_damping * dt, self._bodies)
        motion.add_gravity(awake, self.gravity * dt, self._bodies)
        velocity += machine.free_change
        residual = solve_contacts(
            n_rows, awake, IterationSettings(iterations, config.machine_sweeps, attempt.acceleration),
            float(self.mass[awake].sum()) * self._strength * dt, rows, self._bodies, machine.arrays, velocity,
            self._batches, self._single_bodies, self._marks,
        )  # fmt: skip
        return _Solution(velocity, iterations, residual, n_impacts > 0)


def _mark_redone(result: tuple[RockArrays, StepReport]) -> tuple[RockArrays, StepReport]:
    arrays, report = result
    return arrays, replace(report, redone=True, flagged=True)


def _calc_percentile(values: Array, share: float) -> float:
    """Return the value that `share` of the values are below (0 if there are none)."""
    if len(values) == 0:
        return 0.0
    place = min(int(share * len(values)), len(values) - 1)
    return float(np.partition(values, place)[place])
