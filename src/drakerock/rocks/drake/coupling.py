"""The machine's side of the contact solve: free velocities, inertia and own forces, from the MultibodyPlant.

In one step of length h the machine's generalised velocities v obey

    (M + h D) (v' - v) = h (tau_g - C - D v) + sum_k J_k^T F_k h + sum_r g_r lambda_r,

with the rocks' spatial forces F_k on its bodies and one row g_r per motor, joint stop and site contact, each
with a law  g_r v' + s_r lambda_r = b_r,  lower <= lambda_r <= upper. The laws are those that Drake's discrete
solver uses: a motor with velocity gain d has s = 1 / (h d) and its effort limit as bounds, a point contact of
stiffness k has s = 1 / (h^2 k). So the rocks feel the machine's inertia, its motors until they saturate, and its
tyres until they slip, in the same step. The plant itself is then advanced with the rocks' forces, by its own
solver; nothing of the machine's motion is decided here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.geometry import QueryObject, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces
from pydrake.systems.framework import Context, LeafSystem, ValueProducer

from drakerock.lhd.geometry import collision_pieces, get_material
from drakerock.lhd.model import Machine
from drakerock.memory import weak
from drakerock.rocks.engine.engine import MachinePiece, MachineStep, make_machineless_step
from drakerock.rocks.engine.machine_step import (
    JOINT_WIDTH,
    SITE_WIDTH,
    calc_free_motion,
    make_machine_arrays,
)

Array = NDArray[np.float64]

# Within this angle of its stop a joint has a row for it [rad, m].
STOP_MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class MachineLayout:
    """What of the machine touches rocks.

    Attributes:
        bodies: names of the bodies, in the order of their numbers.
        pieces: their convex pieces.
        bucket: number of the bucket among the bodies.
        sensor: (2, 3) lower and upper corner of the refinement sensor in the bucket's frame [m].
    """

    bodies: tuple[str, ...]
    pieces: tuple[MachinePiece, ...]
    bucket: int
    sensor: Array


def make_machine_layout(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    machine: Machine,
    sensor_length: float,
    sensor_margin: float,
) -> MachineLayout:
    """Read the machine's convex pieces off the finalized plant.

    Args:
        plant, scene_graph, machine: where it is.
        sensor_length: how far the refinement sensor reaches in front of the bucket [m].
        sensor_margin: ... and to the other sides [m].
    """
    by_body = collision_pieces(plant, scene_graph, machine)
    bodies = tuple(by_body)
    pieces = tuple(
        MachinePiece(number, np.asarray(piece.vertices, float), piece.mu, piece.stiffness)
        for number, name in enumerate(bodies)
        for piece in by_body[name]
    )
    corners = np.vstack([piece.vertices for piece in by_body["bucket"]])
    sensor = np.array([corners.min(axis=0) - sensor_margin, corners.max(axis=0) + sensor_margin])
    sensor[1, 0] = corners[:, 0].max() + sensor_length
    return MachineLayout(bodies, pieces, bodies.index("bucket"), sensor)


class MachineView(LeafSystem):
    """Gives the rock engine the machine over the coming step.

    Input ports:
        ``state``: the plant's whole state.
        ``desired_state``: what the plant's desired-state port of the machine gets.
        ``geometry_query``: SceneGraph's query port, for the machine's contacts with the site.

    Output port ``machine_step``: a `MachineStep`.
    """

    def __init__(
        self, plant: MultibodyPlant, machine: Machine, layout: MachineLayout, stiction_tolerance: float
    ) -> None:
        """Make it for the finalized `plant`; `stiction_tolerance` [m/s] is the plant's."""
        super().__init__()
        self.set_name("machine_view")
        self._plant = plant
        self._layout = layout
        self._stiction_tolerance = stiction_tolerance
        # Indices: a body or frame of the plant that a system keeps would keep the Diagram alive (`drakerock.memory`).
        self._bodies = [plant.GetBodyByName(name, machine.instance).index() for name in layout.bodies]
        self._body_number = {int(body): k for k, body in enumerate(self._bodies)}
        self._loop_points = [
            (plant.GetFrameByName(body, machine.instance).index(), np.array(p))
            for loop in machine.loops
            for body, p in ((loop.body_A, loop.p_AP), (loop.body_B, loop.p_BQ))
        ]
        self._materials: dict[object, tuple[int | None, float, float]] = {}
        self._motors = _find_motors(plant, machine)
        self._stops = _find_stops(plant, machine)
        self._damping = _find_damping(plant)
        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self._desired = self.DeclareVectorInputPort("desired_state", 2 * len(self._motors))
        self._query = self.DeclareAbstractInputPort("geometry_query", Value(QueryObject()))
        # The plant's kinematics are evaluated in a context of its own, wholly overwritten each time.
        self._scratch = self.DeclareCacheEntry(
            "scratch plant context",
            ValueProducer(allocate=weak(self._make_scratch), calc=lambda _, __: None),
            {self.nothing_ticket()},
        ).cache_index()
        self.DeclareAbstractOutputPort(
            "machine_step", lambda: Value[object](make_machineless_step()), weak(self._calc_step)
        )

    def _make_scratch(self) -> Value:
        return Value[object](self._plant.CreateDefaultContext())

    def _calc_step(self, context: Context, output: Value) -> None:
        plant, layout = self._plant, self._layout
        h = plant.time_step()
        scratch = self.get_cache_entry(self._scratch).Eval(context)
        plant.SetPositionsAndVelocities(scratch, self._state.Eval(context))
        v = plant.GetVelocities(scratch)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(scratch, forces)
        # Gravity, springs and joint damping at the velocities of now.
        generalised = forces.generalized_forces() - plant.CalcBiasTerm(scratch)
        generalised += plant.CalcGravityGeneralizedForces(scratch)
        inverse, free_change = calc_free_motion(
            np.ascontiguousarray(plant.CalcMassMatrix(scratch) + h * np.diag(self._damping)),
            h * generalised,
            v,
            self._calc_loop_rows(scratch, len(v)),
        )

        world = plant.world_frame()
        bodies = [plant.get_body(index) for index in self._bodies]
        jacobian = np.array(
            [
                plant.CalcJacobianSpatialVelocity(
                    scratch, JacobianWrtVariable.kV, body.body_frame(), np.zeros(3), world, world
                )
                for body in bodies
            ]
        )
        X_WBs = np.array([plant.EvalBodyPoseInWorld(scratch, body).GetAsMatrix4() for body in bodies])
        positions = plant.GetPositions(scratch)
        joints = self._find_motor_laws(self._desired.Eval(context), positions, h)
        joints += self._find_stop_laws(positions, h)
        contacts = self._find_site_contacts(self._query.Eval(context))
        arrays = make_machine_arrays(
            inverse,
            jacobian,
            X_WBs[:, :3, 3].copy(),
            np.array(joints, float).reshape(-1, JOINT_WIDTH),
            np.array(contacts, float).reshape(-1, SITE_WIDTH),
            self._stiction_tolerance,
            h,
        )
        X_WB = X_WBs[layout.bucket]
        sensor = np.concatenate([X_WB[:3, :3].reshape(-1), X_WB[:3, 3], layout.sensor[0], layout.sensor[1]])
        output.set_value(MachineStep(X_WBs, v, free_change, arrays, sensor[None, :]))

    def _calc_loop_rows(self, scratch: Context, n_v: int) -> Array:
        """Return what the velocities (v,) must not change: the distance of the two points of each loop, (3 l, v)."""
        plant = self._plant
        world = plant.world_frame()
        points = np.array(
            [
                plant.CalcJacobianTranslationalVelocity(
                    scratch, JacobianWrtVariable.kV, plant.get_frame(frame), p, world, world
                )
                for frame, p in self._loop_points
            ]
        ).reshape(-1, 2, 3, n_v)
        return (points[:, 0] - points[:, 1]).reshape(-1, n_v)

    def _find_motor_laws(self, desired: Array, positions: Array, h: float) -> list[list[float]]:
        """Return a law per motor, see `machine_step`."""
        laws, n = [], len(self._motors)
        for k, motor in enumerate(self._motors):
            gain = motor.d + h * motor.p
            lag = desired[k] - positions[motor.position_start]
            target = (motor.d * desired[n + k] + motor.p * lag) / gain
            laws.append(
                [motor.velocity_start, 1.0, target, 1.0 / (h * gain), -h * motor.effort, h * motor.effort]
            )
        return laws

    def _find_stop_laws(self, positions: Array, h: float) -> list[list[float]]:
        """Return a law per joint stop that is near, see `machine_step`."""
        laws = []
        for stop in self._stops:
            distance = stop.side * (positions[stop.position_start] - stop.limit)
            if distance < STOP_MARGIN:
                # It may reach the stop within the step, not pass it.
                laws.append([stop.velocity_start, stop.side, -max(distance, 0.0) / h, 0.0, 0.0, np.inf])
        return laws

    def _find_site_contacts(self, query: QueryObject) -> list[list[float]]:
        """Return the contacts of machine bodies with the site, tyres on the floor above all; see `machine_step`."""
        contacts = []
        for pair in query.ComputePointPairPenetration():
            body_A, stiffness_A, mu_A = self._find_material(query, pair.id_A)
            body_B, stiffness_B, mu_B = self._find_material(query, pair.id_B)
            if (body_A is None) == (body_B is None):
                continue
            # nhat_BA_W points out of B into A
            number, sign = (body_A, 1.0) if body_A is not None else (body_B, -1.0)
            assert number is not None
            sides = zip(pair.p_WCa.tolist(), pair.p_WCb.tolist(), strict=True)
            contacts.append(
                [
                    number,
                    *(sign * part for part in pair.nhat_BA_W.tolist()),
                    *(0.5 * (a + b) for a, b in sides),
                    pair.depth,
                    stiffness_A * stiffness_B / (stiffness_A + stiffness_B),
                    2.0 * mu_A * mu_B / (mu_A + mu_B),
                ]
            )
        return contacts

    def _find_material(self, query: QueryObject, geometry: object) -> tuple[int | None, float, float]:
        """Return a geometry's body number (None: not the machine's), point stiffness [N/m] and friction."""
        if geometry not in self._materials:
            # Looked up once per geometry: it follows from the finalized plant alone.
            inspector = query.inspector()
            body = self._plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
            mu, stiffness = get_material(inspector, geometry)
            self._materials[geometry] = self._body_number.get(int(body.index())), stiffness, mu
        return self._materials[geometry]


@dataclass(frozen=True)
class _Motor:
    position_start: int
    velocity_start: int
    p: float
    d: float
    effort: float


@dataclass(frozen=True)
class _Stop:
    """A joint's lower (side 1) or upper stop (-1)."""

    position_start: int
    velocity_start: int
    side: float
    limit: float


def _find_motors(plant: MultibodyPlant, machine: Machine) -> Sequence[_Motor]:
    motors = []
    for index in plant.GetJointActuatorIndices(machine.instance):
        actuator = plant.get_joint_actuator(index)
        joint, gains = actuator.joint(), actuator.get_controller_gains()
        motors.append(
            _Motor(joint.position_start(), joint.velocity_start(), gains.p, gains.d, actuator.effort_limit())
        )
    return motors


def _find_stops(plant: MultibodyPlant, machine: Machine) -> Sequence[_Stop]:
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(machine.instance)]
    return [
        _Stop(joint.position_start(), joint.velocity_start(), side, float(limits[0]))
        for joint in joints
        if joint.num_velocities() == 1
        for side, limits in ((1.0, joint.position_lower_limits()), (-1.0, joint.position_upper_limits()))
        if np.isfinite(limits[0])
    ]


def _find_damping(plant: MultibodyPlant) -> Array:
    damping = np.zeros(plant.num_velocities())
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        start = joint.velocity_start()
        damping[start : start + joint.num_velocities()] = joint.default_damping_vector()
    return damping
