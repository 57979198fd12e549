"""The autonomous loader as a part of the Diagram: sense -> choose -> plan, in the place of the dig planner."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem, State

from drakerock.autonomy.choices import Choice
from drakerock.autonomy.decision import Decision, decide
from drakerock.autonomy.model import LoaderModel, load_model
from drakerock.autonomy.preference import Preference, make_preference
from drakerock.errors import InputError
from drakerock.loading.config import StrategyConfig
from drakerock.loading.field import HeightField
from drakerock.loading.parts import StationView
from drakerock.loading.plan import DigPlan, NoPlan
from drakerock.loading.planning import NOT_INITIALISED, DiggingMachine, make_dig_plan
from drakerock.loading.scenario import Scenario

_NOT_DECIDED = Decision("stop", {}, "", False, "", None, (NOT_INITIALISED,), float("nan"), (), ())


class AutonomousLoader(LeafSystem):
    """Looks at the pile, chooses a strategy for the preference of this moment, and plans it.

    It decides once, when its context is initialised, and holds the plan until the context is reset: whatever the bucket
    does to the pile meanwhile, and however the preference changes, the next loading is the first that knows of it. A
    decision to clean or to stop, and a choice that fails, is a `NoPlan`: the machine stands still.

    Input ports:
        ``height_field``: abstract, a `HeightField` in W.
        ``preference``: abstract, a `Preference`; not connected: the one that it was made with. The station's Diagram
            has an input port of this name.

    Output ports:
        ``plan``: abstract, a `DigPlan` (or `NoPlan`).
        ``decision``: abstract, a `Decision`.
        ``strategy``: (4,) alpha, beta, gamma, kappa; the outcome of a cycle tells it.
    """

    def __init__(
        self,
        model: LoaderModel,
        choice: Choice,
        scenario: Scenario,
        machine: DiggingMachine,
        preference: Preference | None = None,
        *,
        cleaned: bool = False,
    ) -> None:
        """Make it.

        Args:
            model: what it knows of piles.
            choice: how it chooses.
            scenario: planning, sensing, and the strategy where nothing is chosen.
            machine: its geometry.
            preference: what is wanted unless the port says otherwise; None: all objectives alike.
            cleaned: whether the floor was cleaned just now.

        Raises:
            InputError: a model of another machine or sensor; a machine that does not fit the drift.
        """
        super().__init__()
        self.set_name("autonomous_loader")
        model.check_fits(scenario)
        machine.check_room(scenario.site.drift_width, scenario.loading.planning.wall_clearance)
        self._model, self._choice, self._scenario, self._machine = model, choice, scenario, machine
        self._default, self._cleaned = preference or Preference(), cleaned
        empty = HeightField(np.zeros(0), np.zeros(0), np.zeros((0, 0)), scenario.loading.sensing.cell)
        self._field = self.DeclareAbstractInputPort("height_field", AbstractValue.Make(empty))
        self._preference = self.DeclareAbstractInputPort("preference", Value[object](Preference()))
        self._plan = self.DeclareAbstractState(AbstractValue.Make(NoPlan(NOT_INITIALISED)))
        self._decision = self.DeclareAbstractState(Value[object](_NOT_DECIDED))
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        self.DeclareStateOutputPort("plan", self._plan)
        self.DeclareStateOutputPort("decision", self._decision)
        self.DeclareVectorOutputPort(
            "strategy", 4, self._calc_strategy, {self.abstract_state_ticket(self._decision)}
        )

    def _initialize(self, context: Context, state: State) -> None:
        held = context.get_abstract_state(int(self._plan)).get_value()
        if not (isinstance(held, NoPlan) and held.reason == NOT_INITIALISED):
            return
        wanted = self._preference.Eval(context) if self._preference.HasValue(context) else self._default
        decision, plan = self.decide(self._field.Eval(context), wanted)
        state.get_mutable_abstract_state(int(self._decision)).set_value(decision)
        state.get_mutable_abstract_state(int(self._plan)).set_value(plan)

    def decide(self, field: HeightField, preference: Preference) -> tuple[Decision, DigPlan | NoPlan]:
        """Return what to do with a sensed pile, and the plan of it."""
        scenario, strategy = self._scenario, self._scenario.loading.strategy
        try:
            situation = self._model.look_at(field, scenario)
            decision = decide(
                self._model.problem, self._choice, self._model.robust, situation, preference, strategy,
                cleaned=self._cleaned,
            )  # fmt: skip
        except Exception as error:  # whatever a choice of one's own dies of
            # The machine is safe where it stands; who runs the loading is told.
            what = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            reason = f"no strategy could be chosen: {what}"
            return (
                Decision("stop", strategy.model_dump(), self._choice.name, False, str(preference), None, (reason,),
                         float("nan"), (), ()),
                NoPlan(reason),
            )  # fmt: skip
        if decision.action != "load":
            return decision, NoPlan(decision.reasons[-1])
        loading = scenario.loading
        plan = make_dig_plan(
            field, StrategyConfig(**decision.strategy), self._machine, loading.planning, loading.sensing,
            scenario.site.drift_width, loading.control.speed_floor,
        )  # fmt: skip
        return decision, plan

    def _calc_strategy(self, context: Context, output: BasicVector) -> None:
        decision: Decision = context.get_abstract_state(int(self._decision)).get_value()
        values = decision.strategy or self._scenario.loading.strategy.model_dump()
        output.SetFromVector([values[name] for name in StrategyConfig.model_fields])


def make_loader(
    view: StationView,
    model: str,
    choice: str = "look_ahead",
    weights: str = "",
    bounds: str = "",
    depth: int = 3,
    seed: int = 0,
    learned_from: str = "",
) -> AutonomousLoader:
    """Return an autonomous loader, for `loading.parts.planner` of a scenario.

    Args:
        view: the station.
        model: folder of a study, or of its exported tables.
        choice: one of `drakerock.autonomy.model.CHOICES`.
        weights: such as ``production=0.6,damage=0.4``; empty: all alike.
        bounds: such as ``debris<=500``, several with commas.
        depth: loadings that ``look_ahead`` looks ahead.
        seed: of learning and choosing.
        learned_from: `LoaderModel.learned_from` that the model has to have; empty: any.

    Raises:
        InputError: a study that cannot be read, does not fit or holds other loadings, an unknown choice, a bad
            preference.
    """
    learned = _load_model(str(Path(model).resolve()), seed)
    if learned_from not in ("", learned.learned_from):
        raise InputError(
            f"{model}: holds other loadings by now than the model was learned from ({learned_from})"
        )
    wanted = make_preference(
        learned.problem, weights or None, [part for part in bounds.split(",") if part.strip()]
    )
    made = learned.make_choice(choice, view.scenario.loading.strategy, depth)
    return AutonomousLoader(learned, made, view.scenario, view.digger, wanted)


@lru_cache(maxsize=2)
def _load_model(folder: str, seed: int) -> LoaderModel:
    """Return a model; a sequence of loadings learns it once."""
    return load_model(folder, seed)
