"""The rocks' state in a Drake context, without a copy of it in every step.

Drake copies discrete values twice in each update, which for a full-size pile took as long as all that a resting pile
needs. So a context holds the arrays in a `RockStates` and, as its discrete value, the number of the one that counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from drakerock.rocks.engine.engine import MachineStep, NonsmoothEngine, RockArrays, StepReport


@dataclass(eq=False)
class SolvedState:
    """A state of the rocks; what `RockStates` gives is not to be written to.

    Attributes:
        arrays: the state; `arrays.steps` is its number.
        report: of the step that led to it; None at the start.
        room: what the arrays are in, the contact cache with its full capacity; None: not to be written to again, since
            others hold this state, too.
    """

    arrays: RockArrays
    report: StepReport | None = None
    room: RockArrays | None = None

    def __deepcopy__(self, _memo: object) -> SolvedState:
        """Share the state: Drake copies a context's values so."""
        self.room = None
        return self


class RockStates:
    """The state of the rocks and the next one, once that is solved: an abstract value of a context.

    The two take turns: the next state is written into the room of the one before the last, from which it differs by
    two steps. The state that counts is never written to, so whoever solves a step, and however often, changes
    nothing. A copy of a context shares what is there until its next steps, which take new room.
    """

    def __init__(self, engine: NonsmoothEngine, *states: SolvedState) -> None:
        """Hold `states`: one, and perhaps the next."""
        self._engine = engine
        self._states = states

    def __deepcopy__(self, memo: dict[int, Any]) -> RockStates:
        """Share the states."""
        return RockStates(self._engine, *(state.__deepcopy__(memo) for state in self._states))

    def get(self, number: int) -> SolvedState:
        """Return a state by its number.

        Raises:
            RuntimeError: it is not there: discrete values were written into the context, without the rest.
        """
        for state in self._states:
            if state.arrays.steps == number:
                return state
        raise RuntimeError(
            "rocks: their discrete state alone cannot be restored; restore the whole context "
            "(SetTimeStateAndParametersFrom), or write a pile into it (set_pile)"
        )

    def solve_next(self, number: int, machine: MachineStep) -> SolvedState:
        """Return the state after a numbered one, and hold both; errors as of `NonsmoothEngine.step`."""
        now = self.get(number)
        # Should the step fail, its room is lost.
        other, self._states = [state for state in self._states if state is not now], (now,)
        room = other[0].room if other else None
        if room is not None and now.report is not None and other[0].arrays.steps == number - 1:
            self._engine.refresh_room(now.arrays, now.report, room)
        else:
            room = self._engine.make_room() if room is None else room
            self._engine.copy_to(now.arrays, room)
        arrays, report = self._engine.step(now.arrays, machine, room)
        following = SolvedState(arrays, report, room)
        self._states = (now, following)
        return following
