"""From what happened in a cycle to its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drakerock.identity import calc_config_hash, get_versions
from drakerock.loading.folder import PLAN, SIGNALS
from drakerock.loading.mining import MachineRating, calc_mining_numbers
from drakerock.loading.outcome import CycleOutcome
from drakerock.loading.performance import Weighing, calc_damage, find_events, find_weighing_events
from drakerock.loading.plan import DigPlan, NoPlan
from drakerock.loading.scenario import Scenario
from drakerock.loading.segments import TIMEOUTS, WAYPOINT_TIMES, Mode

Array = NDArray[np.float64]


def make_outcome(
    scenario: Scenario,
    plan: DigPlan | NoPlan,
    controller: Array,
    signals: dict[str, Array],
    parts: Sequence[str],
    masses: Array,
    in_bucket: NDArray[np.bool_],
    debris: NDArray[np.bool_],
    weighing: Weighing | None,
    failure: str | None,
    at_rest: bool,
    rating: MachineRating,
    wall_time: float,
    cpu_time: float,
) -> CycleOutcome:
    """Return the outcome of a cycle.

    Args:
        scenario: what it was.
        plan: what was planned.
        controller: the tracker's progress, see `SegmentTracker`.
        signals: columns of all steps.
        parts: names of the machine's bodies.
        masses: (n,) of the rocks [kg].
        in_bucket, debris: (n,) the load at t4, and what was left loose on the floor.
        weighing: the machine on the scale, if it came to that.
        failure: why the dynamics failed, if they did.
        at_rest: whether the rocks rested when debris was counted.
        rating: what the numbers of mining are relative to.
        wall_time, cpu_time: cost of the cycle [s].
    """
    times = controller[WAYPOINT_TIMES]
    time = signals["time"]
    load = float(masses[in_bucket].sum())
    phi: tuple[float, float, float] | None = None
    loading_time = None
    if failure is not None:
        reason = failure
    elif isinstance(plan, NoPlan):
        reason = f"no candidate slice: {plan.reason}"
        phi = (0.0, 0.0, 0.0)
    else:
        reason = "s4 timed out" if controller[TIMEOUTS][Mode.S3] else "s4 reached"
        loading_time = float(times[4] - times[0])
        damage = calc_damage(
            time,
            signals["hinge_moment"],
            times[0],
            times[4],
            scenario.tau_c,
            scenario.loading.performance.t_char,
        )
        phi = (-load / loading_time, damage, float(masses[debris].sum()))
    peak = mean = energy = None
    if np.all(np.isfinite(times)):
        push = -signals["bucket_force_x"][(time >= times[0]) & (time < times[2])]
        if len(push):
            peak, mean = float(push.max()), float(push.mean())
        energy = float(
            np.interp(times[4], time, signals["work"]) - np.interp(times[0], time, signals["work"])
        )
    config = scenario.loading
    events = find_events(
        signals, controller[TIMEOUTS], times, config.performance, config.planning.v_x_max, parts
    )
    if weighing:
        events += find_weighing_events(weighing, load, config.performance.weighing_tolerance)
    if not at_rest and failure is None:
        events.append({"event": "rocks not at rest", "time_s": float(time[-1])})
    events.sort(key=lambda item: item["time_s"])
    steps = max(len(time) - 1, 0)
    planned: dict[str, Any]
    if isinstance(plan, DigPlan):
        planned = {
            "entry_y_m": plan.y, "entry_x_m": float(plan.waypoint_x[0]), "slope_rad": plan.slope,
            "h_s2_m": plan.h_s2, "psi_m_rad": plan.psi_m, "volume_m3": plan.volume,
            "volume_wanted_m3": plan.volume_wanted, "volume_reached": plan.reached,
            "waypoint_times_s": plan.waypoint_t.tolist(),
        }  # fmt: skip
    else:
        planned = {"reason": plan.reason}
    return CycleOutcome(
        status="done" if failure is None else "failed",
        reason=reason,
        objectives={
            "production": -phi[0] if phi else None,
            "damage": phi[1] if phi else None,
            "debris": phi[2] if phi else None,
        },
        phi1=phi[0] if phi else None,
        phi2=phi[1] if phi else None,
        phi3=phi[2] if phi else None,
        strategy=scenario.loading.strategy.model_dump(),
        bucket_mass_kg=load if phi else None,
        bucket_rocks=int(in_bucket.sum()) if phi else None,
        weighed_mass_kg=weighing.weight_kg if weighing else None,
        counted_when_weighed_kg=weighing.counted_kg if weighing else None,
        loading_time_s=loading_time,
        waypoint_times_s=[float(t) if np.isfinite(t) else None for t in times],
        plan=planned,
        peak_push_force_N=peak,
        mean_push_force_N=mean,
        energy_J=energy,
        mining=calc_mining_numbers(signals, times, load, float(masses[debris].sum()), rating)
        if phi
        else None,
        events=events,
        rocks={
            "total": len(masses),
            "awake_max": int(signals["n_awake"].max()) if len(time) else 0,
            "awake_mean": float(signals["n_awake"].mean()) if len(time) else 0.0,
            "penetration_max_m": float(signals["penetration_max"].max()) if len(time) else 0.0,
            "lost": int(signals["n_lost"][-1]) if len(time) else 0,
            "flagged_steps": int(signals["n_flagged"][-1]) if len(time) else 0,
        },
        wall_time_s=wall_time,
        cpu_time_s=cpu_time,
        sim_time_s=float(time[-1]) if len(time) else 0.0,
        steps=steps,
        ms_per_step=1e3 * cpu_time / max(steps, 1),
        files={"planned_tip_path": PLAN, "actual_tip_path": SIGNALS},
        seed=scenario.seed,
        versions=get_versions(),
        scenario_hash=calc_config_hash(scenario),
    )
