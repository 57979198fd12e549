"""States of the rocks of an engine: from a pile and back, room for them, what is known of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine import contact_cache, sleeping
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.contact_cache import ContactCache
from drakerock.rocks.engine.records import AWAKE, FIXED, LOST, SLEEP, SLEEPING, copy_records
from drakerock.rocks.engine.state import MOTION, RockArrays, StateIndex, StepReport, Token
from drakerock.rocks.state import ContactMemory, PileState

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Quaternions are taken for unit ones within this, and keep their bits.
UNIT_TOLERANCE = 1e-14


class RockSet:
    """Makes states of a given set of rocks, and piles of them.

    Args:
        config: settings.
        shape, size, fixed: (n,) of the rocks, as in a `PileState`.
        first_piece: bodies from this number on are pieces of a machine.
        lower, upper: (3,) corners of the box outside of which a rock is lost [m].
    """

    def __init__(
        self,
        config: NonsmoothConfig,
        shape: IntArray,
        size: Array,
        fixed: NDArray[np.bool_],
        first_piece: int,
        lower: Array,
        upper: Array,
    ) -> None:
        self.config = config
        self.n_rocks = len(size)
        self.shape_index = np.asarray(shape, np.int64)
        self.size = np.asarray(size, float)
        self.fixed = np.asarray(fixed, bool)
        self.first_piece = first_piece
        self.lower_site, self.upper_site = lower, upper
        self.capacity = config.memory_per_rock * self.n_rocks + 1024

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
        outside = (positions < self.lower_site) | (positions > self.upper_site)
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
            index=None,
        )
        new.positions[rocks] = p_WRs
        new.velocities[rocks] = V_WRs
        sleeping.wake_rocks(np.asarray(rocks, np.int64), new.positions, new.sleep)
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

    def refresh_room(self, new: RockArrays, report: StepReport, target: RockArrays) -> None:
        """Make a copy of the state before a step room for the step after it: write what that one leaves as it is.

        Rocks that are awake, and their contacts, the next step writes itself.

        Args:
            new, report: what `step` gave.
            target: its arrays are changed, `n_sleeping`, `steps` and `index` are not; the cache has its full capacity.
        """
        stopped = report.awake[new.sleep["status"][report.awake] != AWAKE]
        for name in MOTION:
            getattr(target, name)[stopped] = getattr(new, name)[stopped]
        copy_records(new.sleep, target.sleep, report.stirred)
        target.cache.pairs[report.freed] = -1
        changed = slice(report.n_kept, new.n_sleeping)
        for before, after in zip(target.cache, new.cache, strict=True):
            before[changed] = after[changed]

    def make_index(self, arrays: RockArrays) -> StateIndex:
        """Return the index of a state that is not known."""
        status = arrays.sleep["status"]
        return StateIndex(
            np.flatnonzero(status == AWAKE),
            np.flatnonzero((status == SLEEPING) & (arrays.sleep["changed_steps"] != 0.0)),
            np.arange(self.n_rocks),
            np.flatnonzero(status == LOST),
            contact_cache.count_gaps(arrays.cache),
        )

    def copy_to(self, arrays: RockArrays, room: RockArrays) -> None:
        """Copy a state to arrays whose cache has the full capacity, all but `n_sleeping`, `steps` and `index`."""
        for name in MOTION:
            getattr(room, name)[:] = getattr(arrays, name)
        copy_records(arrays.sleep, room.sleep)
        for old, copied in zip(arrays.cache, room.cache, strict=True):
            copied[: len(old)] = old


def make_index_after(
    new: RockArrays, awake: IntArray, stirred: IntArray, n_gaps: int, before: Token
) -> StateIndex:
    """Return the index of the state that a step has made: of the rocks `awake` in it, the first of those `stirred`."""
    status, changed = new.sleep["status"][stirred], new.sleep["changed_steps"][stirred] != 0.0
    return StateIndex(
        stirred[status == AWAKE],
        stirred[(status == SLEEPING) & changed],
        awake,
        stirred[status == LOST],
        n_gaps,
        before,
    )
