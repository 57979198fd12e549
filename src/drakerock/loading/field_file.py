"""The file of the height fields before and after a loading, height_fields.npz: what models of the pile learn from."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drakerock.errors import InputError
from drakerock.loading.field import HeightField
from drakerock.npz import load_arrays, save_arrays

_FORMAT, _VERSION = "drakerock-height-fields", 1
# Heights are kept as whole millimetres: some 2 kB a loading.
_UNIT = 1e-3


def save_height_fields(before: HeightField, after: HeightField, path: str | Path) -> None:
    """Write the pile as it was sensed before a loading and as it lay after it, heights to a millimetre.

    Args:
        before, after: fields on one grid.
        path: the file.

    Raises:
        InputError: the file cannot be written.
    """
    arrays = {"x": before.x, "y": before.y} | {
        name: np.round(field.h / _UNIT).astype(np.int32)
        for name, field in (("before", before), ("after", after))
    }
    save_arrays(path, _FORMAT, _VERSION, {"cell_m": before.cell, "unit_m": _UNIT}, arrays)


def load_height_fields(path: str | Path) -> tuple[HeightField, HeightField]:
    """Return what `save_height_fields` wrote: the fields before and after a loading.

    Raises:
        InputError: missing, foreign or damaged.
    """
    header, arrays = load_arrays(path, _FORMAT, _VERSION)
    try:
        x, y, cell, unit = arrays["x"], arrays["y"], float(header["cell_m"]), float(header["unit_m"])
        heights = [arrays[name] * unit for name in ("before", "after")]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not a readable {_FORMAT} file: {error}") from None
    if any(h.shape != (len(x), len(y)) for h in heights):
        raise InputError(f"{path}: not a readable {_FORMAT} file: heights that do not fit the grid")
    before, after = (HeightField(x, y, h, cell) for h in heights)
    return before, after
