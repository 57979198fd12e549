"""What goes into a step and comes out of it: the rocks' state, the machine over the step, the report."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine.contact_cache import ContactCache
from drakerock.rocks.engine.records import MACHINE_ROW
from drakerock.rocks.engine.solve.machine_rows import MachineArrays

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Of `RockArrays`, what changes of awake rocks only.
MOTION = ("positions", "quaternions", "velocities")


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
            np.zeros(0, MACHINE_ROW),
        ),
        np.zeros((0, 18)),
    )


class Token:
    """Tells one state from all others; a copy is another one."""


@dataclass(frozen=True, eq=False)
class StateIndex:
    """What of a state is else found by a look at all rocks and contacts. It never changes a result.

    Attributes:
        awake: (m,) rocks that are awake, in ascending order.
        unsettled: sleeping rocks that have just fallen asleep, or whose load has changed.
        moved: rocks that are not where they were before the step to this state.
        lost: rocks that left the site in it.
        n_gaps: of the contact cache.
        before: of the state before the step, None if there is none.
        token: of this state.
    """

    awake: IntArray
    unsettled: IntArray
    moved: IntArray
    lost: IntArray
    n_gaps: int
    before: Token | None = None
    token: Token = field(default_factory=Token)


@dataclass(eq=False)
class RockArrays:
    """All state of n rocks. The arrays of a step's result are new, or in the room that the step was given.

    Attributes:
        quaternions: (n, 4) w x y z.
        positions: (n, 3) [m].
        velocities: (n, 6) angular, translational in W.
        sleep: (n,) records `SLEEP`: status and bookkeeping of sleeping rocks.
        cache: of m contact points, loaded or speculative; m changes from step to step.
        n_sleeping: so many of them, the first, are of rocks that slept in the last step; gaps among them.
        steps: how many have been taken.
        index: None: not known, and found anew. Who changes arrays that have one, other than by
            `NonsmoothEngine.refresh_room`, takes it away.
    """

    quaternions: Array
    positions: Array
    velocities: Array
    sleep: np.ndarray
    cache: ContactCache
    n_sleeping: int = 0
    steps: int = 0
    index: StateIndex | None = None

    @property
    def status(self) -> Array:
        """(n,) status of each rock, see `records`."""
        return np.asarray(self.sleep["status"])


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


@dataclass(frozen=True, eq=False)
class StepReport:
    """What a step did.

    Attributes:
        F_Bs_W: (b, 6) spatial impulse over time step of the rocks on each machine body at its origin, in W:
            torque [N m], force [N].
        machine_velocity: (v,) the machine's generalised velocities as the contact solve left them.
        awake: (m,) the rocks awake in the step, the only ones that moved.
        stirred: those whose record of sleep the step has written, which are these and some sleeping ones.
        n_kept: so many points of the cache, the first, are where they were, but for those that left gaps.
        freed: (g,) these.
        n_contacts: contact points; n_loaded of them carry load.
        n_iterations: of the contact solve.
        residual: the last one's change of the normal impulses over their sum or the weight, see `solve_contacts`.
        max_penetration, p99_penetration: of loaded points [m].
        n_woken, n_asleep, n_lost: rocks that changed state (lost: left the site) in this step.
        n_deep: loaded pairs that the step drives deep into each other, see `collision.speculative`.
        redone: the step was solved again, with more iterations.
        flagged: it had to be redone, or penetration is beyond the bound of the settings.
        overflow: loaded points that the cache could not take.
        n_distances: pairs whose distance was computed, the others moved together or were known to be apart.
        has_impacts: some contacts were impacts, whose impulses come on top of those of the resting stage.
    """

    F_Bs_W: Array
    machine_velocity: Array
    awake: IntArray
    stirred: IntArray
    n_kept: int
    freed: IntArray
    n_contacts: int
    n_loaded: int
    n_iterations: int
    residual: float
    max_penetration: float
    p99_penetration: float
    n_woken: int
    n_asleep: int
    n_lost: int
    n_deep: int
    redone: bool
    flagged: bool
    overflow: int
    n_distances: int
    has_impacts: bool

    @property
    def n_awake(self) -> int:
        """Number of rocks awake in the step."""
        return len(self.awake)
