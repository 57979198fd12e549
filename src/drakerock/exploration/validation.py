"""How good the surrogate is, and how good it could be at all (method section 6, accuracy).

NRMSE: eps = sqrt(mean squared error) / (max y - min y), the range taken over the fitted sample. Validation
responses are means of noisy sequences themselves, so even the true phi(x) would not reach eps = 0: the noise
floor is the NRMSE that it would reach, sqrt(mean se^2) / range.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import norm
from sklearn.base import clone

from drakerock.errors import InputError
from drakerock.exploration.problem import Array
from drakerock.exploration.surrogate import Surrogate, calc_ranges
from drakerock.exploration.table import ResponseTable

COVERAGE_LEVELS = (0.5, 0.8, 0.95)


@dataclass(frozen=True)
class Comparison:
    """Predicted against simulated values of one objective, on one set of points.

    Attributes:
        simulated, predicted: (n,) in the objective's unit.
        std: (n,) standard deviation of the difference: the prediction's and the simulated mean's own.
    """

    simulated: Array
    predicted: Array
    std: Array

    def calc_nrmse(self, value_range: float) -> float:
        """Return the NRMSE [-]; NaN without points."""
        if len(self.simulated) == 0:
            return float("nan")
        return float(np.sqrt(np.mean((self.predicted - self.simulated) ** 2)) / value_range)

    def calc_coverage(self, level: float) -> float:
        """Return the share of points inside the central interval of that probability; NaN without points."""
        if len(self.simulated) == 0:
            return float("nan")
        half = norm.ppf(0.5 + level / 2.0) * self.std
        return float(
            np.mean(np.abs(self.predicted - self.simulated) <= half + 1e-12 * np.abs(self.simulated))
        )


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of the surrogate of one objective.

    Attributes:
        objective: its name.
        value_range: max y - min y over the fitted sample (1 for a constant response).
        leave_one_out, validation: the comparisons.
        loo_nrmse, validation_nrmse: [-]; NaN for validation without validation points.
        noise_floor: [-] of the validation points (of the samples without any); NaN with unknown noise.
        coverage: share of validation points (samples without any, by leave-one-out) inside the intervals of
            `COVERAGE_LEVELS`.
    """

    objective: str
    value_range: float
    leave_one_out: Comparison
    validation: Comparison
    loo_nrmse: float
    validation_nrmse: float
    noise_floor: float
    coverage: tuple[float, ...]


def calc_learning_curve(surrogate: Surrogate, table: ResponseTable, n_sizes: int = 8) -> tuple[Array, Array]:
    """Return how the validation NRMSE falls with the number of sample points, taken in the table's order.

    Each size is refitted with the theta, lambda and trend of the full fit, so that the curve shows what more
    points bring and not what more likelihood searches bring.

    Returns:
        Sizes (s,) and NRMSE (s, k); no sizes without validation points or with too few samples.
    """
    samples, others = table.select("sample"), table.select("validation")
    k = len(table.problem.objectives)
    first = max(2 * len(table.problem.variables) + 2, len(samples) // n_sizes)
    complete = np.isfinite(others.Y).all(axis=1)
    if not complete.any() or first >= len(samples):
        return np.empty(0, dtype=int), np.empty((0, k))
    sizes = np.unique(np.linspace(first, len(samples), n_sizes).astype(int))
    nrmse = np.full((len(sizes), k), np.nan)
    for j, model in enumerate(surrogate.models_):
        good = np.isfinite(samples.Y[:, j])
        for i, size in enumerate(sizes):
            rows = np.flatnonzero(good[:size])
            if model.constant_ or len(rows) < 2:
                continue
            part = clone(model).set_params(theta=model.theta_, lam=model.lam_, trend=model.trend_)
            part.fit(samples.X[rows], samples.Y[rows, j], model.noise_[: len(rows)])
            error = part.predict(others.X[complete]) - others.Y[complete, j]
            nrmse[i, j] = np.sqrt(np.mean(error**2)) / calc_ranges(samples.Y[good, j : j + 1])[0]
    return sizes, nrmse


def validate(surrogate: Surrogate, table: ResponseTable) -> tuple[Accuracy, ...]:
    """Return the accuracy of each objective of a surrogate fitted to the sample points of `table`.

    Where the standard error of a validation point is unknown, the fitted regularisation stands for its noise.

    Raises:
        InputError: the surrogate was not fitted to this table's samples.
    """
    samples, others = table.select("sample"), table.select("validation")
    result = []
    for j, (objective, model) in enumerate(zip(table.problem.objectives, surrogate.models_, strict=True)):
        good = np.isfinite(samples.Y[:, j])
        if not np.array_equal(samples.Y[good, j], model.y_train_):
            raise InputError("validation: the surrogate was not fitted to the sample points of this table")
        value_range = float(calc_ranges(samples.Y[good, j : j + 1])[0])
        loo = Comparison(samples.Y[good, j], *model.leave_one_out())
        there = np.isfinite(others.Y[:, j])
        simulated, se = others.Y[there, j], others.noise[there, j]
        if there.any():
            mean, std = (values[:, j] for values in surrogate.predict(others.X[there], return_std=True))
        else:
            mean = std = np.empty(0)
        own = np.where(np.isfinite(se), se, np.sqrt(model.lam_ * model.sigma2_))
        compared = Comparison(simulated, mean, np.hypot(std, own))
        known = se if there.any() else samples.noise[good, j]
        known = known[np.isfinite(known)]
        source = compared if there.any() else loo
        result.append(
            Accuracy(
                objective.name,
                value_range,
                loo,
                compared,
                loo.calc_nrmse(value_range),
                compared.calc_nrmse(value_range),
                float(np.sqrt(np.mean(known**2)) / value_range) if len(known) else float("nan"),
                tuple(source.calc_coverage(level) for level in COVERAGE_LEVELS),
            )
        )
    return tuple(result)
