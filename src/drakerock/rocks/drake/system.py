"""The nonsmooth rock engine as a LeafSystem.

The system holds no physics of its own: its state is the engine's arrays, its update is the engine's step.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    State,
    ValueProducer,
)

from drakerock.errors import InputError
from drakerock.memory import weak
from drakerock.rocks.drake.geometry import PlantGeometry
from drakerock.rocks.drake.interface import (
    ROCK_SUMMARY,
    RockContacts,
    RockSystem,
    find_start_inside,
    make_empty_contacts,
)
from drakerock.rocks.drake.states import RockStates, SolvedState
from drakerock.rocks.engine.engine import (
    MachineStep,
    NonsmoothEngine,
    RockArrays,
    StepReport,
    make_machineless_step,
)
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]


class NonsmoothRocks(RockSystem):
    """All rocks of a pile, stepped by the nonsmooth engine.

    One solve per step: a cache entry computed from the state at t_n, read by the discrete update and by
    ``applied_spatial_force`` alike. All state is in the context (`RockStates`), the contact cache and the bookkeeping
    of sleeping rocks included, so a context can be saved, restored and repeated bit for bit; the whole context, not its
    discrete values alone. The engine's scratch memory is shared by all contexts: one thread at a time.

    When a Diagram is initialised, a body of the plant that starts inside the pile is an InputError.

    Input ports:
        ``plant_step``: a `MachineStep`; in a plant where nothing moves it need not be connected.
        ``applied_spatial_force``: list of ExternallyAppliedSpatialForce, of others on the plant's bodies; may be left
            open.

    Output ports: those of `RockSystem`, and
        ``spatial_force_of_others``: the input ``applied_spatial_force``, empty where it is left open.
        ``applied_spatial_force``: list of ExternallyAppliedSpatialForce for the plant: the rocks' forces on its bodies
            over the coming step, then those of others.
        ``status``: (n,) 0 awake, 1 resting, 2 fixed, 3 lost.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        engine: NonsmoothEngine,
        pile: PileState,
        shapes: tuple[RockShape, ...],
        geometry: PlantGeometry,
    ) -> None:
        """Make the system.

        Args:
            plant: the finalized plant.
            engine: made for the rocks of `pile` and what they meet in the plant.
            pile: their state in a default context.
            shapes: the rock shapes.
            geometry: of the plant.
        """
        super().__init__(plant, pile, shapes, geometry.bodies)
        self._engine = engine
        self._provenance = dict(pile.provenance)
        self._default_state = SolvedState(engine.make_arrays(pile))
        self._states = self.DeclareAbstractState(Value[object](self._make_states(pile)))
        # The state's number, and what the step that led to it told.
        self._number = self.DeclareDiscreteState(1)
        self._report = self.DeclareDiscreteState(np.zeros(len(ROCK_SUMMARY) + 6 * len(geometry.bodies)))
        self._plant_step = self.DeclareAbstractInputPort("plant_step", Value[object](make_machineless_step()))
        self._others = self.DeclareAbstractInputPort(
            "applied_spatial_force", Value[list[ExternallyAppliedSpatialForce]]([])
        )
        step = self.DeclareCacheEntry(
            "step",
            ValueProducer(allocate=lambda: Value[object](()), calc=weak(self._calc_step)),
            {self.all_state_ticket(), self._plant_step.ticket()},
        )
        self._step = step.cache_index()
        state = self.all_state_ticket()
        self._declare_outputs(self.discrete_state_ticket(self._report), state)
        self.DeclareVectorOutputPort("status", engine.n_rocks, self._calc_status, {state})
        self.DeclareAbstractOutputPort(
            "contacts",
            lambda: Value[object](make_empty_contacts()),
            weak(self._calc_contacts),
            {step.ticket()},
        )
        self.DeclareAbstractOutputPort(
            "spatial_force_of_others",
            lambda: Value[list[ExternallyAppliedSpatialForce]]([]),
            weak(self._calc_others),
            {self._others.ticket()},
        )
        self.DeclareAbstractOutputPort(
            "applied_spatial_force",
            lambda: Value[list[ExternallyAppliedSpatialForce]]([]),
            weak(self._calc_applied_force),
            {step.ticket(), self._others.ticket()},
        )
        self.DeclareInitializationPublishEvent(self._check_start)
        # Together with the plant's own update, from the same state: Drake does unrestricted updates first, and a plant
        # whose output ports are sampled has one.
        if plant.has_sampled_output_ports():
            self.DeclarePeriodicUnrestrictedUpdateEvent(
                engine.time_step,
                0.0,
                self._update_with_plant,
            )
        else:
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
        context.SetAbstractState(self._states, self._make_states(pile))
        for group in (self._number, self._report):
            context.get_mutable_discrete_state(group).SetZero()

    def get_pile(self, root_context: Context) -> PileState:
        """Read the rocks' present state, contacts included, from the Diagram's context."""
        arrays = self._get_arrays(self.GetMyContextFromRoot(root_context))
        return self._engine.make_pile(arrays, self._provenance)

    def get_report(self, root_context: Context) -> StepReport:
        """Return the report of the step that starts at the Diagram's context (solved if it is not yet)."""
        report = self._solve(self.GetMyContextFromRoot(root_context)).report
        assert report is not None
        return report

    def _make_states(self, pile: PileState) -> RockStates:
        if pile is self._default_pile:
            return RockStates(self._engine, self._default_state)
        return RockStates(self._engine, SolvedState(self._engine.make_arrays(pile)))

    def _get_states(self, context: Context) -> tuple[RockStates, int]:
        """Return the context's states, and the number of the one that counts."""
        states = context.get_abstract_state().get_value(self._states).get_value()
        return states, int(context.get_discrete_state(self._number)[0])

    def _get_arrays(self, context: Context) -> RockArrays:
        states, number = self._get_states(context)
        return states.get(number).arrays

    def _read_plant_step(self, context: Context) -> MachineStep:
        if self._plant_step.HasValue(context):
            return self._plant_step.Eval(context)
        return make_machineless_step()

    def _calc_step(self, context: Context, value: Value) -> None:
        states, number = self._get_states(context)
        value.set_value(states.solve_next(number, self._read_plant_step(context)))

    def _solve(self, context: Context) -> SolvedState:
        """Return the state after the coming step, as yet solved."""
        following: SolvedState = self.get_cache_entry(self._step).Eval(context)
        return following

    def _update_with_plant(self, context: Context, state: State) -> None:
        self._update(context, state.get_mutable_discrete_state())
        # The state to be is a copy from before the step was solved.
        state.get_mutable_abstract_state().get_mutable_value(self._states).SetFrom(
            context.get_abstract_state().get_value(self._states)
        )

    def _update(self, context: Context, discrete: DiscreteValues) -> None:
        following = self._solve(context)
        report = following.report
        assert report is not None
        last = self._read_report(context)
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
        discrete.set_value(self._number, [following.arrays.steps])
        discrete.set_value(self._report, np.concatenate([summary, report.F_Bs_W.reshape(-1)]))

    def _check_start(self, context: Context) -> EventStatus:
        found: RockContacts = self.GetOutputPort("contacts").Eval(context)
        k = find_start_inside(found, self._default_pile.size)
        if k is not None:
            body = self._plant.get_body(BodyIndex(int(found.body[k])))
            raise InputError(
                f"body '{body.scoped_name()}' starts {found.depth[k]:.2f} m inside a rock at "
                f"{np.round(found.p_WCs[k], 2).tolist()}: place it outside the pile before the simulation starts "
                "(in a station: station.initialize(context))"
            )
        return EventStatus.Succeeded()

    def _find_contacts(self, context: Context) -> RockContacts:
        """Return the contacts of the coming step; it is solved once more, for these alone."""
        table = self._engine.find_loaded_contacts(self._get_arrays(context), self._read_plant_step(context))
        n = self._engine.n_rocks
        first_piece = self._engine.first_piece
        bodies = np.array([int(index) for index in self._bodies], np.int64)
        on_rock, on_piece = table.second < n, table.second >= first_piece
        number = np.zeros(len(table.second), np.int64)
        if len(bodies):
            piece_body = bodies[self._engine.piece_body]
            number[on_piece] = piece_body[table.second[on_piece] - first_piece]
        return RockContacts(
            rock=table.first,
            other=np.where(on_rock, table.second, -1),
            body=np.where(on_rock, -1, number),
            p_WCs=table.points,
            f_WCs=table.impulses / self._engine.time_step,
            t_WCs=np.zeros_like(table.impulses),
            depth=-table.gaps,
        )

    def _read_pile(self, context: Context) -> PileState:
        arrays, pile = self._get_arrays(context), self._default_pile
        return replace(
            pile,
            p_WRs=arrays.positions.copy(),
            q_WRs=arrays.quaternions.copy(),
            V_WRs=arrays.velocities.copy(),
            contacts=None,
        )

    def _read_report(self, context: Context) -> Array:
        return np.array(context.get_discrete_state(self._report).value())

    def _calc_status(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._get_arrays(context).status)

    def _calc_contacts(self, context: Context, output: Value) -> None:
        output.set_value(self._find_contacts(context))

    def _calc_others(self, context: Context, output: Value) -> None:
        output.set_value(self._read_others(context))

    def _read_others(self, context: Context) -> list[ExternallyAppliedSpatialForce]:
        return self._others.Eval(context) if self._others.HasValue(context) else []

    def _calc_applied_force(self, context: Context, output: Value) -> None:
        report = self._solve(context).report
        assert report is not None
        forces = []
        for k in np.flatnonzero(report.F_Bs_W.any(axis=1)):
            F_B_W = report.F_Bs_W[k]
            force = ExternallyAppliedSpatialForce()
            force.body_index = self._bodies[k]
            force.p_BoBq_B = np.zeros(3)
            force.F_Bq_W = SpatialForce(F_B_W[:3], F_B_W[3:])
            forces.append(force)
        output.set_value(forces + self._read_others(context))


_N_LOST = list(ROCK_SUMMARY).index("n_lost")
_N_FLAGGED = list(ROCK_SUMMARY).index("n_flagged")
