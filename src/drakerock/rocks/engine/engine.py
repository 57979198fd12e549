"""The engine: one step of all rocks, from state arrays to state arrays.

A step wakes rocks (`resting`), finds the contacts of those that are awake (`collision.detection`), solves them
together with the machine (`solve`), moves the rocks (`motion`), keeps the contacts for the next step
(`contact_cache`) and lets rocks fall asleep. `NonsmoothEngine` holds what does not change during a simulation
(shapes, masses, the site, settings) and scratch memory that never changes a result. All state is in a `RockArrays`,
which callers own (`rock_set`). What a step costs depends on the rocks that are awake, and hardly on all others:
what of a state is known goes with it (`StateIndex`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeGuard

import numpy as np
from numpy.typing import NDArray

from drakerock.errors import SimulationFailure
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.engine import contact_cache, motion
from drakerock.rocks.engine.collision.detection import ContactDetection, SiteBox
from drakerock.rocks.engine.collision.narrow_phase import CollisionGeometry
from drakerock.rocks.engine.collision.persistence import choose_search_modes
from drakerock.rocks.engine.collision.poses import CollisionBodies
from drakerock.rocks.engine.collision.shapes import make_convex_shapes
from drakerock.rocks.engine.compiling import announce_compilation
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.contact_cache import CacheIndex
from drakerock.rocks.engine.contact_law import ContactLaw
from drakerock.rocks.engine.records import (
    BODY,
    FOLLOWED,
    SEARCHED,
    SENSOR,
    as_records,
)
from drakerock.rocks.engine.resting import Resting
from drakerock.rocks.engine.rock_set import RockSet, make_index_after
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
    StateIndex,
    StepReport,
    Token,
    make_machineless_step,
)
from drakerock.rocks.engine.surroundings import Surroundings
from drakerock.rocks.materials import calc_spring_stiffness
from drakerock.rocks.shapes import RockShape

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
# A step that failed is solved again with this many times the iterations and without acceleration, from a cold start
# if need be; one that begins with an overlap beyond this share of the bound has as many at once. A light rock that
# the machine presses into a jammed pile passes on little of the machine's momentum per iteration, and is squeezed
# meanwhile.
RETRY_FACTOR = 4
DEEP_SHARE = 0.375
# One that would make an overlap beyond this share is solved again, with contacts where its own motion would lead.
DEEPENED_SHARE = 0.75

NOBODY: IntArray = np.zeros(0, np.int64)


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


class NonsmoothEngine(RockSet):
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
        self.time_step, n = time_step, len(size)
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
        super().__init__(
            config, shape, size, fixed, self.first_plane + n_planes, surroundings.lower, surroundings.upper
        )
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

        self._make_scratch(n_bodies)

    def _make_scratch(self, n_bodies: int) -> None:
        n = self.n_rocks
        self.detection = ContactDetection(
            self._collision_bodies,
            CollisionGeometry(
                n, self.first_plane, self.first_piece, self.planes, self.convex, self.restitution
            ),
            self.piece_body,
            self.radius,
            self.inverse_inertia_local,
            SiteBox(self.lower_site, self.upper_site),
            self.time_step,
        )
        self._bodies = np.zeros(n + 1, BODY)
        self._single_bodies = make_single_bodies(n + 1)
        # Zero between steps, for the rocks.
        self._velocities = np.zeros((n + 1 + self.n_machine_bodies, 6))
        self._marks = np.zeros(n + 1 + self.n_machine_bodies, np.int64)
        self._active = np.zeros(self.capacity, np.int64)
        self._table = np.zeros(contact_cache.calc_places(2 * self.capacity), np.int64)
        self._stirs, self._all = np.zeros(n, np.bool_), np.arange(n)
        self._resting = Resting(
            self.radius, self.mass, self.lower_site, self.upper_site, self._strength, self.time_step,
            self.detection.blocks,
        )  # fmt: skip
        # Rocks whose search mode was chosen, and the state that the detection has seen last.
        self._chosen = self._all[:0]
        self._posed: Token | None = None
        self._allocate_rows()

    def _allocate_rows(self) -> None:
        capacity = len(self.detection.rows.values)
        self._impacts = np.zeros((capacity, 3))
        self._depths = np.zeros(capacity)
        self._batches = make_batch_arrays(capacity)

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
            room: where the result is written, see `make_room`; new if None. What the step does not change is left as
                it is in it, see `refresh_room`: to copy it would take longer than all else where little is awake.

        Returns:
            state at t_n + dt, with its index if it is in a room, and the report.

        Raises:
            SimulationFailure: poses, or velocities of awake rocks, are not finite; or the result is not finite or has
                not converged, also when solved again with `RETRY_FACTOR` times the iterations and without
                acceleration.
        """
        iterations, acceleration = self.config.iterations, self.config.momentum
        self.detection.forget_speeds()
        if arrays.index is None:
            arrays = replace(arrays, index=self.make_index(arrays))
        if room is None:
            room = self.make_room()
            self.copy_to(arrays, room)
            new, report = self.step(arrays, machine, room)
            return replace(new, index=None), report
        result = self._try_step(arrays, machine, room, _Attempt(iterations, acceleration, True, False))
        if self._has_converged(result):
            if result[1].n_deep == 0:
                return result
            more = _Attempt(RETRY_FACTOR * iterations, acceleration, True, True)
            self.copy_to(arrays, room)  # other rocks may be awake now
            result = self._try_step(arrays, machine, room, more)
            if self._has_converged(result):
                return _mark_redone(result)
        plain = _Attempt(RETRY_FACTOR * iterations, 0.0, result is not None, True)
        self.copy_to(arrays, room)
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
        self,
        arrays: RockArrays,
        machine: MachineStep,
        room: RockArrays,
        attempt: _Attempt,
        struck: IntArray = NOBODY,
    ) -> tuple[RockArrays, StepReport] | None:
        """Return state and report of a step, which the rocks `struck` begin awake; None if they are not finite."""
        dt, index = self.time_step, arrays.index
        assert index is not None
        new = replace(room, steps=arrays.steps + 1)
        sensors = as_records(machine.sensors, SENSOR)
        stale = self._find_stale(arrays, index)
        woken, touched = self._resting.wake(arrays, index, self.config, sensors, struck, new)
        awake = np.sort(np.concatenate([index.awake, woken])) if len(woken) else index.awake
        stirred = np.concatenate([awake, touched])

        self._velocities[self.n_rocks + 1 :] = machine.arrays.jacobian @ machine.velocity
        self._choose_modes(arrays, awake, index.lost, sensors, attempt.search_all, new.sleep)
        self._update_poses(arrays, awake, stale, machine)
        self._posed = index.token
        motion.set_bodies(
            awake, arrays.velocities, self.inverse_mass, self.detection.inverse_inertia, self._bodies,
            self._velocities,
        )  # fmt: skip
        # Of a state that a step has made, the points before this one are of rocks that sleep on.
        first = 0 if len(woken) or index.before is None else arrays.n_sleeping
        n_rows, cache_index = self._find_contacts(arrays, awake, first, index.n_gaps)
        hit = self._resting.find_struck(n_rows, self.detection.rows, self._bodies, arrays, self.config)
        if len(hit):
            # Once more from the beginning, with these awake.
            motion.clear_bodies(awake, self._bodies)
            self._velocities[awake] = 0.0
            return self._try_step(arrays, machine, room, attempt, np.concatenate([struck, hit]))
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
        n_points, n_sleeping, n_kept, n_gaps = contact_cache.write_cache(
            self.n_rocks, arrays.cache, arrays.n_sleeping, cache_index, n_rows, self.detection.rows,
            self.detection.bodies.rotations, self._velocities, dt, 2.0 * self.config.search_distance, new.cache,
        )  # fmt: skip
        new.cache, new.n_sleeping = new.cache.select(slice(n_points)), n_sleeping
        self._velocities[self.n_rocks + 1 :] = machine.arrays.jacobian @ solution.velocity
        n_deep = self.detection.find_deep_overlaps(
            n_rows, self.detection.rows, self._velocities, DEEPENED_SHARE * self.config.max_penetration
        )
        self._velocities[awake] = 0.0
        n_lost, n_asleep = self._resting.fall_asleep(awake, self.config, sensors, new)
        new.index = make_index_after(new, awake, stirred, n_gaps, index.token)
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
            stirred=stirred,
            n_kept=n_kept,
            freed=self._active[: np.searchsorted(self._active[: cache_index.n_active], n_kept)].copy(),
            n_contacts=n_rows,
            n_loaded=n_loaded,
            n_iterations=solution.n_iterations,
            residual=solution.residual,
            max_penetration=max_penetration,
            p99_penetration=float(_calc_percentile(depths, 0.99)),
            n_woken=len(woken),
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

    def _find_stale(self, arrays: RockArrays, index: StateIndex) -> IntArray:
        """Return the rocks that are not where the detection saw them last."""
        candidates = self._all
        if self._posed is index.token:
            candidates = candidates[:0]
        elif self._posed is index.before and index.before is not None:
            candidates = index.moved
        self._posed = None
        return self.detection.find_stale(candidates, arrays.quaternions, arrays.positions)

    def _choose_modes(
        self,
        arrays: RockArrays,
        awake: IntArray,
        lost: IntArray,
        sensors: np.ndarray,
        search_all: bool,
        sleep: np.ndarray,
    ) -> None:
        """Choose how contacts are searched."""
        config, modes = self.config, self.detection.modes
        search_all = search_all or config.search_period == 1
        modes[self._chosen] = FOLLOWED
        self._chosen = np.concatenate([awake, lost])
        # What was in contact with a lost rock is searched, and found no more.
        modes[lost] = SEARCHED
        choose_search_modes(
            awake, arrays.positions, arrays.velocities, self.radius, sensors, self.time_step, config.slow_speed,
            -1.0 if search_all else config.search_distance,
            search_all or arrays.steps % config.search_period == 0, sleep, modes,
        )  # fmt: skip

    def _update_poses(
        self, arrays: RockArrays, awake: IntArray, stale: IntArray, machine: MachineStep
    ) -> None:
        """Set poses and boxes of what is awake or has moved."""
        self._stirs[awake] = True
        chosen = np.concatenate([awake, stale[~self._stirs[stale]]])
        self._stirs[awake] = False
        # What is not finite differs from itself, so it is among these.
        for name in MOTION:
            if not motion.are_finite(getattr(arrays, name), chosen):
                raise SimulationFailure(f"rocks: {name} that are not finite")
        self.detection.update_poses(
            chosen, awake, arrays.quaternions, arrays.positions, arrays.velocities, machine.X_WBs,
            self._velocities[self.n_rocks + 1 :], self.config.contact_margin,
        )  # fmt: skip

    def _find_contacts(
        self, arrays: RockArrays, awake: IntArray, first: int, n_gaps: int
    ) -> tuple[int, CacheIndex]:
        """Set the contact rows; return their number, and what of the cache was looked up, from the row `first` on."""
        n_pairs = self.detection.find_pairs(awake, arrays.sleep)
        self._stirs[self._chosen] = True
        places, n_active = contact_cache.index_cache(
            arrays.cache, first, self.n_rocks, self._stirs, self._active, self._table
        )
        self._stirs[self._chosen] = False
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
