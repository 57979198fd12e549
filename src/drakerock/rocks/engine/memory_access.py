"""How kernels meet the processor's cache: memory is asked for before it is needed, and begins with a line of the cache.

What a contact needs lies anywhere: its bodies' poses, their velocities, the pair's cached points. A processor that
finds out only when it gets there waits each time for the far end of its cache, and so spent up to a seventh of the
narrow phase.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import DTypeLike, NDArray

# How many pairs, rows or points before its use memory is asked for: enough for it to arrive, few enough to stay.
AHEAD = 4
# A line of the processor's cache [bytes].
CACHE_LINE = 64

_INTEGER = ir.IntType(64)


def make_aligned_zeros(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return zeros that begin with a line of the cache; a vector that lies across two takes two loads."""
    size = prod(shape) * np.dtype(dtype).itemsize
    room = np.zeros(size + CACHE_LINE, np.uint8)
    start = -room.ctypes.data % CACHE_LINE
    return room[start : start + size].view(dtype).reshape(shape)


@intrinsic  # type: ignore[untyped-decorator]
def prefetch(_context: Any, array: Any, row: Any) -> Any:
    """Ask for ``array[row]``, its first byte and, of more than a number, its last. Nothing is read: no row can fail."""
    return types.void(array, types.int64), _build_prefetch


def _build_prefetch(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    pointer_type, number = ir.IntType(8).as_pointer(), ir.IntType(32)
    function = builder.module.declare_intrinsic(
        "llvm.prefetch",
        [pointer_type],
        ir.FunctionType(ir.VoidType(), [pointer_type, number, number, number]),
    )
    # To be read, to be kept, data.
    how = [ir.Constant(number, setting) for setting in (0, 3, 1)]
    stride = builder.extract_value(array.strides, 0)
    first = builder.gep(builder.bitcast(array.data, pointer_type), [builder.mul(arguments[1], stride)])
    builder.call(function, [first, *how])
    if signature.args[0].ndim > 1 or isinstance(signature.args[0].dtype, types.Record):
        builder.call(function, [builder.gep(first, [builder.sub(stride, ir.Constant(_INTEGER, 1))]), *how])
    return context.get_dummy_value()
