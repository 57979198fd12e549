import json

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from drakerock.lhd.kinematics import calc_bucket_range, calc_full_tilt, calc_pitch, calc_reach, calc_tip
from drakerock.loading.config import PlanningConfig, SensingConfig, StrategyConfig
from drakerock.loading.field import PileProfile
from drakerock.loading.plan import DigPlan, NoPlan
from drakerock.loading.planning import (
    _solve_depth,
    calc_halt,
    calc_swept_volume,
    choose_entry_slice,
    make_dig_plan,
    sweep_profile,
)
from tests.unit.loading.test_field import make_field

PLANNING, SENSING = PlanningConfig(), SensingConfig()


def plan_for(digger, field, width=6.5, **strategy):
    config = StrategyConfig(**{"alpha": 1.0, "beta": 0.5, "gamma": 0.5, "kappa": 0.5} | strategy)
    return make_dig_plan(field, config, digger, PLANNING, SENSING, width, 0.1)


def make_wedge(slope=0.65, toe=-7.0, skew=0.0):
    return make_field(lambda x, y: np.tan(slope) * (x - toe - skew * y), length=12.0)


strategies = st.fixed_dictionaries(
    {
        "alpha": st.floats(0.2, 2.0),
        "beta": st.floats(0.0, 1.0),
        "gamma": st.floats(0.0, 1.0),
        "kappa": st.floats(0.0, 1.0),
    }
)


@settings(max_examples=25)
@given(strategy=strategies, slope=st.floats(0.45, 0.9))
def test_plan_sweeps_the_wanted_volume_inside_the_joint_stops(digger, strategy, slope):
    kin = digger.kinematics
    plan = plan_for(digger, make_wedge(slope), **strategy)
    assert isinstance(plan, DigPlan)
    if plan.reached:
        assert plan.volume == pytest.approx(plan.volume_wanted, rel=0.01)
    assert np.all(plan.phi_l >= kin.phi_l_range[0] - 1e-9)
    assert np.all(plan.phi_l <= kin.phi_l_range[1] + 1e-9)
    low, high = calc_bucket_range(kin, plan.phi_l)
    assert np.all(plan.phi_b >= low - 1e-9)
    assert np.all(plan.phi_b <= high + 1e-9)
    # The boom only raises, and the path is where the joints put the tip.
    assert np.all(np.diff(plan.phi_l) <= 1e-12)
    assert np.allclose(plan.psi, calc_pitch(kin, plan.phi_l, plan.phi_b), atol=1e-9)
    assert np.allclose(plan.z, calc_tip(kin, 0.0, plan.phi_l, plan.phi_b)[:, 1], atol=1e-9)
    assert plan.x.max() <= 1e-6  # the drift's rear end
    assert np.all(np.diff(plan.waypoint_t) >= -1e-12)


@settings(max_examples=10)
@given(beta=st.floats(0.05, 1.0), slope=st.floats(0.45, 0.9))
def test_dig_height_obeys_beta(digger, beta, slope):
    plan = plan_for(digger, make_wedge(slope), beta=beta, kappa=0.0)
    assert plan.h_s2 == pytest.approx(
        beta * calc_reach(digger.kinematics, np.radians(40)) * np.sin(plan.slope)
    )
    s2 = np.searchsorted(plan.segment, 2) - 1
    kin = digger.kinematics
    if (
        min(plan.phi_l[s2] - kin.phi_l_range[0], plan.phi_b[s2] - calc_bucket_range(kin, plan.phi_l[s2])[0])
        < 1e-6
    ):
        assert plan.waypoint_z[2] < plan.h_s2  # the reach ends at a joint stop
    else:
        assert plan.waypoint_z[2] == pytest.approx(max(plan.h_s2, PLANNING.floor_clearance), abs=0.01)


@settings(max_examples=10)
@given(kappa=st.floats(0.0, 1.0))
def test_curl_obeys_kappa(digger, kappa):
    plan = plan_for(digger, make_wedge(), kappa=kappa, beta=0.7)
    assert plan.waypoint_psi[1] == pytest.approx(0.0, abs=1e-9)
    assert plan.waypoint_psi[2] == pytest.approx(kappa * plan.psi_m, abs=0.02)
    assert plan.waypoint_psi[3] == pytest.approx(plan.psi_m, abs=1e-6)
    stop = float(calc_full_tilt(digger.kinematics, plan.phi_l[-1]))
    assert plan.psi_m == pytest.approx(stop - PLANNING.stop_margin, abs=1e-4)


def test_depth_grows_with_alpha(digger):
    field = make_wedge()
    depths = [
        np.diff(plan_for(digger, field, alpha=alpha).waypoint_x[:2])[0] for alpha in np.linspace(0.6, 2.0, 8)
    ]
    assert np.all(np.diff(depths) > 0)


def test_zero_height_lets_s1_and_s2_coincide(digger):
    plan = plan_for(digger, make_wedge(), beta=0.0)
    assert plan.waypoint_x[1] == plan.waypoint_x[2]
    assert plan.waypoint_t[1] == plan.waypoint_t[2]
    assert plan.waypoint_psi[2] == pytest.approx(0.0, abs=1e-9)
    assert plan.waypoint_psi[3] == pytest.approx(plan.psi_m, abs=1e-9)


def test_tip_rises_parallel_to_the_slope(digger):
    plan = plan_for(digger, make_wedge(0.6), beta=0.8, kappa=0.2)
    lift = plan.segment == 1
    x, z = plan.x[lift], plan.z[lift]
    middle = (x > x[0] + 0.3 * np.ptp(x)) & (x < x[0] + 0.7 * np.ptp(x))
    slope = np.polyfit(x[middle], z[middle], 1)[0]
    assert np.arctan(slope) == pytest.approx(plan.slope, abs=0.06)
    # ... and over the whole segment exactly, whatever the ramps do.
    assert np.ptp(z) / np.ptp(x) == pytest.approx(np.tan(plan.slope), rel=0.05)


@pytest.mark.parametrize("slope", [0.2, 0.6, 1.2])
def test_tiny_pile_is_dug_as_far_as_it_goes_and_flagged(digger, slope):
    plan = plan_for(digger, make_wedge(slope, toe=-1.0), alpha=2.0)
    assert isinstance(plan, DigPlan)
    assert not plan.reached
    assert plan.volume < plan.volume_wanted
    assert plan.x.max() == pytest.approx(0.0, abs=0.02)


def test_too_much_even_without_driving_in_is_flagged(digger):
    field = make_field(lambda x, y: np.where(x > -5.0, 3.5, 0.0), length=12.0)
    plan = plan_for(digger, field, alpha=0.2, beta=1.0, kappa=1.0)
    assert not plan.reached
    assert plan.volume > plan.volume_wanted
    assert plan.waypoint_x[1] == plan.waypoint_x[0]


def test_depth_of_least_excess_where_nothing_fits():
    depth = _solve_depth(lambda d: 2.0 + (d - 1.3) ** 2, 4.0, 0.1)
    assert depth == pytest.approx(1.3, abs=0.06)
    assert _solve_depth(lambda d: -2.0 + d, 1.0, 0.1) == 1.0
    assert _solve_depth(lambda d: 2.0 + d, 1.0, 0.1) == 0.0
    # Both ends lack, the middle does not: the first crossing.
    assert _solve_depth(lambda d: 1.0 - (d - 2.0) ** 2, 4.0, 0.1) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("slope", [0.9, 1.25])
def test_planned_rates_are_within_the_motors_limits(digger, slope):
    kin = digger.kinematics
    plan = plan_for(digger, make_wedge(slope, toe=-5.0), alpha=0.5, beta=1.0, kappa=1.0)
    dt = np.diff(plan.t)
    moving = dt > 1e-6
    for angle, limit in ((plan.phi_l, kin.boom_speed), (plan.phi_b, kin.bucket_speed)):
        assert np.abs(np.diff(angle)[moving] / dt[moving]).max() <= limit * (1 + 1e-6)
    # What boom and bucket do not give to the tip's x, the wheels do.
    wheel = np.diff(plan.x - calc_tip(kin, 0.0, plan.phi_l, plan.phi_b)[:, 0]) / kin.wheel_radius
    assert np.abs(wheel[moving] / dt[moving]).max() <= kin.wheel_speed * (1 + 1e-6)
    # The turn asked for on [s1, s2] is far beyond the limit: the rest of it is left to [s2, s3].
    assert plan.waypoint_psi[3] == pytest.approx(plan.psi_m, abs=1e-6)


def test_empty_drift_and_narrow_drift_have_no_plan(digger):
    empty = make_field(lambda x, y: 0 * x)
    assert isinstance(plan_for(digger, empty), NoPlan)
    narrow = plan_for(digger, make_wedge(), width=3.0)
    assert isinstance(narrow, NoPlan)
    assert "does not fit" in narrow.reason


def test_entry_follows_gamma_among_slices_that_fit(digger):
    skewed = make_wedge(skew=0.4)  # the pile reaches farther out at small y
    x_m = [plan_for(digger, skewed, gamma=gamma).y for gamma in (1.0, 0.5, 0.0)]
    assert x_m[0] < x_m[1] < x_m[2]
    half_room = 0.5 * (6.5 - 3.1) - PLANNING.wall_clearance
    assert np.abs(x_m).max() <= half_room


def test_entry_ranks_by_centre_of_mass():
    profile = PileProfile(
        np.arange(5.0) - 2, np.zeros(5), np.array([-3.0, -1.0, np.nan, -2.0, -9.0]), np.zeros(5)
    )
    assert choose_entry_slice(profile, 1.0, 1.5) == 3
    assert choose_entry_slice(profile, 0.0, 1.5) == 1
    assert choose_entry_slice(profile, 1.0, 2.0) == 4
    assert choose_entry_slice(profile, 0.5, 0.4) is None


def test_plan_survives_json(digger):
    plan = plan_for(digger, make_wedge())
    back = DigPlan.from_dict(json.loads(json.dumps(plan.to_dict())))
    assert back.to_dict() == plan.to_dict()
    assert back.v_x.calc(-2.0) == plan.v_x.calc(-2.0)


def test_swept_area_of_a_straight_push_and_of_a_turn():
    square = np.array([[0.0, 0.0], [-1.0, 0.0], [-1.0, 1.0], [0.0, 1.0]])
    x = np.linspace(0.0, 3.0, 7)
    assert sweep_profile(square, x, 0 * x, 0 * x).area == pytest.approx(4.0)
    # A stick turned about its end sweeps a sector, r^2 angle / 2.
    stick = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1e-6], [0.0, 1e-6]])
    psi = np.linspace(0.0, 1.0, 200)
    assert sweep_profile(stick, 0 * psi, 0 * psi, psi).area == pytest.approx(2.0, rel=1e-3)


def test_swept_volume_counts_cells_under_the_width():
    field = make_field(lambda x, y: 1.0 + 0 * x, cell=0.1, width=6.0)
    box = shapely.box(-3.0, 0.0, -1.0, 0.5)
    assert calc_swept_volume(box, field, 0.0, 2.75) == pytest.approx(2.0 * 0.5 * 2.75)
    assert calc_swept_volume(box, field, 0.33, 2.0) == pytest.approx(2.0)
    assert calc_swept_volume(shapely.box(-3, 0, -1, 9), field, 0.0, 2.0) == pytest.approx(4.0)


@given(ramp=st.floats(0.05, 0.5), floor=st.floats(0.01, 0.5))
def test_ramp_stays_between_floor_and_one(ramp, floor):
    u = np.linspace(0, 1, 101)
    share = calc_halt(u, ramp, floor)
    assert share[-1] == pytest.approx(floor)
    assert np.all(np.diff(share) <= 1e-15)
    assert np.all(share[u <= 1 - ramp] == pytest.approx(1.0))
