"""Which pairs of convex bodies are near each other, whatever the contact law."""

from __future__ import annotations

from drakerock.rocks.engine.collision.geometry import get_rotation
from drakerock.rocks.engine.collision.gjk import SEPARATED, Workspace, calc_core_distance
from drakerock.rocks.engine.collision.shapes import ConvexShapes
from drakerock.rocks.engine.compiling import Array, kernel


@kernel
def find_near(
    shapes: ConvexShapes,
    shape: Array,
    scale: Array,
    rotations: Array,
    positions: Array,
    pairs: Array,
    gap: float,
    workspace: Workspace,
    near: Array,
) -> None:
    """Mark the pairs of bodies whose cores overlap or are at most a gap apart.

    Args:
        shapes: all shapes.
        shape, scale, rotations, positions: of the bodies, (n,), (n,), (n, 3, 3) and (n, 3) in W [m].
        pairs: (m, 2) bodies.
        gap: [m].
        workspace: from `make_gjk_workspace`.
        near: (m,), set to True or False.
    """
    for k in range(len(pairs)):
        a, b = pairs[k, 0], pairs[k, 1]
        px = positions[b, 0] - positions[a, 0]
        py = positions[b, 1] - positions[a, 1]
        pz = positions[b, 2] - positions[a, 2]
        # At one place any direction is as good as another.
        gx = px if px * px + py * py + pz * pz > 0.0 else 1.0
        found = calc_core_distance(
            shapes, shape[a], scale[a], get_rotation(rotations, a), shape[b], scale[b], get_rotation(rotations, b),
            px, py, pz, gx, py, pz, 0, gap, workspace,
        )  # fmt: skip
        near[k] = found[0] != SEPARATED
