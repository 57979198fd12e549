"""Surfaces and clouds as files that site software opens: PLY, LAS, GeoTIFF, npz."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from drakerock.errors import InputError
from drakerock.npz import save_arrays
from drakerock.rocks.surveying.cloud import import_laspy

Array = NDArray[np.float64]

FIELD_FORMAT, FIELD_VERSION = "drakerock-height-field", 1
# Resolution of LAS coordinates [m].
LAS_SCALE = 1e-4
# GeoTIFF tags: pixel scale, tie point, keys; the keys say: model of projected coordinates, pixel is an area, a user's
# own metric system (linear unit 9001: metre), since a drift's frame is no map's.
_PIXEL_SCALE, _TIE_POINT, _GEO_KEYS = 33550, 33922, 34735
_KEYS = (1, 1, 0, 4, 1024, 0, 1, 1, 1025, 0, 1, 1, 3072, 0, 1, 32767, 3076, 0, 1, 9001)
_NO_DATA = 42113


def save_cloud_ply(points: Array, path: Path) -> None:
    """Write points (n, 3) [m] as binary PLY; InputError if it cannot be written."""
    _write(path, trimesh.PointCloud(points).export(file_type="ply"))


def save_mesh_ply(mesh: trimesh.Trimesh, path: Path) -> None:
    """Write a mesh as binary PLY; InputError if it cannot be written."""
    _write(path, mesh.export(file_type="ply"))


def save_cloud_las(points: Array, path: Path) -> None:
    """Write points (n, 3) [m] as LAS 1.4 (``.laz``: compressed), to a tenth of a millimetre.

    Raises:
        InputError: it cannot be written, or laspy is not installed.
    """
    laspy: Any = import_laspy()
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = np.full(3, LAS_SCALE), np.zeros(3)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    try:
        cloud.write(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def save_field_npz(x: Array, y: Array, h: Array, path: Path) -> None:
    """Write a height field as npz: cell centres x (nx,), y (ny,), heights h (nx, ny) [m].

    Raises:
        InputError: it cannot be written.
    """
    save_arrays(path, FIELD_FORMAT, FIELD_VERSION, {"unit": "m"}, {"x": x, "y": y, "h": h})


def save_field_tiff(x: Array, y: Array, h: Array, path: Path) -> None:
    """Write a height field as GeoTIFF: 32-bit heights, north (y) up, in the site's own metric system.

    Args:
        x: (nx,) cell centres, evenly apart [m].
        y: (ny,) likewise.
        h: (nx, ny) heights [m]; NaN: none.
        path: the file.

    Raises:
        InputError: it cannot be written, or tifffile is not installed.
    """
    try:
        import tifffile
    except ImportError:
        raise InputError(
            "GeoTIFF needs tifffile: pip install 'drakerock[scan]' (the npz holds the same)"
        ) from None
    dx, dy = float(x[1] - x[0]), float(y[1] - y[0])
    corner = (float(x[0]) - 0.5 * dx, float(y[-1]) + 0.5 * dy)
    tags = [
        (_PIXEL_SCALE, "d", 3, (dx, dy, 0.0), False),
        (_TIE_POINT, "d", 6, (0.0, 0.0, 0.0, *corner, 0.0), False),
        (_GEO_KEYS, "H", len(_KEYS), _KEYS, False),
        (_NO_DATA, "s", 0, "nan", False),
    ]
    try:
        tifffile.imwrite(path, np.ascontiguousarray(h.T[::-1], np.float32), extratags=tags, metadata=None)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None


def _write(path: Path, data: bytes | str) -> None:
    try:
        path.write_bytes(data.encode() if isinstance(data, str) else data)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
