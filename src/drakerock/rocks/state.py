"""PileState: the pose, velocity, shape and size of every rock, its contacts, and its file format."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drakerock.errors import InputError
from drakerock.npz import load_arrays, save_arrays

Array = NDArray[np.float64]
FORMAT = "drakerock-pile"
VERSION = 2


@dataclass(frozen=True, eq=False)
class ContactMemory:
    """The loaded contact points of a pile at rest: its force network, so that a stored pile starts warm.

    Attributes:
        pairs: (c, 2) indices of the rocks in contact, the lower first; -1, -2, ... as the second stand for the
            site's pieces, then its planes. Points of one pair are in line.
        points: (c, 3) positions in the frame of the pair's first rock [m]; single precision, here as in the file,
            so that a pile goes on the same, bit for bit, whether it was stored in between or not.
        impulses: (c, 3) impulse of a time step on the second, in W [N s]; single precision.
        resting: (n,) True for rocks that the model reduction had at rest.
    """

    pairs: NDArray[np.int64]
    points: NDArray[np.floating[Any]]
    impulses: NDArray[np.floating[Any]]
    resting: NDArray[np.bool_]

    def __post_init__(self) -> None:
        for name in ("points", "impulses"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.float32))

    def select(self, rocks: NDArray[np.int64], p_WRs: Array, q_WRs: Array) -> ContactMemory:
        """Return the contacts among the chosen rocks (indices into n rocks), renumbered.

        Where a pair's rocks change order, its points go to the other's frame. A rock that loses a contact no longer
        rests: what held it may be gone.

        Args:
            rocks: (m,) in their new order.
            p_WRs, q_WRs: (n, 3) and (n, 4) poses of all rocks, see `PileState`.
        """
        number = np.full(len(p_WRs), -1, np.int64)
        number[rocks] = np.arange(len(rocks))
        first, second = self.pairs.T if len(self.pairs) else np.zeros((2, 0), np.int64)
        new_first = number[first]
        new_second = np.where(second < 0, second, number[np.maximum(second, 0)])
        kept = (new_first >= 0) & ((second < 0) | (new_second >= 0))
        resting = self.resting.copy()
        resting[first[~kept]] = False
        resting[second[~kept & (second >= 0)]] = False
        points, impulses = self.points.copy(), self.impulses.copy()
        pairs = np.column_stack([new_first, new_second])
        swapped = np.flatnonzero(kept & (second >= 0) & (new_second < new_first))
        if len(swapped):
            old, new = first[swapped], second[swapped]
            R_WOs, R_WNs = (Rotation.from_quat(q_WRs[side], scalar_first=True) for side in (old, new))
            p_WCs = p_WRs[old] + R_WOs.apply(points[swapped])
            points[swapped] = R_WNs.inv().apply(p_WCs - p_WRs[new])
            impulses[swapped] = -impulses[swapped]
            pairs[swapped] = pairs[swapped, ::-1]
        rows = np.flatnonzero(kept)
        if (np.diff(rocks) < 0).any():
            rows = rows[np.lexsort((pairs[rows, 1], pairs[rows, 0]))]
        return ContactMemory(pairs[rows], points[rows], impulses[rows], resting[rocks])

    def join(self, other: ContactMemory) -> ContactMemory:
        """Return the contacts of both piles, the other's rocks numbered after this one's."""
        shift = len(self.resting)
        pairs = np.where(other.pairs < 0, other.pairs, other.pairs + shift)
        return ContactMemory(
            np.concatenate([self.pairs, pairs]),
            np.concatenate([self.points, other.points]),
            np.concatenate([self.impulses, other.impulses]),
            np.concatenate([self.resting, other.resting]),
        )


def make_empty_contacts(n: int) -> ContactMemory:
    """Return the memory of n rocks without contacts."""
    return ContactMemory(
        np.zeros((0, 2), np.int64),
        np.zeros((0, 3), np.float32),
        np.zeros((0, 3), np.float32),
        np.zeros(n, np.bool_),
    )


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
        contacts: the force network it was stored with, if any.
    """

    p_WRs: Array
    q_WRs: Array
    V_WRs: Array
    shape: NDArray[np.int64]
    size: Array
    fixed: NDArray[np.bool_]
    provenance: dict[str, Any] = field(default_factory=dict)
    contacts: ContactMemory | None = None

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
            _check_numbers(name, array)
        if self.contacts is not None:
            _check_contacts(self.contacts, n)

    def __len__(self) -> int:
        """Return the number of rocks, static ones included."""
        return len(self.size)

    def select(self, rocks: NDArray[Any]) -> PileState:
        """Return the pile of the rocks chosen by a mask (n,) or by indices, in their order."""
        arrays: dict[str, Any] = {name: getattr(self, name)[rocks] for name in _ARRAYS}
        contacts = None
        if self.contacts is not None:
            contacts = self.contacts.select(np.arange(len(self))[rocks], self.p_WRs, self.q_WRs)
        return replace(self, **arrays, contacts=contacts)

    def join(self, other: PileState) -> PileState:
        """Return the pile of the rocks of both, this one's first; the provenance is this one's."""
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _ARRAYS
        }
        contacts = None
        if self.contacts is not None or other.contacts is not None:
            first = self.contacts or make_empty_contacts(len(self))
            contacts = first.join(other.contacts or make_empty_contacts(len(other)))
        return replace(self, **arrays, contacts=contacts)

    def calc_masses(self, shape_volumes: Array, density: float) -> Array:
        """Return the masses (n,) [kg], given the shapes' volumes at sieve width 1 (k,) [m^3]."""
        return density * shape_volumes[self.shape] * self.size**3


_ARRAYS = ("p_WRs", "q_WRs", "V_WRs", "shape", "size", "fixed")
_CONTACT_ARRAYS = ("pairs", "points", "impulses", "resting")


# Kinds of numbers (numpy's letters) that the arrays may hold; floats unless said otherwise.
_KINDS = {"shape": "iu", "pairs": "iu", "fixed": "b", "resting": "b"}


def _check_numbers(name: str, array: NDArray[Any]) -> None:
    kinds = _KINDS.get(name.rpartition(".")[2], "fiu")
    if array.dtype.kind not in kinds:
        raise ValueError(f"{name}: holds {array.dtype}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name}: not finite")


def _check_contacts(contacts: ContactMemory, n: int) -> None:
    c = len(contacts.pairs)
    expected = {"pairs": (c, 2), "points": (c, 3), "impulses": (c, 3), "resting": (n,)}
    for name, form in expected.items():
        array = getattr(contacts, name)
        if array.shape != form:
            raise ValueError(f"contacts.{name}: shape {array.shape} instead of {form}")
        _check_numbers(f"contacts.{name}", array)
    if c and not ((contacts.pairs[:, 0] >= 0).all() and (contacts.pairs < n).all()):
        raise ValueError("contacts.pairs: a rock that is not in the pile")


def make_empty_pile() -> PileState:
    """Return a pile of no rocks."""
    return PileState(
        np.zeros((0, 3)), np.zeros((0, 4)), np.zeros((0, 6)), np.zeros(0, int), np.zeros(0), np.zeros(0, bool)
    )


def save_pile(pile: PileState, path: str | Path) -> None:
    """Write a pile as a versioned npz with a checksum; InputError if the file cannot be written."""
    arrays = {name: getattr(pile, name) for name in _ARRAYS}
    if pile.contacts is not None:
        arrays |= {f"contact_{name}": getattr(pile.contacts, name) for name in _CONTACT_ARRAYS}
    save_arrays(path, FORMAT, VERSION, {"provenance": pile.provenance}, arrays)


def load_pile(path: str | Path) -> PileState:
    """Read a pile.

    Raises:
        InputError: missing, foreign, damaged, or of a newer version.
    """
    header, arrays = load_arrays(path, FORMAT, VERSION)
    try:
        contacts = None
        if "contact_pairs" in arrays:
            contacts = ContactMemory(**{name: arrays[f"contact_{name}"] for name in _CONTACT_ARRAYS})
        pile = PileState(
            **{name: arrays[name] for name in _ARRAYS},
            provenance=dict(header["provenance"]),
            contacts=contacts,
        )
        if (np.abs(np.linalg.norm(pile.q_WRs, axis=1) - 1.0) > 1e-3).any():
            raise ValueError("q_WRs: not unit quaternions")
        if (pile.size <= 0.0).any() or (pile.shape < 0).any():
            raise ValueError("size and shape: sizes must be > 0, shapes >= 0")
    except KeyError as error:
        raise InputError(f"{path}: not a readable pile: {error} is missing") from None
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: not a readable pile: {error}") from None
    return pile
