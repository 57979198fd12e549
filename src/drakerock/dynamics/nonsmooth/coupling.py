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

from drakerock.dynamics.nonsmooth import solver
from drakerock.dynamics.nonsmooth.collision.geometry import make_tangents
from drakerock.dynamics.nonsmooth.engine import MachinePiece, MachineStep, make_machineless_step
from drakerock.dynamics.nonsmooth.solver import MachineArrays
from drakerock.machine.geometry import collision_pieces
from drakerock.machine.model import Machine

Array = NDArray[np.float64]

# Within this angle of its stop a joint has a row for it [rad, m].
STOP_MARGIN = 0.05
# Of the linkage's closed loops, as a share of the mobility they take away.
LOOP_COMPLIANCE = 1e-10


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
        MachinePiece(number, np.asarray(piece.vertices, float), piece.mu)
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
        self._bodies = [plant.GetBodyByName(name, machine.instance) for name in layout.bodies]
        self._body_number = {int(body.index()): k for k, body in enumerate(self._bodies)}
        self._loop_points = [
            (plant.GetFrameByName(body, machine.instance), np.array(p))
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
            ValueProducer(
                allocate=lambda: Value[object](plant.CreateDefaultContext()), calc=lambda _, __: None
            ),
            {self.nothing_ticket()},
        )
        self.DeclareAbstractOutputPort(
            "machine_step", lambda: Value[object](make_machineless_step()), self._calc_step
        )

    def _calc_step(self, context: Context, output: Value) -> None:
        plant, layout = self._plant, self._layout
        h = plant.time_step()
        scratch = self._scratch.Eval(context)
        plant.SetPositionsAndVelocities(scratch, self._state.Eval(context))
        v = plant.GetVelocities(scratch)
        n_v = len(v)

        inertia = plant.CalcMassMatrix(scratch) + h * np.diag(self._damping)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(scratch, forces)
        # Gravity, springs and joint damping at the velocities of now.
        generalised = forces.generalized_forces() - plant.CalcBiasTerm(scratch)
        spatial = plant.CalcGravityGeneralizedForces(scratch)
        inverse = np.linalg.inv(inertia)
        free_change = h * inverse @ (generalised + spatial)
        world = plant.world_frame()
        if self._loop_points:
            inverse, free_change = self._close_loops(scratch, inverse, free_change, v)

        jacobian = np.array(
            [
                plant.CalcJacobianSpatialVelocity(
                    scratch, JacobianWrtVariable.kV, body.body_frame(), np.zeros(3), world, world
                )
                for body in self._bodies
            ]
        )
        response = np.ascontiguousarray(inverse @ jacobian.transpose(0, 2, 1))
        X_WBs = np.array([plant.EvalBodyPoseInWorld(scratch, body).GetAsMatrix4() for body in self._bodies])

        rows, values = self._make_motor_rows(self._desired.Eval(context), plant.GetPositions(scratch), n_v, h)
        self._add_stop_rows(plant.GetPositions(scratch), n_v, h, rows, values)
        self._add_site_rows(self._query.Eval(context), X_WBs, jacobian, h, rows, values)
        row_array = np.array(rows).reshape(-1, n_v)
        row_response = np.ascontiguousarray(row_array @ inverse)
        row_values = np.zeros((len(rows), solver.MACHINE_ROW_WIDTH))
        if rows:
            row_values[
                :, [solver.TARGET, solver.ROW_COMPLIANCE, solver.LOWER, solver.UPPER, solver.NORMAL_ROW]
            ] = values
            diagonal = np.einsum("rv,rv->r", row_array, row_response)
            row_values[:, solver.ROW_MASS] = 1.0 / (diagonal + row_values[:, solver.ROW_COMPLIANCE])
        X_WB = X_WBs[layout.bucket]
        sensor = np.concatenate([X_WB[:3, :3].reshape(-1), X_WB[:3, 3], layout.sensor[0], layout.sensor[1]])
        output.set_value(
            MachineStep(
                X_WBs,
                v,
                free_change,
                MachineArrays(
                    np.ascontiguousarray(jacobian),
                    response,
                    np.ascontiguousarray(jacobian @ response),
                    row_array,
                    row_response,
                    row_values,
                ),
                sensor[None, :],
            )
        )

    def _close_loops(
        self, scratch: Context, inverse: Array, free_change: Array, v: Array
    ) -> tuple[Array, Array]:
        """Return inverse inertia and free change of velocity with the linkage's loops held closed."""
        plant = self._plant
        world = plant.world_frame()
        points = [
            plant.CalcJacobianTranslationalVelocity(scratch, JacobianWrtVariable.kV, frame, p, world, world)
            for frame, p in self._loop_points
        ]
        rows = np.vstack(points[0::2]) - np.vstack(points[1::2])
        response = inverse @ rows.T
        # A plane linkage has rows that say nothing: with a little compliance they have a solution, too.
        mobility = rows @ response
        mobility += LOOP_COMPLIANCE * np.trace(mobility) * np.eye(len(rows))
        hold = np.linalg.solve(mobility, response.T).T
        return inverse - hold @ response.T, free_change - hold @ (rows @ (v + free_change))

    def _make_motor_rows(
        self, desired: Array, positions: Array, n_v: int, h: float
    ) -> tuple[list[Array], list[list[float]]]:
        rows, values = [], []
        n = len(self._motors)
        for k, motor in enumerate(self._motors):
            row = np.zeros(n_v)
            row[motor.velocity_start] = 1.0
            gain = motor.d + h * motor.p
            target = (
                motor.d * desired[n + k] + motor.p * (desired[k] - positions[motor.position_start])
            ) / gain
            rows.append(row)
            values.append([target, 1.0 / (h * gain), -h * motor.effort, h * motor.effort, -1])
        return rows, values

    def _add_stop_rows(
        self, positions: Array, n_v: int, h: float, rows: list[Array], values: list[list[float]]
    ) -> None:
        for stop in self._stops:
            position = positions[stop.position_start]
            for side, limit in ((1.0, stop.lower), (-1.0, stop.upper)):
                distance = side * (position - limit)
                if distance < STOP_MARGIN:
                    row = np.zeros(n_v)
                    row[stop.velocity_start] = side
                    rows.append(row)
                    # It may reach the stop within the step, not pass it.
                    values.append([-max(distance, 0.0) / h, 0.0, 0.0, np.inf, -1])

    def _add_site_rows(
        self,
        query: QueryObject,
        X_WBs: Array,
        jacobian: Array,
        h: float,
        rows: list[Array],
        values: list[list[float]],
    ) -> None:
        """Add three rows per contact of a machine body with the site: tyres on the floor, above all."""
        numbers: list[int] = []
        axes: list[list[float]] = []
        arms: list[Array] = []
        for pair in query.ComputePointPairPenetration():
            body_A, stiffness_A, mu_A = self._find_material(query, pair.id_A)
            body_B, stiffness_B, mu_B = self._find_material(query, pair.id_B)
            if (body_A is None) == (body_B is None):
                continue
            # nhat_BA_W points out of B into A
            number, sign = (body_A, 1.0) if body_A is not None else (body_B, -1.0)
            assert number is not None
            stiffness = stiffness_A * stiffness_B / (stiffness_A + stiffness_B)
            mu = 2.0 * mu_A * mu_B / (mu_A + mu_B)
            normal = [sign * part for part in pair.nhat_BA_W]
            numbers.append(number)
            axes.append([*normal, *make_tangents(*normal)])
            arms.append(0.5 * (pair.p_WCa + pair.p_WCb) - X_WBs[number, :3, 3])
            first = len(values)
            load = h * stiffness * pair.depth
            # Drake's regularised friction is full at the stiction tolerance.
            friction = [0.0, self._stiction_tolerance / (mu * load), -mu, mu, first]
            values.append([pair.depth / h, 1.0 / (h * h * stiffness), 0.0, np.inf, -1])
            values.extend([friction, friction])
        if numbers:
            directions = np.array(axes).reshape(-1, 3, 3)
            # A direction's velocity at an arm: along it, and about the arm.
            turning = np.cross(np.array(arms)[:, None], directions)
            spatial = np.concatenate([turning, directions], axis=2)
            rows.extend((spatial @ jacobian[numbers]).reshape(-1, jacobian.shape[2]))

    def _find_material(self, query: QueryObject, geometry: object) -> tuple[int | None, float, float]:
        """Return a geometry's body number (None: not the machine's), point stiffness [N/m] and friction."""
        if geometry not in self._materials:
            # Looked up once per geometry: it follows from the finalized plant alone.
            inspector = query.inspector()
            body = self._plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
            properties = inspector.GetProximityProperties(geometry)
            self._materials[geometry] = (
                self._body_number.get(int(body.index())),
                properties.GetPropertyOrDefault("material", "point_contact_stiffness", 1e8),
                properties.GetProperty("material", "coulomb_friction").dynamic_friction(),
            )
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
    position_start: int
    velocity_start: int
    lower: float
    upper: float


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
    stops = []
    for index in plant.GetJointIndices(machine.instance):
        joint = plant.get_joint(index)
        if joint.num_velocities() == 1 and (
            np.isfinite(joint.position_lower_limits()).any()
            or np.isfinite(joint.position_upper_limits()).any()
        ):
            stops.append(
                _Stop(
                    joint.position_start(),
                    joint.velocity_start(),
                    float(joint.position_lower_limits()[0]),
                    float(joint.position_upper_limits()[0]),
                )
            )
    return stops


def _find_damping(plant: MultibodyPlant) -> Array:
    damping = np.zeros(plant.num_velocities())
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        start = joint.velocity_start()
        damping[start : start + joint.num_velocities()] = joint.default_damping_vector()
    return damping
