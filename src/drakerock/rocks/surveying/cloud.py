"""Point clouds from files: PLY, LAS, LAZ, XYZ, CSV."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from drakerock.errors import InputError

Array = NDArray[np.float64]

SUFFIXES = (".ply", ".las", ".laz", ".xyz", ".txt", ".asc", ".pts", ".csv")
# Headers by which a text file's columns are found, else the first three are taken.
_HEADERS = (("x", "easting", "east"), ("y", "northing", "north"), ("z", "height", "elevation", "altitude"))


def read_cloud(path: str | Path) -> Array:
    """Return the points (n, 3) of a file as they stand in it, in its unit; they may hold NaN.

    Args:
        path: ``.ply`` (points, or the corners of a mesh), ``.las``, ``.laz``, or text: ``.xyz``, ``.txt``, ``.asc``,
            ``.pts``, ``.csv``, with spaces, tabs, commas or semicolons between the numbers. A header's x, y, z (also
            easting, northing, elevation or height) say which columns, else it is the first three.

    Raises:
        InputError: missing, of another kind, damaged, or a reader that is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: '{suffix}' is no point cloud; known are {', '.join(SUFFIXES)}")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: an empty file")
    if suffix == ".ply":
        return _read_ply(path)
    return _read_las(path) if suffix in (".las", ".laz") else _read_text(path)


def _read_ply(path: Path) -> Array:
    try:
        loaded = trimesh.load(path, process=False)
        points = np.asarray(loaded.vertices, float).reshape(-1, 3)
    except Exception as error:  # whatever a reader makes of a damaged file
        raise InputError(f"{path}: not a readable PLY file: {error}") from None
    return points


def import_laspy() -> Any:
    """Return laspy, which the extra ``scan`` installs; InputError if it is not there."""
    try:
        import laspy
    except ImportError:
        raise InputError(
            "LAS and LAZ need laspy: pip install 'drakerock[scan]' (or take PLY, XYZ or CSV)"
        ) from None
    return laspy


def _read_las(path: Path) -> Array:
    laspy = import_laspy()
    try:
        points = np.asarray(laspy.read(path).xyz, float).reshape(-1, 3)
    except Exception as error:
        raise InputError(f"{path}: not a readable LAS or LAZ file: {error}") from None
    return points


def _read_text(path: Path) -> Array:
    try:
        with open(path, encoding="utf-8-sig") as file:
            lines = [file.readline() for _ in range(50)]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a readable text file: {error}") from None
    skip = 0
    header: list[str] = []
    for line in lines:
        cells = _split(line)
        if line.strip() and len(cells) >= 3 and all(_is_number(cell) for cell in cells[:3]):
            break
        skip += 1
        if len(cells) >= 3:
            header = [
                cell.strip("#\"' ").partition("[")[0].partition("(")[0].strip().casefold() for cell in cells
            ]
            header = [cell for cell in header if cell]
    else:
        raise InputError(
            f"{path}: no line with three numbers among the first 50; needed are x, y, z in columns"
        )
    columns = tuple(next((header.index(name) for name in names if name in header), k)
                    for k, names in enumerate(_HEADERS))  # fmt: skip
    row = lines[skip]
    separator = next((mark for mark in ";\t," if mark in row), None)
    if separator == ";" and re.search(r"\d,\d", row):
        raise InputError(f"{path}: line {skip + 1} has decimal commas; write decimal points")
    try:
        points: Array = np.loadtxt(
            path, delimiter=separator, skiprows=skip, usecols=columns, ndmin=2, encoding="utf-8-sig",
            converters=lambda cell: float(cell) if cell.strip() else np.nan,
        )  # fmt: skip
        return points
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: not three columns of numbers: {error}") from None


def _split(line: str) -> list[str]:
    return [cell for cell in re.split(r"[;,\t ]+", line.strip()) if cell]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
