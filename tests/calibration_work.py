"""A stand-in for the simulation whose curves are known functions of density, friction and the wheels' stall torque."""

from __future__ import annotations

import numpy as np

import study_work
from drakerock.loading.signal_table import save_signals
from drakerock.randomness import make_generator

RUNS: list[str] = []


def calc_curves(density, friction, time):
    angle = 0.4 + 0.1 * time - 0.02 * (density / 2500.0) * time**1.5
    force = 4e4 * friction**0.7 * (density / 2500.0) * (1 - np.exp(-time))
    return angle, force


def calc_speed(stall_torque, time):
    return 1.3 * (1 - np.exp(-5.0 * stall_torque / 1.9e5 * time))


def run(scenario, n_loadings, folder, *, progress=None):
    RUNS.append(str(folder))
    outcomes = study_work.run(scenario, n_loadings, folder, progress=progress)
    time = np.arange(0.0, 6.0, 0.01)
    angle, force = calc_curves(scenario.rocks.density, scenario.rocks.friction, time)
    # As one pile differs from another.
    force = force * (1 + 0.02 * make_generator(scenario.seed, "scatter").normal())
    columns = {"time": time, "phi_l": angle, "bucket_force_x": force, "x_T": -3.0 + 0.4 * time}
    columns["torque_boom"] = 2.0 * force
    columns["v_F"] = calc_speed(scenario.machine.wheel.effort or 1.9e5, time)
    units = {
        "time": "s",
        "phi_l": "rad",
        "bucket_force_x": "N",
        "x_T": "m",
        "torque_boom": "N m",
        "v_F": "m/s",
    }
    for number in range(n_loadings):
        save_signals(columns, units, folder / f"loading_{number:02d}" / "signals.parquet")
    return outcomes
