"""Rocks as free bodies of the machine's plant."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    GeometryId,
    ProximityProperties,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactResults, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import RotationalInertia, SpatialInertia
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem

from drakerock.errors import SimulationFailure
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.drake.assembly import make_convex, make_pose
from drakerock.rocks.drake.interface import ROCK_SUMMARY
from drakerock.rocks.engine.config import DynamicsConfig
from drakerock.rocks.engine.motion import HUGE
from drakerock.rocks.materials import calc_spring_stiffness
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]


def add_rock_bodies(
    plant: MultibodyPlant,
    pile: PileState,
    shapes: tuple[RockShape, ...],
    rocks: RocksConfig,
    dynamics: DynamicsConfig,
) -> list[GeometryId]:
    """Add one body per rock to `plant` (before Finalize); all fixed rocks are on one that is welded to the world.

    On the world's own body hundreds of them beside the floor, a half-space whose box has no bounds, make Drake read
    stray memory (1.58: a segmentation fault when they are registered).

    Returns:
        The collision geometry of each rock.
    """
    instance = plant.AddModelInstance("rocks")
    kinds = {
        (shape, size): _make_kind(shapes[shape], size, rocks, dynamics)
        for shape, size in sorted({(int(k), float(s)) for k, s in zip(pile.shape, pile.size, strict=True)})
    }
    if pile.fixed.any():
        solid = plant.AddRigidBody("fixed_rocks", instance, SpatialInertia.Zero())
        plant.WeldFrames(plant.world_frame(), solid.body_frame())
    geometries = []
    for rock in range(len(pile)):
        inertia, convex, properties = kinds[int(pile.shape[rock]), float(pile.size[rock])]
        name = _name(rock)
        if pile.fixed[rock]:
            X_WR = make_pose(pile.q_WRs[rock], pile.p_WRs[rock])
            body = solid
        else:
            X_WR = RigidTransform()
            body = plant.AddRigidBody(name, instance, inertia)
        geometries.append(plant.RegisterCollisionGeometry(body, X_WR, convex, name, properties))
    return geometries


def _make_kind(
    shape: RockShape, size: float, rocks: RocksConfig, dynamics: DynamicsConfig
) -> tuple[SpatialInertia, object, ProximityProperties]:
    volume = shape.volume * size**3
    tensor = rocks.density * size**5 * shape.inertia
    inertia = SpatialInertia.MakeFromCentralInertia(
        rocks.density * volume,
        np.zeros(3),
        RotationalInertia(*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]),
    )
    # Drake puts the two bodies' stiffnesses in series.
    stiffness = calc_spring_stiffness(
        rocks.elastic_modulus, rocks.poisson_ratio, volume, dynamics.reference_overlap
    )
    properties = ProximityProperties()
    AddContactMaterial(
        dissipation=dynamics.plant.dissipation,
        point_stiffness=stiffness,
        friction=CoulombFriction(rocks.friction, rocks.friction),
        properties=properties,
    )
    if dynamics.plant.contact_model == "hydroelastic":
        AddCompliantHydroelasticProperties(
            resolution_hint=dynamics.plant.hydroelastic_resolution * size,
            hydroelastic_modulus=dynamics.plant.hydroelastic_modulus,
            properties=properties,
        )
    return inertia, make_convex(shape.vertices, shape.name, size), properties


class PlantRocks(LeafSystem):
    """Shows the rocks of a plant by the interface that both engines share (`RockSystem`).

    Input ports:
        ``state``: the plant's whole state.
        ``contact_results``, ``body_poses``: the plant's contact results and body poses.

    Output ports: those of `RockSystem`.

    After every step, before anything else looks at it, the plant's state is checked: Drake's proximity engine does
    not survive poses that are not finite. SimulationFailure is raised then.
    """

    def __init__(self, plant: MultibodyPlant, pile: PileState, geometries: list[GeometryId]) -> None:
        """Make the view of `pile`'s rocks in the finalized `plant`; `geometries` as `add_rock_bodies` gave."""
        super().__init__()
        self.set_name("rocks")
        self._plant = plant
        self._pile = pile
        self._free = np.flatnonzero(~pile.fixed)
        bodies = [plant.GetBodyByName(_name(int(rock))) for rock in self._free]
        self._q = np.array([body.floating_positions_start() for body in bodies], int)
        self._v = (
            np.array([body.floating_velocities_start_in_v() for body in bodies], int) + plant.num_positions()
        )
        self._rock_geometries = frozenset(geometry.get_value() for geometry in geometries)
        bucket = plant.GetBodyByName("bucket") if plant.HasBodyNamed("bucket") else None
        # Numbers: a body, or a geometry's id from the plant, would keep the Diagram alive (`drakerock.memory`).
        self._bucket = None if bucket is None else int(bucket.index())
        bucket_geometries = plant.GetCollisionGeometriesForBody(bucket) if bucket else []
        self._bucket_geometries = frozenset(geometry.get_value() for geometry in bucket_geometries)
        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self._contacts = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self._machine_poses = self.DeclareAbstractInputPort("body_poses", Value([RigidTransform()]))
        n = len(pile)
        state_only = {self._state.ticket()}
        self.DeclareVectorOutputPort("rock_poses", 7 * n, self._calc_poses, state_only)
        self.DeclareVectorOutputPort("rock_velocities", 6 * n, self._calc_velocities, state_only)
        self.DeclareVectorOutputPort("rock_summary", len(ROCK_SUMMARY), self._calc_summary)
        self.DeclareVectorOutputPort("F_B_W", 6, self._calc_bucket_force)
        # Publish events come in the order of the systems: this one before those of the logs.
        self.DeclarePerStepPublishEvent(self._check)

    def _check(self, context: Context) -> None:
        if not (np.abs(self._state.Eval(context)) < HUGE).all():
            raise SimulationFailure("rocks: positions or velocities that are not finite")

    def set_pile(self, root_context: Context, pile: PileState) -> None:
        """Write poses and velocities of the free rocks into the plant's context."""
        context = self._plant.GetMyMutableContextFromRoot(root_context)
        state = np.array(self._plant.GetPositionsAndVelocities(context))
        state[self._q[:, None] + np.arange(7)] = np.hstack([pile.q_WRs, pile.p_WRs])[self._free]
        state[self._v[:, None] + np.arange(6)] = pile.V_WRs[self._free]
        self._plant.SetPositionsAndVelocities(context, state)

    def get_pile(self, root_context: Context) -> PileState:
        """Read the rocks' present state."""
        state = self._plant.GetPositionsAndVelocities(self._plant.GetMyContextFromRoot(root_context))
        poses, velocities = self._gather(state)
        return PileState(
            p_WRs=poses[:, 4:],
            q_WRs=poses[:, :4] / np.linalg.norm(poses[:, :4], axis=1)[:, None],
            V_WRs=velocities,
            shape=self._pile.shape,
            size=self._pile.size,
            fixed=self._pile.fixed,
            provenance=dict(self._pile.provenance),
        )

    def _gather(self, state: Array) -> tuple[Array, Array]:
        poses = np.hstack([self._pile.q_WRs, self._pile.p_WRs])
        velocities = np.zeros((len(self._pile), 6))
        poses[self._free] = state[self._q[:, None] + np.arange(7)]
        velocities[self._free] = state[self._v[:, None] + np.arange(6)]
        return poses, velocities

    def _calc_poses(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._gather(self._state.Eval(context))[0].ravel())

    def _calc_velocities(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._gather(self._state.Eval(context))[1].ravel())

    def _calc_summary(self, context: Context, output: BasicVector) -> None:
        results = self._contacts.Eval(context)
        depths = [
            results.point_pair_contact_info(k).point_pair().depth
            for k in range(results.num_point_pair_contacts())
        ]
        count = len(depths) + results.num_hydroelastic_contacts()
        depth_max, depth_99 = (max(depths), float(np.percentile(depths, 99))) if depths else (0.0, 0.0)
        output.SetFromVector([len(self._free), count, depth_max, depth_99, 0.0, 0.0, 0.0])

    def _calc_bucket_force(self, context: Context, output: BasicVector) -> None:
        total = np.zeros(6)
        if self._bucket is not None:
            results = self._contacts.Eval(context)
            p_WB = self._machine_poses.Eval(context)[self._bucket].translation()
            for k in range(results.num_point_pair_contacts()):
                info = results.point_pair_contact_info(k)
                pair = info.point_pair()
                # contact_force() is the force on body B.
                side = self._find_side(pair.id_B, pair.id_A)
                if side:
                    force = side * info.contact_force()
                    total += np.concatenate([np.cross(info.contact_point() - p_WB, force), force])
            for k in range(results.num_hydroelastic_contacts()):
                info = results.hydroelastic_contact_info(k)
                surface = info.contact_surface()
                # F_Ac_W() is the force on the body of geometry M, at the surface's centroid.
                side = self._find_side(surface.id_M(), surface.id_N())
                if not side:
                    continue
                force = side * info.F_Ac_W().translational()
                arm = surface.centroid() - p_WB
                total += np.concatenate([side * info.F_Ac_W().rotational() + np.cross(arm, force), force])
        output.SetFromVector(total)

    def _find_side(self, first: GeometryId, second: GeometryId) -> float:
        """Return 1 if `first` is the bucket and `second` a rock, -1 the other way round, else 0."""
        one, other = first.get_value(), second.get_value()
        if one in self._bucket_geometries and other in self._rock_geometries:
            return 1.0
        if other in self._bucket_geometries and one in self._rock_geometries:
            return -1.0
        return 0.0


def add_plant_rocks(
    builder: DiagramBuilder, plant: MultibodyPlant, pile: PileState, geometries: list[GeometryId]
) -> PlantRocks:
    """Add the view of the rocks that `add_rock_bodies` put into the plant, and connect it (after Finalize)."""
    system = builder.AddSystem(PlantRocks(plant, pile, geometries))
    builder.Connect(plant.get_state_output_port(), system.GetInputPort("state"))
    builder.Connect(plant.get_contact_results_output_port(), system.GetInputPort("contact_results"))
    builder.Connect(plant.get_body_poses_output_port(), system.GetInputPort("body_poses"))
    return system


def _name(rock: int) -> str:
    return f"rock_{rock}"
