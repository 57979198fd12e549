"""Small scenes for the tests of the rock engine."""

from __future__ import annotations

import numpy as np
import trimesh
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from drakerock.rocks.config import RocksConfig, SiteConfig
from drakerock.rocks.drake.add_rocks import AddRocks
from drakerock.rocks.drake.drift import AddDrift
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.engine.config import DynamicsConfig, NonsmoothConfig
from drakerock.rocks.engine.engine import MachineStep, NonsmoothEngine, RockArrays, StepReport
from drakerock.rocks.engine.records import MACHINE_ROW
from drakerock.rocks.engine.solve.machine_rows import MachineArrays
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.site import Plane, Site, calc_bounds, make_surroundings
from drakerock.rocks.state import PileState


def make_shape(mesh: trimesh.Trimesh, name: str = "shape") -> RockShape:
    """A convex mesh about its centre of mass, not scaled."""
    mesh = mesh.convex_hull
    mesh.apply_translation(-mesh.center_mass)
    mesh.density = 1.0
    return RockShape(
        name,
        np.asarray(mesh.vertices),
        np.asarray(mesh.faces, np.int64),
        float(mesh.volume),
        np.asarray(mesh.moment_inertia),
    )


def make_box(x: float, y: float, z: float) -> RockShape:
    return make_shape(trimesh.creation.box((x, y, z)), "box")


def make_ball() -> RockShape:
    """A polyhedron near a ball of diameter 1."""
    return make_shape(trimesh.creation.icosphere(subdivisions=2, radius=0.5), "ball")


def make_plane_site(friction: float = 1.125, slope: float = 0.0, planes: int = 1) -> Site:
    """A floor, inclined by `slope` [rad] down along +x; with planes=5 also four walls at +-10 m."""
    floor = Plane("floor", np.array([np.sin(slope), 0.0, np.cos(slope)]), 0.0)
    walls = [
        Plane("wall_0", np.array([1.0, 0, 0]), -10.0),
        Plane("wall_1", np.array([-1.0, 0, 0]), -10.0),
        Plane("wall_2", np.array([0, 1.0, 0]), -10.0),
        Plane("wall_3", np.array([0, -1.0, 0]), -10.0),
    ]
    config = SiteConfig(
        friction=friction, drift_width=30.0, drift_length=100.0, void_depth=50.0, void_height=60.0
    )
    return Site(config, (floor, *walls)[:planes], ())


def make_pile(positions, shape=None, size=None, quaternions=None, velocities=None, fixed=None) -> PileState:
    positions = np.atleast_2d(np.asarray(positions, float))
    n = len(positions)
    if quaternions is None:
        quaternions = np.tile([1.0, 0, 0, 0], (n, 1))
    return PileState(
        positions,
        np.asarray(quaternions, float),
        np.zeros((n, 6)) if velocities is None else np.asarray(velocities, float),
        np.zeros(n, np.int64) if shape is None else np.asarray(shape, np.int64),
        np.ones(n) if size is None else np.asarray(size, float),
        np.zeros(n, bool) if fixed is None else np.asarray(fixed, bool),
    )


def make_engine(
    pile: PileState,
    shapes,
    site: Site | None = None,
    rocks: RocksConfig | None = None,
    config: NonsmoothConfig | None = None,
    time_step: float = 0.01,
    **options,
) -> NonsmoothEngine:
    return NonsmoothEngine(
        rocks or RocksConfig(),
        shapes,
        make_surroundings(site or make_plane_site()),
        config or NonsmoothConfig(reduction="none"),
        time_step,
        pile.shape,
        pile.size,
        pile.fixed,
        **options,
    )


def make_rock_diagram(pile: PileState, shapes, site: Site, config: NonsmoothConfig | None = None):
    """A Diagram with rocks on a site and nothing that moves but them; and their system."""
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, DynamicsConfig())
    AddDrift(plant, site)
    plant.Finalize()
    rocks = AddRocks(
        builder, plant, scene_graph, pile,
        engine=config or NonsmoothConfig(reduction="none"), shapes=shapes, bounds=calc_bounds(site.config),
    )  # fmt: skip
    return builder.Build(), rocks


def make_machine_step(X_WBs, velocity, jacobian, response) -> MachineStep:
    """A machine of b bodies with v velocities, without rows or sensors of its own."""
    v = len(velocity)
    return MachineStep(
        X_WBs,
        velocity,
        np.zeros(v),
        MachineArrays(
            jacobian,
            response,
            jacobian @ response,
            np.zeros((0, v)),
            np.zeros((0, v)),
            np.zeros(0, MACHINE_ROW),
        ),
        np.zeros((0, 18)),
    )


def run(engine: NonsmoothEngine, arrays: RockArrays, time: float) -> tuple[RockArrays, StepReport]:
    report = None
    for _ in range(round(time / engine.time_step)):
        arrays, report = engine.advance(arrays)
    return arrays, report


def draw_quaternion(rng: np.random.Generator) -> np.ndarray:
    return Rotation.random(random_state=int(rng.integers(2**31))).as_quat(scalar_first=True)
