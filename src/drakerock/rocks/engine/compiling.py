"""How the engine's kernels are compiled: numba, ahead of nothing, cached on disk.

The cache folder carries a hash of all kernel sources. numba itself only notices a change in the file of the
kernel that it loads, not in the files of the kernels called from there.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numba
import platformdirs
from numba import types
from numba.core.compiler_lock import global_compiler_lock
from numpy.typing import NDArray

# Types of the kernels' arguments: arrays of any number type, a record (see `records`), a vector in three numbers, a
# quaternion w x y z, a symmetric matrix xx xy xz yy yz zz, a rotation by rows.
Array = NDArray[Any]
Record = Any
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Symmetric = tuple[float, float, float, float, float, float] | NDArray[Any]
Rotation = tuple[float, float, float, float, float, float, float, float, float]

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
    """Decorate a function over arrays and numbers to be compiled on first use and cached on disk.

    It must not make arrays (`allocating_kernel` may); views of those it is given are free. Arrays are not counted
    then: counting all that a function is given, once per pair of rocks, took a third of the narrow phase. Kernels that
    call it have it inlined: an array is passed as seven numbers, all shapes as more than a hundred, which took a fifth
    of a step.
    """
    return _compile(function, counts_arrays=False)


def allocating_kernel[Function: Callable[..., Any]](function: Function) -> Function:
    """Decorate a kernel that makes arrays of its own; not for what is called once per rock or contact."""
    return _compile(function, counts_arrays=True)


def _compile[Function: Callable[..., Any]](function: Function, counts_arrays: bool) -> Function:
    """Compile a kernel twice, when and where it is called: for Python, and without an entry for Python for kernels.

    Most are called by kernels only. The entry takes all fields of all records and tuples apart, and is as long as many
    a kernel: without it, compilation takes a sixth less.
    """
    folder = find_cache_folder()
    decorated: Function = _decorate(function, folder, counts_arrays, no_cpython_wrapper=False)
    if numba.config.DISABLE_JIT:
        return decorated
    inlined = _decorate(function, folder / "inlined", counts_arrays, no_cpython_wrapper=True)
    for dispatcher in (decorated, inlined):
        _compile_alone(dispatcher)
    _compile_once(inlined)
    # What kernels that call it ask for; and the other one, for those who want to know.
    decorated.inlined = inlined  # type: ignore[attr-defined]
    decorated.get_call_template = inlined.get_call_template  # type: ignore[attr-defined]
    decorated.get_overload = inlined.get_overload  # type: ignore[attr-defined]
    return decorated


def _decorate(function: Callable[..., Any], folder: Path, counts_arrays: bool, **options: bool) -> Any:
    # Strict arithmetic: with fused or reordered operations the results depend on what the compiler inlines, and
    # that differs between kernels just compiled and kernels from the cache. It costs a tenth of the time.
    # numba reads its cache folder when it decorates; other users of numba must not see ours.
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(folder)
    try:
        return numba.njit(
            cache=True,
            error_model="numpy",
            _nrt=counts_arrays,
            forceinline=not counts_arrays,
            no_cfunc_wrapper=True,  # nothing in C calls them
            **options,
        )(function)
    finally:
        numba.config.CACHE_DIR = before


class _OneProcess:
    """Held while compiling into the cache folder, or loading from it: by one process of all that share the folder.

    The lock is the operating system's, so it ends with its process, however that ends. Within a process numba's
    own lock keeps threads apart; a kernel that is compiled for another one enters again.
    """

    def __init__(self) -> None:
        self._depth, self._file = 0, -1

    def __enter__(self) -> None:
        global_compiler_lock.acquire()
        if self._depth == 0:
            try:
                folder = find_cache_folder()
                folder.mkdir(parents=True, exist_ok=True)
                self._file = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
                fcntl.flock(self._file, fcntl.LOCK_EX)
            except OSError as error:  # a file system without locks costs time, no more
                _log.debug("drakerock: the kernels' folder cannot be locked: %s", error)
        self._depth += 1

    def __exit__(self, *_error: object) -> None:
        self._depth -= 1
        if self._depth == 0 and self._file >= 0:
            os.close(self._file)
            self._file = -1
        global_compiler_lock.release()


_one_process = _OneProcess()


def _compile_alone(dispatcher: Any) -> None:
    """Make processes that need the same kernel at once compile it once: the others wait, then load it."""
    compile_now = dispatcher.compile

    def compile_alone(signature: Any) -> Any:
        with _one_process:
            return compile_now(signature)

    dispatcher.compile = compile_alone


def _compile_once(dispatcher: Any) -> None:
    """Make kernels that are called with a constant the same as with any number: numba compiles one for each constant.

    Nothing is lost: kernels are inlined, constants and all.
    """
    find_template = dispatcher.get_call_template

    def find_without_constants(args: tuple[Any, ...], kws: dict[str, Any]) -> Any:
        plain = {name: types.unliteral(type_) for name, type_ in kws.items()}
        return find_template(tuple(types.unliteral(type_) for type_ in args), plain)

    dispatcher.get_call_template = find_without_constants


def are_kernels_compiled() -> bool:
    """Return whether kernels have been compiled into the folder before; all of them, unless that was cut short."""
    return any(find_cache_folder().rglob("*.nbc"))


def describe_compilation() -> str:
    """Return what is said before the kernels are compiled."""
    return f"compiling the rock engine's kernels into {find_cache_folder()} (once, about a minute)"


@lru_cache(maxsize=1)
def announce_compilation() -> None:
    """Say once, before the first use, if the kernels are about to be compiled."""
    if not are_kernels_compiled():
        _log.warning("drakerock: %s", describe_compilation())
