"""The bucket's distance from the rest of the machine, over its whole range.

Crank, rods and cylinders have no contact shapes, so they are taken by their looks: each mesh falls into its connected
parts, each part into its convex hull.
"""

from __future__ import annotations

import numpy as np
import trimesh
from pydrake.geometry import Convex, GeometryId, Mesh, SceneGraph
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import DiagramBuilder

from drakerock.lhd import names
from drakerock.lhd.checks.bench import Bench
from drakerock.lhd.checks.rows import CheckRow, require
from drakerock.lhd.kinematics import calc_bucket_range
from drakerock.lhd.model import Machine, add_machine
from drakerock.lhd.placement import set_machine_angles

# Parts of the linkage that stay further away than this are not worth a line [m].
_FAR = 0.5


def check_clearance(bench: Bench) -> list[CheckRow]:
    """Check the bucket's clearance to tyres and front unit, and report that to the linkage's parts.

    The bucket is at its stops, full tilt and full dump, from the lowest to the highest boom.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01), builder)
    machine = add_machine(plant, bench.machine.config)
    bucket = plant.GetCollisionGeometriesForBody(plant.GetBodyByName("bucket", machine.instance))
    parts = {body.name(): _add_looks(plant, scene_graph, body) for body in _find_linkage(plant, machine)}
    others = ("front_unit", *names.WHEELS[:2])
    parts[""] = [
        g
        for name in others
        for g in plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name, machine.instance))
    ]
    plant.Finalize()
    diagram = builder.Build()
    context = plant.GetMyMutableContextFromRoot(diagram.CreateDefaultContext())
    nearest = dict.fromkeys(parts, np.inf)
    for phi_l in bench.kin.phi_l_grid:
        for phi_b in calc_bucket_range(bench.kin, phi_l):
            set_machine_angles(plant, context, machine, phi_l=float(phi_l), phi_b=float(phi_b), kin=bench.kin)
            query = plant.get_geometry_query_input_port().Eval(context)
            for name, shapes in parts.items():
                distances = [
                    query.ComputeSignedDistancePairClosestPoints(a, b).distance
                    for a in bucket
                    for b in shapes
                ]
                nearest[name] = min(nearest[name], *distances)
    rows = [require("clearance of the bucket to tyres and front unit", float(nearest.pop("")), "m", 0.0)]
    return rows + [
        CheckRow(f"clearance of the bucket to {name}, by its looks", float(distance), "m")
        for name, distance in nearest.items()
        if distance < _FAR
    ]


def _find_linkage(plant: MultibodyPlant, machine: Machine) -> list[RigidBody]:
    """Return the bodies without a name of `names` that have looks and no pin on the bucket."""
    loops = [loop for loop in machine.loops if "bucket" in (loop.body_A, loop.body_B)]
    pinned = {body for loop in loops for body in (loop.body_A, loop.body_B)}
    bodies = [plant.get_body(index) for index in plant.GetBodyIndices(machine.instance)]
    return [
        body
        for body in bodies
        if body.name() not in {*names.BODIES, *pinned} and plant.GetVisualGeometriesForBody(body)
    ]


def _add_looks(plant: MultibodyPlant, scene_graph: SceneGraph, body: RigidBody) -> list[GeometryId]:
    """Give a body contact shapes out of its visual meshes; return them."""
    inspector = scene_graph.model_inspector()
    found: list[GeometryId] = []
    for look in plant.GetVisualGeometriesForBody(body):
        shape = inspector.GetShape(look)
        if not isinstance(shape, Mesh) or not shape.source().is_path():
            continue
        mesh = trimesh.load(shape.source().path(), force="mesh", process=False)
        mesh.merge_vertices(merge_norm=True, merge_tex=True)
        labels = trimesh.graph.connected_component_labels(mesh.edges, node_count=len(mesh.vertices))
        for label in np.unique(labels):
            name = f"{inspector.GetName(look)}_{len(found)}"
            hull = Convex(mesh.vertices[labels == label].T * shape.scale3()[:, None], name)
            X_BG = inspector.GetPoseInFrame(look)
            found.append(plant.RegisterCollisionGeometry(body, X_BG, hull, name, CoulombFriction(1.0, 1.0)))
    return found
