"""Writes the six rock meshes beside this file, `python make_rocks.py`. Same seed, same rocks."""

from pathlib import Path

import numpy as np
import trimesh

from drakerock.rocks.shapes import make_rock_shape, sample_rock_points

SEED = 20180
CORNERS = (12, 13, 14, 15, 16, 14)

if __name__ == "__main__":
    rng = np.random.default_rng(SEED)
    for k, corners in enumerate(CORNERS):
        shape = make_rock_shape(f"rock_{k}", sample_rock_points(rng, corners))
        path = Path(__file__).parent / f"rock_{k}.obj"
        mesh = trimesh.Trimesh(shape.vertices, shape.triangles, process=False)
        path.write_text(trimesh.exchange.obj.export_obj(mesh, include_normals=False, header=None) + "\n")
        print(f"{path.name}: {len(shape.vertices)} corners, volume {shape.volume:.3f} at sieve width 1")
