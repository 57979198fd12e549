"""A test bench: the machine alone on a floor, with what a check needs beside it, and its motion recorded."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from pydantic import Field
from pydrake.common.value import Value
from pydrake.geometry import AddContactMaterial, Box, ProximityProperties, SceneGraph, Shape
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    ContactResults,
    CoulombFriction,
    ExternallyAppliedSpatialForce,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import RigidBody, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from shapely import Polygon

from drakerock.config import Config
from drakerock.errors import SimulationFailure
from drakerock.lhd import names
from drakerock.lhd.config import MachineConfig
from drakerock.lhd.geometry import BucketGeometry, calc_area, make_bucket_geometry, read_profile
from drakerock.lhd.hinge import HingeMoment, add_hinge_moment
from drakerock.lhd.kinematics import Kinematics, make_kinematics
from drakerock.lhd.linkage import Linkage
from drakerock.lhd.model import Machine, add_machine
from drakerock.lhd.motors import Motors, add_motors

Array = np.ndarray

_HALF_FLOOR = (60.0, 20.0, 5.0)


class CheckConfig(Config):
    """The bench on which the machine is checked."""

    time_step: float = Field(default=0.01, gt=0, description="of the plant [s]")
    contact_approximation: str = Field(default="lagged", pattern="^(lagged|similar|sap)$")
    floor_friction: float = Field(default=1.125, gt=0, description="of the floor; tyres bring their own")
    floor_stiffness: float = Field(default=1e10, gt=0, description="of floor and obstacles [N/m]")
    floor_dissipation: float = Field(default=1.0, ge=0, description="of floor and obstacles [s/m]")


@dataclass(frozen=True)
class Obstacle:
    """A fixed obstacle: `shape` at `p_WO` (3,) [m] with friction `mu`."""

    shape: Shape
    p_WO: tuple[float, float, float]
    mu: float


@dataclass
class Bench:
    """The machine on the bench."""

    plant: MultibodyPlant
    scene_graph: SceneGraph
    machine: Machine
    motors: Motors
    kin: Kinematics
    bucket: BucketGeometry
    hinge: HingeMoment
    simulator: Simulator
    context: Context
    linkage: Linkage

    @property
    def plant_context(self) -> Context:
        """The plant's context."""
        return self.plant.GetMyMutableContextFromRoot(self.context)

    def get_body(self, name: str) -> RigidBody:
        """Return a body of the machine."""
        return self.plant.GetBodyByName(name, self.machine.instance)

    def get_positions(self) -> tuple[float, float]:
        """Return (phi_l, phi_b) [rad]."""
        return tuple(  # type: ignore[return-value]
            self.plant.GetJointByName(name, self.machine.instance).get_angle(self.plant_context)
            for name in ("boom_joint", "bucket_joint")
        )

    def apply_force(self, body: str, p_BQ: Array, force: Array) -> None:
        """Apply a constant force [N, world] at a point of a body [m, body frame] from now on."""
        load = ExternallyAppliedSpatialForce()
        load.body_index = self.get_body(body).index()
        load.p_BoBq_B = np.asarray(p_BQ, dtype=float)
        load.F_Bq_W = SpatialForce(tau=np.zeros(3), f=np.asarray(force, dtype=float))
        self.plant.get_applied_spatial_force_input_port().FixValue(self.plant_context, Value([load]))

    def run(self, duration: float, *, wheel: float = 0.0, boom: float = 0.0, bucket: float = 0.0) -> Record:
        """Run with constant motor targets [rad/s] for `duration` [s] and record every step.

        Raises:
            SimulationFailure: a step could not be solved.
        """
        plant, machine = self.plant, self.machine
        context, root = self.plant_context, self.context
        self.motors.GetInputPort("motor_speeds").FixValue(
            self.motors.GetMyMutableContextFromRoot(root), np.array([wheel, boom, bucket])
        )
        motors_context, hinge_context = (
            self.motors.GetMyContextFromRoot(root),
            self.hinge.GetMyContextFromRoot(root),
        )
        steps = round(duration / plant.time_step())
        start = round(root.get_time() / plant.time_step())
        columns: dict[str, list[object]] = {key: [] for key in Record.__dataclass_fields__}
        tip = plant.GetFrameByName("tip", machine.instance)
        wall = 0.0
        for k in range(1, steps + 1):
            begin = perf_counter()
            try:
                # What acts over the step is told at its beginning.
                torques = self.motors.GetOutputPort("motor_torques").Eval(motors_context).copy()
                columns["effort"].append(torques)
                columns["moment"].append(self.hinge.GetOutputPort("components").Eval(hinge_context).copy())
                columns["tyre_force"].append(self._calc_contact_forces(names.WHEELS))
                columns["bucket_force"].append(self._calc_contact_forces(("bucket",))[0])
                self.simulator.AdvanceTo((start + k) * plant.time_step())
            except RuntimeError as error:
                raise SimulationFailure(f"{machine.config.model}: the bench's step failed: {error}") from None
            wall += perf_counter() - begin
            columns["time"].append(root.get_time())
            columns["q"].append(plant.GetPositions(context, machine.instance))
            columns["v"].append(plant.GetVelocities(context, machine.instance))
            columns["gap"].append(np.linalg.norm(self.linkage.calc_gap(), axis=1).max(initial=0.0))
            columns["tip"].append(tip.CalcPoseInWorld(context).translation())
            columns["wall"].append(wall / k)
        return Record(**{key: np.array(values) for key, values in columns.items()})

    def get_column(self, joint: str) -> int:
        """Return the column of an actuator in `Record.effort`."""
        indices = self.plant.GetJointActuatorIndices(self.machine.instance)
        return [self.plant.get_joint_actuator(i).joint().name() for i in indices].index(joint)

    def get_rate(self, record: Record, joint: str) -> Array:
        """Return (n,) rates of a joint [rad/s]."""
        # The machine is alone in its plant: a joint's place in the plant is its place in the record.
        return record.v[:, self.plant.GetJointByName(joint, self.machine.instance).velocity_start()]

    def _calc_contact_forces(self, bodies: tuple[str, ...]) -> Array:
        """Return (n, 3): contact force on each body in the world [N]."""
        results: ContactResults = self.plant.get_contact_results_output_port().Eval(self.plant_context)
        rows = {int(self.get_body(name).index()): i for i, name in enumerate(bodies)}
        forces = np.zeros((len(bodies), 3))
        for i in range(results.num_point_pair_contacts()):
            contact = results.point_pair_contact_info(i)
            for index, sign in ((contact.bodyA_index(), -1.0), (contact.bodyB_index(), 1.0)):
                if int(index) in rows:
                    forces[rows[int(index)]] += sign * contact.contact_force()
        return forces


@dataclass(frozen=True)
class Record:
    """One run, a row per step.

    Attributes:
        time: (n,) the step's end [s].
        q, v: (n, nq), (n, nv) positions and velocities of the machine then.
        effort: (n, actuators) the motors' torques over the step [N m], in Drake's order.
        moment: (n, 2) the hinge's carried moment [N m].
        gap: (n,) largest closure error of the linkage [m].
        tip: (n, 3) the bucket's tip in the world [m].
        tyre_force: (n, 4, 3) contact force on each tyre, world [N].
        bucket_force: (n, 3) contact force on the bucket, world [N].
        wall: (n,) mean wall time of a step so far [s].
    """

    time: Array
    q: Array
    v: Array
    effort: Array
    moment: Array
    gap: Array
    tip: Array
    tyre_force: Array
    bucket_force: Array
    wall: Array


def make_bench(
    config: MachineConfig,
    checks: CheckConfig,
    *,
    hold_chassis: bool = False,
    floor: bool = True,
    gravity: bool = True,
    obstacle: Obstacle | None = None,
    payload: float = 0.0,
    kin: Kinematics | None = None,
) -> Bench:
    """Build a bench.

    Args:
        config: the machine.
        checks: the bench's numbers.
        hold_chassis: weld the front unit to the world, at the height of undeflected tyres, its axle at x = 0.
        floor: have a floor at z = 0.
        gravity: have gravity.
        obstacle: a fixed obstacle.
        payload: mass [kg] of a cube fixed in the bucket, in the middle of its profile.
        kin: the machine's kinematics, if at hand.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=checks.time_step,
            discrete_contact_approximation=checks.contact_approximation,
            use_sampled_output_ports=False,
        ),
        builder,
    )

    def add_fixed(shape: Shape, p: tuple[float, float, float], name: str, mu: float) -> None:
        material = ProximityProperties()
        AddContactMaterial(
            dissipation=checks.floor_dissipation,
            point_stiffness=checks.floor_stiffness,
            friction=CoulombFriction(mu, mu),
            properties=material,
        )
        X_WO = RigidTransform(np.array(p))
        plant.RegisterCollisionGeometry(plant.world_body(), X_WO, shape, name, material)

    if floor:
        x, y, z = _HALF_FLOOR
        add_fixed(Box(2 * x, 2 * y, 2 * z), (0.0, 0.0, -z), "floor", checks.floor_friction)
    if obstacle is not None:
        add_fixed(obstacle.shape, obstacle.p_WO, "obstacle", obstacle.mu)
    machine = add_machine(plant, config)
    if payload > 0:
        _add_payload(plant, machine, payload)
    if hold_chassis:
        height = -plant.GetFrameByName("floor", machine.instance).GetFixedPoseInBodyFrame().translation()[2]
        plant.WeldFrames(
            plant.world_frame(),
            plant.GetFrameByName("front_unit", machine.instance),
            RigidTransform(np.array([0, 0, height])),
        )
    if not gravity:
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    motors = add_motors(builder, plant, machine)
    hinge = add_hinge_moment(builder, plant, machine)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    return Bench(
        plant=plant,
        scene_graph=scene_graph,
        machine=machine,
        motors=motors,
        kin=kin or make_kinematics(plant, machine),
        bucket=make_bucket_geometry(plant, scene_graph, machine),
        hinge=hinge,
        simulator=simulator,
        context=context,
        linkage=Linkage(plant, plant_context, machine.instance, machine.loops),
    )


def _add_payload(plant: MultibodyPlant, machine: Machine, mass: float) -> None:
    profile = read_profile(plant, machine)[:, [0, 2]]
    center = Polygon(profile).centroid
    side = float(np.sqrt(calc_area(profile)))
    cube = SpatialInertia.SolidBoxWithMass(mass, side, side, side)
    load = plant.AddRigidBody("payload", machine.instance, cube)
    bucket = plant.GetBodyByName("bucket", machine.instance)
    X_BL = RigidTransform(np.array([center.x, 0.0, center.y]))
    plant.WeldFrames(bucket.body_frame(), load.body_frame(), X_BL)
