"""Effects of one variable at a time on the objectives: what hangs on what is not known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from drakerock.errors import InputError
from drakerock.exploration.config import SamplingConfig
from drakerock.exploration.problem import Array, Problem

if TYPE_CHECKING:  # schemas make designs, and the table brings pyarrow
    from drakerock.exploration.table import ResponseTable


@dataclass(frozen=True)
class Effect:
    """What one variable changes of one objective, all others at the centre.

    Attributes:
        block: value of the block's variable; 0 without one.
        variable, objective: names.
        centre: the objective at the centre.
        values: the variable at the centre, and at its ends (those that are not the centre).
        changes: the objective there less the centre's.
        errors: standard errors of the changes; NaN: unknown.
    """

    block: float
    variable: str
    objective: str
    centre: float
    values: tuple[float, ...]
    changes: tuple[float, ...]
    errors: tuple[float, ...]

    @property
    def size(self) -> float:
        """The larger change's size; 0 if none is known."""
        return max((abs(change) for change in self.changes if np.isfinite(change)), default=0.0)


def _find_centre(problem: Problem, config: SamplingConfig) -> Array:
    unknown = set(config.centre) - set(problem.variable_names)
    if unknown:
        raise InputError(
            f"exploration.sampling.centre: no variable '{min(unknown)}'; there are: {', '.join(problem.variable_names)}"
        )
    middle = {v.name: 0.5 * (v.low + v.high) for v in problem.variables}
    return problem.make_point(middle | config.centre)


def _find_blocks(problem: Problem, config: SamplingConfig) -> tuple[int, list[float]]:
    """Return the index of the block's variable, -1 without one, and its values."""
    if config.block is None:
        return -1, [0.0]
    if config.block not in problem.variable_names:
        raise InputError(
            f"exploration.sampling.block: no variable '{config.block}'; there are: {', '.join(problem.variable_names)}"
        )
    index = problem.variable_names.index(config.block)
    v = problem.variables[index]
    return index, np.arange(np.ceil(v.low), np.floor(v.high) + 1).tolist()


def make_one_at_a_time(problem: Problem, config: SamplingConfig) -> Array:
    """Return the points (n, d): in each block the centre, then each other variable at its ends.

    An end that is the centre's value is left out.

    Raises:
        InputError: a centre or block that names no variable, or lies outside of a range.
    """
    block, blocks = _find_blocks(problem, config)
    points = []
    for value in blocks:
        centre = _find_centre(problem, config)
        if block >= 0:
            centre[block] = value
        points.append(centre)
        for j, v in enumerate(problem.variables):
            for end in (v.low, v.high):
                if j != block and end != centre[j]:
                    point = centre.copy()
                    point[j] = end
                    points.append(point)
    return np.array(points)


def calc_effects(table: ResponseTable, config: SamplingConfig) -> list[Effect]:
    """Return the effects in a table of the design `make_one_at_a_time`; what has no response is NaN.

    Raises:
        InputError: a block's centre is not among the points.
    """
    problem = table.problem
    block, blocks = _find_blocks(problem, config)
    rows = {(x + 0.0).tobytes(): i for i, x in enumerate(table.X)}
    effects = []
    for value in blocks:
        centre = _find_centre(problem, config)
        if block >= 0:
            centre[block] = value
        middle = rows.get((centre + 0.0).tobytes())
        if middle is None:
            raise InputError(f"effects: the centre {centre.tolist()} has not been simulated")
        for j, v in enumerate(problem.variables):
            if j == block:
                continue
            ends = [end for end in (v.low, v.high) if end != centre[j]]
            found = []
            for end in ends:
                point = centre.copy()
                point[j] = end
                found.append(rows.get((point + 0.0).tobytes()))
            for k, name in enumerate(problem.objective_names):
                y = [np.nan if i is None else float(table.Y[i, k]) for i in found]
                se = [np.nan if i is None else float(table.noise[i, k]) for i in found]
                here, own = float(table.Y[middle, k]), float(table.noise[middle, k])
                effects.append(
                    Effect(
                        value, v.name, name, here, (float(centre[j]), *ends), tuple(item - here for item in y),
                        tuple(float(np.hypot(item, own)) for item in se),
                    )
                )  # fmt: skip
    return effects
