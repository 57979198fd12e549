"""Rock shapes: convex bodies whose size is a sieve width (method section 3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.optimize import minimize

from drakerock.errors import InputError
from drakerock.resources import find_file

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RockShape:
    """A convex rock at sieve width 1 m, in its own frame R (origin at the centre of mass, the mesh's axes).

    A rock of size s has vertices ``s * vertices``, volume ``s**3 * volume`` and inertia
    ``density * s**5 * inertia``.

    Attributes:
        name: the mesh file's stem.
        vertices: (k, 3) [m].
        triangles: (m, 3) vertex indices, outward by the right-hand rule.
        volume: [m^3].
        inertia: (3, 3) about R's origin at density 1 kg/m^3 [kg m^2].
    """

    name: str
    vertices: Array
    triangles: NDArray[np.int64]
    volume: float
    inertia: Array

    @property
    def radius(self) -> float:
        """Radius of the sphere about the centre of mass that holds the rock at sieve width 1 [m]."""
        return float(np.linalg.norm(self.vertices, axis=1).max())


def calc_sieve_width(vertices: Array) -> float:
    """Return the side of the smallest square aperture that a convex body passes [m].

    The body may be turned at will: the smallest square that encloses its projection along a direction,
    minimised over all directions.

    Args:
        vertices: (k, 3) of the body.
    """

    def calc_square(angles: Array) -> float:
        polar, azimuth, turn = angles
        d = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
        a = np.array([np.cos(polar) * np.cos(azimuth), np.cos(polar) * np.sin(azimuth), -np.sin(polar)])
        b = np.cross(d, a)
        plane = vertices @ np.column_stack(
            [np.cos(turn) * a + np.sin(turn) * b, np.cos(turn) * b - np.sin(turn) * a]
        )
        return float(np.ptp(plane, axis=0).max())

    starts = [
        (polar, azimuth, turn)
        for polar in np.linspace(0.0, np.pi / 2, 9)
        for azimuth in np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
        for turn in np.linspace(0.0, np.pi / 2, 6, endpoint=False)
    ]
    best = sorted(starts, key=lambda angles: calc_square(np.array(angles)))[:8]
    results = [
        minimize(calc_square, start, method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9})
        for start in best
    ]
    return float(min(result.fun for result in results))


def make_rock_shape(name: str, points: Array) -> RockShape:
    """Return the convex hull of `points` as a rock of sieve width 1 with its origin at the centre of mass.

    Args:
        name: what to call it.
        points: (k, 3), k >= 4, not all in one plane, at any scale.

    Raises:
        ValueError: the points span no volume.
    """
    hull = trimesh.convex.convex_hull(np.asarray(points, float))
    if not hull.volume > 1e-9 * np.ptp(hull.vertices, axis=0).max() ** 3:
        raise ValueError("the points span no volume")
    hull.apply_translation(-hull.center_mass)
    hull.apply_scale(1.0 / calc_sieve_width(np.asarray(hull.vertices)))
    hull.density = 1.0
    return RockShape(
        name,
        np.asarray(hull.vertices),
        np.asarray(hull.faces, dtype=np.int64),
        float(hull.volume),
        np.asarray(hull.moment_inertia),
    )


@lru_cache(maxsize=8)
def load_rock_shapes(uris: tuple[str, ...]) -> tuple[RockShape, ...]:
    """Read convex shapes from mesh files (``package://drakerock/...`` or paths); the hull is taken.

    Raises:
        InputError: a file is missing or holds no mesh with a volume.
    """
    return tuple(_load_rock_shape(uri) for uri in uris)


def _load_rock_shape(uri: str) -> RockShape:
    try:
        path = find_file(uri)
        mesh = trimesh.load_mesh(path, process=False)
        return make_rock_shape(path.stem, np.asarray(mesh.vertices))
    except FileNotFoundError:
        raise InputError(f"rocks.shapes: {uri}: no such mesh file") from None
    except Exception as error:  # trimesh raises many kinds for a file that is no mesh
        raise InputError(f"rocks.shapes: {uri}: not a mesh with a volume: {error}") from None


def sample_rock_points(rng: np.random.Generator, n_vertices: int = 14) -> Array:
    """Draw the corner points of a blasted rock: on a flattened ellipsoid, roughened, well apart.

    Args:
        rng: source of randomness.
        n_vertices: number of points; nearly all end up as corners of the hull.

    Returns:
        (n_vertices, 3), at no particular scale.
    """
    while True:
        points = rng.normal(size=(40 * n_vertices, 3))
        points /= np.linalg.norm(points, axis=1)[:, None]
        chosen = [points[0]]
        for point in points[1:]:
            # Spread over the sphere, so that faces are of like size, as on broken rock.
            if min(np.linalg.norm(point - other) for other in chosen) > 2.0 / np.sqrt(n_vertices):
                chosen.append(point)
            if len(chosen) == n_vertices:
                break
        if len(chosen) == n_vertices:
            break
    radius = rng.uniform(0.85, 1.0, size=(n_vertices, 1))
    axes = np.array([1.0, rng.uniform(0.7, 1.0), rng.uniform(0.6, 0.9)])
    return np.array(chosen) * radius * axes
