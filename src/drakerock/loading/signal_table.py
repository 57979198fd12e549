"""The file of a cycle's signals: Parquet, with units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from drakerock.errors import InputError

Array = NDArray[np.float64]


def save_signals(columns: dict[str, Array], units: dict[str, str], path: str | Path) -> None:
    """Write the columns as Parquet; each column's unit is in its field's metadata under ``unit``.

    Raises:
        InputError: the file cannot be written.
    """
    schema = pa.schema([pa.field(name, pa.float64(), metadata={"unit": units[name]}) for name in columns])
    # Not by `pa.array(column)`, which imports pandas only to see that a column is none of its own.
    buffers = [pa.py_buffer(np.ascontiguousarray(column, float)) for column in columns.values()]
    arrays = [pa.Array.from_buffers(pa.float64(), len(buffer) // 8, [None, buffer]) for buffer in buffers]
    table = pa.table(arrays, schema=schema)
    try:
        pq.write_table(table, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error}") from None


def load_signals(path: str | Path) -> tuple[dict[str, Array], dict[str, str]]:
    """Read what `save_signals` wrote: the columns (k,), and their units.

    Raises:
        InputError: missing or not a file of signals.
    """
    try:
        with pq.ParquetFile(path) as file:
            table = file.read()
        table.validate(full=True)
        units = {field.name: field.metadata[b"unit"].decode() for field in table.schema}
        columns = {
            name: np.asarray(table[name].cast(pa.float64()), dtype=float) for name in table.column_names
        }
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except Exception as error:  # whatever pyarrow makes of a damaged or foreign file
        raise InputError(f"{path}: not a readable file of signals: {error}") from None
    return columns, units
