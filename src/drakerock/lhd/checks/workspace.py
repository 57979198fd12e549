"""Checks of masses, bucket and workspace, without simulation."""

from __future__ import annotations

import numpy as np

from drakerock.lhd.checks.bench import Bench
from drakerock.lhd.checks.clearance import check_clearance
from drakerock.lhd.checks.rows import CheckRow, compare
from drakerock.lhd.config import MachineData
from drakerock.lhd.geometry import calc_heaped_capacity
from drakerock.lhd.kinematics import (
    calc_bucket_range,
    calc_full_tilt,
    calc_joint_angles,
    calc_pitch,
    calc_reach,
    calc_tip,
)


def check_geometry(bench: Bench, data: MachineData) -> list[CheckRow]:
    """Check counts, masses, the bucket's volume, ranges and clearances."""
    plant, kin, machine = bench.plant, bench.kin, bench.machine
    context = plant.CreateDefaultContext()
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(machine.instance)]
    phi_l = kin.phi_l_range
    tilt, dump = calc_bucket_range(kin, phi_l)
    phi_floor = float(calc_joint_angles(kin, 0.0, 0.0)[0])
    top = calc_tip(kin, 0.0, phi_l[0], tilt[0])
    low = calc_tip(kin, 0.0, phi_l[0], dump[0])
    return [
        CheckRow("bodies", len(plant.GetBodyIndices(machine.instance)), ""),
        # The joint that Drake adds for the free front unit is none of the machine's.
        CheckRow("joints of the tree", sum(joint.num_velocities() == 1 for joint in joints), ""),
        CheckRow("joints that close loops", len(machine.loops), ""),
        CheckRow("elements of the file without effect (see the warnings)", len(machine.ignored), ""),
        CheckRow("degrees of freedom of the tree", plant.num_velocities(machine.instance), ""),
        compare("total mass", plant.CalcTotalMass(context, [machine.instance]), "kg", data.total_mass, 1e-3),
        compare(
            "bucket, heaped capacity", calc_heaped_capacity(bench.bucket), "m^3", data.heaped_capacity, 0.02
        ),
        CheckRow("boom, lowest", float(np.degrees(phi_l[1])), "deg"),
        CheckRow("boom, highest", float(np.degrees(phi_l[0])), "deg"),
        CheckRow(
            "bucket, full tilt psi_m on the floor", float(np.degrees(calc_full_tilt(kin, phi_floor))), "deg"
        ),
        CheckRow(
            "bucket, full tilt psi_m at the top", float(np.degrees(calc_full_tilt(kin, phi_l[0]))), "deg"
        ),
        CheckRow(
            "bucket, full dump at the top", float(np.degrees(calc_pitch(kin, phi_l[0], dump[0]))), "deg"
        ),
        CheckRow("tip, highest (tilted, boom up)", float(top[1]), "m"),
        CheckRow("tip, dumped with the boom up", float(low[1]), "m"),
        *check_clearance(bench),
        compare(
            f"r_ft on a slope of {data.reach_slope_deg:g} deg",
            calc_reach(kin, float(np.radians(data.reach_slope_deg))),
            "m",
            data.reach,
            0.05,
        ),
    ]
