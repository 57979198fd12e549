"""Tables of extreme but finite numbers: an exploration comes to an end, with numbers in it that JSON can hold."""

import json
import warnings

import numpy as np
import pytest

from drakerock.exploration.analysis import ExplorationConfig, explore, summarize
from drakerock.exploration.problem import Objective, Problem, Variable
from drakerock.exploration.table import ResponseTable

QUICK = ExplorationConfig.model_validate(
    {
        "surrogate": {"n_starts": 2},
        "pareto": {"population": 20, "evaluations": 200, "n_draws": 4},
        "sensitivity": {"n_base": 64},
    }
)


def spike(Y):
    return np.where(np.arange(len(Y))[:, None] == 3, 1e59, Y)


CASES = {
    "large": {"scale": 1e59, "k": 5},
    "large, many": {"scale": 1e59, "k": 6},
    "small": {"scale": 1e-100, "k": 5},
    "vanishing": {"scale": 1e-320},
    "far from zero": {"scale": 1e-10, "offset": 1e10},
    "constant": {"scale": 0.0, "offset": 3.0},
    "one apart": {"change": spike},
    "mixed": {"change": lambda Y: Y * np.array([1e-200, 1.0, 1e50])},
    "half missing": {"change": lambda Y: np.where(np.arange(len(Y))[:, None] % 2 == 0, np.nan, Y)},
    "objectives alike": {"k": 6, "change": lambda Y: np.repeat(Y[:, :1], 6, axis=1)},
    "some constant": {"k": 6, "change": lambda Y: np.where(np.arange(6) < 2, 1.0, Y)},
    "wide ranges": {"low": -1e60, "high": 1e60},
    "narrow ranges": {"low": 1.0, "high": 1.0 + 1e-15},
    "unsure": {"error": 1e59},
    "sure": {"error": 1e-300},
}


@pytest.mark.parametrize("name", CASES)
def test_extreme_tables_are_explored(name):
    case = {
        "scale": 1.0,
        "offset": 0.0,
        "k": 3,
        "low": -1.0,
        "high": 1.0,
        "change": lambda Y: Y,
        "error": None,
    }
    case |= CASES[name]
    problem = Problem(
        variables=tuple(Variable(name=f"x{i}", low=case["low"], high=case["high"]) for i in range(2)),
        objectives=tuple(Objective(name=f"f{i}") for i in range(case["k"])),
    )
    U = np.random.default_rng(0).uniform(-1, 1, (12, 2))
    Y = np.stack([((U - np.cos(i)) ** 2).sum(axis=1) for i in range(case["k"])], axis=1)
    Y = case["change"](Y * case["scale"] + case["offset"])
    noise = None if case["error"] is None else np.full_like(Y, case["error"])
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        exploration = explore(ResponseTable(problem, problem.unscale(U), Y, noise), QUICK)
    json.dumps(summarize(exploration), allow_nan=False)
    assert len(exploration.front) >= 1
