"""Contract: a scenario names controllers that yield; with gains that do nothing they are feed-forward, to the bit."""

import numpy as np
import pytest

from drakerock.errors import InputError
from drakerock.loading.cycle import run_cycle
from drakerock.loading.segments import Mode
from drakerock.loading.station import make_station
from drakerock.study.jobs import get_pile


@pytest.fixture(scope="module")
def scenario(small_scenario):
    return small_scenario.replace(
        **{
            "dynamics.rocks": "nonsmooth",
            "loading.strategy": {"alpha": 1.1, "beta": 0.5, "gamma": 1.0, "kappa": 0.5},
        }
    )


@pytest.fixture(scope="module")
def pile(scenario):
    return get_pile(scenario)


@pytest.fixture(scope="module")
def plain(scenario, pile):
    return run_cycle(scenario, pile)


def name(scenario, function, **parameters):
    part = {"system": f"drakerock.loading.yielding_control:{function}", "parameters": parameters}
    return scenario.replace(**{"loading.parts.controller": part})


def test_slip_control_that_does_not_ease_off_is_feed_forward(scenario, pile, plain):
    result = run_cycle(name(scenario, "make_slip_control", ease=0.0), pile)
    assert np.array_equal(result.signals["x_T"], plain.signals["x_T"])
    assert result.outcome.phi2 == plain.outcome.phi2


def test_admittance_drives_at_the_planned_speed_over_one_plus_the_force(scenario, pile, plain):
    result = run_cycle(name(scenario, "make_admittance", half_force=3e4, time_constant=0.0), pile)
    signals = result.signals
    push = np.flatnonzero((signals["mode"] == Mode.S0) & (np.abs(signals["bucket_force_x"]) > 1e3))
    force = np.sqrt(sum(signals[f"bucket_force_{axis}"] ** 2 for axis in "xyz"))
    planned = result.plan.drive_speed / make_station(scenario, pile).digger.kinematics.wheel_radius
    # Row k holds the target of the step that begins then, and the force over it: the target knows the force before.
    wanted = planned / (1.0 + force[push - 2] / 3e4)
    assert len(push) > 5
    assert np.median(np.abs(signals["target_wheel_rate"][push] - wanted)) < 0.02 * planned
    ours, theirs = (r.outcome.waypoint_times_s for r in (result, plain))
    assert ours[2] - ours[0] > theirs[2] - theirs[0]


def test_a_bad_gain_is_named_by_its_key(scenario, pile):
    with pytest.raises(InputError, match=r"loading\.parts\.controller\.parameters\.ease: 2; from 0 to 1"):
        make_station(name(scenario, "make_slip_control", ease=2.0), pile)
