"""Placing the machine on the floor."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from drakerock.errors import InputError
from drakerock.lhd import names
from drakerock.lhd.kinematics import Kinematics, calc_bucket_range, calc_joint_angles, make_kinematics
from drakerock.lhd.linkage import Linkage
from drakerock.lhd.model import Machine


def set_machine_angles(
    plant: MultibodyPlant,
    context: Context,
    machine: Machine,
    *,
    phi_l: float,
    phi_b: float,
    kin: Kinematics | None = None,
) -> None:
    """Set boom, bucket and steering angle with the linkage closed behind them, and all joints at rest.

    Args:
        plant: the finalized plant.
        context: the plant's context.
        machine: the machine.
        phi_l, phi_b: boom and bucket angle [rad].
        kin: the machine's kinematics, if at hand: saves making it.

    Raises:
        InputError: an angle beyond a stop.
    """
    kin = kin or make_kinematics(plant, machine)
    tilt, dump = calc_bucket_range(kin, phi_l)
    if not (kin.phi_l_range[0] <= phi_l <= kin.phi_l_range[1] and tilt <= phi_b <= dump):
        raise InputError(
            f"the machine can't reach boom angle {np.degrees(phi_l):.1f} deg with bucket angle "
            f"{np.degrees(phi_b):.1f} deg: boom {np.degrees(kin.phi_l_range).round(1)}, there the bucket "
            f"{np.degrees([tilt, dump]).round(1)}"
        )
    linkage = Linkage(plant, context, machine.instance, machine.loops)
    linkage.reset(*(float(angle) for angle in calc_joint_angles(kin, 0.0, 0.0)))
    linkage.move(machine.steering_angle, phi_l, phi_b)
    plant.SetVelocities(context, machine.instance, np.zeros(plant.num_velocities(machine.instance)))


def set_machine_pose(
    plant: MultibodyPlant,
    context: Context,
    machine: Machine,
    *,
    x_tip: float,
    y: float = 0.0,
    z_tip: float = 0.0,
    psi: float = 0.0,
    kin: Kinematics | None = None,
) -> None:
    """Put the machine at rest on the floor z = 0, along +x, at its static equilibrium.

    Args:
        plant: the finalized plant.
        context: the plant's context; positions and velocities of the machine are written. With a SceneGraph
            connected the tyres' contact stiffness is read from it, otherwise they are rigid.
        machine: the machine.
        x_tip, z_tip: where the bucket's tip is to be [m].
        y: of the machine's middle [m].
        psi: pitch of the bucket [rad], nose-up positive.
        kin: the machine's kinematics, if at hand: saves making it.

    Raises:
        InputError: boom or bucket can't reach that pose.
    """
    kin = kin or make_kinematics(plant, machine)
    front = plant.GetBodyByName("front_unit", machine.instance)
    tip = plant.GetFrameByName("tip", machine.instance)
    plant.SetPositions(context, machine.instance, plant.GetDefaultPositions(machine.instance))
    sink, pitch, z_level = 0.0, 0.0, z_tip
    for _ in range(3):
        # Sink and pitch of the chassis on its tyres move the tip by millimetres: corrected by iteration.
        phi_l, phi_b = (float(angle) for angle in calc_joint_angles(kin, z_level, psi + pitch))
        if np.isnan(phi_l):
            raise InputError(f"the machine can't reach z_tip = {z_tip:.3f} m with psi = {psi:.3f} rad")
        set_machine_angles(plant, context, machine, phi_l=phi_l, phi_b=phi_b, kin=kin)
        X_WF = RigidTransform(RollPitchYaw(0, pitch, 0), np.array([0, y, kin.wheel_radius - sink]))
        plant.SetFreeBodyPose(context, front, X_WF)
        p_WT = tip.CalcPoseInWorld(context).translation()
        X_WF.set_translation(X_WF.translation() + np.array([x_tip - p_WT[0], 0, 0]))
        plant.SetFreeBodyPose(context, front, X_WF)
        z_level += z_tip - p_WT[2]
        sink, pitch = _calc_equilibrium(plant, context, machine)


def _calc_equilibrium(plant: MultibodyPlant, context: Context, machine: Machine) -> tuple[float, float]:
    """Return how far the front axle sinks [m] and the chassis pitches (about +y) under the axle loads."""
    instance = machine.instance
    stiffness = _find_tyre_stiffness(plant, context, machine)
    if stiffness is None:
        return 0.0, 0.0
    x_front, x_rear = (
        np.mean([plant.GetBodyByName(w, instance).EvalPoseInWorld(context).translation()[0] for w in pair])
        for pair in (names.WHEELS[:2], names.WHEELS[2:])
    )
    x_center = plant.CalcCenterOfMassPositionInWorld(context, [instance])[0]
    weight = plant.CalcTotalMass(context, [instance]) * -plant.gravity_field().gravity_vector()[2]
    share = (x_center - x_rear) / (x_front - x_rear)
    sink_front = share * weight / (2 * stiffness)
    sink_rear = (1 - share) * weight / (2 * stiffness)
    return sink_front, float(np.arctan2(sink_front - sink_rear, x_front - x_rear))


def _find_tyre_stiffness(plant: MultibodyPlant, context: Context, machine: Machine) -> float | None:
    port = plant.get_geometry_query_input_port()
    if not port.HasValue(context):
        return None
    inspector = port.Eval(context).inspector()
    wheel = plant.GetBodyByName(names.WHEELS[0], machine.instance)
    for geometry in plant.GetCollisionGeometriesForBody(wheel):
        properties = inspector.GetProximityProperties(geometry)
        if properties.HasProperty("material", "point_contact_stiffness"):
            return float(properties.GetProperty("material", "point_contact_stiffness"))
    return None
