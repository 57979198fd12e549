"""How far the machine gets into the drift's walls, rear wall and roof: from a loading's recorded poses.

    python benchmarks/walls.py run out/walls
    python benchmarks/walls.py table out/walls

`run` loads the shipped pile once with each strategy and records every step; 20 to 60 CPU seconds each. `table` takes
what `run` wrote, or folders of loadings, and prints the deepest penetration by part and wall beside the event
``wall contact`` of `outcome.json`. Penetration is the greatest depth of a corner of a part's convex contact pieces
behind a wall's plane, or inside a convex piece of the roof; tyres count as polyhedra of 24 facets.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from drakerock import get_pile, load_scenario
from drakerock.lhd.geometry import collision_pieces
from drakerock.lhd.model import add_machine
from drakerock.loading.cycle import run_cycle, save_cycle
from drakerock.loading.folder import OUTCOME, RECORDING, SCENARIO
from drakerock.loading.recording import Recording, load_recording
from drakerock.loading.scenario import Scenario
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.site import make_site

Array = NDArray[np.float64]

STRATEGIES = {"demo": (1.2, 0.9, 0.5, 0.8), "readme": (1.3, 0.85, 1.0, 0.6)}


@dataclass(frozen=True)
class Wall:
    """A convex solid: the points with ``normals @ p < offsets`` in every row.

    Attributes:
        name: of the plane or piece.
        normals: (k, 3) unit vectors out of the solid, in W.
        offsets: (k,) [m].
    """

    name: str
    normals: Array
    offsets: Array


@dataclass(frozen=True)
class Penetration:
    """The deepest of one part in one wall.

    Attributes:
        part: body of the machine.
        wall: what it gets into.
        depth: [m].
        time: when [s].
        duration: how long it is in the wall, all in all [s].
    """

    part: str
    wall: str
    depth: float
    time: float
    duration: float


def make_walls(scenario: Scenario) -> list[Wall]:
    """Return the site's solids but for the floor."""
    site = make_site(scenario.site)
    walls = [
        Wall(plane.name, plane.normal[None], np.array([plane.offset]))
        for plane in site.planes
        if plane.name != "floor"
    ]
    for piece in site.pieces:
        faces = ConvexHull(piece.vertices).equations
        walls.append(Wall(piece.name, faces[:, :3], -faces[:, 3]))
    return walls


def read_corners(scenario: Scenario) -> dict[str, Array]:
    """Return the corners (k, 3) of each body's contact pieces in its frame [m]."""
    plant, scene_graph = add_plant(DiagramBuilder(), scenario.dynamics)
    machine = add_machine(plant, scenario.machine)
    plant.Finalize()
    return {
        body: np.vstack([piece.vertices for piece in pieces])
        for body, pieces in collision_pieces(plant, scene_graph, machine).items()
    }


def calc_depth(p_WCs: Array, wall: Wall) -> Array:
    """Return how deep each corner p_WCs (..., 3) [m] is in the wall [m]; negative outside."""
    return (wall.offsets - p_WCs @ wall.normals.T).min(axis=-1)


def find_penetrations(
    recording: Recording, corners: dict[str, Array], walls: list[Wall]
) -> list[Penetration]:
    """Return what got into a wall, the deepest first."""
    step = float(np.median(np.diff(recording.times)))
    found = []
    for body, p_BCs in corners.items():
        poses = recording.X_WBs[:, recording.bodies.index(body)].astype(float)
        R_WBs = Rotation.from_quat(poses[:, :4], scalar_first=True).as_matrix()
        p_WCs = np.einsum("fij,cj->fci", R_WBs, p_BCs) + poses[:, None, 4:]
        for wall in walls:
            depth = calc_depth(p_WCs, wall).max(axis=1)
            deepest = int(depth.argmax())
            if depth[deepest] > 0.0:
                time, duration = float(recording.times[deepest]), step * int((depth > 0.0).sum())
                found.append(Penetration(body, wall.name, float(depth[deepest]), time, duration))
    return sorted(found, key=lambda item: -item.depth)


def run(out: Path) -> None:
    """Load the shipped pile with each strategy."""
    for name, strategy in STRATEGIES.items():
        values = zip(("alpha", "beta", "gamma", "kappa"), strategy, strict=True)
        overrides = [f"loading.strategy.{key}={value}" for key, value in values]
        scenario = load_scenario(None, [*overrides, "recording.frame_rate=100"])
        result = run_cycle(scenario, get_pile(scenario))
        save_cycle(result, out / name)
        outcome = result.outcome
        print(
            f"{name}: {outcome.reason}, {outcome.bucket_mass_kg:.0f} kg, {outcome.cpu_time_s:.0f} CPU s",
            flush=True,
        )


def table(folders: list[Path]) -> None:
    """Print a line per part and wall of each loading, and its wall contacts."""
    for folder in folders:
        scenario = Scenario.model_validate(json.loads((folder / SCENARIO).read_text()))
        outcome = json.loads((folder / OUTCOME).read_text())
        recording = load_recording(folder / RECORDING)
        print(f"{folder.name}: {len(recording.times)} frames of {recording.times[-1]:.1f} s")
        for item in find_penetrations(recording, read_corners(scenario), make_walls(scenario)):
            print(
                f"  {item.part:<24} in {item.wall:<12} {1e3 * item.depth:8.2f} mm at {item.time:6.2f} s, "
                f"{item.duration:6.2f} s in all"
            )
        for event in outcome["events"]:
            if event["event"] == "wall contact":
                print(
                    f"  event: {event['part']} with {event['force_N'] / 1e3:.0f} kN, from {event['time_s']:.2f} s "
                    f"for {event['duration_s']:.2f} s"
                )


def main() -> None:
    """Run what the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("run").add_argument("out", type=Path)
    commands.add_parser("table").add_argument(
        "folders", type=Path, nargs="+", help="of `run`, or of loadings"
    )
    args = parser.parse_args()
    if args.command == "run":
        run(args.out)
    else:
        table([found for folder in args.folders for found in find_loadings(folder)])


def find_loadings(folder: Path) -> list[Path]:
    """Return the folder if it is a loading's, otherwise the loadings in it."""
    if (folder / OUTCOME).exists():
        return [folder]
    return sorted(path.parent for path in folder.glob(f"*/{OUTCOME}"))


if __name__ == "__main__":
    main()
