"""What the machine's own sensors tell: tip, pitch, joint angles and rates as one vector."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem

from drakerock.lhd import names
from drakerock.lhd.kinematics import Kinematics, calc_pitch
from drakerock.lhd.model import Machine

MEASUREMENT: dict[str, str] = {
    "x_T": "m",
    "y_T": "m",
    "z_T": "m",
    "psi": "rad",
    "phi_l": "rad",
    "phi_b": "rad",
    "phi_l_rate": "rad/s",
    "phi_b_rate": "rad/s",
    "wheel_rate": "rad/s",
    "v_F": "m/s",
    "pitch_F": "rad",
    "y_F": "m",
    "yaw_F": "rad",
    "articulation": "rad",
}
"""The measurement's elements in order, with their units: the tip's position in W, the bucket's pitch to the floor
(nose-up positive), boom and bucket angle and their rates, the wheels' mean rate, the front unit's forward speed
and pitch (nose-up positive), its y in W, its heading to the left, and the articulation's angle."""


class MachineSensor(LeafSystem):
    """Measures the machine without noise.

    Input ports:
        ``body_poses``, ``body_spatial_velocities``: the plant's outputs.
        ``machine_state``: the plant's state output of the machine's instance.

    Output port:
        ``measurement``: the vector of `MEASUREMENT`.
    """

    def __init__(self, plant: MultibodyPlant, machine: Machine, kinematics: Kinematics) -> None:
        """Make the sensor of `machine` in the finalized `plant`."""
        super().__init__()
        self.set_name("machine_sensor")
        instance = machine.instance
        self._kinematics = kinematics
        self._front = int(plant.GetBodyByName("front_unit", instance).index())
        self._bucket = int(plant.GetBodyByName("bucket", instance).index())
        # The tip is a fixed frame of the bucket: its offset is read once.
        tip = plant.GetFrameByName("tip", instance)
        self._p_BT = tip.GetFixedPoseInBodyFrame().translation()
        n_q = plant.num_positions(instance)
        position, velocity = _find_starts(plant, machine)
        self._angles = [position["boom_joint"], position["bucket_joint"]]
        self._rates = [n_q + velocity[name] for name in ("boom_joint", "bucket_joint")]
        self._articulation = position["articulation"]
        self._wheels = [n_q + velocity[name] for name in names.WHEEL_JOINTS]
        self._poses = self.DeclareAbstractInputPort("body_poses", Value([RigidTransform()]))
        self._velocities = self.DeclareAbstractInputPort(
            "body_spatial_velocities", Value([SpatialVelocity()])
        )
        self._state = self.DeclareVectorInputPort("machine_state", plant.num_multibody_states(instance))
        self.DeclareVectorOutputPort(
            "measurement", len(MEASUREMENT), self._calc_measurement, {self.all_input_ports_ticket()}
        )

    def _calc_measurement(self, context: Context, output: BasicVector) -> None:
        poses = self._poses.Eval(context)
        state = self._state.Eval(context)
        X_WF, X_WB = poses[self._front], poses[self._bucket]
        p_WT = X_WB.multiply(self._p_BT)
        phi_l, phi_b = state[self._angles]
        # Drake's pitch is about +y, nose-down for a body whose x points forward.
        attitude = RollPitchYaw(X_WF.rotation())
        pitch_F = -attitude.pitch_angle()
        v_WF = self._velocities.Eval(context)[self._front].translational()
        output.SetFromVector(
            [
                *p_WT,
                pitch_F + float(calc_pitch(self._kinematics, phi_l, phi_b)),
                phi_l,
                phi_b,
                *state[self._rates],
                float(np.mean(state[self._wheels])),
                float(v_WF @ X_WF.rotation().col(0)),
                pitch_F,
                float(X_WF.translation()[1]),
                attitude.yaw_angle(),
                float(state[self._articulation]),
            ]
        )


def add_machine_sensor(
    builder: DiagramBuilder, plant: MultibodyPlant, machine: Machine, kinematics: Kinematics
) -> MachineSensor:
    """Add a `MachineSensor` and connect it to the plant."""
    system = builder.AddSystem(MachineSensor(plant, machine, kinematics))
    builder.Connect(plant.get_body_poses_output_port(), system.GetInputPort("body_poses"))
    builder.Connect(
        plant.get_body_spatial_velocities_output_port(), system.GetInputPort("body_spatial_velocities")
    )
    builder.Connect(plant.get_state_output_port(machine.instance), system.GetInputPort("machine_state"))
    return system


def _find_starts(plant: MultibodyPlant, machine: Machine) -> tuple[dict[str, int], dict[str, int]]:
    """Return each joint's first position and velocity within the instance's own state."""
    instance = machine.instance
    probe_q = plant.GetPositionsFromArray(instance, np.arange(plant.num_positions(), dtype=float))
    probe_v = plant.GetVelocitiesFromArray(instance, np.arange(plant.num_velocities(), dtype=float))
    position, velocity = {}, {}
    for index in plant.GetJointIndices(instance):
        joint = plant.get_joint(index)
        if joint.num_positions() == 1:
            position[joint.name()] = int(np.flatnonzero(probe_q == joint.position_start())[0])
            velocity[joint.name()] = int(np.flatnonzero(probe_v == joint.velocity_start())[0])
    return position, velocity
