"""Seeds: one per study or scenario, child seeds derived from it by name."""

from __future__ import annotations

import hashlib

import numpy as np


def make_generator(seed: int, *names: str | int) -> np.random.Generator:
    """Return a generator that depends on `seed` and on the names only, not on the order of the calls.

    Args:
        seed: the scenario's or study's seed, >= 0.
        names: what the randomness is for, for example ``("pile", "sizes")`` or ``("loading", 3)``.
    """
    return np.random.default_rng(derive_seed(seed, *names))


def derive_seed(seed: int, *names: str | int) -> int:
    """Return a child seed in [0, 2**63) for (seed, names)."""
    text = "/".join([str(seed), *(str(name) for name in names)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little") >> 1
