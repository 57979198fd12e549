"""One loading cycle: a pure function of scenario, pile and strategy (method section 5)."""

from __future__ import annotations

import json
import time as clock
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, EventStatus

import drakerock
from drakerock.config import calc_config_hash
from drakerock.errors import SimulationFailure
from drakerock.files import make_folder, write_text
from drakerock.lhd.placement import set_machine_pose
from drakerock.loading.control import TIMEOUTS, WAYPOINT_TIMES, Mode
from drakerock.loading.field import HeightField
from drakerock.loading.performance import (
    Weighing,
    calc_damage,
    find_bucket_load,
    find_debris,
    find_events,
    find_lost,
    find_weighing_events,
)
from drakerock.loading.plan import DigPlan, NoPlan
from drakerock.loading.plan_file import save_plan
from drakerock.loading.recording import Recorder, Recording, save_recording
from drakerock.loading.scenario import Scenario
from drakerock.loading.signal_table import save_signals
from drakerock.loading.signals import calc_signals
from drakerock.loading.station import Station, make_station
from drakerock.rocks.state import PileState, save_pile

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
"""Called with the mode's name and the simulated time [s]."""


@dataclass(frozen=True)
class CycleOutcome:
    """What a cycle came to; `outcome.json` is this as JSON.

    Attributes:
        status: ``done`` (the cycle ended as the method allows) or ``failed`` (solver failure).
        reason: why it ended: ``s4 reached``, ``s4 timed out``, ``no candidate slice: ...``, or the failure.
        objectives: production [kg/s, positive], damage, debris [kg].
        phi1, phi2, phi3: minus production [kg/s], damage, debris [kg]; all minimised.
        strategy: alpha, beta, gamma, kappa.
        bucket_mass_kg, bucket_rocks: the load at t4.
        weighed_mass_kg: the machine's weight on the floor as it stands after t4, less its own: what rocks it
            carries, a cross-check of the load; null where it did not come to that.
        counted_when_weighed_kg: the bucket's load by geometry at that time, t4 plus weighing delay and time.
        loading_time_s: t4 - t0.
        waypoint_times_s: t0 to t4; null where not passed.
        plan: swept and wanted volume, whether the wanted one could be reached, entry point, slope, dig height.
        peak_push_force_N, mean_push_force_N: of the rocks against the bucket's motion into the pile.
        energy_J: the motors' work over [t0, t4].
        events: stalls, slips, time-outs, a load that changed after s4 or differs from its weight, and rocks
            that still moved when debris was counted, with their times.
        rocks: number in all, awake at most and on average; the deepest penetration [m]; how many left the site;
            steps that had to be solved again or were beyond the bound of penetration.
        wall_time_s, sim_time_s, steps, ms_per_step: cost of the cycle.
        files: names of the files with the planned and the actual tip path.
        seed, versions, scenario_hash: what the cycle depended on.
    """

    status: str
    reason: str
    objectives: dict[str, float | None]
    phi1: float | None
    phi2: float | None
    phi3: float | None
    strategy: dict[str, float]
    bucket_mass_kg: float | None
    bucket_rocks: int | None
    weighed_mass_kg: float | None
    counted_when_weighed_kg: float | None = field(default=None, kw_only=True)
    loading_time_s: float | None
    waypoint_times_s: list[float | None]
    plan: dict[str, Any]
    peak_push_force_N: float | None
    mean_push_force_N: float | None
    energy_J: float | None
    events: list[dict[str, Any]]
    rocks: dict[str, float]
    wall_time_s: float
    sim_time_s: float
    steps: int
    ms_per_step: float
    files: dict[str, str]
    seed: int
    versions: dict[str, str]
    scenario_hash: str

    @classmethod
    def from_json(cls, text: str) -> CycleOutcome:
        """Return the outcome that `to_json` wrote."""
        return cls(**json.loads(text))

    def to_json(self) -> str:
        """Return the outcome as JSON text."""
        return json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"


@dataclass(frozen=True, eq=False)
class CycleResult:
    """All that a cycle produces.

    Attributes:
        outcome: the numbers.
        scenario: the resolved configuration that they come from.
        pile_before, pile_after: the rocks at the start, and when they rest again after s4.
        in_bucket: (n,) rocks that the bucket took: in it at t4, or still at the end.
        debris: (n,) rocks left loose on the floor.
        field: the sensed height field.
        plan: what was planned.
        signals, units: columns (k,) of all steps, and their units.
        recording: for the replay; None if nothing ran.
    """

    outcome: CycleOutcome
    scenario: Scenario
    pile_before: PileState
    pile_after: PileState
    in_bucket: NDArray[np.bool_]
    debris: NDArray[np.bool_]
    field: HeightField
    plan: DigPlan | NoPlan
    signals: dict[str, Array]
    units: dict[str, str]
    recording: Recording | None


def run_cycle(scenario: Scenario, pile: PileState, progress: Progress | None = None) -> CycleResult:
    """Run one loading cycle.

    A failure of the dynamics does not raise: the outcome's status is ``failed`` and its reason says why.

    Args:
        scenario: machine, site, rocks, dynamics, strategy.
        pile: the rocks before the loading.
        progress: called a few times per simulated second.

    Raises:
        InputError: the configuration cannot be built (SDFormat file, rock meshes, machine pose).
    """
    start = clock.perf_counter()
    station = make_station(scenario, pile)
    simulator = Simulator(station.diagram)
    root = simulator.get_mutable_context()
    station.rocks.set_pile(root, pile)
    performance = scenario.loading.performance
    recorder = Recorder(
        station.plant, station.scene_graph, station.machine, pile, station.shapes, scenario.site,
        scenario.recording.motion_threshold,
    )  # fmt: skip
    plant_context = station.plant.GetMyMutableContextFromRoot(root)
    # Sensing and planning come first: they tell where the machine starts. Only a scanner's view depends on where
    # it stands meanwhile.
    _place(station, root, x_tip=-scenario.loading.sensing.scanner.distance, y=0.0)
    station.diagram.ExecuteInitializationEvents(root)
    field: HeightField = station.diagram.GetOutputPort("height_field").Eval(root)
    plan: DigPlan | NoPlan = station.diagram.GetOutputPort("plan").Eval(root)
    if isinstance(plan, DigPlan):
        _place(station, root, x_tip=float(plan.waypoint_x[0]) - scenario.loading.planning.run_up, y=plan.y)

    body_poses = station.plant.get_body_poses_output_port()
    mode_port = station.diagram.GetOutputPort("mode")
    progress_port = station.diagram.GetOutputPort("progress")
    rock_port = station.diagram.GetOutputPort("rock_poses")
    rock_force_port = station.rocks.GetOutputPort("F_B_W")
    rocks_context = station.rocks.GetMyContextFromRoot(root)
    failure: str | None = None
    t4: float | None = None
    weighing: Weighing | None = None
    floor_forces, bucket_forces = list[float](), list[float]()
    volumes = np.array([shape.volume for shape in station.shapes])
    masses = pile.calc_masses(volumes, scenario.rocks.density)
    gravity = float(-station.plant.gravity_field().gravity_vector()[2])

    def record() -> Mode:
        mode = Mode(int(mode_port.Eval(root)[0]))
        time = root.get_time()
        recorder.add(time, int(mode), body_poses.Eval(plant_context), rock_port.Eval(root))
        if progress:
            progress(mode.name, time)
        return mode

    def stop_at_s4(root_context: Context) -> EventStatus:
        if mode_port.Eval(root_context)[0] < Mode.DONE:
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(station.controller, "s4")

    def weigh(root_context: Context) -> EventStatus:
        assert t4 is not None
        since = root_context.get_time() - t4
        if 0.0 <= since - performance.weighing_delay <= performance.weighing_time:
            floor_forces.append(_calc_floor_force(station, plant_context))
            bucket_forces.append(-float(rock_force_port.Eval(rocks_context)[5]))
        return EventStatus.DidNothing()

    def finish_weighing(pile: PileState) -> Weighing:
        own = station.plant.CalcTotalMass(plant_context, [station.machine.instance])
        return Weighing(
            time_s=root.get_time(),
            weight_kg=float(np.mean(floor_forces)) / gravity - own,
            on_bucket_kg=float(np.mean(bucket_forces)) / gravity,
            counted_kg=float(masses[find_load(pile)].sum()),
        )

    def find_load(pile: PileState) -> NDArray[np.bool_]:
        bucket = station.plant.GetBodyByName("bucket", station.machine.instance)
        return find_bucket_load(pile, station.digger.bucket, bucket.EvalPoseInWorld(plant_context))

    record()
    load, at_rest = np.zeros(len(pile), bool), True
    last_pile = pile
    frame, last_check = 0, 0.0
    try:
        simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        simulator.set_monitor(stop_at_s4)
        while not isinstance(plan, NoPlan):
            frame += 1
            simulator.AdvanceTo(frame / scenario.recording.frame_rate)
            if t4 is None and mode_port.Eval(root)[0] >= Mode.DONE:
                t4 = last_check = root.get_time()
                at_rest = False
                last_pile = station.rocks.get_pile(root)
                load = find_load(last_pile)
                simulator.set_monitor(weigh)
                simulator.AdvanceTo(frame / scenario.recording.frame_rate)
            record()
            if t4 is None:
                continue
            time = root.get_time()
            if weighing is None and time - t4 >= performance.weighing_delay + performance.weighing_time:
                weighing = finish_weighing(station.rocks.get_pile(root))
            if time - last_check >= performance.rest_window - 1e-9:
                now = station.rocks.get_pile(root)
                moved = np.linalg.norm(now.p_WRs - last_pile.p_WRs, axis=1)[~load]
                at_rest = bool(np.all(moved < performance.rest_speed * (time - last_check)))
                last_check, last_pile = time, now
            if weighing and (at_rest or time - t4 >= performance.settle_time):
                break
    except (RuntimeError, SimulationFailure) as error:
        failure = f"solver failure at {root.get_time():.2f} s: {error}"

    try:
        pile_after = station.rocks.get_pile(root)
    except ValueError:  # a failure left rocks that are nowhere
        pile_after = last_pile
    signals, units = calc_signals(station, root)
    controller = np.array(progress_port.Eval(root))
    in_bucket, debris = load, np.zeros(len(pile), bool)
    if t4 is not None and failure is None:
        in_bucket = load | find_load(pile_after)
        gone = in_bucket | find_lost(pile_after, scenario.site)
        debris = find_debris(pile_after, station.shapes, gone, scenario.pile.contact_gap)

    outcome = _make_outcome(
        scenario, plan, controller, signals, masses, load, debris, weighing, failure, at_rest,
        wall_time=clock.perf_counter() - start,
    )  # fmt: skip
    recording = recorder.finish(
        {
            "title": "drakerock loading cycle",
            "strategy": outcome.strategy,
            "objectives": outcome.objectives,
            "bucket_mass_kg": outcome.bucket_mass_kg,
            "loading_time_s": outcome.loading_time_s,
            "reason": outcome.reason,
            "versions": outcome.versions,
        }
    )
    return CycleResult(
        outcome, scenario, pile, pile_after, in_bucket, debris, field, plan, signals, units, recording
    )


def save_cycle(result: CycleResult, folder: str | Path) -> list[Path]:
    """Write a cycle's files: outcome.json, signals.parquet, plan.json, scenario.json, pile_before.npz,
    pile_after.npz, recording.npz.

    Returns:
        The paths written; outcome.json is the last, so that a folder with it is complete.

    Raises:
        InputError: the folder cannot be written.
    """
    folder = Path(folder)
    make_folder(folder)
    save_pile(result.pile_before, folder / "pile_before.npz")
    save_pile(result.pile_after, folder / "pile_after.npz")
    save_signals(result.signals, result.units, folder / "signals.parquet")
    if result.recording is not None:
        save_recording(result.recording, folder / "recording.npz")
    save_plan(result.plan, result.field, folder / "plan.json")
    write_text(folder / "scenario.json", result.scenario.model_dump_json(indent=2) + "\n")
    write_text(folder / "outcome.json", result.outcome.to_json())
    names = [
        "pile_before.npz",
        "pile_after.npz",
        "signals.parquet",
        "recording.npz",
        "plan.json",
        "scenario.json",
        "outcome.json",
    ]
    return [folder / name for name in names if (folder / name).exists()]


def _place(station: Station, root: Any, x_tip: float, y: float) -> None:
    context = station.plant.GetMyMutableContextFromRoot(root)
    z_tip = station.scenario.loading.planning.floor_clearance
    kin = station.digger.kinematics
    set_machine_pose(station.plant, context, station.machine, x_tip=x_tip, y=y, z_tip=z_tip, kin=kin)


def _calc_floor_force(station: Station, plant_context: Any) -> float:
    """Return the site's vertical force on the machine at this instant [N]."""
    plant = station.plant
    ground = frozenset(plant.GetCollisionGeometriesForBody(plant.world_body()))
    own = frozenset(
        geometry
        for index in plant.GetBodyIndices(station.machine.instance)
        for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(index))
    )
    results = plant.get_contact_results_output_port().Eval(plant_context)
    total = 0.0
    for k in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(k)
        pair = info.point_pair()
        if pair.id_B in own and pair.id_A in ground:
            total += float(info.contact_force()[2])
        elif pair.id_A in own and pair.id_B in ground:
            total -= float(info.contact_force()[2])
    return total


def _make_outcome(
    scenario: Scenario,
    plan: DigPlan | NoPlan,
    controller: Array,
    signals: dict[str, Array],
    masses: Array,
    in_bucket: NDArray[np.bool_],
    debris: NDArray[np.bool_],
    weighing: Weighing | None,
    failure: str | None,
    at_rest: bool,
    wall_time: float,
) -> CycleOutcome:
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
        damage = calc_damage(time, signals["hinge_moment"], times[0], times[4], scenario.loading.performance)
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
    events = find_events(signals, controller[TIMEOUTS], times, config.performance, config.planning.v_x_max)
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
        sim_time_s=float(time[-1]) if len(time) else 0.0,
        steps=steps,
        ms_per_step=1e3 * wall_time / max(steps, 1),
        files={"planned_tip_path": "plan.json", "actual_tip_path": "signals.parquet"},
        seed=scenario.seed,
        versions={"drakerock": drakerock.__version__, "drake": version("drake")},
        scenario_hash=calc_config_hash(scenario),
    )
