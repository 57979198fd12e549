"""From a choice's proposal to a decision that is safe to execute, with its reasons."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from drakerock.autonomy.choices import Choice, Proposal
from drakerock.autonomy.preference import Preference
from drakerock.autonomy.situation import Situation
from drakerock.exploration.problem import Array, Problem
from drakerock.loading.config import StrategyConfig

Action = Literal["load", "clean", "stop"]


@dataclass(frozen=True)
class Decision:
    """What is to be done with this pile, and why.

    Attributes:
        action: load with the strategy; clean the floor and look again; stop, since the pile cannot be entered.
        strategy: alpha, beta, gamma, kappa.
        choice: name of the choice that was asked.
        fell_back: whether the robust fixed strategy stands in for it.
        preference: what was wanted, in words.
        predicted: by objective: mean and std (None: not predicted).
        reasons: why, in words, the choice's own last.
        novelty: how unlike the training set the pile is; above 1 it is unlike.
        hazards: what was seen.
        x: the design point.
    """

    action: Action
    strategy: dict[str, float]
    choice: str
    fell_back: bool
    preference: str
    predicted: dict[str, dict[str, float]] | None
    reasons: tuple[str, ...]
    novelty: float
    hazards: tuple[str, ...]
    x: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON; a novelty that is not known is null."""
        known = math.isfinite(self.novelty)
        return asdict(self) | {"novelty": self.novelty if known else None}


def decide(
    problem: Problem,
    choice: Choice,
    robust: Choice,
    situation: Situation,
    preference: Preference,
    strategy: StrategyConfig,
    *,
    cleaned: bool = False,
) -> Decision:
    """Return what to do with a pile.

    A pile that cannot be entered: stop. Debris in the way: clean, unless that has just been done. A pile unlike the
    training set: the robust fixed strategy instead of a choice that looks at it. An entry that a hazard bars: the
    nearest one that none bars.

    Args:
        problem: variables and objectives.
        choice: what is asked.
        robust: the fixed strategy that stands in for it.
        situation: the pile.
        preference: what is wanted.
        strategy: values of what is no variable.
        cleaned: whether the floor was cleaned just now.

    Raises:
        InputError: no fixed strategy keeps the bounds.
    """
    hazards = tuple(str(hazard) for hazard in situation.hazards)
    reasons: list[str] = []

    def make(action: Action, x: Array | None, proposal: Proposal | None, fell_back: bool) -> Decision:
        point = {} if x is None else dict(zip(problem.variable_names, map(float, x), strict=True))
        predicted = None
        if proposal is not None and proposal.Y is not None and proposal.std is not None:
            predicted = {
                name: {"mean": float(mean), "std": float(std)}
                for name, mean, std in zip(problem.objective_names, proposal.Y, proposal.std, strict=True)
            }
        return Decision(
            action, strategy.model_dump() | point, choice.name, fell_back, str(preference), predicted, tuple(reasons),
            situation.novelty, hazards, tuple(point.values()),
        )  # fmt: skip

    if situation.entries is None:
        reasons.append(
            "the pile cannot be entered: none of the slices that the machine fits into holds any pile"
        )
        return make("stop", None, None, False)
    debris = [hazard for hazard in situation.hazards if hazard.kind == "debris in the way"]
    if debris and not cleaned:
        reasons.append(f"clean first: {max(debris, key=lambda hazard: hazard.size)}")
        return make("clean", None, None, False)
    unlike = choice.sees_pile and not situation.novelty <= 1.0
    if unlike:
        reasons.append(
            f"the pile is unlike those learned from (novelty {situation.novelty:.2f}, at most 1): "
            "the robust fixed strategy stands in"
        )
    proposal = (robust if unlike else choice).choose(situation, preference)
    x, gamma = proposal.x, _find_gamma(problem, proposal.x, strategy)
    moved = _move_entry(situation, gamma)
    if moved != gamma:
        at = [hazard for hazard in situation.hazards if abs(hazard.y - situation.find_entry(gamma)) < 1e-6]
        what = at[0].kind if at else "hazard"
        reasons.append(f"{what} at gamma {gamma:.2f}: entered at gamma {moved:.2f} instead")
        if "gamma" in problem.variable_names:
            x = x.copy()
            x[problem.variable_names.index("gamma")] = moved
        else:
            strategy = strategy.replace(gamma=moved)
    elif situation.is_barred(np.array([gamma]))[0]:
        reasons.append("hazards bar every entry; the least costly is taken")
    reasons.append(proposal.reason)
    return make("load", x, proposal, unlike)


def _find_gamma(problem: Problem, x: Array, strategy: StrategyConfig) -> float:
    names = problem.variable_names
    return float(x[names.index("gamma")]) if "gamma" in names else strategy.gamma


def _move_entry(situation: Situation, gamma: float) -> float:
    """Return gamma, or the nearest one that no hazard bars where one bars it and another is free."""
    if not situation.is_barred(np.array([gamma]))[0]:
        return gamma
    free = situation.gammas[~situation.is_barred(situation.gammas)]
    return gamma if len(free) == 0 else float(free[np.argmin(np.abs(free - gamma))])
