"""What every sampler must keep, whatever its method."""

import numpy as np
import pytest

from drakerock.errors import InputError
from drakerock.exploration.config import SamplingConfig
from drakerock.exploration.problem import Objective, Problem, Variable
from drakerock.exploration.problems import make_dtlz2, make_noisy_loading
from drakerock.exploration.sampling import SAMPLERS, make_sampler

KNOWN = make_noisy_loading()
METHODS = [(name,) for name in SAMPLERS] + [("lola_voronoi", "error"), ("error", "hypervolume", "front")]


def make(methods, seed=3, problem=KNOWN.problem, **changes):
    config = SamplingConfig(
        methods=methods, n_initial=8, n_corners=6, n_candidates=256, batch_size=4, **changes
    )
    return make_sampler(problem, config, seed)


def rows(X):
    return {x.tobytes() for x in X}


@pytest.fixture(params=METHODS, ids="+".join)
def methods(request):
    return request.param


def test_initial_design_comes_first_and_is_not_asked_twice(methods):
    sampler = make(methods)
    first = sampler.ask(5)
    assert np.array_equal(first, sampler.ask(5)), "asking alone changes nothing"
    sampler.tell(first, KNOWN.evaluate(first))
    rest = sampler.ask(9)
    assert rows(np.vstack([first, rest])) == rows(sampler.initial)


def test_new_points_are_inside_distinct_and_not_told_before(methods):
    sampler = make(methods)
    X = sampler.ask(14)
    sampler.tell(X, KNOWN.evaluate(X))
    for _ in range(3):
        new = sampler.ask(4)
        assert new.shape == (4, 4)
        assert np.all((new >= KNOWN.problem.low) & (new <= KNOWN.problem.high))
        assert len(rows(new)) == 4
        assert not rows(new) & rows(X)
        sampler.tell(new, KNOWN.evaluate(new))
        X = np.vstack([X, new])


def test_next_points_depend_on_what_was_told_and_not_on_its_order(methods):
    first = make(methods)
    X = first.ask(14)
    Y = KNOWN.evaluate(X)
    first.tell(X, Y)
    expected = first.ask(4)
    resumed = make(methods)
    for i in np.random.default_rng(0).permutation(14):
        resumed.tell(X[i : i + 1], Y[i : i + 1])
    np.random.default_rng()  # neither sampler uses global randomness
    assert np.array_equal(resumed.ask(4), expected)


def test_seed_changes_the_design(methods):
    assert not np.array_equal(make(methods, seed=1).ask(8), make(methods, seed=2).ask(8))


def test_running_and_failed_points_are_avoided(methods):
    sampler = make(methods)
    X = sampler.ask(14)
    sampler.tell(X, KNOWN.evaluate(X))
    running = sampler.ask(4)
    sampler.tell(running, np.full((4, 3), np.nan))
    new = sampler.ask(4)
    assert not rows(new) & rows(running)
    # Not even close by: a batch on top of a running one would be wasted.
    gap = np.linalg.norm(KNOWN.problem.scale(new)[:, None] - KNOWN.problem.scale(running), axis=2)
    assert gap.min() > 1e-3
    sampler.tell(running, KNOWN.evaluate(running))
    assert np.isfinite(sampler.ask(4)).all()


def test_nothing_but_failures_still_gives_points(methods):
    sampler = make(methods)
    X = sampler.ask(14)
    sampler.tell(X, np.full((14, 3), np.nan))
    assert len(rows(sampler.ask(5))) == 5


def test_a_batch_may_be_larger_than_what_was_told(methods):
    sampler = make(methods)
    X = sampler.ask(14)
    sampler.tell(X, KNOWN.evaluate(X))
    assert len(rows(sampler.ask(40))) == 40


def test_constant_responses_still_give_points(methods):
    sampler = make(methods)
    X = sampler.ask(14)
    sampler.tell(X, np.ones((14, 3)))
    assert len(rows(sampler.ask(3))) == 3


@pytest.mark.parametrize("d", [1, 10])
def test_one_and_ten_variables_one_objective(methods, d):
    problem = Problem(
        variables=tuple(Variable(name=f"x{i}", low=-1, high=1) for i in range(d)),
        objectives=(Objective(name="f"),),
    )
    sampler = make(methods, problem=problem)
    X = sampler.ask(len(sampler.initial))
    for _ in range(2):
        sampler.tell(X, np.sum(X**2, axis=1, keepdims=True))
        X = sampler.ask(4)
        assert X.shape == (4, d)
        assert len(rows(X)) == 4


def test_two_objectives_of_six_variables(methods):
    known = make_dtlz2(6)
    sampler = make(methods, problem=known.problem)
    X = sampler.ask(14)
    sampler.tell(X, known.evaluate(X))
    assert sampler.ask(4).shape == (4, 6)


def test_wrong_shapes_and_numbers_are_refused(methods):
    sampler = make(methods)
    X = sampler.ask(2)
    with pytest.raises(InputError, match="2 rows of 3 responses"):
        sampler.tell(X, np.zeros((2, 2)))
    with pytest.raises(InputError, match="finite"):
        sampler.tell(np.full((1, 4), np.nan), np.zeros((1, 3)))
    with pytest.raises(InputError, match="at least one"):
        sampler.ask(0)
