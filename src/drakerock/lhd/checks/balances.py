"""Checks of momentum and energy, and of what has to hold in every run."""

from __future__ import annotations

import numpy as np

from drakerock.lhd import names
from drakerock.lhd.checks.bench import Bench, Record
from drakerock.lhd.checks.rows import CheckRow, bound
from drakerock.lhd.checks.trials import Trials, place

Array = np.ndarray


def check_free_flight(trials: Trials) -> list[CheckRow]:
    """Let the machine float while its motors work; and fall, for gravity's impulse."""
    kin, rows = trials.kin, []
    for gravity in (True, False):
        bench = trials.make(floor=False, gravity=gravity)
        plant, context, instance = bench.plant, bench.plant_context, [bench.machine.instance]
        bodies = [plant.get_body(index) for index in plant.GetBodyIndices(bench.machine.instance)]
        # Nose-down by so much that the bucket does not reach its stop on the way, however fast it turns.
        place(bench, x_tip=0.0, z_tip=0.5 * kin.bucket_length, psi=-0.15)
        momentum_0, _, energy_0 = _measure_motion(bench)
        duration = plant.time_step() * round(0.5 / kin.bucket_speed / plant.time_step())
        record = trials.run(
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
            rows.append(bound("momentum in free fall: error", 100 * float(error), "% of m g t", 0.1))
            continue
        moved = sum(
            np.linalg.norm(body.EvalSpatialVelocityInWorld(context).translational()) * body.get_mass(context)
            for body in bodies
        )
        work, turnover = _calc_work(bench, record)
        reach = kin.boom_length + kin.bucket_length
        rows += [
            bound(
                "momentum afloat: error", 100 * float(np.linalg.norm(momentum_1)) / moved, "% of moved", 0.5
            ),
            bound(
                "angular momentum afloat: error",
                100 * float(np.linalg.norm(spin_1)) / (moved * reach),
                "% of moved",
                0.5,
            ),
            bound(
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
        damping = joint.default_damping_vector()[0]
        torque = np.zeros_like(rate)
        if joint.name() in names.JOINTS:
            torque = record.effort[:, bench.get_column(joint.name())]
        torque = torque - damping * rate
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


def check_records(trials: Trials) -> list[CheckRow]:
    """Check what has to hold in every run."""
    gap = max(float(record.gap.max()) for _, record in trials.records)
    rows = [bound("closure error of the linkage, all runs", 1e3 * gap, "mm", 1.0)]
    for name, joints in (
        ("wheels", names.WHEEL_JOINTS),
        ("boom", ("boom_joint",)),
        ("bucket", ("bucket_joint",)),
    ):
        torque = max(
            float(np.abs(record.effort[:, bench.get_column(joint)]).max())
            for bench, record in trials.records
            for joint in joints
        )
        limits = trials.records[0][0].machine
        motor = {"wheels": limits.wheel, "boom": limits.boom, "bucket": limits.bucket}[name]
        limit = motor.peak * (1.0 + 1e-9)
        rows.append(bound(f"torque of {name}, all runs", torque / 1e3, "kNm", limit / 1e3))
    walls = [float(record.wall[-1]) for _, record in trials.records]
    return [*rows, CheckRow("wall time of a step, the machine alone", 1e3 * float(np.median(walls)), "ms")]
