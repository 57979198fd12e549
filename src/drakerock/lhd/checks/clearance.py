"""Whether boom, bucket and linkage keep clear of each other, of the front unit and of the tyres, everywhere.

Rods, cranks and cylinders touch only what they are pinned to; so does the bucket. Drake's contact solver never sees
the machine's own parts meet (they are in one collision filter group): this check does.
"""

from __future__ import annotations

import itertools

import numpy as np
from pydrake.geometry import GeometryId
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import DiagramBuilder

from drakerock.lhd import names
from drakerock.lhd.checks.bench import Bench
from drakerock.lhd.checks.rows import CheckRow, require
from drakerock.lhd.kinematics import calc_bucket_range
from drakerock.lhd.model import Machine, add_machine
from drakerock.lhd.placement import set_machine_angles

# Parts of the linkage that stay further away than this are not worth a line [m].
_FAR = 0.5
# Angles of boom and bucket that are looked at, their stops among them.
_BOOM_ANGLES, _BUCKET_ANGLES = 24, 3
_OTHERS = ("front_unit", *names.WHEELS[:2])


def check_clearance(bench: Bench) -> list[CheckRow]:
    """Check bucket against front unit and tyres, and the linkage's parts against these three.

    The boom goes from its lowest to its highest angle, the bucket from stop to stop.
    """
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01), builder)
    machine = add_machine(plant, bench.machine.config)
    plant.Finalize()
    diagram = builder.Build()
    context = plant.GetMyMutableContextFromRoot(diagram.CreateDefaultContext())
    pairs = _find_pairs(plant, machine)
    nearest = dict.fromkeys(pairs, np.inf)
    lowest, highest = bench.kin.phi_l_grid[[-1, 0]]
    for phi_l in np.linspace(lowest, highest, _BOOM_ANGLES):
        for phi_b in np.linspace(*calc_bucket_range(bench.kin, phi_l), _BUCKET_ANGLES):
            set_machine_angles(plant, context, machine, phi_l=float(phi_l), phi_b=float(phi_b), kin=bench.kin)
            query = plant.get_geometry_query_input_port().Eval(context)
            for name, shapes in pairs.items():
                distances = (query.ComputeSignedDistancePairClosestPoints(a, b).distance for a, b in shapes)
                nearest[name] = min(nearest[name], *distances)
    bodies = [plant.get_body(index) for index in plant.GetBodyIndices(machine.instance)]
    bare = sum(not plant.GetCollisionGeometriesForBody(body) for body in bodies)
    first, *others = nearest.items()
    rows = [CheckRow("bodies without contact shapes: rocks and walls pass through", bare, "")]
    rows.append(require(first[0], float(first[1]), "m", 0.0))
    return rows + [require(name, float(distance), "m", 0.0) for name, distance in others if distance < _FAR]


def _find_pairs(plant: MultibodyPlant, machine: Machine) -> dict[str, list[tuple[GeometryId, GeometryId]]]:
    """Return the pairs of contact shapes of each line of the table."""

    def shapes(*bodies: str) -> list[GeometryId]:
        return [
            geometry
            for body in bodies
            for geometry in plant.GetCollisionGeometriesForBody(plant.GetBodyByName(body, machine.instance))
        ]

    pinned = _find_pinned(plant, machine)
    lines: dict[str, tuple[str, tuple[str, ...]]] = {
        "clearance of the bucket to tyres and front unit": ("bucket", _OTHERS)
    }
    for index in plant.GetBodyIndices(machine.instance):
        body = plant.get_body(index).name()
        if body in names.BODIES:
            continue
        choices: tuple[tuple[str, tuple[str, ...]], ...] = (
            ("the bucket", ("bucket",)),
            ("tyres and front unit", _OTHERS),
        )
        for title, others in choices:
            if not pinned[body].intersection(others):
                lines[f"clearance of {body} to {title}"] = (body, others)
    pairs = {
        title: list(itertools.product(shapes(body), shapes(*others)))
        for title, (body, others) in lines.items()
    }
    return {title: found for title, found in pairs.items() if found}


def _find_pinned(plant: MultibodyPlant, machine: Machine) -> dict[str, set[str]]:
    """Return what each body is pinned to by joints and loops; parts of a cylinder together."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(machine.instance)]
    links = [(j.parent_body().name(), j.child_body().name()) for j in joints]
    links += [(loop.body_A, loop.body_B) for loop in machine.loops]
    pinned: dict[str, set[str]] = {
        plant.get_body(index).name(): set() for index in plant.GetBodyIndices(machine.instance)
    }
    for a, b in links:
        if a in pinned and b in pinned:
            pinned[a].add(b)
            pinned[b].add(a)
    for joint in joints:
        if joint.type_name() == "prismatic":
            both = {joint.parent_body().name(), joint.child_body().name()}
            together = set().union(*(pinned[name] for name in both))
            for name in both:
                pinned[name] |= together - both
    return pinned
