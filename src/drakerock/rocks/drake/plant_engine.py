"""Rocks as free bodies of the plant: the engine that is the plant itself, for small piles and as a reference."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    GeometryId,
    GeometryInstance,
    ProximityProperties,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactResults, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RotationalInertia, SpatialInertia
from pydrake.systems.framework import Context, DiscreteValues, EventStatus

from drakerock.errors import InputError, SimulationFailure
from drakerock.memory import weak
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.drake.drift import make_convex
from drakerock.rocks.drake.interface import ROCK_SUMMARY, RockContacts, RockSystem, make_empty_contacts
from drakerock.rocks.drake.poses import make_pose
from drakerock.rocks.drake.scene import make_illustration, make_perception
from drakerock.rocks.engine.config import PlantEngineConfig
from drakerock.rocks.engine.motion import HUGE
from drakerock.rocks.materials import calc_spring_stiffness
from drakerock.rocks.shapes import RockShape, load_rock_shapes
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RockBodies:
    """The rocks that `AddRockBodies` put into a plant.

    Attributes:
        pile: the rocks.
        shapes: their shapes.
        geometries: the collision geometry of each.
    """

    pile: PileState
    shapes: tuple[RockShape, ...]
    geometries: tuple[GeometryId, ...]


def AddRockBodies(
    plant: MultibodyPlant,
    pile: PileState,
    rocks: RocksConfig | None = None,
    config: PlantEngineConfig | None = None,
    reference_overlap: float = 1e-3,
    shapes: tuple[RockShape, ...] | None = None,
) -> RockBodies:
    """Add one body per rock to `plant` (before Finalize); all fixed rocks are on one that is welded to the world.

    What rocks lie on wants a contact material with a dissipation like theirs (1 s/m); with Drake's default they sink.

    The plant's output ports are no longer sampled then (`SetUseSampledOutputPorts`): what the rocks' ports say of the
    coming step is not in them otherwise.

    On the world's own body hundreds of them beside the floor, a half-space whose box has no bounds, make Drake read
    stray memory (1.58: a segmentation fault when they are registered).

    Args:
        plant: not finalized, with a SceneGraph.
        pile: the rocks; they start there.
        rocks: shapes and material.
        config: contact model.
        reference_overlap: at which the contact stiffness is taken [m].
        shapes: the rock shapes, if not those of `rocks.shapes`.

    Returns:
        What `AddRocks` is to be given as its engine.

    Raises:
        InputError: the plant is finalized already, or a rock mesh cannot be used.
    """
    if plant.is_finalized():
        raise InputError("AddRockBodies: the plant is finalized; add rocks as bodies before Finalize()")
    rocks, config = rocks or RocksConfig(), config or PlantEngineConfig()
    shapes = shapes or load_rock_shapes(rocks)
    # Its contacts are then those of the step that begins.
    plant.SetUseSampledOutputPorts(False)
    instance = plant.AddModelInstance("rocks")
    kinds = {
        (shape, size): _make_kind(shapes[shape], size, rocks, config, reference_overlap)
        for shape, size in sorted({(int(k), float(s)) for k, s in zip(pile.shape, pile.size, strict=True)})
    }
    if pile.fixed.any():
        solid = plant.AddRigidBody("fixed_rocks", instance, SpatialInertia.Zero())
        plant.WeldFrames(plant.world_frame(), solid.body_frame())
    geometries = []
    for rock in range(len(pile)):
        inertia, convex, properties = kinds[int(pile.shape[rock]), float(pile.size[rock])]
        name = _name(rock)
        X_WR = make_pose(pile.q_WRs[rock], pile.p_WRs[rock])
        X_BG = X_WR if pile.fixed[rock] else RigidTransform()
        body = solid if pile.fixed[rock] else plant.AddRigidBody(name, instance, inertia)
        if not pile.fixed[rock]:
            plant.SetDefaultFloatingBaseBodyPose(body, X_WR)
        geometries.append(plant.RegisterCollisionGeometry(body, X_BG, convex, name, properties))
        look = GeometryInstance(X_BG, convex, f"{name}_look")
        look.set_illustration_properties(make_illustration(bool(pile.fixed[rock])))
        look.set_perception_properties(make_perception(rock, bool(pile.fixed[rock])))
        plant.RegisterVisualGeometry(body, look)
    return RockBodies(pile, shapes, tuple(geometries))


def _make_kind(
    shape: RockShape, size: float, rocks: RocksConfig, config: PlantEngineConfig, reference_overlap: float
) -> tuple[SpatialInertia, object, ProximityProperties]:
    volume = shape.volume * size**3
    tensor = rocks.density * size**5 * shape.inertia
    inertia = SpatialInertia.MakeFromCentralInertia(
        rocks.density * volume,
        np.zeros(3),
        RotationalInertia(*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]),
    )
    # Drake puts the two bodies' stiffnesses in series.
    stiffness = calc_spring_stiffness(rocks.elastic_modulus, rocks.poisson_ratio, volume, reference_overlap)
    properties = ProximityProperties()
    AddContactMaterial(
        dissipation=config.dissipation,
        point_stiffness=stiffness,
        friction=CoulombFriction(rocks.friction, rocks.friction),
        properties=properties,
    )
    if config.contact_model == "hydroelastic":
        AddCompliantHydroelasticProperties(
            # Drake wants a hint, and does without it for convex shapes.
            resolution_hint=0.5 * size,
            hydroelastic_modulus=config.hydroelastic_modulus,
            properties=properties,
        )
    return inertia, make_convex(shape.vertices, shape.name, size), properties


class PlantRocks(RockSystem):
    """Shows the rocks that are bodies of a plant.

    Input ports:
        ``state``: the plant's whole state.
        ``contact_results``, ``body_poses``: the plant's contact results and body poses.

    Output ports: those of `RockSystem`.

    After every step, before anything else looks at it, the plant's state is checked: Drake's proximity engine does
    not survive poses that are not finite. SimulationFailure is raised then.
    """

    def __init__(self, plant: MultibodyPlant, bodies: RockBodies, touching: tuple[BodyIndex, ...]) -> None:
        """Make the view of the rocks `bodies` in the finalized `plant`; `touching` bodies may meet them."""
        pile = bodies.pile
        super().__init__(plant, pile, bodies.shapes, touching)
        self._free = np.flatnonzero(~pile.fixed)
        free = [plant.GetBodyByName(_name(int(rock))) for rock in self._free]
        self._q = np.array([body.floating_positions_start() for body in free], int)
        self._v = (
            np.array([body.floating_velocities_start_in_v() for body in free], int) + plant.num_positions()
        )
        # By the ids' values: ids from the plant would keep the Diagram alive (`drakerock.memory`).
        self._rock_of = {geometry.get_value(): rock for rock, geometry in enumerate(bodies.geometries)}
        self._number = {int(index): k for k, index in enumerate(touching)}
        self._body_of = {
            geometry.get_value(): int(index)
            for index in map(BodyIndex, range(plant.num_bodies()))
            for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(index))
        }
        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self._results = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self._body_poses = self.DeclareAbstractInputPort("body_poses", Value([RigidTransform()]))
        report = self.DeclareDiscreteState(np.zeros(len(ROCK_SUMMARY) + 6 * len(touching)))
        self._report = report
        self._declare_outputs(self.discrete_state_ticket(report), self._state.ticket())
        self.DeclareAbstractOutputPort(
            "contacts", lambda: Value[object](make_empty_contacts()), weak(self._calc_contacts)
        )
        self.DeclarePeriodicDiscreteUpdateEvent(plant.time_step(), 0.0, self._update)
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
        own = self.GetMyMutableContextFromRoot(root_context)
        own.get_mutable_discrete_state(self._report).SetFromVector(
            np.zeros(len(ROCK_SUMMARY) + 6 * len(self._bodies))
        )

    def get_pile(self, root_context: Context) -> PileState:
        """Read the rocks' present state; this engine keeps no contacts."""
        return self._make_pile(
            self._plant.GetPositionsAndVelocities(self._plant.GetMyContextFromRoot(root_context))
        )

    def _read_pile(self, context: Context) -> PileState:
        return self._make_pile(self._state.Eval(context))

    def _make_pile(self, state: Array) -> PileState:
        pile = self._default_pile
        q_WRs, p_WRs, V_WRs = pile.q_WRs.copy(), pile.p_WRs.copy(), np.zeros((len(pile), 6))
        poses = state[self._q[:, None] + np.arange(7)]
        q_WRs[self._free] = poses[:, :4] / np.linalg.norm(poses[:, :4], axis=1)[:, None]
        p_WRs[self._free] = poses[:, 4:]
        V_WRs[self._free] = state[self._v[:, None] + np.arange(6)]
        return replace(pile, p_WRs=p_WRs, q_WRs=q_WRs, V_WRs=V_WRs, contacts=None)

    def _read_report(self, context: Context) -> Array:
        return np.array(context.get_discrete_state(self._report).value())

    def _update(self, context: Context, discrete: DiscreteValues) -> EventStatus:
        found = self._find_contacts(context)
        depths = found.depth
        deepest, depth_99 = (
            (float(depths.max()), float(np.percentile(depths, 99))) if len(found) else (0.0, 0.0)
        )
        forces = np.zeros((len(self._bodies), 6))
        poses = self._body_poses.Eval(context)
        for k in np.flatnonzero(found.body >= 0):
            number = self._number.get(int(found.body[k]))
            if number is not None:
                f, arm = found.f_WCs[k], found.p_WCs[k] - poses[int(found.body[k])].translation()
                forces[number] += np.concatenate([found.t_WCs[k] + np.cross(arm, f), f])
        summary = [len(self._free), len(found), deepest, depth_99, 0.0, 0.0, 0.0]
        discrete.get_mutable_vector(self._report).SetFromVector([*summary, *forces.ravel()])
        return EventStatus.Succeeded()

    def _calc_contacts(self, context: Context, output: Value) -> None:
        output.set_value(self._find_contacts(context))

    def _find_contacts(self, context: Context) -> RockContacts:
        """Return the contacts of rocks over the coming step; a hydroelastic surface is a point at its centroid."""
        results = self._results.Eval(context)
        rows: list[tuple[int, int, int, Array, Array, Array, float]] = []
        for k in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(k)
            pair = info.point_pair()
            # contact_force() is the force on body B.
            force = np.concatenate([np.zeros(3), info.contact_force()])
            self._add_row(rows, pair.id_A, pair.id_B, info.contact_point(), force, pair.depth)
        for k in range(results.num_hydroelastic_contacts()):
            info = results.hydroelastic_contact_info(k)
            surface = info.contact_surface()
            # F_Ac_W() is the force on the body of geometry M, at the surface's centroid.
            force = np.concatenate([info.F_Ac_W().rotational(), info.F_Ac_W().translational()])
            self._add_row(rows, surface.id_N(), surface.id_M(), surface.centroid(), force, 0.0)
        if not rows:
            return make_empty_contacts()
        return RockContacts(*(np.array(column) for column in zip(*rows, strict=True)))

    def _add_row(
        self,
        rows: list[tuple[int, int, int, Array, Array, Array, float]],
        first: GeometryId,
        second: GeometryId,
        p_WC: Array,
        force: Array,
        depth: float,
    ) -> None:
        """Add a contact with spatial force (6,) on the second, if a rock has part in it."""
        rock, other = self._rock_of.get(first.get_value()), self._rock_of.get(second.get_value())
        if rock is None:
            first, second, rock, other, force = second, first, other, rock, -force
        if rock is None:
            return
        body = -1 if other is not None else self._body_of[second.get_value()]
        if body >= 0 and body not in self._number:
            body = 0
        rows.append((rock, -1 if other is None else other, body, p_WC, force[3:], force[:3], depth))


def _name(rock: int) -> str:
    return f"rock_{rock}"
