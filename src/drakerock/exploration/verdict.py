"""Whether a study is fit for decisions, in words: accuracy against the noise floor, coverage, points needed.

A surrogate's error against simulated means has two parts: the means' own noise (the noise floor, `validation`) and the
error of the surrogate itself, m = sqrt(max(NRMSE^2 - floor^2, 0)), in ranges of the objective. What it explains is
the share of the true spread of the compared points, 1 - m^2 / (s^2 - floor^2), with s their simulated spread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from drakerock.exploration.problem import Array
from drakerock.exploration.validation import COVERAGE_LEVELS, Accuracy

# In ranges of the objective: what a decision can live with, and beyond which a prediction says nothing.
GOOD_ERROR, ROUGH_ERROR = 0.10, 0.25
# Shares of the true spread that are explained.
GOOD_SHARE, ROUGH_SHARE = 0.75, 0.3
# Shares of points inside their 95 % intervals.
GOOD_COVERAGE, ROUGH_COVERAGE = 0.85, 0.6
# With fewer validation points, leaving out one sample at a time says more.
MIN_VALIDATION = 8
# Beyond so many times the points, a learning curve is not trusted.
_FARTHEST = 10.0


class Grade(IntEnum):
    """How far a surrogate can be relied on."""

    UNFIT = 0
    ROUGH = 1
    GOOD = 2


_WORDS = {
    Grade.GOOD: "fit for decisions",
    Grade.ROUGH: "fit for a first choice, which has to be confirmed by simulation",
    Grade.UNFIT: "not fit for decisions",
}


@dataclass(frozen=True)
class Judgement:
    """What can be said of the surrogate of one objective.

    Attributes:
        objective: its name.
        grade: how far it can be relied on.
        compared: "validation" or "leave-one-out".
        n_compared: points compared with.
        error: of the surrogate itself, without the noise, in ranges of the objective.
        noise_floor: in ranges; NaN if the noise is unknown.
        share: of the true spread explained; NaN where the points differ by no more than their noise.
        coverage: share of the points inside their 95 % intervals.
        reasons: what keeps it from a better grade, in words.
        advice: what would help, in words; "" if nothing is needed.
    """

    objective: str
    grade: Grade
    compared: str
    n_compared: int
    error: float
    noise_floor: float
    share: float
    coverage: float
    reasons: tuple[str, ...]
    advice: str

    def to_text(self) -> str:
        """Return it in one sentence or two."""
        floor = f", noise floor {_percent(self.noise_floor)}" if np.isfinite(self.noise_floor) else ""
        text = f"{self.objective}: {_WORDS[self.grade]} (error {_percent(self.error)} of the range{floor}, against "
        text += f"{self.n_compared} {'validation' if self.compared == 'validation' else 'left-out'} points)"
        text += f": {'; '.join(self.reasons)}" if self.reasons else ""
        return text + "." + (f" {self.advice}" if self.advice else "")


@dataclass(frozen=True)
class Verdict:
    """What can be said of all of them.

    Attributes:
        judgements: one per objective.
    """

    judgements: tuple[Judgement, ...]

    @property
    def grade(self) -> Grade:
        """The worst of the objectives' grades."""
        return min(judgement.grade for judgement in self.judgements)

    @property
    def title(self) -> str:
        """The verdict in a few words, such as "Not fit for decisions"."""
        words = _WORDS[self.grade]
        return words[0].upper() + words[1:]

    def get(self, objective: str) -> Judgement:
        """Return the judgement of an objective."""
        return next(item for item in self.judgements if item.objective == objective)

    def to_text(self) -> str:
        """Return the verdict as lines for a person."""
        return "\n".join([f"{self.title}.", *(f"  {item.to_text()}" for item in self.judgements)])

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return {
            "fit": self.grade.name.lower(),
            "title": self.title,
            "objectives": {
                item.objective: {
                    "fit": item.grade.name.lower(),
                    "error": _finite(item.error),
                    "noise_floor": _finite(item.noise_floor),
                    "share_explained": _finite(item.share),
                    "coverage_95": _finite(item.coverage),
                    "text": item.to_text(),
                }
                for item in self.judgements
            },
        }


def judge(
    accuracy: Sequence[Accuracy],
    n_points: int,
    learning_sizes: Array | None = None,
    learning_nrmse: Array | None = None,
) -> Verdict:
    """Judge the surrogates of a study.

    Args:
        accuracy: one per objective (`validate`).
        n_points: sample points fitted to.
        learning_sizes, learning_nrmse: (s,), (s, k) of `calc_learning_curve`, for the advice.
    """
    return Verdict(
        tuple(
            _judge_one(
                item,
                n_points,
                np.empty(0) if learning_sizes is None else np.asarray(learning_sizes, dtype=float),
                np.empty(0) if learning_nrmse is None else learning_nrmse[:, j],
            )
            for j, item in enumerate(accuracy)
        )
    )


def _judge_one(accuracy: Accuracy, n_points: int, sizes: Array, nrmse: Array) -> Judgement:
    validated = len(accuracy.validation.simulated) >= MIN_VALIDATION
    compared = accuracy.validation if validated else accuracy.leave_one_out
    total = compared.calc_nrmse(accuracy.value_range)
    floor = accuracy.noise_floor
    noise = floor**2 if np.isfinite(floor) else 0.0
    error = float(np.sqrt(max(total**2 - noise, 0.0)))
    true_spread = float(np.var(compared.simulated / accuracy.value_range)) - noise
    constant = float(np.ptp(compared.simulated)) == 0.0
    share = float("nan") if true_spread <= 0.0 else 1.0 - error**2 / true_spread
    coverage = compared.calc_coverage(COVERAGE_LEVELS[-1])
    grades, reasons = [Grade.GOOD], []
    for value, good, rough, reason in (
        (-error, -GOOD_ERROR, -ROUGH_ERROR, f"its error is {_percent(error)} of the range"),
        (
            share,
            GOOD_SHARE,
            ROUGH_SHARE,
            f"it explains {_percent(max(share, 0.0))} of what differs between points",
        ),
        (
            coverage,
            GOOD_COVERAGE,
            ROUGH_COVERAGE,
            f"{_percent(coverage)} of the points are in their 95 % intervals",
        ),
    ):
        if np.isfinite(value) and value < good and not constant:
            grades.append(Grade.ROUGH if value >= rough else Grade.UNFIT)
            reasons.append(reason)
    if true_spread <= 0.0 and not constant:
        grades.append(Grade.UNFIT)
        reasons.append("the points differ by no more than their noise")
    grade = min(grades)
    advice = "" if grade == Grade.GOOD else _advise(error, floor, true_spread, n_points, sizes, nrmse)
    return Judgement(
        accuracy.objective, grade, "validation" if validated else "leave-one-out", len(compared.simulated),
        error, floor, share, coverage, tuple(reasons), advice,
    )  # fmt: skip


def _advise(error: float, floor: float, true_spread: float, n_points: int, sizes: Array, nrmse: Array) -> str:
    """Return what would help: more loadings a point where noise decides, more points otherwise."""
    if np.isfinite(floor) and (floor > error or true_spread <= 0.0):
        return f"Noise decides: four times as many loadings a point would halve its {_percent(floor)}."
    needed = _extrapolate(floor, n_points, sizes, nrmse)
    if needed is None:
        return f"More points are needed; {n_points} do not show how many."
    if needed > _FARTHEST * n_points:
        return f"More than {_FARTHEST * n_points:.0f} points would be needed: narrower ranges may help."
    return f"About {needed:.0f} points would be needed, {n_points} there are."


def _extrapolate(floor: float, n_points: int, sizes: Array, nrmse: Array) -> float | None:
    """Return the points at which the surrogate's own error falls to GOOD_ERROR; None if it does not fall."""
    own = np.sqrt(np.maximum(nrmse**2 - (floor**2 if np.isfinite(floor) else 0.0), 1e-8))
    there = np.isfinite(own)
    if there.sum() < 4:
        return None
    slope, offset = np.polyfit(np.log(sizes[there]), np.log(own[there]), 1)
    if slope > -0.1:
        return None
    return float(max(np.exp((np.log(GOOD_ERROR) - offset) / slope), n_points))


def _percent(value: float) -> str:
    return f"{100.0 * value:.0f} %" if np.isfinite(value) else "-"


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
