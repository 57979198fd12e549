"""The site: drift, brow and void as half-spaces and convex pieces, all at rest in W (method section 3)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drakerock.pile.config import SiteConfig

Array = NDArray[np.float64]


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
        pieces: roof with the face above the brow.
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
    return Site(config, planes, tuple(pieces))


def calc_roof_height(config: SiteConfig, y: float | Array) -> float | Array:
    """Return the height of the drift's roof at `y` [m]: a parabola, highest on the centreline."""
    return config.drift_height - config.roof_sag * (np.asarray(y) / (0.5 * config.drift_width)) ** 2
