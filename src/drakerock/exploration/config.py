"""The exploration's part of the configuration (method section 6)."""

from __future__ import annotations

from statistics import NormalDist
from typing import Annotated, Literal

from pydantic import Field

from drakerock.config import Config
from drakerock.exploration.problem import Array, Problem

MethodName = Literal["space_filling", "lola_voronoi", "error", "variance", "hypervolume", "front"]


class SurrogateConfig(Config):
    """How the surrogate is fitted."""

    p: float | tuple[float, ...] = Field(default=2.0, description="exponent of the correlation, in (0, 2]")
    n_starts: int = Field(default=16, ge=1, description="starting points of the maximum likelihood")
    trend: Literal["mean", "likelihood"] = Field(
        default="mean",
        description="constant trend: the mean of the responses, or that of greatest likelihood",
    )
    use_noise: bool = Field(default=True, description="use the points' standard errors where they are known")


class SamplingConfig(Config):
    """The campaign's design of experiments."""

    design: Literal["latin_hypercube", "one_at_a_time"] = Field(
        default="latin_hypercube",
        description="the initial design; one_at_a_time: the centre, and each variable at both ends",
    )
    centre: dict[str, float] = Field(
        default={}, description="one_at_a_time: the variables' values at the centre; left out: mid-range"
    )
    block: str | None = Field(
        default=None,
        description="one_at_a_time: a variable of whole numbers, at each of which all is done again",
    )
    n_initial: int = Field(default=24, ge=0, description="Latin hypercube points of the initial design")
    n_corners: int = Field(
        default=16, ge=0, description="corner points of the initial design, at most; all 2^d when they fit"
    )
    n_samples: int = Field(default=204, ge=1, description="sample points in all, initial design included")
    n_validation: int = Field(default=40, ge=0, description="random points used for validation only")
    batch_size: int = Field(default=8, ge=1, description="points per sequential step")
    lag: int | None = Field(
        default=None,
        ge=0,
        description="a sequential step waits for all points but the last so many asked for, whose responses it does "
        "without, so that workers have work at the end of a step; none: batch_size; 0: it waits for all",
    )
    methods: tuple[MethodName, ...] = Field(
        default=("lola_voronoi", "error"),
        min_length=1,
        description="sequential methods, taken in turn per batch",
    )
    n_candidates: int = Field(default=2048, ge=64, description="candidate points of the sequential methods")
    surrogate: SurrogateConfig = SurrogateConfig()

    def count_awaited(self, n: int) -> int:
        """Return how many of `n` points asked for, the first ones, a sequential step waits for; at least half."""
        lag = self.batch_size if self.lag is None else self.lag
        return n - min(lag, n // 2)


class Bound(Config):
    """A limit on an objective, in its natural sense and unit, such as debris <= 500."""

    objective: str
    relation: Literal["<=", ">="]
    value: float
    probability: Annotated[
        float,
        Field(
            ge=0.5,
            lt=1.0,
            description="with which it has to hold, by the surrogate's own uncertainty; 0.5: none",
        ),
    ] = 0.9

    def __str__(self) -> str:
        return f"{self.objective}{self.relation}{self.value:g}"

    def calc_violation(self, problem: Problem, Y: Array, std: Array) -> Array:
        """Return by how much the bound is broken (n,); negative where it holds with its probability.

        Args:
            problem: variables and objectives.
            Y, std: (n, k) predicted objectives and their standard deviations.
        """
        excess, spread = self._calc_excess(problem, Y, std)
        return excess + NormalDist().inv_cdf(self.probability) * spread

    def calc_probability(self, problem: Problem, Y: Array, std: Array) -> Array:
        """Return the probability (n,) with which it holds; arguments as of `calc_violation`."""
        excess, spread = self._calc_excess(problem, Y, std)
        sure = (excess <= 0.0).astype(float)
        known = spread > 0.0
        sure[known] = [NormalDist().cdf(z) for z in -excess[known] / spread[known]]
        return sure

    def _calc_excess(self, problem: Problem, Y: Array, std: Array) -> tuple[Array, Array]:
        j = problem.get_objective(self.objective)[0]
        excess = Y[:, j] - self.value
        return (excess if self.relation == "<=" else -excess), std[:, j]


class ParetoConfig(Config):
    """Settings of the search for the front."""

    population: int = Field(default=300, ge=4)
    evaluations: int = Field(default=40_000, ge=100, description="evaluations of the surrogate, about")
    bounds: tuple[Bound, ...] = Field(default=(), description="limits on objectives")
    max_trade_off: float | None = Field(
        default=50.0, gt=1.0, description="M, bound of the trade-off between objectives; null: none"
    )
    n_draws: int = Field(default=64, ge=0, description="draws of the surrogate for the front's uncertainty")


class SensitivityConfig(Config):
    """Settings of the Sobol' indices."""

    n_base: int = Field(
        default=1024, ge=64, description="base samples, a power of two; n_base (d + 2) evaluations"
    )
    confidence: float = Field(default=0.95, gt=0.0, lt=1.0, description="probability of the intervals")


class ExplorationConfig(Config):
    """Everything that can be set about the exploration; the study's YAML embeds it."""

    sampling: SamplingConfig = SamplingConfig()
    surrogate: SurrogateConfig = SurrogateConfig()
    pareto: ParetoConfig = ParetoConfig()
    sensitivity: SensitivityConfig = SensitivityConfig()
    n_confirm: int = Field(default=10, ge=1, description="front points to re-simulate")
