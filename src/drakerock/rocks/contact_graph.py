"""Which rocks of a resting pile touch each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from drakerock.rocks.engine.collision.gjk import make_gjk_workspace
from drakerock.rocks.engine.collision.nearness import find_near_pairs
from drakerock.rocks.engine.collision.shapes import make_convex_shapes
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState


def find_contacts(pile: PileState, shapes: tuple[RockShape, ...], gap: float) -> NDArray[np.int64]:
    """Return the pairs of rocks (m, 2) whose surfaces overlap or are at most `gap` [m] apart."""
    if len(pile) < 2:
        return np.zeros((0, 2), np.int64)
    radii = np.array([shape.radius for shape in shapes])[pile.shape] * pile.size
    pairs = cKDTree(pile.p_WRs).query_pairs(2.0 * radii.max() + gap, output_type="ndarray")
    distance = np.linalg.norm(pile.p_WRs[pairs[:, 0]] - pile.p_WRs[pairs[:, 1]], axis=1)
    pairs = pairs[distance <= radii[pairs[:, 0]] + radii[pairs[:, 1]] + gap]
    near = np.zeros(len(pairs), np.bool_)
    find_near_pairs(
        # The hulls themselves, without the engine's rounding.
        make_convex_shapes([shape.vertices for shape in shapes], [0.0] * len(shapes)),
        np.ascontiguousarray(pile.shape, np.int64),
        np.ascontiguousarray(pile.size, float),
        Rotation.from_quat(pile.q_WRs, scalar_first=True).as_matrix(),
        np.ascontiguousarray(pile.p_WRs, float),
        pairs,
        gap,
        near,
        make_gjk_workspace(),
    )
    return pairs[near]


def find_loose(pile: PileState, shapes: tuple[RockShape, ...], gap: float) -> NDArray[np.bool_]:
    """Return which rocks (n,) are not connected to the pile through contacts (gap below `gap` [m]).

    The pile is the connected body of largest mass, and every body that holds a fixed rock.
    """
    n = len(pile)
    if n == 0:
        return np.zeros(0, bool)
    pairs = find_contacts(pile, shapes, gap)
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    mass = np.bincount(label, weights=pile.size**3, minlength=count)
    is_pile = np.zeros(count, bool)
    is_pile[np.argmax(mass)] = True
    is_pile[np.unique(label[pile.fixed])] = True
    return ~is_pile[label]
