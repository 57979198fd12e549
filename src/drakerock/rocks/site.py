"""The site: drift, brow and void as half-spaces and convex pieces, all at rest in W (method section 3)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.config import SiteConfig
from drakerock.rocks.engine.surroundings import HalfSpace, StaticPiece, Surroundings

Array = NDArray[np.float64]

# How far outside the site's box a rock still counts as inside [m].
SITE_MARGIN = 0.5


@dataclass(frozen=True, eq=False)
class Plane:
    """A half-space of rock: solid where ``normal @ p < offset``.

    Attributes:
        name: what it is.
        normal: (3,) unit vector out of the solid, in W.
        offset: ``normal @ p`` of the surface [m].
    """

    name: str
    normal: Array
    offset: float


@dataclass(frozen=True, eq=False)
class ConvexPiece:
    """A convex piece of solid rock.

    Attributes:
        name: what it is.
        vertices: (k, 3) corners in W [m].
    """

    name: str
    vertices: Array


@dataclass(frozen=True, eq=False)
class Site:
    """The static surroundings of machine and rocks.

    Attributes:
        config: what it was made from.
        planes: floor, side walls, rear wall.
        pieces: roof with the face above the brow; what the void tapers by.
    """

    config: SiteConfig
    planes: tuple[Plane, ...]
    pieces: tuple[ConvexPiece, ...]


def make_site(config: SiteConfig, n_roof: int = 8) -> Site:
    """Build the site from its configuration.

    The drift is x < 0, the void 0 < x < void_depth; the rock above the drift is cut into `n_roof` convex
    pieces across the drift, whose undersides follow the curved roof and whose front is the leaning face.

    Args:
        config: dimensions.
        n_roof: number of pieces across the curved roof.
    """
    half = 0.5 * config.drift_width
    planes = (
        Plane("floor", np.array([0.0, 0.0, 1.0]), 0.0),
        Plane("left_wall", np.array([0.0, -1.0, 0.0]), -half),
        Plane("right_wall", np.array([0.0, 1.0, 0.0]), -half),
        Plane("rear_wall", np.array([-1.0, 0.0, 0.0]), -config.void_depth),
    )
    lean = np.tan(np.deg2rad(config.wall_lean_deg))
    top = config.void_height
    # The solid reaches past the side walls, so that no seam is open where roof and wall meet.
    edges = np.linspace(-half, half, n_roof + 1)
    pieces = []
    for k, (y0, y1) in enumerate(pairwise(edges)):
        wide0, wide1 = (y0 - (2.0 if k == 0 else 0.0), y1 + (2.0 if k == n_roof - 1 else 0.0))
        corners = []
        for y, wide in ((y0, wide0), (y1, wide1)):
            z = calc_roof_height(config, y)
            for x in (-config.drift_length, -lean * (z - config.drift_height)):
                corners.append([x, wide, z])
            corners += [[-config.drift_length, wide, top], [-lean * (top - config.drift_height), wide, top]]
        pieces.append(ConvexPiece(f"roof_{k}", np.array(corners)))
    if config.void_taper_deg:
        pieces += _make_taper(config)
    return Site(config, planes, tuple(pieces))


def make_confined_site(config: SiteConfig) -> Site:
    """Build the mould of the rear layer: the void's walls, and a plane in front of the rear wall."""
    site = make_site(config)
    taper = np.deg2rad(config.void_taper_deg)
    # Parallel to the rear wall, on the layer's other side.
    normal = np.array([np.cos(taper), 0.0, -np.sin(taper)])
    on_wall = np.array([config.void_depth, 0.0, config.void_height])
    plane = Plane("confining_plane", normal, float(normal @ on_wall) - config.rear_layer)
    taper_pieces = tuple(piece for piece in site.pieces if piece.name.startswith("taper"))
    return Site(config, (*site.planes, plane), taper_pieces)


def _make_taper(config: SiteConfig) -> list[ConvexPiece]:
    """Return wedges on the void's side and rear walls, thickest at the floor."""
    half, depth, top = 0.5 * config.drift_width, config.void_depth, config.void_height
    foot = top * np.tan(np.deg2rad(config.void_taper_deg))
    rear = [[depth, y, z] for y in (-half, half) for z in (0.0, top)]
    pieces = [ConvexPiece("taper_rear", np.array(rear + [[depth - foot, y, 0.0] for y in (-half, half)]))]
    for name, side in (("taper_left", 1.0), ("taper_right", -1.0)):
        wall = [[x, side * half, z] for x in (0.0, depth) for z in (0.0, top)]
        edge = [[x, side * (half - foot), 0.0] for x in (0.0, depth)]
        pieces.append(ConvexPiece(name, np.array(wall + edge)))
    return pieces


def calc_roof_height(config: SiteConfig, y: float | Array) -> float | Array:
    """Return the height of the drift's roof at `y` [m]: a parabola, highest on the centreline."""
    return config.drift_height - config.roof_sag * (np.asarray(y) / (0.5 * config.drift_width)) ** 2


def make_surroundings(site: Site) -> Surroundings:
    """Return the site as the rock engine meets it, without Drake; with it, see `drakerock.rocks.drake.drift`."""
    config = site.config
    return Surroundings(
        tuple(HalfSpace(plane.normal, plane.offset, config.friction) for plane in site.planes),
        tuple(StaticPiece(piece.vertices, config.friction) for piece in site.pieces),
        *calc_bounds(config),
    )


def calc_bounds(config: SiteConfig) -> tuple[Array, Array]:
    """Return the corners (3,) of the box outside of which a rock has left the site [m]."""
    half = 0.5 * config.drift_width + SITE_MARGIN
    return (
        np.array([-config.drift_length, -half, -SITE_MARGIN]),
        np.array([config.void_depth + SITE_MARGIN, half, config.void_height + 20.0]),
    )
