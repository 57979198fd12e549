"""The machine measured against its data (section 2), by simulation on a `bench`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydrake.geometry import Box, Sphere
from pydrake.multibody.plant import CoulombFriction
from rich.table import Table

from drakerock.lhd import names
from drakerock.lhd.checks.bench import Bench, Obstacle, Record, make_bench
from drakerock.lhd.config import CheckConfig, MachineConfig, MachineData
from drakerock.lhd.geometry import calc_heaped_capacity
from drakerock.lhd.kinematics import (
    Kinematics,
    calc_bucket_range,
    calc_full_tilt,
    calc_joint_angles,
    calc_pitch,
    calc_reach,
    calc_tip,
)
from drakerock.lhd.placement import set_machine_angles, set_machine_pose

Array = np.ndarray

_MARGIN = 0.01  # rad kept from the stops when the bench sets a pose


@dataclass(frozen=True)
class CheckRow:
    """A line of the table: what was measured, against what.

    Attributes:
        name: what.
        measured: the value, in `unit`.
        unit: its unit.
        expected: what it is compared with; None: reported only.
        rule: how the comparison goes, in words.
        passed: the verdict; None: reported only.
    """

    name: str
    measured: float
    unit: str
    expected: float | None = None
    rule: str = "reported"
    passed: bool | None = None


def run_machine_checks(config: MachineConfig, checks: CheckConfig | None = None) -> list[CheckRow]:
    """Measure the machine by simulation (some seconds) and compare with `config.expected`.

    Args:
        config: the machine.
        checks: the bench.

    Returns:
        The table's rows, in the order of the table.

    Raises:
        InputError: the machine's SDFormat file is not usable.
    """
    checks = checks or CheckConfig()
    bench = make_bench(config, checks)
    shared = _Shared(config, checks, bench.kin, [])
    rows = [
        *_check_geometry(bench, config.expected),
        *_check_balance(shared),
        *_check_traction(shared),
        *_check_breakout(shared),
        *_check_lift(shared),
        *_check_motion(shared),
        *_check_hinge(shared),
        *_check_corner(shared),
        *_check_free_flight(shared),
    ]
    return [*rows, *_check_records(shared)]


def make_check_table(rows: list[CheckRow]) -> Table:
    """Return the rows as a table to print with rich."""
    table = Table("check", "measured", "expected", "unit", "rule", "", title="Machine check")
    for row in rows:
        verdict = {True: "[green]ok[/]", False: "[red]FAILED[/]", None: ""}[row.passed]
        expected = "" if row.expected is None else f"{row.expected:.5g}"
        table.add_row(row.name, f"{row.measured:.5g}", expected, row.unit, row.rule, verdict)
    return table


def make_check_data(rows: list[CheckRow]) -> dict[str, Any]:
    """Return the rows as plain data for JSON: {"passed": ..., "checks": [...]}."""
    return {
        "passed": all(row.passed is not False for row in rows),
        "checks": [asdict(row) for row in rows],
    }


@dataclass(frozen=True)
class _Shared:
    """What the checks share; `records` collects every run for the checks that hold throughout."""

    config: MachineConfig
    checks: CheckConfig
    kin: Kinematics
    records: list[tuple[Bench, Record]]

    def make(self, **options: Any) -> Bench:
        return make_bench(self.config, self.checks, kin=self.kin, **options)

    def run(self, bench: Bench, duration: float, **targets: float) -> Record:
        record = bench.run(duration, **targets)
        self.records.append((bench, record))
        return record


def _compare(name: str, value: float, unit: str, expected: float | None, tolerance: float) -> CheckRow:
    if expected is None:
        return CheckRow(name, float(value), unit)
    passed = bool(abs(value - expected) <= tolerance * abs(expected))
    return CheckRow(name, float(value), unit, float(expected), f"within {100 * tolerance:g} %", passed)


def _bound(name: str, value: float, unit: str, limit: float) -> CheckRow:
    return CheckRow(name, value, unit, limit, "at most", bool(value <= limit))


def _require(name: str, value: float, unit: str, limit: float) -> CheckRow:
    return CheckRow(name, value, unit, limit, "at least", bool(value >= limit))


def _place(bench: Bench, **pose: float) -> None:
    set_machine_pose(bench.plant, bench.plant_context, bench.machine, kin=bench.kin, **pose)


def _set_angles(bench: Bench, phi_l: float, phi_b: float) -> None:
    set_machine_angles(
        bench.plant, bench.plant_context, bench.machine, phi_l=phi_l, phi_b=phi_b, kin=bench.kin
    )


def _calc_carry_pose(kin: Kinematics) -> dict[str, float]:
    """Return z_tip and psi with the bucket level, its tip a tenth of its length above the floor."""
    return {"z_tip": 0.1 * kin.bucket_length, "psi": 0.0}


# -- geometry and statics


def _check_geometry(bench: Bench, data: MachineData) -> list[CheckRow]:
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
        CheckRow("degrees of freedom of the tree", plant.num_velocities(machine.instance), ""),
        _compare("total mass", plant.CalcTotalMass(context, [machine.instance]), "kg", data.total_mass, 1e-3),
        _compare(
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
        _require("clearance of the bucket to tyres and front unit", _calc_clearance(bench), "m", 0.0),
        _compare(
            f"r_ft on a slope of {data.reach_slope_deg:g} deg",
            calc_reach(kin, float(np.radians(data.reach_slope_deg))),
            "m",
            data.reach,
            0.05,
        ),
    ]


def _calc_clearance(bench: Bench) -> float:
    """Return the smallest distance [m] of the bucket at its stops from the front unit and its wheels."""
    plant, kin, context = bench.plant, bench.kin, bench.plant_context
    others = ("front_unit", *names.WHEELS[:2])
    bucket = plant.GetCollisionGeometriesForBody(bench.get_body("bucket"))
    chassis = [g for name in others for g in plant.GetCollisionGeometriesForBody(bench.get_body(name))]
    distances = []
    for phi_l in kin.phi_l_grid:
        for phi_b in calc_bucket_range(kin, phi_l):
            _set_angles(bench, float(phi_l), float(phi_b))
            query = plant.get_geometry_query_input_port().Eval(context)
            distances += [
                query.ComputeSignedDistancePairClosestPoints(a, b).distance for a in bucket for b in chassis
            ]
    return float(min(distances))


def _check_balance(shared: _Shared) -> list[CheckRow]:
    bench = shared.make()
    plant, machine = bench.plant, bench.machine
    _place(bench, x_tip=0.0, **_calc_carry_pose(bench.kin))
    start = _find_chassis(bench)
    record = shared.run(bench, 2.0)
    loads = record.tyre_force[-1, :, 2]
    context = bench.plant_context
    weight = plant.CalcTotalMass(context, [machine.instance]) * 9.81
    front, rear = (
        np.mean([bench.get_body(w).EvalPoseInWorld(context).translation()[0] for w in pair])
        for pair in (names.WHEELS[:2], names.WHEELS[2:])
    )
    center = plant.CalcCenterOfMassPositionInWorld(context, [machine.instance])[0]
    share = (center - rear) / (front - rear)
    drift = float(np.linalg.norm(_find_chassis(bench) - start))
    sag = float(record.tip[0, 2] - record.tip[-1, 2])
    return [
        _compare("load of the front axle", loads[:2].sum() / 1e3, "kN", share * weight / 1e3, 0.01),
        _compare("load of the rear axle", loads[2:].sum() / 1e3, "kN", (1 - share) * weight / 1e3, 0.01),
        _bound("chassis' drift in 2 s of standing", 1e3 * drift, "mm", 1.0),
        CheckRow("tip's sag in 2 s by the motors' compliance", 1e3 * sag, "mm"),
    ]


def _find_chassis(bench: Bench) -> Array:
    return bench.get_body("front_unit").EvalPoseInWorld(bench.plant_context).translation().copy()


def _check_traction(shared: _Shared) -> list[CheckRow]:
    kin = shared.kin
    pose = _calc_carry_pose(kin)
    # A frictionless wall across the lip: it takes the push and no weight.
    size = 2 * kin.bucket_length
    wall = Obstacle(Box(size, 20.0, size), (size / 2 + 0.02, 0.0, size / 2 + 0.02), 0.0)
    bench = shared.make(obstacle=wall)
    _place(bench, x_tip=0.0, **pose)
    # Not for long: the push lowers the boom by its motor's compliance, and a bucket on the floor takes weight.
    record = shared.run(bench, 1.5, wheel=kin.wheel_speed)
    late = record.time > record.time[-1] - 0.5
    push = record.tyre_force[late, :, 0].sum(axis=1).mean()
    normal = record.tyre_force[late, :, 2].sum(axis=1).mean()
    rates = [bench.get_rate(record, joint)[late].mean() for joint in names.WHEEL_JOINTS]
    efforts = [np.abs(record.effort[late, bench.get_column(j)]).max() for j in names.WHEEL_JOINTS]
    friction = _calc_tyre_friction(bench, shared.checks)
    return [
        _compare("traction against a wall", push / 1e3, "kN", friction * normal / 1e3, 0.02),
        CheckRow(
            "traction the motors could hold", 4 * bench.machine.wheel.effort / kin.wheel_radius / 1e3, "kN"
        ),
        _require(
            "wheels slip before they stall: slowest wheel", float(min(rates)), "rad/s", 0.9 * kin.wheel_speed
        ),
        _bound(
            "wheels slip before they stall: largest torque",
            float(max(efforts)) / 1e3,
            "kNm",
            bench.machine.wheel.effort / 1e3,
        ),
    ]


def _calc_tyre_friction(bench: Bench, checks: CheckConfig) -> float:
    wheel = bench.get_body(names.WHEELS[0])
    inspector = bench.scene_graph.model_inspector()
    geometry = bench.plant.GetCollisionGeometriesForBody(wheel)[0]
    material: CoulombFriction = inspector.GetProximityProperties(geometry).GetProperty(  # type: ignore[assignment]
        "material", "coulomb_friction"
    )
    mu = material.dynamic_friction()
    return float(2 * mu * checks.floor_friction / (mu + checks.floor_friction))


# -- forces and motion


def _check_breakout(shared: _Shared) -> list[CheckRow]:
    held, free = (_measure_breakout(shared, hold_chassis) for hold_chassis in (True, False))
    return [
        _compare(
            "breakout force, chassis held",
            held / 1e3,
            "kN",
            _scale(shared.config.expected.breakout_force, 1e-3),
            0.05,
        ),
        CheckRow("breakout force, chassis free", free / 1e3, "kN"),
    ]


def _measure_breakout(shared: _Shared, hold_chassis: bool) -> float:
    """Return the vertical force [N] on a ball without friction that stalls the tip of the curling bucket."""
    kin = shared.kin
    pose = {"z_tip": 0.02 * kin.bucket_length, "psi": 0.0}
    angles = [float(angle) for angle in calc_joint_angles(kin, **pose)]
    x_tip = float(calc_tip(kin, 0.0, *angles)[0])
    radius = 0.02 * kin.bucket_length
    ball = Obstacle(Sphere(radius), (x_tip - radius / 2, 0.0, pose["z_tip"] + 5 * radius), 0.0)
    bench = shared.make(hold_chassis=hold_chassis, floor=not hold_chassis, obstacle=ball)
    if hold_chassis:
        _set_angles(bench, *angles)
    else:
        _place(bench, x_tip=x_tip, **pose)
    record = shared.run(bench, 1.2, bucket=-0.2 * kin.bucket_speed)
    return float(-record.bucket_force[record.time > record.time[-1] - 0.2, 2].mean())


def _scale(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _check_lift(shared: _Shared) -> list[CheckRow]:
    kin = shared.kin
    bench = shared.make(payload=shared.config.expected.payload)
    phi_l = float(calc_joint_angles(kin, 0.0, 0.0)[0])
    psi = float(calc_full_tilt(kin, phi_l)) - 2 * _MARGIN
    z_tip = float(calc_tip(kin, 0.0, phi_l, kin.phi_level - phi_l - psi)[1])
    _place(bench, x_tip=0.0, z_tip=z_tip, psi=psi)
    # The bucket turns against the boom and so keeps its pitch.
    rate = min(kin.boom_speed, kin.bucket_speed)
    span = kin.phi_l_range[1] - kin.phi_l_range[0]
    record = shared.run(bench, 1.2 * span / rate, boom=-rate, bucket=rate)
    # Past the start's jerk and before the stop.
    angles = record.q[:, bench.plant.GetJointByName("boom_joint").position_start()]
    moving = (record.time > 0.2) & (angles > kin.phi_l_range[0] + 2 * _MARGIN)
    boom = np.abs(record.effort[moving, bench.get_column("boom_joint")]).max()
    rear = record.tyre_force[moving, 2:, 2].sum(axis=1).min()
    return [
        _bound(
            f"boom lifts {shared.config.expected.payload / 1e3:g} t: angle reached",
            float(np.degrees(angles.min())),
            "deg",
            float(np.degrees(kin.phi_l_range[0] + _MARGIN)),
        ),
        _bound("largest boom torque on the way", float(boom) / 1e3, "kNm", bench.machine.boom.effort / 1e3),
        _require("smallest load of the rear axle on the way", float(rear) / 1e3, "kN", 0.0),
    ]


def _check_motion(shared: _Shared) -> list[CheckRow]:
    kin, rows = shared.kin, []
    low, high = kin.phi_l_range[1] - _MARGIN, kin.phi_l_range[0] + _MARGIN
    bench = shared.make()
    _set_angles(bench, low, kin.phi_level - low)
    _place(bench, x_tip=0.0, z_tip=_find_lowest_tip(kin), psi=0.0)
    rate = min(kin.boom_speed, kin.bucket_speed)
    start = bench.get_positions()[0]
    for name, sign, goal in (("raised", -1.0, high), ("lowered", 1.0, start)):
        # The bucket turns against the boom and so keeps level.
        nominal = abs(goal - bench.get_positions()[0]) / rate
        record = shared.run(bench, 1.3 * nominal, boom=sign * rate, bucket=-sign * rate)
        time = _find_time(bench, record, "boom_joint", goal)
        rows.append(_compare(f"boom {name} with a level bucket", time, "s", nominal, 0.05))
        bench.run(0.5)
    bench = shared.make()
    _place(bench, x_tip=0.0, z_tip=float(calc_tip(kin, 0.0, high, kin.phi_level - high)[1]), psi=0.0)
    tilt, dump = (float(angle) for angle in calc_bucket_range(kin, high))
    shared.run(bench, 1.3 * (bench.get_positions()[1] - tilt) / kin.bucket_speed, bucket=-kin.bucket_speed)
    for name, sign, goal in (("dumped", 1.0, dump - _MARGIN), ("tilted back", -1.0, tilt + _MARGIN)):
        nominal = abs(goal - bench.get_positions()[1]) / kin.bucket_speed
        record = shared.run(bench, 1.3 * nominal, bucket=sign * kin.bucket_speed)
        time = _find_time(bench, record, "bucket_joint", goal)
        rows.append(_compare(f"bucket {name}, boom up", time, "s", nominal, 0.05))
    return rows


def _find_lowest_tip(kin: Kinematics) -> float:
    """Return a tip height just above the floor that the level bucket can take."""
    return max(0.02 * kin.bucket_length, float(calc_tip(kin, 0.0, kin.phi_l_range[1], 0.0)[1]))


def _find_time(bench: Bench, record: Record, joint: str, goal: float) -> float:
    """Return when the joint passed `goal` [s since the run's start]; infinite if it never did."""
    angles = record.q[:, bench.plant.GetJointByName(joint, bench.machine.instance).position_start()]
    passed = np.nonzero((angles - goal) * (angles[0] - goal) <= 0)[0]
    return float(record.time[passed[0]] - record.time[0]) if len(passed) else float("inf")


# -- what the hinge carries


def _check_hinge(shared: _Shared) -> list[CheckRow]:
    kin = shared.kin
    bench = shared.make(hold_chassis=True, floor=False)
    angles = [float(angle) for angle in calc_joint_angles(kin, 0.3 * kin.bucket_length, 0.2)]
    _set_angles(bench, *angles)
    p_BQ = np.array([*bench.bucket.profile[0], bench.bucket.outer_width / 2])[[0, 2, 1]]
    R_WB = bench.get_body("bucket").EvalPoseInWorld(bench.plant_context).rotation()
    weight = 9.81 * shared.config.expected.payload
    force = weight * np.array([-0.5, 0.2, 0.7])
    bench.apply_force("bucket", p_BQ, force)
    record = shared.run(bench, 0.3)
    # Statics: the joint's reaction on the bucket balances the load about the hinge's mid-point.
    expected = -np.cross(p_BQ, R_WB.inverse().multiply(force))[[0, 2]]
    error = np.linalg.norm(record.moment[-1] - expected) / np.linalg.norm(expected)
    return [
        _compare(
            "hinge moment under a known load at the corner",
            float(np.linalg.norm(record.moment[-1])) / 1e3,
            "kNm",
            float(np.linalg.norm(expected)) / 1e3,
            0.01,
        ),
        _bound("  its vector's error", 100 * float(error), "%", 1.0),
    ]


def _check_corner(shared: _Shared) -> list[CheckRow]:
    kin = shared.kin
    half = make_bench(shared.config, shared.checks, kin=kin).bucket.outer_width / 2
    size = 2 * kin.bucket_length
    # A post in the way of the bucket's left corner, a fifth of the half width inwards.
    post = Obstacle(
        Box(size, half, size), (size / 2 + 0.001, 1.3 * half, size / 2 + 0.02), shared.checks.floor_friction
    )
    bench = shared.make(obstacle=post)
    _place(bench, x_tip=0.0, **_calc_carry_pose(kin))
    record = shared.run(bench, 2.0, wheel=kin.wheel_speed)
    moment = np.linalg.norm(record.moment, axis=1) / 1e3
    late = record.time > record.time[-1] - 1.0
    expected = _scale(shared.config.expected.critical_moment, 1e-3)
    rule = "for comparison"
    return [
        CheckRow(
            "tau_c: corner at a post, full torque, steady", float(moment[late].mean()), "kNm", expected, rule
        ),
        CheckRow("tau_c: the same, largest", float(moment.max()), "kNm", expected, rule),
    ]


# -- balances


def _check_free_flight(shared: _Shared) -> list[CheckRow]:
    """Let the machine float while its motors work; and fall, for gravity's impulse."""
    kin, rows = shared.kin, []
    for gravity in (True, False):
        bench = shared.make(floor=False, gravity=gravity)
        plant, context, instance = bench.plant, bench.plant_context, [bench.machine.instance]
        bodies = [plant.get_body(index) for index in plant.GetBodyIndices(bench.machine.instance)]
        _place(bench, x_tip=0.0, z_tip=0.5 * kin.bucket_length, psi=0.0)
        momentum_0, _, energy_0 = _measure_motion(bench)
        duration = 0.5
        record = shared.run(
            bench,
            duration,
            boom=-0.5 * kin.boom_speed,
            bucket=-0.8 * kin.bucket_speed,
            wheel=0.5 * kin.wheel_speed,
        )
        momentum_1, spin_1, energy_1 = _measure_motion(bench)
        if gravity:
            impulse = (
                plant.CalcTotalMass(context, instance) * plant.gravity_field().gravity_vector() * duration
            )
            error = np.linalg.norm(momentum_1 - momentum_0 - impulse) / np.linalg.norm(impulse)
            rows.append(_bound("momentum in free fall: error", 100 * float(error), "% of m g t", 0.1))
            continue
        moved = sum(
            np.linalg.norm(body.EvalSpatialVelocityInWorld(context).translational()) * body.get_mass(context)
            for body in bodies
        )
        work, turnover = _calc_work(bench, record)
        reach = kin.boom_length + kin.bucket_length
        rows += [
            _bound(
                "momentum afloat: error", 100 * float(np.linalg.norm(momentum_1)) / moved, "% of moved", 0.5
            ),
            _bound(
                "angular momentum afloat: error",
                100 * float(np.linalg.norm(spin_1)) / (moved * reach),
                "% of moved",
                0.5,
            ),
            _bound(
                "energy less the motors' work: error",
                100 * abs(energy_1 - energy_0 - work) / turnover,
                "% of work",
                5.0,
            ),
        ]
    return rows


def _calc_work(bench: Bench, record: Record) -> tuple[float, float]:
    """Return what motors put in less what damped joints took out, and the sum of the amounts [J].

    The work of a step is the torque times the mean of the joint's rate before and after.
    """
    plant, instance = bench.plant, bench.machine.instance
    work, turnover = 0.0, 0.0
    for index in plant.GetJointIndices(instance):
        joint = plant.get_joint(index)
        if joint.num_velocities() != 1:
            continue
        rate = bench.get_rate(record, joint.name())
        torque = -joint.default_damping_vector()[0] * rate
        if joint.name() in names.JOINTS:
            torque = torque + record.effort[:, bench.get_column(joint.name())]
        power = torque * (rate + np.concatenate([[0.0], rate[:-1]])) / 2
        work += float(power.sum() * plant.time_step())
        turnover += float(np.abs(power).sum() * plant.time_step())
    return work, turnover


def _measure_motion(bench: Bench) -> tuple[Array, Array, float]:
    """Return momentum, angular momentum about the centre of mass, kinetic energy of the machine."""
    plant, context, instance = bench.plant, bench.plant_context, [bench.machine.instance]
    center = plant.CalcCenterOfMassPositionInWorld(context, instance)
    momentum = plant.CalcSpatialMomentumInWorldAboutPoint(context, instance, center)
    return momentum.translational(), momentum.rotational(), float(plant.CalcKineticEnergy(context))


def _check_records(shared: _Shared) -> list[CheckRow]:
    """Check what has to hold in every run."""
    gap = max(float(record.gap.max()) for _, record in shared.records)
    rows = [_bound("closure error of the linkage, all runs", 1e3 * gap, "mm", 1.0)]
    for name, joints in (
        ("wheels", names.WHEEL_JOINTS),
        ("boom", ("boom_joint",)),
        ("bucket", ("bucket_joint",)),
    ):
        torque = max(
            float(np.abs(record.effort[:, bench.get_column(joint)]).max())
            for bench, record in shared.records
            for joint in joints
        )
        limits = shared.records[0][0].machine
        limit = {"wheels": limits.wheel, "boom": limits.boom, "bucket": limits.bucket}[name].effort
        rows.append(_bound(f"torque of {name}, all runs", torque / 1e3, "kNm", limit / 1e3 * (1 + 1e-9)))
    walls = [float(record.wall[-1]) for _, record in shared.records]
    return [*rows, CheckRow("wall time of a step, the machine alone", 1e3 * float(np.median(walls)), "ms")]
