"""Writes the rock meshes beside this file, `python make_rocks.py`. Same seed, same rocks.

The six default ones; three angular ones, of few corners; three rounded ones, as many corners as a shape may have.
"""

from pathlib import Path

import numpy as np
import trimesh

from drakerock.rocks.shapes import make_rock_shape, sample_rock_points

SEED = 20180
KINDS = {"rock": (12, 13, 14, 15, 16, 14), "angular": (7, 8, 8), "rounded": (40, 40, 40)}


def make_rounded_points(rng: np.random.Generator, corners: int) -> np.ndarray:
    """Return corners (n, 3) spread evenly over a flattened ellipsoid."""
    k = np.arange(corners) + 0.5
    z = 1.0 - 2.0 * k / corners
    angle = np.pi * (1.0 + np.sqrt(5.0)) * k
    ball = np.column_stack([np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z])
    return ball * [1.0, rng.uniform(0.75, 1.0), rng.uniform(0.65, 0.9)]


if __name__ == "__main__":
    rng = np.random.default_rng(SEED)
    for kind, k, corners in [(kind, k, n) for kind, numbers in KINDS.items() for k, n in enumerate(numbers)]:
        points = make_rounded_points(rng, corners) if kind == "rounded" else sample_rock_points(rng, corners)
        shape = make_rock_shape(f"{kind}_{k}", points)
        path = Path(__file__).parent / f"{kind}_{k}.obj"
        mesh = trimesh.Trimesh(shape.vertices, shape.triangles, process=False)
        path.write_text(trimesh.exchange.obj.export_obj(mesh, include_normals=False, header=None) + "\n")
        print(f"{path.name}: {len(shape.vertices)} corners, volume {shape.volume:.3f} at sieve width 1")
