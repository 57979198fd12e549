"""One loading cycle: a pure function of scenario, pile and strategy (method section 5)."""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

from drakerock.errors import SimulationFailure
from drakerock.files import make_folder, write_text
from drakerock.lhd.geometry import calc_heaped_capacity
from drakerock.loading.evaluation import make_outcome
from drakerock.loading.field import HeightField
from drakerock.loading.field_file import save_height_fields
from drakerock.loading.folder import (
    CYCLE_FILES,
    HEIGHT_FIELDS,
    OUTCOME,
    PILE_AFTER,
    PILE_BEFORE,
    PLAN,
    RECORDING,
    SCENARIO,
    SIGNALS,
)
from drakerock.loading.mining import MachineRating
from drakerock.loading.outcome import CycleOutcome
from drakerock.loading.performance import Weighing, find_bucket_load, find_debris, find_lost
from drakerock.loading.plan import DigPlan, NoPlan
from drakerock.loading.plan_file import save_plan
from drakerock.loading.recording import Recorder, Recording, save_recording
from drakerock.loading.scenario import Scenario
from drakerock.loading.segments import Mode
from drakerock.loading.sensing import look_down
from drakerock.loading.signal_table import save_signals
from drakerock.loading.signals import calc_signals
from drakerock.loading.station import Station, make_station
from drakerock.loading.weighing import Scale
from drakerock.rocks.state import PileState, save_pile

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]
"""Called with the mode's name and the simulated time [s]."""


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
        field_after: heights when the rocks rest again, the load taken out, on the same grid; None after a failure.
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
    field_after: HeightField | None
    plan: DigPlan | NoPlan
    signals: dict[str, Array]
    units: dict[str, str]
    recording: Recording | None


def run_cycle(
    scenario: Scenario,
    pile: PileState,
    progress: Progress | None = None,
    station: Station | None = None,
) -> CycleResult:
    """Run one loading cycle.

    A failure of the dynamics does not raise: the outcome's status is ``failed`` and its reason says why.

    Args:
        scenario: machine, site, rocks, dynamics, strategy.
        pile: the rocks before the loading.
        progress: called a few times per simulated second.
        station: what `make_station` made of both, if parts of one's own are in it.

    Raises:
        InputError: the configuration cannot be built (SDFormat file, rock meshes, machine pose).
    """
    start = clock.perf_counter(), clock.process_time()
    station = station or make_station(scenario, pile, visible=False)
    simulator = Simulator(station.diagram)
    root = simulator.get_mutable_context()
    field = station.initialize(root)
    cycle = _Cycle(station, simulator, pile, progress)
    cycle.record()
    failure: str | None = None
    try:
        simulator.Initialize()
        if isinstance(cycle.plan, DigPlan):
            cycle.drive_to_s4()
            cycle.wait_for_rest()
    except (RuntimeError, SimulationFailure) as error:
        failure = f"solver failure at {root.get_time():.2f} s: {error}"

    pile_after = cycle.read_pile_after()
    signals, units = calc_signals(station, root)
    signals["bucket_load"], units["bucket_load"] = cycle.calc_load_history(signals["time"]), "kg"
    in_bucket, debris = cycle.load, np.zeros(len(pile), bool)
    if cycle.t4 is not None and failure is None:
        in_bucket = cycle.load | cycle.find_load(pile_after)
        gone = in_bucket | find_lost(pile_after, scenario.site)
        debris = find_debris(pile_after, station.shapes, gone, scenario.pile.contact_gap)
    outcome = make_outcome(
        scenario,
        cycle.plan,
        np.array(station.diagram.GetOutputPort("progress").Eval(root)),
        signals,
        [station.plant.get_body(k).name() for k in station.plant.GetBodyIndices(station.machine.instance)],
        cycle.masses,
        cycle.load,
        debris,
        cycle.weighing,
        failure,
        cycle.at_rest,
        _make_rating(station),
        wall_time=clock.perf_counter() - start[0],
        cpu_time=clock.process_time() - start[1],
    )
    outcome = replace(outcome, strategy=station.read_strategy(root))
    return CycleResult(
        outcome, scenario, pile, pile_after, in_bucket, debris, field,
        None if failure else look_down(
            pile_after.select(~in_bucket), station.shapes, scenario.site, field.x, field.y, field.cell
        ),
        cycle.plan, signals, units, cycle.recorder.finish(_make_notes(outcome)),
    )  # fmt: skip


class _Cycle:
    """A cycle under way.

    Attributes:
        plan: what was planned.
        masses: (n,) of the rocks [kg].
        t4: when s4 was passed [s]; None before.
        load: (n,) rocks in the bucket then.
        weighing: the machine's weight some time later.
        at_rest: whether the rocks rest, as of the last look.
        recorder: the frames so far.
    """

    def __init__(
        self, station: Station, simulator: Simulator, pile: PileState, progress: Progress | None
    ) -> None:
        self._station, self._simulator, self._progress = station, simulator, progress
        self._root: Context = simulator.get_mutable_context()
        self._plant_context = station.plant.GetMyMutableContextFromRoot(self._root)
        self._ports = {name: station.diagram.GetOutputPort(name) for name in ("mode", "pile")}
        self.plan: DigPlan | NoPlan = station.diagram.GetOutputPort("plan").Eval(self._root)
        volumes = np.array([shape.volume for shape in station.shapes])
        self.masses = pile.calc_masses(volumes, station.scenario.rocks.density)
        self.t4: float | None = None
        self.load: NDArray[np.bool_] = np.zeros(len(pile), bool)
        self.weighing: Weighing | None = None
        self.at_rest = True
        self._loads: list[tuple[float, float]] = []
        self._last_pile, self._last_check, self._frame = pile, 0.0, 0
        self.recorder = Recorder(
            station.plant, station.scene_graph, station.machine, pile, station.shapes, station.scenario.site,
            station.scenario.recording.motion_threshold,
        )  # fmt: skip

    def record(self) -> None:
        """Add a frame to the recording."""
        mode = Mode(int(self._ports["mode"].Eval(self._root)[0]))
        time = self._root.get_time()
        body_poses = self._station.plant.get_body_poses_output_port().Eval(self._plant_context)
        pile = self._ports["pile"].Eval(self._root)
        self.recorder.add(time, int(mode), body_poses, pile)
        self._loads.append((time, float(self.masses[self.find_load(pile)].sum())))
        if self._progress:
            self._progress(mode.name, time)

    def drive_to_s4(self) -> None:
        """Simulate until s4 is passed, to the step, and count the load."""
        self._simulator.set_monitor(self._stop_at_s4)
        while not self._has_passed_s4():
            self._advance_to_next_frame()
            if not self._has_passed_s4():
                self.record()
        self._simulator.clear_monitor()
        self.t4 = self._last_check = self._root.get_time()
        self.at_rest = False
        self._last_pile = self._station.rocks.get_pile(self._root)
        self.load = self.find_load(self._last_pile)
        self._loads.append((self.t4, float(self.masses[self.load].sum())))

    def wait_for_rest(self) -> None:
        """Simulate on from s4 until the machine is weighed and the rocks rest, or `settle_time` is over."""
        assert self.t4 is not None
        limits = self._station.scenario.loading.performance
        scale = Scale(self._station)
        t4 = self.t4

        def weigh(root_context: Context) -> EventStatus:
            if 0.0 <= root_context.get_time() - t4 - limits.weighing_delay <= limits.weighing_time:
                scale.add(root_context)
            return EventStatus.DidNothing()

        self._simulator.set_monitor(weigh)
        self._frame -= 1  # the frame in which s4 was passed is finished first
        while True:
            self._advance_to_next_frame()
            self.record()
            time = self._root.get_time()
            if self.weighing is None and time - self.t4 >= limits.weighing_delay + limits.weighing_time:
                now = self._station.rocks.get_pile(self._root)
                self.weighing = scale.weigh(self._root, self.masses, self.find_load(now))
            self._look_for_rest(time)
            if self.weighing and (self.at_rest or time - self.t4 >= limits.settle_time):
                return

    def find_load(self, pile: PileState) -> NDArray[np.bool_]:
        """Return which rocks (n,) are in the bucket as it is now."""
        station = self._station
        bucket = station.plant.GetBodyByName("bucket", station.machine.instance)
        return find_bucket_load(pile, station.digger.bucket, bucket.EvalPoseInWorld(self._plant_context))

    def calc_load_history(self, time: Array) -> Array:
        """Return the bucket's load (k,) at the times of the steps [kg]: counted in each frame, linear in between."""
        return np.interp(time, *np.array(self._loads).T)

    def read_pile_after(self) -> PileState:
        """Return the rocks as they are now; after a failure that left rocks that are nowhere, as last seen."""
        try:
            return self._station.rocks.get_pile(self._root)
        except ValueError:
            return self._last_pile

    def _has_passed_s4(self) -> bool:
        return bool(self._ports["mode"].Eval(self._root)[0] >= Mode.DONE)

    def _stop_at_s4(self, root_context: Context) -> EventStatus:
        if self._ports["mode"].Eval(root_context)[0] < Mode.DONE:
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(self._station.tracker, "s4")

    def _advance_to_next_frame(self) -> None:
        self._frame += 1
        self._simulator.AdvanceTo(self._frame / self._station.scenario.recording.frame_rate)

    def _look_for_rest(self, time: float) -> None:
        limits = self._station.scenario.loading.performance
        if time - self._last_check < limits.rest_window - 1e-9:
            return
        now = self._station.rocks.get_pile(self._root)
        moved = np.linalg.norm(now.p_WRs - self._last_pile.p_WRs, axis=1)[~self.load]
        self.at_rest = bool(np.all(moved < limits.rest_speed * (time - self._last_check)))
        self._last_check, self._last_pile = time, now


def _make_rating(station: Station) -> MachineRating:
    """Return what the numbers of mining are relative to."""
    scenario = station.scenario
    return MachineRating(
        payload=scenario.machine.data.payload,
        capacity=calc_heaped_capacity(station.digger.bucket),
        loose_density=scenario.rocks.density * scenario.loading.performance.loose_packing,
        wheel_radius=station.digger.kinematics.wheel_radius,
        bucket_effort=station.machine.bucket.peak,
    )


def _make_notes(outcome: CycleOutcome) -> dict[str, object]:
    """Return what the replay says beside its pictures."""
    return {
        "title": "drakerock loading cycle",
        "strategy": outcome.strategy,
        "objectives": outcome.objectives,
        "bucket_mass_kg": outcome.bucket_mass_kg,
        "loading_time_s": outcome.loading_time_s,
        "reason": outcome.reason,
        "versions": outcome.versions,
    }


def save_cycle(result: CycleResult, folder: str | Path) -> list[Path]:
    """Write a cycle's files, those of `CYCLE_FILES`.

    Returns:
        The paths written; outcome.json is the last, so that a folder with it is complete.

    Raises:
        InputError: the folder cannot be written.
    """
    folder = Path(folder)
    make_folder(folder)
    save_pile(result.pile_before, folder / PILE_BEFORE)
    save_pile(result.pile_after, folder / PILE_AFTER)
    save_signals(result.signals, result.units, folder / SIGNALS)
    if result.recording is not None:
        save_recording(result.recording, folder / RECORDING)
    save_plan(result.plan, result.field, folder / PLAN)
    if result.field_after is not None:
        save_height_fields(result.field, result.field_after, folder / HEIGHT_FIELDS)
    write_text(folder / SCENARIO, result.scenario.resolve().model_dump_json(indent=2) + "\n")
    write_text(folder / OUTCOME, result.outcome.to_json())
    return [folder / name for name in CYCLE_FILES if (folder / name).exists()]
