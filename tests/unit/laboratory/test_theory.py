"""Contract: the laws are those of the literature, by limits and by other ways to the same number."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drakerock.laboratory.theory import (
    calc_beverloo_rate,
    calc_blade_force,
    calc_curved_blade_force,
    calc_dilation,
    calc_hopper_factor,
    calc_janssen_share,
    calc_triaxial_friction,
    fit_janssen_k,
    fit_mohr_coulomb,
)

ANGLES = st.floats(0.3, 0.9)


@given(ANGLES, st.floats(0.0, 5e4))
def test_mohr_coulomb_finds_the_line_that_failures_lie_on(angle, cohesion):
    passive = (1 + np.sin(angle)) / (1 - np.sin(angle))
    lateral = np.array([5e4, 1e5, 2e5])
    found, offset = fit_mohr_coulomb(passive * lateral + 2 * cohesion * np.sqrt(passive), lateral)
    assert found == pytest.approx(angle, abs=1e-6)
    assert offset == pytest.approx(cohesion, abs=1.0)
    if cohesion == 0.0:
        assert calc_triaxial_friction(passive * lateral, lateral) == pytest.approx(angle)


@given(ANGLES)
def test_a_smooth_blade_feels_rankines_passive_pressure(friction):
    passive = np.tan(0.25 * np.pi + 0.5 * friction) ** 2
    force = calc_blade_force(1.3, 2.0, 15e3, 0.0, friction, 0.0)
    assert force == pytest.approx(0.5 * 15e3 * 1.3**2 * 2.0 * passive, rel=1e-3)


@given(ANGLES, st.floats(0.05, 0.35), st.floats(0.0, 5e4))
def test_the_blades_wedge_is_in_balance_at_the_weakest_plane(friction, wall, surcharge):
    # By forces: weight, the blade's force at `wall` to its normal, the plane's reaction at `friction` to its own.
    beta = np.linspace(0.05, 0.5 * np.pi - friction, 4000)[:-1]
    along, across = beta + friction, np.full_like(beta, wall)
    sums = np.array([[-np.sin(along), np.cos(across)], [np.cos(along), -np.sin(across)]])
    weight = 0.5 * 15e3 / np.tan(beta) + surcharge
    loads = np.column_stack([np.zeros_like(beta), weight])
    reaction, push = np.linalg.solve(sums.transpose(2, 0, 1), loads[:, :, None])[:, :, 0].T
    least = (push[(reaction > 0) & (push > 0)] * np.cos(wall)).min()
    assert calc_blade_force(1.0, 1.0, 15e3, surcharge, friction, wall) == pytest.approx(least, rel=1e-3)


@settings(max_examples=20, deadline=None)
@given(ANGLES, st.floats(0.0, 0.9))
def test_a_curved_slip_lies_between_the_lower_bound_and_the_plane(friction, share):
    # Lancellotta (2002): the exact lower bound of the passive pressure on a rough vertical wall.
    wall = share * friction
    ratio = np.sin(wall) / np.sin(friction)
    root = np.sqrt(np.sin(friction) ** 2 - np.sin(wall) ** 2)
    bound = np.cos(wall) / (1 - np.sin(friction)) * (np.cos(wall) + root)
    bound *= np.exp((np.arcsin(ratio) + wall) * np.tan(friction))
    x = np.arange(0.0, 30.0, 0.02)
    force = calc_curved_blade_force(x, np.ones_like(x), 2.0, friction, wall)
    plane = calc_blade_force(1.0, 1.0, 2.0, 0.0, friction, wall)
    assert 0.99 * bound < force < 1.01 * plane


def test_a_heap_counts_where_it_lies_and_a_bed_that_is_too_short_jams():
    x = np.arange(0.0, 30.0, 0.02)
    level = np.ones_like(x)
    bare, near, far = (
        calc_curved_blade_force(x, level + 0.5 * ((x > a) & (x < a + 1.0)), 2.0, 0.65, 0.3)
        for a in (99.0, 0.5, 20.0)
    )
    assert near > 1.1 * bare
    assert far == pytest.approx(bare)
    assert calc_curved_blade_force(x[:40], level[:40], 2.0, 0.65, 0.3) == np.inf


@given(st.floats(0.1, 2.0), st.floats(0.5, 8.0))
def test_janssens_k_is_found_again(k, slenderness):
    section = 4.0, 8.0
    share = calc_janssen_share(2.0 * slenderness, *section, 0.4, k)
    assert 0.0 < share < 1.0
    assert fit_janssen_k(share, 2.0 * slenderness, *section, 0.4) == pytest.approx(k, rel=2e-3)


def test_a_floor_that_carries_all_says_nothing_of_k():
    assert np.isnan(fit_janssen_k(1.0, 4.0, 4.0, 8.0, 0.4))


def test_the_rate_grows_with_the_power_three_halves_and_ends_at_the_empty_edge():
    rates = [calc_beverloo_rate(1.4 * 0.1 + width, 1.0, 0.1, 1500.0) for width in (0.2, 0.8)]
    assert rates[1] / rates[0] == pytest.approx(8.0)
    assert calc_beverloo_rate(0.13, 1.0, 0.1, 1500.0) == 0.0


def test_steeper_hoppers_run_faster():
    assert calc_hopper_factor(np.deg2rad(15), 0.7) > calc_hopper_factor(np.deg2rad(30), 0.7) > 1.0


def test_dilation_is_zero_at_constant_volume_and_grows_with_swelling():
    assert calc_dilation(0.0) == 0.0
    assert calc_dilation(-0.6) > calc_dilation(-0.2) > 0.0
