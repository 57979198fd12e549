"""A stand-in for the simulation whose curves are known functions of density and friction."""

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


def run(scenario, n_loadings, folder, *, progress=None):
    RUNS.append(str(folder))
    outcomes = study_work.run(scenario, n_loadings, folder, progress=progress)
    time = np.arange(0.0, 6.0, 0.01)
    angle, force = calc_curves(scenario.rocks.density, scenario.rocks.friction, time)
    # As one pile differs from another.
    force = force * (1 + 0.02 * make_generator(scenario.seed, "scatter").normal())
    columns = {"time": time, "phi_l": angle, "bucket_force_x": force, "x_T": -3.0 + 0.4 * time}
    columns["torque_boom"] = 2.0 * force
    units = {"time": "s", "phi_l": "rad", "bucket_force_x": "N", "x_T": "m", "torque_boom": "N m"}
    for number in range(n_loadings):
        save_signals(columns, units, folder / f"loading_{number:02d}" / "signals.parquet")
    return outcomes
