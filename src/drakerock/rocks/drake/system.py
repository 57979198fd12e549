"""The nonsmooth rock engine as a LeafSystem, and its wiring to the machine's plant.

The system holds no physics of its own: its state is the engine's arrays, its update is the engine's step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.geometry import SceneGraph
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
    ValueProducer,
)

from drakerock.lhd.model import Machine
from drakerock.rocks.config import RocksConfig
from drakerock.rocks.drake.coupling import MachineLayout, MachineView, make_machine_layout
from drakerock.rocks.drake.interface import ROCK_SUMMARY
from drakerock.rocks.engine.config import DynamicsConfig
from drakerock.rocks.engine.contact_cache import ContactCache, make_contact_cache
from drakerock.rocks.engine.engine import (
    NonsmoothEngine,
    RockArrays,
    StepReport,
    make_machineless_step,
)
from drakerock.rocks.engine.records import CACHED_POINT, SLEEP
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.site import Site
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Step:
    """The solution of one step: the state after it, the report, and the room that the state is in."""

    arrays: RockArrays
    report: StepReport | None
    room: RockArrays


class NonsmoothRocks(LeafSystem):
    """All rocks of a pile, stepped by the nonsmooth engine (`RockSystem`).

    One solve per step: a cache entry computed from the state at t_n, read by the discrete update and by
    ``spatial_forces`` alike. ``rock_summary`` and ``F_B_W`` are state, so that reading them solves nothing: they
    belong to the step taken last. A log's row at t_n is written before the update at t_n, so it holds the step that
    ended there; `drakerock.loading.signals` moves it to the step's beginning. All state is discrete and numeric,
    the contact cache and the bookkeeping of sleeping rocks included, so a context can be saved, restored and
    repeated bit for bit. The engine's scratch memory is shared by all contexts: one thread at a time.

    Input port:
        ``machine_step``: a `MachineStep`; without a machine the port need not be connected.

    Output ports:
        those of `RockSystem`: ``rock_poses``, ``rock_velocities``, ``rock_summary``, ``F_B_W``.
        ``spatial_forces``: list of ExternallyAppliedSpatialForce, the rocks' forces on the machine's bodies over
            the coming step, for the plant's applied-spatial-force port.
        ``rock_status``: (n,) 0 awake, 1 resting, 2 fixed, 3 lost.
    """

    def __init__(
        self,
        engine: NonsmoothEngine,
        pile: PileState,
        layout: MachineLayout | None = None,
        body_indices: Sequence[BodyIndex] = (),
    ) -> None:
        """Make the system.

        Args:
            engine: made for the rocks of `pile`.
            pile: their state in a default context.
            layout: the machine's bodies that touch rocks, if there is a machine.
            body_indices: of these bodies in the plant.
        """
        super().__init__()
        self.set_name("rocks")
        self._engine = engine
        self._layout = layout
        self._body_indices = list(body_indices)
        self._provenance = dict(pile.provenance)
        n = engine.n_rocks
        arrays = engine.make_arrays(pile)
        values = _flatten(arrays)
        # Room for more points than there are: `counts` tells how many points of the cache count, and the like.
        for name, flat in _flatten_cache(make_contact_cache(engine.capacity)).items():
            values[name] = np.pad(values[name], (0, len(flat) - len(values[name])))
        self._groups = {name: self.DeclareDiscreteState(flat) for name, flat in values.items()}
        self._machine = self.DeclareAbstractInputPort("machine_step", Value[object](make_machineless_step()))
        step = self.DeclareCacheEntry(
            "step",
            ValueProducer(allocate=self._make_step, calc=self._calc_step),
            {self.xd_ticket(), self._machine.ticket()},
        )
        self._step = step
        state_only = {self.xd_ticket()}
        self.DeclareVectorOutputPort("rock_poses", 7 * n, self._calc_poses, state_only)
        self.DeclareVectorOutputPort("rock_velocities", 6 * n, self._calc_velocities, state_only)
        self.DeclareVectorOutputPort("rock_status", n, self._calc_status, state_only)
        self.DeclareVectorOutputPort("rock_summary", len(ROCK_SUMMARY), self._calc_summary, state_only)
        self.DeclareVectorOutputPort("F_B_W", 6, self._calc_bucket_force, state_only)
        self.DeclareAbstractOutputPort(
            "spatial_forces",
            lambda: Value[list[ExternallyAppliedSpatialForce]]([]),
            self._calc_spatial_forces,
            {step.ticket()},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(engine.time_step, 0.0, self._update)

    @property
    def engine(self) -> NonsmoothEngine:
        """The engine that steps the rocks."""
        return self._engine

    def set_pile(self, root_context: Context, pile: PileState) -> None:
        """Write a pile into the Diagram's context; its contacts, if stored, start warm.

        Raises:
            ValueError: not the rocks this system was made for.
        """
        context = self.GetMyMutableContextFromRoot(root_context)
        self._write(context.get_mutable_discrete_state(), _flatten(self._engine.make_arrays(pile)))

    def get_pile(self, root_context: Context) -> PileState:
        """Read the rocks' present state, contacts included, from the Diagram's context."""
        arrays = self._get_arrays(self.GetMyContextFromRoot(root_context))
        return self._engine.make_pile(arrays, self._provenance)

    def get_report(self, root_context: Context) -> StepReport:
        """Return the report of the step that starts at the Diagram's context (solved if it is not yet)."""
        return self._solve(self.GetMyContextFromRoot(root_context))[1]

    def _get_arrays(self, context: Context) -> RockArrays:
        discrete = context.get_discrete_state()
        n_points, n_sleeping, steps = discrete.value(self._groups["counts"]).reshape(-1)
        arrays = self._view({name: discrete.value(group).reshape(-1) for name, group in self._groups.items()})
        cache = arrays.cache.select(slice(int(n_points)))
        return replace(arrays, cache=cache, n_sleeping=int(n_sleeping), steps=int(steps))

    def _view(self, state: dict[str, Array]) -> RockArrays:
        """Return arrays that are in the state's, the cache with its full capacity, without the counts."""
        n = self._engine.n_rocks
        return RockArrays(
            state["quaternions"].reshape(n, 4),
            state["positions"].reshape(n, 3),
            state["velocities"].reshape(n, 6),
            state["sleep"].view(SLEEP),
            ContactCache(state["pairs"].view(np.int32).reshape(-1, 2), state["points"].view(CACHED_POINT)),
        )

    def _write(self, discrete: DiscreteValues, values: dict[str, Array]) -> None:
        for name, flat in values.items():
            discrete.get_mutable_value(self._groups[name])[: len(flat)] = flat

    def _make_step(self) -> Value:
        room = self._engine.make_room()
        return Value[object](_Step(room, None, room))

    def _calc_step(self, context: Context, value: Value) -> None:
        machine = self._machine.Eval(context) if self._machine.HasValue(context) else make_machineless_step()
        room = value.get_value().room
        value.set_value(_Step(*self._engine.step(self._get_arrays(context), machine, room), room))

    def _solve(self, context: Context) -> tuple[RockArrays, StepReport]:
        step: _Step = self._step.Eval(context)
        assert step.report is not None
        return step.arrays, step.report

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        arrays, report = self._solve(context)
        last = context.get_discrete_state(self._groups["report"]).value()
        F_B_W = np.zeros(6) if self._layout is None else report.F_Bs_W[self._layout.bucket]
        values = {
            "n_awake": report.n_awake,
            "n_contacts": report.n_contacts,
            "penetration_max": report.max_penetration,
            "penetration_p99": report.p99_penetration,
            "residual": report.residual,
            "n_lost": last[_N_LOST] + report.n_lost,
            "n_flagged": last[_N_FLAGGED] + report.flagged,
        }
        summary = [float(values[name]) for name in ROCK_SUMMARY]
        # What is written to begins as a copy of the state before the step.
        state = {name: discrete.get_mutable_value(group) for name, group in self._groups.items()}
        self._engine.write_changes(arrays, report, self._view(state))
        state["counts"][:] = _count(arrays)
        state["report"][:] = [*summary, *F_B_W]

    def _calc_poses(self, context: Context, output: BasicVector) -> None:
        arrays = self._get_arrays(context)
        output.SetFromVector(np.hstack([arrays.quaternions, arrays.positions]).reshape(-1))

    def _calc_velocities(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._get_arrays(context).velocities.reshape(-1))

    def _calc_status(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._get_arrays(context).status)

    def _calc_summary(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._groups["report"]).value()[: len(ROCK_SUMMARY)])

    def _calc_bucket_force(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._groups["report"]).value()[len(ROCK_SUMMARY) :])

    def _calc_spatial_forces(self, context: Context, output: Value) -> None:
        _, report = self._solve(context)
        forces = []
        for index, F_B_W in zip(self._body_indices, report.F_Bs_W, strict=True):
            if F_B_W.any():
                force = ExternallyAppliedSpatialForce()
                force.body_index = index
                force.p_BoBq_B = np.zeros(3)
                force.F_Bq_W = SpatialForce(F_B_W[:3], F_B_W[3:])
                forces.append(force)
        output.set_value(forces)


_N_LOST = list(ROCK_SUMMARY).index("n_lost")
_N_FLAGGED = list(ROCK_SUMMARY).index("n_flagged")


def _count(arrays: RockArrays) -> Array:
    return np.array([len(arrays.cache.pairs), arrays.n_sleeping, arrays.steps], float)


def _flatten(arrays: RockArrays) -> dict[str, Array]:
    return {
        "quaternions": arrays.quaternions.reshape(-1),
        "positions": arrays.positions.reshape(-1),
        "velocities": arrays.velocities.reshape(-1),
        "sleep": arrays.sleep.view(float),
        **_flatten_cache(arrays.cache),
        "counts": _count(arrays),
        "report": np.zeros(len(ROCK_SUMMARY) + 6),
    }


def _flatten_cache(cache: ContactCache) -> dict[str, Array]:
    # Bits, two numbers in one.
    return {"pairs": cache.pairs.reshape(-1).view(np.float64), "points": cache.points.view(np.float64)}


def add_nonsmooth_rocks(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    machine: Machine,
    site: Site,
    shapes: tuple[RockShape, ...],
    rocks: RocksConfig,
    dynamics: DynamicsConfig,
    pile: PileState,
) -> tuple[NonsmoothRocks, MachineView]:
    """Add the rocks and their coupling to the machine, and connect both ways (after Finalize).

    Args:
        builder: of the Diagram that holds `plant` and `scene_graph`.
        plant, scene_graph: the finalized plant, with machine and site.
        machine: the machine in it.
        site, shapes, rocks: where and what the rocks are.
        dynamics: settings; its time step is the plant's.
        pile: the rocks.

    Returns:
        the rocks, and the machine's view, whose input ``desired_state`` is left to be connected to what the
        plant's desired-state port of the machine gets.
    """
    config = dynamics.nonsmooth
    layout = make_machine_layout(
        plant, scene_graph, machine, config.rest.sensor_length, config.rest.sensor_margin
    )
    engine = NonsmoothEngine(
        rocks, shapes, site, config, dynamics.time_step, pile.shape, pile.size, pile.fixed,
        layout.pieces, len(layout.bodies),
    )  # fmt: skip
    indices = [plant.GetBodyByName(name, machine.instance).index() for name in layout.bodies]
    system = builder.AddSystem(NonsmoothRocks(engine, pile, layout, indices))
    view = builder.AddSystem(MachineView(plant, machine, layout, dynamics.stiction_tolerance))
    builder.Connect(plant.get_state_output_port(), view.GetInputPort("state"))
    builder.Connect(scene_graph.get_query_output_port(), view.GetInputPort("geometry_query"))
    builder.Connect(view.GetOutputPort("machine_step"), system.GetInputPort("machine_step"))
    builder.Connect(system.GetOutputPort("spatial_forces"), plant.get_applied_spatial_force_input_port())
    return system, view
