"""Which pairs of convex bodies are near each other, whatever the contact law."""

from __future__ import annotations

from drakerock.rocks.engine.collision.geometry import Core
from drakerock.rocks.engine.collision.gjk import SEPARATED, GjkWorkspace, calc_core_distance
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, kernel
from drakerock.rocks.engine.vectors import dot, get_rotation, get_vector, subtract


@kernel
def find_near_pairs(
    shapes: ConvexShapes,
    shape: Array,
    scale: Array,
    rotations: Array,
    positions: Array,
    pairs: Array,
    gap: float,
    near: Array,
    workspace: GjkWorkspace,
) -> None:
    """Mark the pairs of bodies whose cores overlap or are at most a gap apart.

    Reads:
        shapes: all shapes.
        shape, scale, rotations, positions: of the bodies, (n,), (n,), (n, 3, 3) and (n, 3) in W [m].
        pairs: (m, 2) bodies.
        gap: [m].
    Writes:
        near: (m,) True or False.
        workspace: from `make_gjk_workspace`.
    """
    for k in range(len(pairs)):
        a, b = pairs[k, 0], pairs[k, 1]
        p = subtract(get_vector(positions[b]), get_vector(positions[a]))
        # At one place any direction is as good as another.
        guess = (p[0] if dot(p, p) > 0.0 else 1.0, p[1], p[2])
        core_a = Core(shape[a], scale[a], get_rotation(rotations, a))
        core_b = Core(shape[b], scale[b], get_rotation(rotations, b))
        found = calc_core_distance(shapes, core_a, core_b, p, guess, 0, gap, workspace)
        near[k] = found[0] != SEPARATED
