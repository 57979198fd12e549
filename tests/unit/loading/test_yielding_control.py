"""Contract: controllers that yield do what feed-forward does where nothing presses or slips, and less where it does."""

import numpy as np
import pytest
from pydrake.common.value import AbstractValue

from drakerock.errors import InputError
from drakerock.lhd.measurement import MEASUREMENT
from drakerock.loading.config import WeightTransferConfig
from drakerock.loading.control import FeedforwardController
from drakerock.loading.plan import NoPlan
from drakerock.loading.segments import Mode
from drakerock.loading.yielding_control import (
    AdmittanceController,
    SlipController,
    calc_admittance,
    calc_easing,
    calc_slip_ratio,
    make_admittance,
    make_slip_control,
)

STEP = 0.01


def make(kind, digger, **kwargs):
    if kind is AdmittanceController:
        kwargs = {"half_force": 2e5, "time_constant": 0.0} | kwargs
    else:
        kwargs = {"allowed_slip": 0.2, "ease": 0.5, "lift": 0.1, "time_constant": 0.0} | kwargs
    return kind(digger.kinematics, WeightTransferConfig(), STEP, **kwargs)


def run(controller, plan, mode, force=0.0, wheel_rate=1.0, v=1.0, steps=1):
    """Return the speeds after so many updates of the filter."""
    context = controller.CreateDefaultContext()
    measured = dict.fromkeys(MEASUREMENT, 0.0)
    measured |= {
        "x_T": float(plan.waypoint_x[1]) if hasattr(plan, "waypoint_x") else 0.0,
        "z_T": 0.2,
        "psi": 0.1,
    }
    measured |= {"wheel_rate": wheel_rate, "v_F": v}
    controller.GetInputPort("plan").FixValue(context, AbstractValue.Make(plan))
    controller.GetInputPort("mode").FixValue(context, [float(mode)])
    controller.GetInputPort("measurement").FixValue(context, list(measured.values()))
    if controller.HasInputPort("bucket_force"):
        controller.GetInputPort("bucket_force").FixValue(context, [9e9, 0, 0, -force * 0.6, 0, -force * 0.8])
    if not isinstance(controller, FeedforwardController):
        for _ in range(steps):
            context.SetDiscreteState(controller.EvalUniquePeriodicDiscreteUpdate(context))
    return controller.GetOutputPort("motor_speeds").Eval(context)


@pytest.mark.parametrize("kind", [AdmittanceController, SlipController])
@pytest.mark.parametrize("mode", list(Mode))
def test_without_force_and_slip_it_is_feed_forward(kind, mode, plan, digger):
    ours = run(FeedforwardController(digger.kinematics), plan, mode)
    assert np.array_equal(run(make(kind, digger), plan, mode), ours)


@pytest.mark.parametrize("mode", [Mode.S0, Mode.S1, Mode.S2])
def test_admittance_halves_the_speeds_at_its_force(mode, plan, digger):
    ours = run(FeedforwardController(digger.kinematics), plan, mode)
    controller = make(AdmittanceController, digger)
    assert np.allclose(run(controller, plan, mode, force=2e5), 0.5 * ours)
    assert np.allclose(run(controller, plan, mode, force=6e5), 0.25 * ours)


@pytest.mark.parametrize("mode", [Mode.APPROACH, Mode.S3, Mode.DONE])
def test_admittance_does_not_slow_the_way_to_and_from_the_pile(mode, plan, digger):
    ours = run(FeedforwardController(digger.kinematics), plan, mode)
    assert np.array_equal(run(make(AdmittanceController, digger), plan, mode, force=1e6), ours)


def test_the_filter_takes_its_time(plan, digger):
    controller = make(AdmittanceController, digger, time_constant=0.5)
    fast = run(FeedforwardController(digger.kinematics), plan, Mode.S0)[0]
    once, later = (run(controller, plan, Mode.S0, force=2e5, steps=n)[0] for n in (1, 50))
    assert once == pytest.approx(fast / (1 + 1 - np.exp(-0.02)))
    assert later == pytest.approx(fast / (1 + 1 - np.exp(-1.0)))


@pytest.mark.parametrize("mode", [Mode.S0, Mode.S1])
def test_spinning_wheels_ease_off_and_the_boom_lifts(mode, plan, digger):
    ours = run(FeedforwardController(digger.kinematics), plan, mode)
    controller = make(SlipController, digger)
    spinning = run(controller, plan, mode, v=0.0)
    assert spinning[0] == pytest.approx(0.5 * ours[0])
    assert spinning[1] == pytest.approx(ours[1] - 0.1)
    some = run(controller, plan, mode, v=0.5)  # slip ratio 0.5: (0.5 - 0.2) / 0.8 of the way
    assert some[0] == pytest.approx(ours[0] * (1 - 0.5 * 0.375))
    assert some[2] == ours[2]


@pytest.mark.parametrize("mode", [Mode.APPROACH, Mode.S2, Mode.S3])
def test_slip_matters_in_the_push_only(mode, plan, digger):
    ours = run(FeedforwardController(digger.kinematics), plan, mode)
    assert np.array_equal(run(make(SlipController, digger), plan, mode, v=0.0), ours)


@pytest.mark.parametrize("kind", [AdmittanceController, SlipController])
def test_without_a_plan_the_machine_stands(kind, digger):
    assert not run(make(kind, digger), NoPlan("nothing there"), Mode.S0, force=1e5).any()


def test_slip_ratio_is_the_share_by_which_the_rims_are_faster():
    assert calc_slip_ratio(1.0, 0.25, 1.0) == 0.75
    assert calc_slip_ratio(1.0, 1.2, 1.0) == 0.0  # pushed from behind
    assert calc_slip_ratio(1.0, -0.5, 1.0) == 1.0  # sliding back
    assert calc_slip_ratio(0.05, 0.0, 1.0) == 0.0  # all but standing
    assert calc_slip_ratio(-1.0, 0.0, 1.0) == 0.0  # in reverse
    assert calc_easing(0.1, 0.2, 0.5) == 0.0
    assert calc_easing(1.0, 0.2, 0.5) == 0.5
    assert np.array_equal(calc_admittance(np.ones(3), 0.0, 1e5), np.ones(3))


@pytest.mark.parametrize(
    ("make_it", "parameters", "message"),
    [
        (make_admittance, {"half_force": 0.0}, "half_force: 0; from 1"),
        (make_admittance, {"time_constant": -1.0}, "time_constant: -1"),
        (make_slip_control, {"allowed_slip": 1.0}, "allowed_slip: 1; from 0 to 0.95"),
        (make_slip_control, {"ease": 1.5}, "ease: 1.5"),
    ],
)
def test_gains_that_mean_nothing_are_named(make_it, parameters, message):
    with pytest.raises(InputError, match=message):
        make_it(None, **parameters)
