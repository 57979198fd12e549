"""What is known of broken rock: the laws and the published ranges that tests are held against.

Angles in radians, forces in newtons, lengths in metres.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brute, minimize_scalar

from drakerock.rocks.config import GRAVITY

Array = NDArray[np.float64]

REPOSE = (34.0, 40.0, "dumped mine rock, observed 34 to 40 deg (Colowyo mine, Colorado DRMS file 71445)")
PACKING = (0.59, 0.77, "swell of blasted rock by 30 to 70 % (handbooks)")
JANSSEN_K = (0.45, 0.60, "aggregate, 0.52 within a factor of 1.15 (EN 1991-4, annex E)")
BEVERLOO_C, BEVERLOO_K = 1.03, 1.4
"""Of Beverloo's law for a slot, with the velocity's coefficient for slots and the usual empty edge (Nedderman 1992)."""
INSERTION_EXPONENT = (1.0, 2.0, "friction under a level bed 1, under a slope that rises from the tip 2")
FEE_RESIDUAL = (0.0, 15.0, "10 to 15 % with parameters fitted to the cycle before (arXiv 2506.22579)")


def calc_rockfill_friction(stress: float) -> tuple[float, float]:
    """Return the range of rockfill's friction angle at a normal stress [Pa] (Barton and Kjaernsli 1981) [rad].

    phi = R log10(S / stress) + phi_b: roughness R from 4 (rounded, loose) to 9 (angular, loose to dense), strength S of
    large pieces from 30 to 60 MPa, base friction phi_b from 28 to 32 degrees.
    """
    low = 4.0 * np.log10(30e6 / stress) + 28.0
    high = 9.0 * np.log10(60e6 / stress) + 32.0
    return float(np.deg2rad(low)), float(np.deg2rad(high))


def calc_triaxial_friction(axial: float | Array, lateral: float | Array) -> Array:
    """Return the mobilised friction angle of principal stresses [Pa], Mohr and Coulomb without cohesion [rad]."""
    return np.arcsin((np.asarray(axial) - lateral) / (np.asarray(axial) + lateral))


def fit_mohr_coulomb(axial: Array, lateral: Array) -> tuple[float, float]:
    """Return friction angle [rad] and cohesion [Pa] of the line through failures (k,) in principal stresses."""
    slope, offset = np.polyfit(lateral, axial, 1)
    angle = np.arcsin((slope - 1.0) / (slope + 1.0))
    return float(angle), float(offset / (2.0 * np.sqrt(slope)))


def calc_dilation(volume_rate: float) -> float:
    """Return the dilation angle of a triaxial test [rad] (Vermeer and de Borst 1984).

    Args:
        volume_rate: volumetric over axial strain rate, both positive in compression; < 0 dilates.
    """
    return float(np.arcsin(-volume_rate / (2.0 - volume_rate)))


def calc_beverloo_rate(
    opening: float, width: float, size: float, density: float, c: float = BEVERLOO_C, k: float = BEVERLOO_K
) -> float:
    """Return the mass rate out of a slot by Beverloo's law in its form for a slot [kg/s]; 0 where nothing passes.

    Args:
        opening, width: of the slot [m].
        size: of the rocks [m].
        density: of the bed [kg/m^3].
        c, k: its coefficients.
    """
    return c * density * np.sqrt(GRAVITY) * width * max(opening - k * size, 0.0) ** 1.5


def calc_hopper_factor(angle: float, friction: float) -> float:
    """Return the rate out of a hopper over that of a flat floor (Rose and Tanaka 1959).

    Args:
        angle: of its walls to the vertical [rad].
        friction: the material's friction angle [rad].
    """
    return max(float((np.tan(angle) * np.tan(friction)) ** -0.35), 1.0)


def calc_janssen_share(height: float, area: float, perimeter: float, friction: float, k: float) -> float:
    """Return the share of its filling's weight that a silo's floor carries (Janssen 1895).

    Args:
        height: of the filling [m].
        area, perimeter: of the silo's section [m^2, m].
        friction: of its walls.
        k: lateral over vertical stress.
    """
    decay = area / (perimeter * friction * k)
    return float(decay / height * (1.0 - np.exp(-height / decay)))


def fit_janssen_k(share: float, height: float, area: float, perimeter: float, friction: float) -> float:
    """Return lateral over vertical stress of a silo whose floor carries a share; nan outside of 0.01 to 3."""
    grid = np.geomspace(0.01, 3.0, 400)
    shares = np.array([calc_janssen_share(height, area, perimeter, friction, k) for k in grid])
    if not shares[-1] < share < shares[0]:
        return float("nan")
    return float(np.interp(-share, -shares, grid))


def calc_blade_force(
    depth: float, width: float, weight: float, surcharge: float, friction: float, wall: float
) -> float:
    """Return the horizontal force on a vertical blade by the fundamental earth-moving equation [N].

    Reece (1964), without cohesion: a wedge before the blade slides up a plane at the angle beta at which it resists
    least; the force on the blade is at the wall's friction angle to its normal.

    Args:
        depth, width: of the blade in the bed [m].
        weight: of the bed [N/m^3].
        surcharge: weight of what is heaped up before the blade [N].
        friction: the material's friction angle [rad].
        wall: the blade's friction angle [rad].
    """
    rake = 0.5 * np.pi

    def calc_force(beta: float) -> float:
        resistance = np.cos(rake + wall) + np.sin(rake + wall) / np.tan(beta + friction)
        if resistance <= 1e-9:
            return 1e30  # it would jam
        wedge = 0.5 * weight * depth**2 * width * (1.0 / np.tan(rake) + 1.0 / np.tan(beta))
        return float((wedge + surcharge) / resistance)

    highest = 0.5 * np.pi - friction - 1e-3
    found = minimize_scalar(calc_force, bounds=(0.05, highest), method="bounded")
    return float(found.fun * np.sin(rake + wall))


def calc_curved_blade_force(x: Array, h: Array, weight: float, friction: float, wall: float) -> float:
    """Return the horizontal force on a vertical blade by a curved slip surface, over the blade's width [N/m].

    Terzaghi (1943): the slip surface is a logarithmic spiral from the blade's edge, so that what acts on it passes
    through its pole, and moments about the pole give the force: that of the weakest spiral. The force is at the wall's
    friction angle to the blade's normal and a third of the rock's height at the blade above the edge. Inf: no spiral
    from the edge comes out of the surface.

    Against a rough blade the earth-moving equation's plane is stronger than this, the more so the greater both angles.

    Args:
        x: (k,) evenly spaced from the blade on, from 0 [m].
        h: (k,) the surface's height over the blade's edge, with all that is heaped up [m].
        weight: of the bed [N/m^3].
        friction: the material's friction angle [rad].
        wall: the blade's friction angle [rad].
    """
    turns = np.linspace(0.0, 2.5, 300)
    growth = np.exp(turns * np.tan(friction))
    step, high = float(x[1] - x[0]), float(h[0])

    def calc_force(pole: Array) -> float:
        # By the pole's direction from the edge and the logarithm of its distance over the height at the blade.
        radius = high * np.exp(pole[1])
        pole_x, pole_z = radius * np.cos(pole[0]), radius * np.sin(pole[0])
        angles = pole[0] + np.pi + turns
        path_x = pole_x + radius * growth * np.cos(angles)
        path_z = pole_z + radius * growth * np.sin(angles)
        # Up to where it would turn back.
        ends = int(np.argmax(np.diff(path_x) <= 0.0)) if (np.diff(path_x) <= 0.0).any() else len(turns) - 1
        if ends < 1:
            return 1e30
        slip = np.interp(x, path_x[: ends + 1], path_z[: ends + 1], right=np.nan)
        out = np.flatnonzero(slip[1:] >= h[1:])
        if not len(out) or np.isnan(slip[: out[0] + 1]).any():
            return 1e30
        k = int(out[0]) + 1
        moment = weight * step * float(np.sum(np.maximum(h[:k] - slip[:k], 0.0) * (x[:k] - pole_x)))
        arm = pole_x * np.sin(wall) + (pole_z - high / 3.0) * np.cos(wall)
        return moment / arm if moment > 0.0 and arm > 1e-9 else 1e30

    directions = slice(0.35, 3.0, 0.09)
    distances = slice(np.log(0.7), np.log(60.0), 0.2)
    force = float(brute(calc_force, (directions, distances), full_output=True)[1])
    return force * float(np.cos(wall)) if force < 1e29 else float("inf")
