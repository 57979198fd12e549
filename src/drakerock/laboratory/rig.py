"""A scene in Drake: slabs on a small plant, movers on joints with motors, rocks by `AddRocks`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    CollisionFilterDeclaration,
    GeometryId,
    GeometrySet,
    ProximityProperties,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import CoulombFriction
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JointActuator,
    PdControllerGains,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    SpatialInertia,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drakerock.errors import SimulationFailure
from drakerock.laboratory.material import Material
from drakerock.laboratory.scene import Drive, Mover, Record, Scene, Slab
from drakerock.rocks.drake.add_rocks import AddRocks
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.drake.plant_engine import AddRockBodies
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]

# A motor whose speed is given lags by this share of a step's change of it.
LAG = 0.01
# Around the scene a rock is still followed [m].
MARGIN = 5.0


class DrakeRig:
    """A `Rig` of one of drakerock's engines, the material's `dynamics.rocks`.

    Args:
        scene: the bench and its tools.
        pile: the rocks, where they start; contacts that it holds are left out, they are of another bench.
        material: what they are.
    """

    def __init__(self, scene: Scene, pile: PileState, material: Material) -> None:
        dynamics, self._material = material.dynamics, material
        builder = DiagramBuilder()
        self._plant, scene_graph = add_plant(builder, dynamics)
        plant, self._movers = self._plant, scene.movers
        if not scene.gravity:
            plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        geometries = [
            self._add_slab(plant.world_body(), slab, np.zeros(3), f"slab_{k}")
            for k, slab in enumerate(scene.slabs)
        ]
        for mover in scene.movers:
            geometries += self._add_mover(mover)
        bodies = None
        if dynamics.rocks == "plant":
            bodies = AddRockBodies(
                plant, pile, material.config, dynamics.plant, dynamics.reference_overlap, material.shapes
            )
        plant.Finalize()
        # Tools pass through the bench and each other; only rocks feel them.
        own = CollisionFilterDeclaration().ExcludeWithin(GeometrySet(geometries))
        scene_graph.collision_filter_manager().Apply(own)
        self._sources = {mover.name: self._connect(builder, mover) for mover in scene.movers}
        parts = (scene.slabs, *(mover.slabs for mover in scene.movers))
        corners = np.vstack([slab.calc_corners() for slabs in parts for slab in slabs] + [pile.p_WRs])
        lower, upper = corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN
        lower[2] = max(lower[2], scene.floor)
        self._rocks = AddRocks(
            builder, plant, scene_graph, pile, material.config, engine=bodies or dynamics.nonsmooth,
            shapes=material.shapes, bounds=(lower, upper), stiction_tolerance=dynamics.stiction_tolerance,
            visible=False,
        )  # fmt: skip
        self._simulator = Simulator(builder.Build())
        self._root = self._simulator.get_mutable_context()
        self._rocks.set_pile(self._root, replace(pile, contacts=None))
        self._steps = 0
        self._simulator.Initialize()

    def _add_slab(self, body: RigidBody, slab: Slab, origin: Array, name: str) -> GeometryId:
        settings = self._material.dynamics.plant
        properties = ProximityProperties()
        # Of two bodies Drake takes 2 a b / (a + b); the slab's is such that the pair's is the one wanted.
        rock = self._material.config.friction
        friction = slab.friction * rock / max(2.0 * rock - slab.friction, 1e-9)
        AddContactMaterial(
            dissipation=settings.dissipation,
            point_stiffness=settings.site_stiffness,
            friction=CoulombFriction(friction, friction),
            properties=properties,
        )
        if settings.contact_model == "hydroelastic":
            AddRigidHydroelasticProperties(properties)
        X_BG = RigidTransform(RollPitchYaw(0.0, slab.pitch, 0.0), np.array(slab.p) - origin)
        return self._plant.RegisterCollisionGeometry(body, X_BG, Box(*slab.size), name, properties)

    def _add_mover(self, mover: Mover) -> list[GeometryId]:
        plant = self._plant
        instance = plant.AddModelInstance(mover.name)
        plant.set_gravity_enabled(instance, False)
        body = plant.AddRigidBody(
            mover.name, instance, SpatialInertia.SolidBoxWithMass(mover.mass, 2.0, 2.0, 2.0)
        )
        pivot = np.array(mover.pivot)
        anchor = plant.AddFrame(
            FixedOffsetFrame(f"{mover.name}_pivot", plant.world_frame(), RigidTransform(pivot))
        )
        kind = RevoluteJoint if mover.joint == "turn" else PrismaticJoint
        joint = plant.AddJoint(
            kind(mover.name, anchor, body.body_frame(), np.array(mover.axis, float), damping=mover.damping)
        )
        motor: JointActuator = plant.AddJointActuator(mover.name, joint)
        if mover.drive == "speed":
            motor.set_controller_gains(PdControllerGains(p=0.0, d=mover.mass / (LAG * plant.time_step())))
        return [self._add_slab(body, slab, pivot, f"{mover.name}_{k}") for k, slab in enumerate(mover.slabs)]

    def _connect(self, builder: DiagramBuilder, mover: Mover) -> ConstantVectorSource:
        """Connect a mover's motor with what gives its speed or its force."""
        instance = self._plant.GetModelInstanceByName(mover.name)
        by_speed = mover.drive == "speed"
        source = builder.AddSystem(ConstantVectorSource(np.zeros(2 if by_speed else 1)))
        find = self._plant.get_desired_state_input_port if by_speed else self._plant.get_actuation_input_port
        builder.Connect(source.get_output_port(), find(instance))
        return source

    def _read_travels(self) -> dict[str, float]:
        context = self._plant.GetMyContextFromRoot(self._root)
        return {
            mover.name: float(
                self._plant.GetPositions(context, self._plant.GetModelInstanceByName(mover.name))[0]
            )
            for mover in self._movers
        }

    def _set_drives(self, values: Mapping[str, float]) -> None:
        for mover in self._movers:
            source = self._sources[mover.name]
            vector = source.get_mutable_source_value(source.GetMyMutableContextFromRoot(self._root))
            vector.SetAtIndex(vector.size() - 1, float(values.get(mover.name, 0.0)))

    def advance(self, duration: float, drive: Drive | None = None) -> Record:
        """Go on so long [s]; movers that the drive leaves out stand still, or have no force.

        Raises:
            SimulationFailure: the dynamics failed.
        """
        time_step = self._plant.time_step()
        context = self._rocks.GetMyContextFromRoot(self._root)
        ports = {
            mover.name: self._rocks.get_body_force_output_port(self._plant.GetBodyByName(mover.name).index())
            for mover in self._movers
        }
        rows: list[list[float]] = []
        for _ in range(round(duration / time_step)):
            travels = self._read_travels()
            self._set_drives(drive(travels) if callable(drive) else drive or {})
            self._steps += 1
            try:
                self._simulator.AdvanceTo(self._steps * time_step)
            except RuntimeError as error:
                raise SimulationFailure(
                    f"the test failed at {self._steps * time_step:.2f} s: {error}"
                ) from None
            travels = self._read_travels()
            row = [self._steps * time_step, *travels.values()]
            for port in ports.values():
                row.extend(port.Eval(context)[3:])
            rows.append(row)
        table = np.array(rows).reshape(-1, 1 + 4 * len(ports))
        names = list(ports)
        n = len(names)
        return Record(
            table[:, 0],
            {name: table[:, 1 + k] for k, name in enumerate(names)},
            {name: table[:, 1 + n + 3 * k : 4 + n + 3 * k] for k, name in enumerate(names)},
        )

    def get_pile(self) -> PileState:
        """Return where the rocks are."""
        return self._rocks.get_pile(self._root)
