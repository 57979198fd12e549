"""What replay and pile page have in common: site, rocks at rest, light, in a Meshcat scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat, Rgba
from scipy.spatial.transform import Rotation

from drakerock.files import write_text
from drakerock.rocks.config import SiteConfig

Array = NDArray[np.float64]
RockMesh = tuple[Array, NDArray[np.int64]]
"""Vertices (k, 3) [m] at sieve width 1 in the rock's frame, and triangles (m, 3)."""

# Warm greys by size class, told apart by lightness alone; the floor is darker than any rock.
_ROCK_LIGHTNESS = (0.42, 0.78)
_ROCK_HUE = np.array([1.0, 0.96, 0.9])
_MOVED_HUE = np.array([1.0, 0.76, 0.50])
_TWO_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def calc_rock_colors(sizes: Array) -> dict[float, Array]:
    """Return the colour (3,) in [0, 1] of each size, the larger the lighter."""
    return _shade(sizes, _ROCK_HUE)


def calc_moved_colors(sizes: Array) -> dict[float, Array]:
    """Return the colour (3,) in [0, 1] by size of rocks that move in a loading: brown, otherwise as the others."""
    return _shade(sizes, _MOVED_HUE)


def _shade(sizes: Array, hue: Array) -> dict[float, Array]:
    classes = np.unique(sizes)
    return dict(zip(classes, np.linspace(*_ROCK_LIGHTNESS, len(classes))[:, None] * hue, strict=True))


def draw_still_rocks(
    meshcat: Meshcat,
    path: str,
    meshes: Sequence[RockMesh],
    shape: NDArray[np.int64],
    size: Array,
    X_WRs: Array,
    colors: dict[float, Array],
) -> None:
    """Draw rocks that don't move, merged into one mesh per size.

    Args:
        meshcat: the scene.
        path: where in it.
        meshes: by shape.
        shape: (n,) index into `meshes`.
        size: (n,) sieve widths [m].
        X_WRs: (n, 7) quaternion (w, x, y, z), position in W [m].
        colors: (3,) in [0, 1] by size, see `calc_rock_colors`.
    """
    for width in np.unique(size):
        corners, faces, offset = [], [], 0
        for rock in np.flatnonzero(size == width):
            vertices, triangles = meshes[shape[rock]]
            R_WR = Rotation.from_quat(X_WRs[rock, :4], scalar_first=True).as_matrix()
            corners.append(width * vertices @ R_WR.T + X_WRs[rock, 4:])
            faces.append(triangles + offset)
            offset += len(vertices)
        color = Rgba(*colors[width], 1.0)
        meshcat.SetTriangleMesh(
            f"{path}/{width:g}", np.concatenate(corners).T, np.concatenate(faces).T, color
        )


def draw_site(meshcat: Meshcat, site: SiteConfig, x_start: float, height: float | None = None) -> None:
    """Draw floor, far wall, rear wall and the brow's outline, and light them; the near wall would hide all.

    Args:
        meshcat: the scene.
        site: its dimensions.
        x_start: smallest x worth drawing [m].
        height: of the walls in the void [m]; the drift's if None.
    """
    half, end, top = 0.5 * site.drift_width, site.void_depth, height or site.drift_height
    roof = site.drift_height
    floor = np.array([[x_start, -half, 0], [end, -half, 0], [end, half, 0], [x_start, half, 0]], float)
    far = np.array([[x_start, half, 0], [0, half, 0], [0, half, roof], [x_start, half, roof]], float)
    void = np.array([[0, half, 0], [end, half, 0], [end, half, top], [0, half, top]], float)
    rear = np.array([[end, -half, 0], [end, half, 0], [end, half, top], [end, -half, top]], float)
    for name, corners, rgba in (
        ("floor", floor, Rgba(0.30, 0.29, 0.28)),
        ("far_wall", far, Rgba(0.45, 0.44, 0.43, 0.55)),
        ("void_wall", void, Rgba(0.45, 0.44, 0.43, 0.55)),
        ("rear_wall", rear, Rgba(0.38, 0.37, 0.36, 0.55)),
    ):
        # Both sides, so that a wall shows from wherever the camera is turned to.
        both = np.vstack([_TWO_TRIANGLES, _TWO_TRIANGLES[:, ::-1]])
        meshcat.SetTriangleMesh(f"site/{name}", corners.T, both.T, rgba)
    lean = np.tan(np.deg2rad(site.wall_lean_deg)) * (site.void_height - roof)
    brow = np.array([[x_start, half, roof], [0, half, roof], [-lean, half, site.void_height]], float)
    outline = np.vstack([brow, brow[::-1] * [1, -1, 1]])
    meshcat.SetLine("site/brow", outline.T, 2.0, Rgba(0.2, 0.2, 0.2))
    meshcat.SetProperty("/Background/<object>", "top_color", [0.93, 0.94, 0.96])
    meshcat.SetProperty("/Background/<object>", "bottom_color", [0.75, 0.76, 0.78])
    meshcat.SetProperty("/Grid/<object>", "visible", False)
    meshcat.SetProperty("/Axes/<object>", "visible", False)
    # Even light over a scene of tens of metres: the viewer's own lamps light one of a few metres.
    for lamp in ("PointLightNegativeX", "PointLightPositiveX", "SpotLight"):
        meshcat.SetProperty(f"/Lights/{lamp}/<object>", "intensity", 0.0)
    meshcat.SetProperty("/Lights/AmbientLight/<object>", "intensity", 1.3)
    meshcat.SetProperty("/Lights/FillLight/<object>", "intensity", 2.2)
    meshcat.SetProperty("/Lights/FillLight/<object>", "position", [-6.0, 14.0, 9.0])


def write_scene(meshcat: Meshcat, path: str | Path) -> None:
    """Write the scene as one HTML file that opens without a network, whole or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    write_text(Path(path), meshcat.StaticHtml())
