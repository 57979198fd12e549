"""The pile of this moment, as a choice is given it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from drakerock.autonomy.entry import PileGrid
from drakerock.autonomy.hazards import Hazard
from drakerock.exploration.problem import Array
from drakerock.loading.field import HeightField, calc_pile_profile
from drakerock.loading.planning import choose_entry_slice

_N_GAMMA = 51


@dataclass(frozen=True, eq=False)
class Situation:
    """What was sensed, and what is made of it at once.

    Attributes:
        field: the height field.
        grid: its grid, and where the machine fits.
        novelty: how unlike the training set; above 1 is unlike.
        hazards: what speaks against entering, and where.
    """

    field: HeightField
    grid: PileGrid
    novelty: float
    hazards: tuple[Hazard, ...]

    @cached_property
    def gammas(self) -> Array:
        """Values of gamma to look at, (51,)."""
        return np.linspace(0.0, 1.0, _N_GAMMA)

    @cached_property
    def entries(self) -> Array | None:
        """The entry's y of each of `gammas` (51,) [m]; None where the pile cannot be entered."""
        profile = calc_pile_profile(self.field, self.grid.front_height)
        slices = [choose_entry_slice(profile, gamma, self.grid.half_room) for gamma in self.gammas]
        return None if slices[0] is None else self.field.y[np.array(slices)]

    def find_entry(self, gamma: float) -> float:
        """Return where gamma enters, y [m]; the pile can be entered."""
        profile = calc_pile_profile(self.field, self.grid.front_height)
        slice_ = choose_entry_slice(profile, gamma, self.grid.half_room)
        assert slice_ is not None
        return float(self.field.y[slice_])

    def is_barred(self, gamma: Array) -> NDArray[np.bool_]:
        """Return whether a hazard speaks against each gamma (m,), by the nearest of `gammas`."""
        if self.entries is None or not self.hazards:
            return np.zeros(len(gamma), bool)
        barred = np.isin(np.round(self.entries, 6), np.round([hazard.y for hazard in self.hazards], 6))
        return barred[np.clip(np.round(gamma * (_N_GAMMA - 1)).astype(int), 0, _N_GAMMA - 1)]
