"""The plant's side of the contact solve: free velocities, inertia and own forces of all that moves in it.

In one step of length h the plant's generalised velocities v obey

    (M + h D) (v' - v) = h (tau - C - D v) + sum_k J_k^T F_k h + sum_r g_r lambda_r,

with gravity, force elements, actuation and the applied forces of others in tau, the rocks' spatial forces F_k on its
bodies, and one row g_r per motor, joint stop and contact of the plant's own, each with a law
g_r v' + s_r lambda_r = b_r,  lower <= lambda_r <= upper. The laws are those that Drake's discrete solver uses: a
motor with velocity gain d has s = 1 / (h d) and its effort limit as bounds, a point contact of stiffness k without
dissipation has s = 1 / (h^2 k). So the rocks feel a robot's inertia, its motors until they saturate, and its tyres
until they slip, in the same step. The plant itself is then advanced with the rocks' forces, by its own solver; nothing
of its motion is decided here.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.geometry import GeometryId, QueryObject
from pydrake.multibody.plant import (
    DiscreteContactApproximation,
    ExternallyAppliedSpatialForce,
    MultibodyPlant,
)
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable, ModelInstanceIndex, MultibodyForces
from pydrake.systems.framework import Context, InputPort, LeafSystem, ValueProducer

from drakerock.errors import InputError, SimulationFailure
from drakerock.memory import weak
from drakerock.rocks.drake.ball_constraints import BallConstraint, read_ball_constraints
from drakerock.rocks.drake.geometry import Material, read_material
from drakerock.rocks.drake.touches import Touch, find_touches
from drakerock.rocks.engine.engine import MachineStep, make_machineless_step
from drakerock.rocks.engine.machine_step import (
    JOINT_WIDTH,
    NO_BODY,
    SITE_WIDTH,
    calc_free_motion,
    make_machine_arrays,
)
from drakerock.rocks.engine.motion import HUGE
from drakerock.rocks.materials import calc_pair_friction

Array = NDArray[np.float64]
_log = logging.getLogger(__name__)

# Within this distance of its stop a joint has a row for it [rad, m].
STOP_MARGIN = 0.05
# Friction below this is as good as none; the laws divide by it.
SMOOTH = 1e-6


@dataclass(frozen=True, eq=False)
class WakeBox:
    """A box that moves with a body and keeps the rocks in it awake: the method's refinement sensor.

    Attributes:
        body: the body.
        lower, upper: (3,) corners in the body's frame [m].
    """

    body: BodyIndex
    lower: Array
    upper: Array


class PlantView(LeafSystem):
    """Gives the rock engine what moves in the plant over the coming step.

    Input ports:
        ``state``: the plant's whole state.
        ``geometry_query``: for the plant's own contacts.
        ``actuation``, ``MODEL_actuation``, ``MODEL_desired_state``, ``applied_generalized_force``: what the plant's
            ports of these names get; those that are not connected there need not be here.
        ``applied_spatial_force``: what others than rocks apply.

    Output port ``plant_step``: a `MachineStep`.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        bodies: Sequence[BodyIndex],
        wake_boxes: Sequence[WakeBox],
        stiction_tolerance: float,
    ) -> None:
        """Make it.

        Args:
            plant: finalized.
            bodies: those with proximity geometry that are not welded to the world.
            wake_boxes: where bodies keep rocks awake.
            stiction_tolerance: the plant's [m/s].
        """
        super().__init__()
        self.set_name("plant_view")
        self._plant = plant
        self._stiction_tolerance = stiction_tolerance
        # Indices: a body or frame that a system keeps would keep the Diagram alive (`drakerock.memory`).
        self._bodies = list(bodies)
        self._number = {int(index): k for k, index in enumerate(bodies)}
        self._wake_boxes = [
            (self._number[int(box.body)], np.concatenate([box.lower, box.upper])) for box in wake_boxes
        ]
        self._loops = _group_loop_points(_find_loops(plant))
        self._materials: dict[int, tuple[int | None, Material]] = {}
        self._motors = _find_motors(plant)
        self._stops = _find_stops(plant)
        self._damping = plant.time_step() * np.diag(_find_damping(plant))
        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self._query = self.DeclareAbstractInputPort("geometry_query", Value(QueryObject()))
        self._actuation = self._declare(plant.get_actuation_input_port())
        self._instances = {
            instance: (
                self._declare(plant.get_actuation_input_port(instance)),
                self._declare(plant.get_desired_state_input_port(instance)),
            )
            for instance in dict.fromkeys(motor.instance for motor in self._motors)
        }
        self._generalized = self._declare(plant.get_applied_generalized_force_input_port())
        self._spatial = self.DeclareAbstractInputPort(
            "applied_spatial_force", Value[list[ExternallyAppliedSpatialForce]]([])
        )
        # The plant's kinematics are evaluated in a context of its own, wholly overwritten each time.
        self._scratch = self.DeclareCacheEntry(
            "scratch plant context",
            ValueProducer(allocate=weak(self._make_scratch), calc=lambda _, __: None),
            {self.nothing_ticket()},
        ).cache_index()
        self.DeclareAbstractOutputPort(
            "plant_step", lambda: Value[object](make_machineless_step()), weak(self._calc_step)
        )

    def _declare(self, port: InputPort) -> InputPort:
        return self.DeclareVectorInputPort(port.get_name(), port.size())

    def _make_scratch(self) -> Value:
        return Value[object](self._plant.CreateDefaultContext())

    def _calc_step(self, context: Context, output: Value) -> None:
        plant = self._plant
        h = plant.time_step()
        scratch = self.get_cache_entry(self._scratch).Eval(context)
        state = self._state.Eval(context)
        if not (np.abs(state) < HUGE).all():
            # Neither Drake's proximity engine nor the search for rocks survives such poses.
            raise SimulationFailure(f"{self._find_lost_body(state)}: its position or velocity is not finite")
        plant.SetPositionsAndVelocities(scratch, state)
        v, positions = plant.GetVelocities(scratch), plant.GetPositions(scratch).tolist()
        generalised, joints = self._calc_own_forces(context, scratch, positions, h)
        inverse, free_change = calc_free_motion(
            np.ascontiguousarray(plant.CalcMassMatrix(scratch) + self._damping),
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
        ).reshape(-1, 6, len(v))
        X_WBs = np.array(
            [plant.EvalBodyPoseInWorld(scratch, body).GetAsMatrix4() for body in bodies]
        ).reshape(-1, 4, 4)
        contacts = self._find_own_contacts(self._query.Eval(context))
        arrays = make_machine_arrays(
            inverse,
            jacobian,
            X_WBs[:, :3, 3].copy(),
            np.array(joints, float).reshape(-1, JOINT_WIDTH),
            np.array(contacts, float).reshape(-1, SITE_WIDTH),
            self._stiction_tolerance,
            h,
        )
        boxes = [
            [*X_WBs[number, :3, :3].reshape(-1), *X_WBs[number, :3, 3], *corners]
            for number, corners in self._wake_boxes
        ]
        output.set_value(MachineStep(X_WBs, v, free_change, arrays, np.array(boxes, float).reshape(-1, 18)))

    def _find_lost_body(self, state: Array) -> str:
        n_q = self._plant.num_positions()
        for index in self._plant.GetJointIndices():
            joint = self._plant.get_joint(index)
            q = state[joint.position_start() :][: joint.num_positions()]
            v = state[n_q + joint.velocity_start() :][: joint.num_velocities()]
            if not ((np.abs(q) < HUGE).all() and (np.abs(v) < HUGE).all()):
                return f"body '{joint.child_body().scoped_name()}'"
        return "the plant"

    def _calc_own_forces(
        self, context: Context, scratch: Context, positions: list[float], h: float
    ) -> tuple[Array, list[list[float]]]:
        """Return all generalised forces (v,) but those of rocks and rows, and the laws of motors and stops."""
        plant = self._plant
        forces = MultibodyForces(plant)
        # Gravity, springs and joint damping at the velocities of now.
        plant.CalcForceElementsContribution(scratch, forces)
        generalised = plant.CalcGeneralizedForces(scratch, forces) - plant.CalcBiasTerm(scratch)
        if self._generalized.HasValue(context):
            generalised = generalised + self._generalized.Eval(context)
        if self._spatial.HasValue(context):
            for force in self._spatial.Eval(context):
                generalised = generalised + self._calc_applied(scratch, force)
        whole = _read(self._actuation, context)
        told = {
            instance: (_read(actuation, context), _read(desired, context))
            for instance, (actuation, desired) in self._instances.items()
        }
        laws = []
        for motor in self._motors:
            own, desired = told[motor.instance]
            effort = whole[motor.place_in_plant] if whole else 0.0
            if own:
                effort += own[motor.place]
            gain, limit = motor.gain(h), h * motor.effort
            if gain == 0.0 or not desired:
                generalised[motor.velocity_start] += np.clip(effort, -motor.effort, motor.effort)
                continue
            q, v = desired[motor.place], desired[len(desired) // 2 + motor.place]
            pull = motor.d * v + motor.p * (q - positions[motor.position_start]) + effort
            laws.append([motor.velocity_start, 1.0, pull / gain, 1.0 / (h * gain), -limit, limit])
        return generalised, laws + self._find_stop_laws(positions, h)

    def _calc_applied(self, scratch: Context, force: ExternallyAppliedSpatialForce) -> Array:
        world = self._plant.world_frame()
        jacobian = self._plant.CalcJacobianSpatialVelocity(
            scratch, JacobianWrtVariable.kV, self._plant.get_body(force.body_index).body_frame(),
            force.p_BoBq_B, world, world,
        )  # fmt: skip
        return np.asarray(
            jacobian.T @ np.concatenate([force.F_Bq_W.rotational(), force.F_Bq_W.translational()])
        )

    def _calc_loop_rows(self, scratch: Context, n_v: int) -> Array:
        """Return what the velocities (v,) must not change: the distance of the two points of each loop, (3 l, v)."""
        plant, world = self._plant, self._plant.world_frame()
        points = np.zeros((sum(len(places) for _, _, places in self._loops), 3, n_v))
        for body, p_BPs, places in self._loops:
            points[places] = plant.CalcJacobianTranslationalVelocity(
                scratch, JacobianWrtVariable.kV, plant.get_body(body).body_frame(), p_BPs, world, world
            ).reshape(-1, 3, n_v)
        return np.asarray(points[::2] - points[1::2]).reshape(-1, n_v)

    def _find_stop_laws(self, positions: list[float], h: float) -> list[list[float]]:
        """Return a law per joint stop that is near, see `machine_step`."""
        laws = []
        for stop in self._stops:
            distance = stop.side * (positions[stop.position_start] - stop.limit)
            if distance < STOP_MARGIN:
                # It may reach the stop within the step, not pass it.
                laws.append([stop.velocity_start, stop.side, -max(distance, 0.0) / h, 0.0, 0.0, np.inf])
        return laws

    def _find_own_contacts(self, query: QueryObject) -> list[list[float]]:
        """Return the contacts among the plant's bodies and with the world, tyres on the floor above all."""
        contacts = []
        for touch in find_touches(self._plant, query):
            body_A, of_A = self._find_material(query, touch.id_A)
            body_B, of_B = self._find_material(query, touch.id_B)
            if (body_A is None and body_B is None) or not touch.depth > 0.0:
                continue
            number, other, sign = (body_A, body_B, 1.0) if body_A is not None else (body_B, None, -1.0)
            assert number is not None
            in_series = of_A.stiffness * of_B.stiffness / (of_A.stiffness + of_B.stiffness)
            contacts.append(
                [
                    number,
                    *(sign * part for part in touch.normal),
                    *touch.point,
                    touch.depth,
                    in_series if touch.stiffness is None else touch.stiffness,
                    max(calc_pair_friction(of_A.friction, of_B.friction), SMOOTH),
                    NO_BODY if other is None else other,
                    self._calc_damping_time(touch, of_A, of_B),
                ]
            )
        return contacts

    def _calc_damping_time(self, touch: Touch, of_A: Material, of_B: Material) -> float:
        """Return what stands beside the time step in Drake's normal law [s]."""
        if self._plant.get_discrete_contact_approximation() == DiscreteContactApproximation.kSap:
            return of_A.relaxation_time + of_B.relaxation_time
        # The softer side's counts more.
        share = touch.share_A
        if share is None:
            share = of_B.stiffness / (of_A.stiffness + of_B.stiffness)
        return touch.depth * (share * of_A.dissipation + (1.0 - share) * of_B.dissipation)

    def _find_material(self, query: QueryObject, geometry: GeometryId) -> tuple[int | None, Material]:
        """Return a geometry's body number (None: at rest) and its material."""
        key = geometry.get_value()
        if key not in self._materials:
            # Looked up once per geometry: it follows from the finalized plant alone.
            inspector = query.inspector()
            body = self._plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
            self._materials[key] = self._number.get(int(body.index())), read_material(inspector, geometry)
        return self._materials[key]


@dataclass(frozen=True)
class _Motor:
    """An actuator: places of its joint's position and velocity, of itself in its model's ports and in the plant's."""

    instance: ModelInstanceIndex
    place: int
    place_in_plant: int
    position_start: int
    velocity_start: int
    p: float
    d: float
    effort: float

    def gain(self, h: float) -> float:
        return self.d + h * self.p


@dataclass(frozen=True)
class _Stop:
    """A joint's lower (side 1) or upper stop (-1)."""

    position_start: int
    velocity_start: int
    side: float
    limit: float


def _find_loops(plant: MultibodyPlant) -> tuple[BallConstraint, ...]:
    try:
        return read_ball_constraints(plant)
    except InputError as error:
        _log.warning("%s: rocks meet the plant's bodies as if its constraints were not there", error)
        return ()


def _group_loop_points(
    loops: Sequence[BallConstraint],
) -> list[tuple[BodyIndex, Array, list[int]]]:
    """Return a body each, the loops' points (3, k) on it in its frame [m], and their places: 2 l, 2 l + 1 of loop l."""
    points = [
        (body.index(), p)
        for loop in loops
        for body, p in ((loop.body_A, loop.p_AP), (loop.body_B, loop.p_BQ))
    ]
    places = {body: [place for place, (other, _) in enumerate(points) if other == body] for body, _ in points}
    return [(body, np.stack([points[k][1] for k in of], axis=1), of) for body, of in places.items()]


def _read(port: InputPort, context: Context) -> list[float]:
    """Return what is connected to a port, [] if nothing is."""
    return port.Eval(context).tolist() if port.HasValue(context) else []


def _find_motors(plant: MultibodyPlant) -> Sequence[_Motor]:
    motors: list[_Motor] = []
    place: dict[ModelInstanceIndex, int] = {}
    for index in plant.GetJointActuatorIndices():
        actuator = plant.get_joint_actuator(index)
        joint, instance = actuator.joint(), actuator.model_instance()
        p, d = 0.0, 0.0
        if actuator.has_controller():
            gains = actuator.get_controller_gains()
            p, d = gains.p, gains.d
        motors.append(
            _Motor(
                instance=instance,
                place=place.get(instance, 0),
                place_in_plant=actuator.input_start(),
                position_start=joint.position_start(),
                velocity_start=joint.velocity_start(),
                p=p,
                d=d,
                effort=actuator.effort_limit(),
            )
        )
        place[instance] = place.get(instance, 0) + 1
    return motors


def _find_stops(plant: MultibodyPlant) -> Sequence[_Stop]:
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
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
