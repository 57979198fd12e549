"""Rock shapes: convex bodies whose size is a sieve width (method section 3)."""

from __future__ import annotations

import hashlib
import logging
import os
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from platformdirs import user_cache_path
from scipy.optimize import minimize
from scipy.spatial import ConvexHull
from scipy.spatial.distance import pdist

from drakerock.errors import InputError
from drakerock.resources import find_file
from drakerock.rocks.config import RocksConfig

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)

# Longest over shortest extent of a rock: blasted rock has up to 4; the contacts of thin plates are not to be trusted.
MAX_ASPECT = 10.0
# A hull that has so much more volume than its mesh is told of.
NOTABLE_VOLUME = 0.01


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
        # Called some thousand times: in plain numbers a fifth of the time of small arrays, and the same bits.
        (s_p, s_a, s_t), (c_p, c_a, c_t) = np.sin(angles).tolist(), np.cos(angles).tolist()
        d = s_p * c_a, s_p * s_a, c_p
        a = c_p * c_a, c_p * s_a, -s_p
        b = d[1] * a[2] - d[2] * a[1], d[2] * a[0] - d[0] * a[2], d[0] * a[1] - d[1] * a[0]
        plane = vertices @ np.array(
            [[c_t * p + s_t * q, c_t * q - s_t * p] for p, q in zip(a, b, strict=True)]
        )
        return float((plane.max(axis=0) - plane.min(axis=0)).max())

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


def _fetch_sieve_width(vertices: Array) -> float:
    """Return `calc_sieve_width`, from the user's cache folder if it has been found there for the same corners."""
    digest = hashlib.sha256(b"1" + np.ascontiguousarray(vertices).tobytes()).hexdigest()[:24]
    path = user_cache_path("drakerock") / "sieve_widths" / digest
    try:
        return float.fromhex(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        width = calc_sieve_width(vertices)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(f".{os.getpid()}.partial")
        partial.write_text(width.hex(), encoding="ascii")
        partial.replace(path)
    except OSError:
        pass  # a cache that cannot be written only costs time
    return width


def calc_aspect(vertices: Array) -> float:
    """Return a convex body's longest extent over its shortest, the least distance of a face to what is opposite.

    Args:
        vertices: (k, 3) of the body.
    """
    normals = ConvexHull(vertices).equations[:, :3]
    return float(pdist(vertices).max() / np.ptp(vertices @ normals.T, axis=0).min())


def choose_corners(points: Array, number: int) -> NDArray[np.int64]:
    """Choose points whose hull is close to that of all: always the one that is farthest outside the hull so far.

    Args:
        points: (k, 3), not all in one plane.
        number: how many to choose, at least 4.

    Returns:
        Their indices, in order; fewer than `number` if all others are inside.
    """
    span = points - points.mean(axis=0)
    chosen = [int(np.argmax(np.linalg.norm(span, axis=1)))]
    # A first tetrahedron: the farthest from a point, from a line, from a plane.
    rest = points - points[chosen[0]]
    for _ in range(3):
        chosen.append(int(np.argmax(np.linalg.norm(rest, axis=1))))
        along = rest[chosen[-1]] / np.linalg.norm(rest[chosen[-1]])
        rest = rest - np.outer(rest @ along, along)
    while len(chosen) < number:
        outside = calc_height(points[chosen], points)
        if not outside.max() > 1e-9 * np.ptp(points):
            break
        chosen.append(int(np.argmax(outside)))
    return np.sort(np.array(chosen, np.int64))


def calc_height(hull: Array, points: Array) -> Array:
    """Return how far points (m,) are above the nearest face's plane of a hull of corners (k, 3); < 0: inside."""
    planes = ConvexHull(hull).equations
    heights: Array = (points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    return heights


def make_rock_shape(name: str, points: Array) -> RockShape:
    """Return the convex hull of `points` as a rock of sieve width 1 with its origin at the centre of mass.

    Args:
        name: what to call it.
        points: (k, 3), k >= 4, not all in one plane, at any scale.

    Raises:
        ValueError: the points span no volume, or a plate or needle.
    """
    hull = trimesh.convex.convex_hull(np.asarray(points, float))
    if not hull.volume > 1e-9 * np.ptp(hull.vertices, axis=0).max() ** 3:
        raise ValueError("the points span no volume")
    aspect = calc_aspect(np.asarray(hull.vertices))
    if aspect > MAX_ASPECT:
        raise ValueError(
            f"{aspect:.3g} times as long as thin; at most {MAX_ASPECT:g} is allowed, blasted rock has up to 4"
        )
    hull.apply_translation(-hull.center_mass)
    hull.apply_scale(1.0 / _fetch_sieve_width(np.asarray(hull.vertices)))
    hull.density = 1.0
    return RockShape(
        name,
        np.asarray(hull.vertices),
        np.asarray(hull.faces, dtype=np.int64),
        float(hull.volume),
        np.asarray(hull.moment_inertia),
    )


def load_rock_shapes(rocks: RocksConfig) -> tuple[RockShape, ...]:
    """Read the convex shapes of the rocks from mesh files, `rocks.shapes`, one rock each, in any unit.

    The hull is taken, and what that changes is said as a warning of this module's logger: holes, hollows, corners
    beyond `rocks.max_corners`.

    Raises:
        InputError: a file is missing, or holds no mesh with a volume, several bodies, or a plate.
    """
    return load_convex_meshes(rocks.shapes, rocks.max_corners)


@lru_cache(maxsize=8)
def load_convex_meshes(uris: tuple[str, ...], max_corners: int) -> tuple[RockShape, ...]:
    """Read what `load_rock_shapes` says; kept, since many parts of a simulation ask for the same shapes."""
    return tuple(_load_rock_shape(uri, max_corners) for uri in uris)


def _load_rock_shape(uri: str, max_corners: int) -> RockShape:
    try:
        path = find_file(uri)
        mesh = trimesh.load_mesh(path, process=False)
        points = np.asarray(mesh.vertices, float)[np.unique(mesh.faces)]
        hull = points[ConvexHull(points).vertices]
    except FileNotFoundError:
        raise InputError(f"rocks.shapes: {uri}: no such mesh file") from None
    except Exception as error:  # trimesh and qhull raise many kinds for a file that is no mesh
        raise InputError(f"rocks.shapes: {uri}: not a mesh with a volume: {error}") from None
    _check_mesh(uri, mesh)
    try:
        if len(hull) <= max_corners:
            return make_rock_shape(path.stem, points)
        reduced = hull[choose_corners(hull, max_corners)]
        shape = make_rock_shape(path.stem, reduced)
    except ValueError as error:
        raise InputError(f"rocks.shapes: {uri}: {error}") from None
    width = _fetch_sieve_width(hull)
    volume = ConvexHull(hull).volume / width**3
    _log.warning(
        "rocks.shapes: %s: %d corners reduced to %d (rocks.max_corners): at the same sieve width its volume changes by "
        "%+.1f %%; its surface moves by at most %.3f sieve widths",
        uri, len(hull), len(shape.vertices), 100 * (shape.volume / volume - 1),
        calc_height(reduced, hull).max() / width,
    )  # fmt: skip
    return shape


def _check_mesh(uri: str, mesh: trimesh.Trimesh) -> None:
    """Refuse a mesh of several bodies; say what taking the hull of one changes."""
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    body.merge_vertices()
    body.update_faces(body.nondegenerate_faces())
    body.remove_unreferenced_vertices()
    if body.body_count > 1:
        raise InputError(
            f"rocks.shapes: {uri}: {body.body_count} bodies in one mesh; a shape is one rock: give each its own file"
        )
    hull = body.convex_hull
    if not body.is_watertight:
        _log.warning(
            "rocks.shapes: %s: the mesh has holes, which its convex hull closes: volume %.4g before (as far as it has "
            "one), %.4g after, in the file's unit", uri, abs(body.volume), hull.volume,
        )  # fmt: skip
        return
    if not body.is_winding_consistent:
        trimesh.repair.fix_normals(body)
    excess = hull.volume / abs(body.volume) - 1
    if excess > NOTABLE_VOLUME:
        depth = -calc_height(np.asarray(hull.vertices), np.asarray(body.vertices)).min()
        _log.warning(
            "rocks.shapes: %s: the mesh is not convex, its hull is taken: %.1f %% more volume, hollows up to %.3f "
            "sieve widths deep are filled", uri, 100 * excess, depth / _fetch_sieve_width(np.asarray(hull.vertices)),
        )  # fmt: skip


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
