"""How the engine's kernels are compiled: numba, ahead of nothing, cached on disk.

The cache folder carries a hash of all kernel sources. numba itself only notices a change in the file of the
kernel that it loads, not in the files of the kernels called from there.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
import platformdirs
from numpy.typing import NDArray

# Types of the kernels' arguments: arrays of any number type, a rotation by rows, a vector in three numbers.
Array = NDArray[Any]
Rotation = tuple[float, float, float, float, float, float, float, float, float]
Vector = tuple[float, float, float]

_log = logging.getLogger(__name__)


@lru_cache(maxsize=1)
def find_cache_folder() -> Path:
    """Return the folder of the compiled kernels; it changes with every change of a kernel's source."""
    digest = hashlib.sha256(numba.__version__.encode())
    root = Path(__file__).resolve().parent
    for path in sorted(root.rglob("*.py")):
        digest.update(path.read_bytes())
    base = numba.config.CACHE_DIR or platformdirs.user_cache_dir("drakerock")
    return Path(base) / f"kernels-{digest.hexdigest()[:12]}"


def kernel[Function: Callable[..., Any]](function: Function) -> Function:
    """Decorate a function over arrays and numbers to be compiled on first use and cached on disk."""
    # Strict arithmetic: with fused or reordered operations the results depend on what the compiler inlines, and
    # that differs between kernels just compiled and kernels from the cache. It costs a tenth of the time.
    # numba reads its cache folder when it decorates; other users of numba must not see ours.
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(find_cache_folder())
    try:
        decorated: Function = numba.njit(cache=True, error_model="numpy")(function)
    finally:
        numba.config.CACHE_DIR = before
    return decorated


@lru_cache(maxsize=1)
def announce_compilation() -> None:
    """Say once, before the first use, if the kernels are about to be compiled (less than a minute)."""
    folder = find_cache_folder()
    if not any(folder.rglob("*.nbc")):
        _log.warning("drakerock: compiling the rock engine's kernels into %s (once, below a minute)", folder)
