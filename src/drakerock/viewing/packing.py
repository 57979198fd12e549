"""Arrays and plain values inside a page: one compressed block of text."""

from __future__ import annotations

import base64
import gzip
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray


def pack(values: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> str:
    """Return values and arrays as text that a page's `unpack` (page.js) reads.

    The arrays are stored by columns, where neighbours resemble each other.

    Args:
        values: what JSON can hold.
        arrays: by name; the page sees each as a flat array of its type, column after column.
    """
    places, blocks, offset = {}, [], 0
    for name, array in arrays.items():
        block = np.asfortranarray(array).tobytes(order="F")
        block += b"\0" * (-len(block) % 8)  # the page's arrays begin at multiples of their items' size
        places[name] = {"type": array.dtype.name, "offset": offset, "count": int(array.size)}
        blocks.append(block)
        offset += len(block)
    head = json.dumps({"values": values, "arrays": places}, allow_nan=False).encode()
    head += b" " * (-len(head) % 8)
    return compress(len(head).to_bytes(8, "little") + head + b"".join(blocks))


def compress(data: bytes) -> str:
    """Return data, compressed, as text; equal data give equal text."""
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode()
