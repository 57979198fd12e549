"""A stand-in for the simulation with the contract of `run_sequence`: seconds become milliseconds.

What a loading yields depends on scenario, loading and the loading before, as with the real one. Environment
variables say how it behaves; each start and finish is logged, so that tests can tell what was run twice.
"""

from __future__ import annotations

import errno
import json
import os
import signal
import time
from pathlib import Path

import numpy as np

from drakerock.errors import InputError, SimulationFailure
from drakerock.files import write_text
from drakerock.identity import calc_config_hash
from drakerock.loading.cost import LoadingCost
from drakerock.loading.field import HeightField
from drakerock.loading.field_file import save_height_fields
from drakerock.loading.folder import HEIGHT_FIELDS, NEXT_PILE, PLAN
from drakerock.loading.outcome import CycleOutcome
from drakerock.loading.sensing import make_grid
from drakerock.randomness import make_generator
from drakerock.rocks.config import SiteConfig

DURATION = float(os.environ.get("STUDY_WORK_SECONDS", "0.05"))
LOG = os.environ.get("STUDY_WORK_LOG")
# How points with alpha above 1.5 misbehave.
MODE = os.environ.get("STUDY_WORK_MODE", "")


def run(scenario, n_loadings, folder, *, progress=None):
    folder.mkdir(parents=True, exist_ok=True)
    state, outcomes = 0.0, []
    for number in range(n_loadings):
        place = folder / f"loading_{number:02d}"
        path = place / "outcome.json"
        if path.exists():
            outcome = CycleOutcome.from_json(path.read_text())
            assert outcome.scenario_hash == calc_config_hash(scenario), "the folder is of another sequence"
        else:
            if number:
                state = json.loads((folder / f"loading_{number - 1:02d}" / NEXT_PILE).read_text())
            outcome = _load(scenario, number, state, place, progress)
        outcomes.append(outcome)
        if outcome.status == "failed":
            break
    return outcomes


def _load(scenario, number, state, place, progress):
    started = time.time()
    if progress:
        progress(number, "approach", 0.0)
    _log(place, "start")
    s = scenario.loading.strategy
    _misbehave(scenario, number)
    rng = make_generator(scenario.seed, "loading", number, *(repr(v) for v in (s.alpha, s.beta, s.gamma)))
    state = 0.6 * state + rng.normal()
    place.mkdir(exist_ok=True)
    # Half-written files for a while, as in the real one.
    (place / "signals.bin").write_bytes(b"half")
    end = time.monotonic() + DURATION
    while time.monotonic() < end:
        time.sleep(DURATION / 5)
        if progress:
            progress(number, "s1", 1.0)
    (place / "signals.bin").write_bytes(rng.bytes(int(os.environ.get("STUDY_WORK_BYTES", "2000"))))
    (place / NEXT_PILE).write_text(json.dumps(state))
    (place / PLAN).write_text(json.dumps({"reason": "no pile to plan on"}))
    failed = MODE == "fail" and s.alpha > 1.5 and number == 1 and scenario.dynamics.time_step > 0.006
    production = 100 * s.alpha + 30 * s.beta + 3 * state
    values = {"production": production, "damage": s.gamma**2 + 0.02 * state, "debris": 500 * s.kappa + state}
    outcome = CycleOutcome(
        status="failed" if failed else "done",
        reason="solver failure at 1.00 s: made to fail" if failed else "s4 reached",
        objectives=dict.fromkeys(values) if failed else values,
        phi1=-production, phi2=values["damage"], phi3=values["debris"],
        strategy=s.model_dump(), bucket_mass_kg=1e3, bucket_rocks=3, weighed_mass_kg=1e3, loading_time_s=9.0,
        waypoint_times_s=[0.0, 1.0, 2.0, 3.0, 9.0], plan={}, peak_push_force_N=1.0, mean_push_force_N=1.0,
        energy_J=1.0, events=[], rocks={"total": 9, "awake_max": 5, "awake_mean": 2.5},
        wall_time_s=started, sim_time_s=9.0, steps=900, ms_per_step=1.0, files={}, seed=scenario.seed,
        versions={}, scenario_hash=calc_config_hash(scenario),
    )  # fmt: skip
    save_height_fields(*(make_height_field(state + i) for i in (0.0, 0.1)), place / HEIGHT_FIELDS)
    LoadingCost(1.0, 1.0, 500.0).save(place)
    write_text(place / "outcome.json", outcome.to_json())
    _log(place, "finish")
    return outcome


def make_height_field(state):
    """Return a slope of 45 degrees whose toe is where `state` says."""
    x, y = make_grid(SiteConfig(drift_width=3.0), 0.5, 4.0)
    toe = -2.0 - 0.1 * np.tanh(state)
    return HeightField(x, y, np.maximum(x - toe, 0.0)[:, None] * np.ones(len(y)), 0.5)


def _misbehave(scenario, number):
    s = scenario.loading.strategy
    if s.alpha <= 1.5 or number != 1:
        return
    if MODE == "raise":
        raise SimulationFailure("made to fail")
    if MODE == "impossible":
        raise InputError("made impossible")
    if MODE == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    if MODE == "memory":
        hoard = []
        while True:
            hoard.append(np.ones(4_000_000))
            time.sleep(0.01)
    if MODE == "disk":
        raise OSError(errno.ENOSPC, "No space left on device")


def _log(place: Path, what: str) -> None:
    if LOG:
        with open(LOG, "a") as file:
            file.write(
                f"{what} {place.parent.parent.name}/{place.parent.name}/{place.name} {time.time()!r}\n"
            )
