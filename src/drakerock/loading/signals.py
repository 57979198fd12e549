"""The time-stamped signals of a cycle: columns and units from the logs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from drakerock.lhd.measurement import MEASUREMENT
from drakerock.lhd.names import WHEEL_JOINTS
from drakerock.lhd.wall_contact import WALL_CONTACT
from drakerock.loading.station import Station
from drakerock.rocks.drake.interface import ROCK_SUMMARY

Array = NDArray[np.float64]

FORCE_NAMES = ("bucket_torque_x", "bucket_torque_y", "bucket_torque_z",
               "bucket_force_x", "bucket_force_y", "bucket_force_z")  # fmt: skip


def calc_signals(station: Station, root_context: Context) -> tuple[dict[str, Array], dict[str, str]]:
    """Return the columns (k,) of all logged steps, and their units.

    A row holds what is so when the step at ``time`` begins, before any update at that time, and the forces
    and torques that act over that step. Powers are motor torque times the mean joint rate of the step, so that
    their sum over time, the work since the start, balances the kinetic energy of a discrete step. Slip is the
    difference of the wheels' circumferential speed and the front unit's.
    """
    data = {name: log.FindLog(root_context).data() for name, log in station.logs.items()}
    # A failure leaves the logs of its step incomplete.
    count = min(rows.shape[1] for rows in data.values())
    data = {name: rows[:, :count] for name, rows in data.items()}
    time = station.logs["mode"].FindLog(root_context).sample_times()[:count]
    columns: dict[str, Array] = {"time": time, "mode": data["mode"][0]}
    units: dict[str, str] = {"time": "s", "mode": "1"}

    def add(names: dict[str, str], rows: Array) -> None:
        for (name, unit), row in zip(names.items(), rows, strict=True):
            columns[name], units[name] = row, unit

    add(MEASUREMENT, data["measurement"])
    add(
        dict.fromkeys(("target_wheel_rate", "target_boom_rate", "target_bucket_rate"), "rad/s"),
        data["motor_speeds"],
    )
    add({"hinge_moment": "N m"}, data["hinge_moment"])
    # Rocks report on the step that ended; a row holds the step that begins.
    for name in ("bucket_force", "rock_summary"):
        data[name] = np.concatenate([data[name][:, 1:], data[name][:, -1:]], axis=1)
    add(dict.fromkeys(FORCE_NAMES[:3], "N m") | dict.fromkeys(FORCE_NAMES[3:], "N"), data["bucket_force"])
    add(ROCK_SUMMARY, data["rock_summary"])
    add(WALL_CONTACT, data["wall_contact"])

    plant, instance = station.plant, station.machine.instance
    n_q = plant.num_positions(instance)
    full = np.arange(plant.num_velocities(), dtype=float)
    row_of_velocity = {int(v): k for k, v in enumerate(plant.GetVelocitiesFromArray(instance, full))}
    # Torques are ordered as the instance's actuators.
    joints = [plant.get_joint_actuator(k).joint() for k in plant.GetJointActuatorIndices(instance)]
    row_of_torque = {joint.name(): k for k, joint in enumerate(joints)}
    row_of_rate = {joint.name(): row_of_velocity[joint.velocity_start()] for joint in joints}
    groups = {"wheels": WHEEL_JOINTS, "boom": ("boom_joint",), "bucket": ("bucket_joint",)}
    step = station.scenario.dynamics.time_step
    total = np.zeros_like(time)
    for name, members in groups.items():
        rate = data["machine_state"][n_q:][[row_of_rate[joint] for joint in members]]
        following = np.concatenate([rate[:, 1:], rate[:, -1:]], axis=1)
        torque = data["motor_torques"][[row_of_torque[joint] for joint in members]]
        columns[f"torque_{name}"], units[f"torque_{name}"] = torque.sum(axis=0), "N m"
        power = (torque * 0.5 * (rate + following)).sum(axis=0)
        columns[f"power_{name}"], units[f"power_{name}"] = power, "W"
        total += power
    columns["work"], units["work"] = np.concatenate([[0.0], np.cumsum(total[:-1]) * step])[:count], "J"
    wheel_speed = columns["wheel_rate"] * station.digger.kinematics.wheel_radius
    columns["wheel_slip"], units["wheel_slip"] = wheel_speed - columns["v_F"], "m/s"
    return columns, units
