"""Rest in a step: the sleeping rocks that it wakes, and the awake ones that fall asleep; `sleeping` has the laws."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.engine import sleeping
from drakerock.rocks.engine.blows import find_struck
from drakerock.rocks.engine.collision.blocks import Blocks
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.contact_cache import ContactCache
from drakerock.rocks.engine.records import SLEEPING, copy_records
from drakerock.rocks.engine.solve.rows import ContactRows
from drakerock.rocks.engine.state import RockArrays, StateIndex

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


class Resting:
    """Wakes rocks and lets them fall asleep, with the scratch memory for it, which never changes a result.

    Args:
        radius, mass: (n,) bounding spheres [m], [kg].
        lower, upper: (3,) corners of the box outside of which a rock is lost [m].
        strength: gravity by which impulses are measured [m/s^2].
        time_step: [s].
        blocks: of the rocks, kept by the collision detection.
    """

    def __init__(
        self,
        radius: Array,
        mass: Array,
        lower: Array,
        upper: Array,
        strength: float,
        time_step: float,
        blocks: Blocks,
    ) -> None:
        n = len(radius)
        self._radius, self._mass, self._reach = radius, mass, float(radius.max(initial=0.0))
        self._lower, self._upper = lower, upper
        self._strength, self._time_step, self._blocks = strength, time_step, blocks
        self._movers, self._by_movers = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
        self._touched, self._woken = np.zeros(n, np.int64), np.zeros(2 * n, np.int64)
        # All zero between steps.
        self._places = np.zeros(n, np.int64)

    def wake(
        self,
        arrays: RockArrays,
        index: StateIndex,
        config: NonsmoothConfig,
        sensors: np.ndarray,
        struck: IntArray,
        new: RockArrays,
    ) -> tuple[IntArray, IntArray]:
        """Write the records of sleep that the step may change to the new state, and wake rocks in it.

        Args:
            arrays, index: the state before the step.
            config: settings.
            sensors: records `SENSOR`.
            struck: sleeping rocks to be woken, see `find_struck`.
            new: written to.

        Returns:
            the rocks woken, and those that touch rocks that were solved and sleep on.
        """
        if config.reduction != "rest":
            woken = np.flatnonzero(arrays.sleep["status"] == SLEEPING)
            copy_records(arrays.sleep, new.sleep, index.awake)
            copy_records(arrays.sleep, new.sleep, woken)
            sleeping.wake_rocks(woken, arrays.positions, new.sleep)
            return woken, woken[:0]
        rest, dt, cache = config.rest, self._time_step, arrays.cache
        n_touched, n_all = sleeping.find_touched(
            cache, arrays.n_sleeping, index.unsettled, arrays.sleep, self._places, self._touched
        )
        touched = self._touched[:n_all]
        copy_records(arrays.sleep, new.sleep, index.awake)
        copy_records(arrays.sleep, new.sleep, touched)
        n_woken = 0
        if n_all > 0:
            chosen = np.concatenate([index.awake, touched])
            self._mark_by_movers(
                chosen, arrays.sleep, arrays.velocities, cache, arrays.n_sleeping, rest.mover_speed
            )
            n_woken = sleeping.find_woken(
                n_touched, touched, self._mass, cache, self._by_movers, self._make_thresholds(config),
                self._places, new.sleep, self._woken,
            )  # fmt: skip
        n_sensed = sleeping.find_sensed(
            arrays.positions, self._radius, self._reach, sensors, self._blocks, arrays.sleep,
            self._woken[n_woken:],
        )  # fmt: skip
        woken = self._woken[: n_woken + n_sensed]
        if new.steps % max(round(rest.recheck_period / dt), 1) == 0:
            asleep = arrays.sleep["status"] == SLEEPING
            woken = np.concatenate([woken, np.flatnonzero(asleep & (arrays.sleep["moved"] == 1.0))])
        woken = np.unique(np.concatenate([woken, struck]))
        copy_records(arrays.sleep, new.sleep, woken)
        sleeping.wake_rocks(woken, arrays.positions, new.sleep)
        return woken, touched[new.sleep["status"][touched] == SLEEPING]

    def find_struck(
        self,
        n_rows: int,
        rows: ContactRows,
        bodies: np.ndarray,
        arrays: RockArrays,
        config: NonsmoothConfig,
    ) -> IntArray:
        """Return the sleeping rocks that a step is about to strike, see `blows`."""
        if config.reduction != "rest" or n_rows == 0:
            return self._touched[:0]
        n_struck = find_struck(
            n_rows, rows, bodies, self._mass, arrays.cache, arrays.sleep, self._make_thresholds(config),
            config.impact_threshold, self._time_step, self._places, self._touched,
        )  # fmt: skip
        return self._touched[:n_struck].copy()

    def _make_thresholds(self, config: NonsmoothConfig) -> sleeping.WakeThresholds:
        rest = config.rest
        load = rest.wake_load * self._strength * self._time_step
        return sleeping.WakeThresholds(load, rest.wake_share, rest.wake_near_movers, rest.wake_steps)

    def fall_asleep(
        self, awake: IntArray, config: NonsmoothConfig, sensors: np.ndarray, new: RockArrays
    ) -> tuple[int, int]:
        """Take lost rocks out of the new state, let others fall asleep; return the numbers of those lost and asleep."""
        rest, may_sleep = config.rest, config.reduction == "rest"
        if may_sleep:
            self._mark_by_movers(
                awake, new.sleep, new.velocities, new.cache, new.n_sleeping, rest.mover_speed
            )
        n_lost = sleeping.take_out_lost(
            awake, self._lower, self._upper, new.positions, new.sleep, new.velocities
        )
        if not may_sleep:
            return n_lost, 0
        n_asleep = sleeping.fall_asleep(
            awake, new.positions, self._radius, sensors, self._by_movers, self._time_step,
            sleeping.SleepLimits(rest.displacement, rest.time, rest.speed), new.sleep, new.velocities,
        )  # fmt: skip
        return n_lost, n_asleep

    def _mark_by_movers(
        self,
        chosen: IntArray,
        sleep: np.ndarray,
        velocities: Array,
        cache: ContactCache,
        n_sleeping: int,
        speed: float,
    ) -> None:
        sleeping.mark_by_movers(
            chosen, sleep, velocities, cache, n_sleeping, speed, self._movers,
            self._by_movers,
        )  # fmt: skip
