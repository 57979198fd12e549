"""Steering by the articulation: the closed form against the kinematics of the bent machine, integrated."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drakerock.loading.steering import calc_steering_angle

L_FRONT, L_REAR, LIMIT = 2.35, 2.1, math.radians(15)


def calc_turning(angle: float) -> float:
    """Return the front axle's curvature of a machine with this joint angle (negative turns left) [1/m]."""
    return math.sin(-angle) / (L_FRONT * math.cos(angle) + L_REAR)


@given(offset=st.floats(-0.05, 0.05), heading=st.floats(-0.02, 0.02), backwards=st.booleans())
def test_angle_gives_the_wanted_curvature(offset, heading, backwards):
    angle = calc_steering_angle(offset, heading, backwards, 4.0, L_FRONT, L_REAR, LIMIT)
    sign = -1.0 if backwards else 1.0
    assert calc_turning(angle) == pytest.approx(-(offset / 16.0 + sign * 2.0 * heading / 4.0), abs=1e-9)


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize(("offset", "heading"), [(0.5, 0.0), (0.0, 0.1), (-0.3, -0.1)])
def test_machine_comes_back_to_the_line(offset, heading, backwards):
    direction, step = (-1.0 if backwards else 1.0), 0.01
    largest = 0.0
    for _ in range(int(24.0 / step)):
        angle = calc_steering_angle(offset, heading, backwards, 4.0, L_FRONT, L_REAR, LIMIT)
        largest = max(largest, abs(angle))
        heading += direction * step * calc_turning(angle)
        offset += direction * step * math.sin(heading)
    assert abs(offset) < 0.02
    assert abs(heading) < 0.01
    assert largest <= LIMIT + 1e-12


def test_negative_angle_turns_left_as_the_machine_does():
    """To the right of the line it steers left, in reverse to the right: the rear goes first there."""
    assert calc_steering_angle(-0.2, 0.0, False, 4.0, L_FRONT, L_REAR, LIMIT) < 0.0
    assert calc_steering_angle(0.0, 0.1, False, 4.0, L_FRONT, L_REAR, LIMIT) > 0.0
    assert calc_steering_angle(0.0, 0.1, True, 4.0, L_FRONT, L_REAR, LIMIT) < 0.0
