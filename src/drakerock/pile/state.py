"""PileState: the pose, velocity, shape and size of every rock, and its file format."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drakerock.npz import load_arrays, save_arrays

Array = NDArray[np.float64]
FORMAT = "drakerock-pile"
VERSION = 1


@dataclass(frozen=True, eq=False)
class PileState:
    """All rocks of a site at one instant (n rocks; arrays are not to be written to).

    Attributes:
        p_WRs: (n, 3) positions of the centres of mass in W [m].
        q_WRs: (n, 4) unit quaternions (w, x, y, z), the rotations R_WR.
        V_WRs: (n, 6) spatial velocities in W, angular [rad/s] then translational [m/s] (Drake's order).
        shape: (n,) index into the scenario's rock shapes.
        size: (n,) sieve widths [m].
        fixed: (n,) True for the rocks of the static rear boundary.
        provenance: where the pile comes from (scenario hash, seed, versions, what was done to it).
    """

    p_WRs: Array
    q_WRs: Array
    V_WRs: Array
    shape: NDArray[np.int64]
    size: Array
    fixed: NDArray[np.bool_]
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.p_WRs)
        expected = {
            "p_WRs": (n, 3),
            "q_WRs": (n, 4),
            "V_WRs": (n, 6),
            "shape": (n,),
            "size": (n,),
            "fixed": (n,),
        }
        for name, form in expected.items():
            array = getattr(self, name)
            if array.shape != form:
                raise ValueError(f"{name}: shape {array.shape} instead of {form}")
            if array.dtype.kind == "f" and not np.isfinite(array).all():
                raise ValueError(f"{name}: not finite")

    def __len__(self) -> int:
        """Return the number of rocks, static ones included."""
        return len(self.size)

    def select(self, rocks: NDArray[Any]) -> PileState:
        """Return the pile of the rocks chosen by an index or mask array (n,)."""
        arrays: dict[str, Any] = {name: getattr(self, name)[rocks] for name in _ARRAYS}
        return replace(self, **arrays)

    def join(self, other: PileState) -> PileState:
        """Return the pile of the rocks of both, this one's first; the provenance is this one's."""
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _ARRAYS
        }
        return replace(self, **arrays)

    def calc_masses(self, shape_volumes: Array, density: float) -> Array:
        """Return the masses (n,) [kg], given the shapes' volumes at sieve width 1 (k,) [m^3]."""
        return density * shape_volumes[self.shape] * self.size**3


_ARRAYS = ("p_WRs", "q_WRs", "V_WRs", "shape", "size", "fixed")


def make_empty_pile() -> PileState:
    """Return a pile of no rocks."""
    return PileState(
        np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 6)), np.zeros(0, int), np.zeros(0), np.zeros(0, bool)
    )


def save_pile(pile: PileState, path: str | Path) -> None:
    """Write a pile as a versioned npz with a checksum; InputError if the file cannot be written."""
    arrays = {name: getattr(pile, name) for name in _ARRAYS}
    save_arrays(path, FORMAT, VERSION, {"provenance": pile.provenance}, arrays)


def load_pile(path: str | Path) -> PileState:
    """Read a pile.

    Raises:
        InputError: missing, foreign, damaged, or of a newer version.
    """
    header, arrays = load_arrays(path, FORMAT, VERSION)
    return PileState(**{name: arrays[name] for name in _ARRAYS}, provenance=header["provenance"])
