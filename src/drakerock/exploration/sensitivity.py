"""Which variables matter: Sobol' indices on the surrogate (SALib), with bootstrap intervals.

First-order index S1_i = V[E(phi | x_i)] / V(phi): what x_i explains alone. Total index
ST_i = 1 - V[E(phi | all but x_i)] / V(phi): x_i with all its interactions. Variables are independent and
uniform over their ranges.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from SALib.analyze import sobol as sobol_analysis
from SALib.sample import sobol as sobol_sample

from drakerock.exploration.config import SensitivityConfig
from drakerock.exploration.problem import Array, Problem
from drakerock.randomness import derive_seed


@dataclass(frozen=True)
class Sensitivity:
    """Sobol' indices of one objective.

    Attributes:
        objective: its name.
        variables: names, in the problem's order.
        first, total: (d,) indices; zero for a response that does not vary.
        first_half, total_half: (d,) half widths of the intervals.
        ranking: names, largest total index first.
    """

    objective: str
    variables: tuple[str, ...]
    first: Array
    first_half: Array
    total: Array
    total_half: Array

    @property
    def ranking(self) -> tuple[str, ...]:
        """Variable names, largest total index first."""
        return tuple(self.variables[i] for i in np.argsort(-self.total, kind="stable"))


def calc_sensitivity(
    predict: Callable[[ArrayLike], Array],
    problem: Problem,
    config: SensitivityConfig | None = None,
    seed: int = 0,
) -> tuple[Sensitivity, ...]:
    """Return the Sobol' indices of every objective of `predict`.

    Args:
        predict: from points (n, d) to objectives (n, k), such as `Surrogate.predict`.
        problem: variables and objectives.
        config: sample size and probability of the intervals.
        seed: seed of the study.

    The intervals are those of the sampling (bootstrap over the base sample), not of the surrogate's error.
    """
    config = config or SensitivityConfig()
    d = len(problem.variables)
    # Ranges are [-1, 1]: SALib meets the real ones through `unscale` only.
    salib = {"num_vars": d, "names": list(problem.variable_names), "bounds": [[-1.0, 1.0]] * d}
    child = derive_seed(seed, "sobol") % 2**32
    U = sobol_sample.sample(salib, config.n_base, calc_second_order=False, seed=child)
    Y = predict(problem.unscale(U))
    result = []
    for j, objective in enumerate(problem.objectives):
        y = Y[:, j]
        if np.ptp(y) <= 1e-12 * max(1.0, float(np.abs(y).max())):
            zero = np.zeros(d)
            result.append(Sensitivity(objective.name, problem.variable_names, zero, zero, zero, zero))
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # SALib on its own use of pandas
            indices = sobol_analysis.analyze(
                salib, y, calc_second_order=False, conf_level=config.confidence, seed=child
            )
        parts = [np.asarray(indices[key], dtype=float) for key in ("S1", "S1_conf", "ST", "ST_conf")]
        result.append(Sensitivity(objective.name, problem.variable_names, *parts))
    return tuple(result)
