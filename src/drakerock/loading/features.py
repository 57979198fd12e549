"""A pile in a few numbers, as a planner sees it: what a model of loadings is given besides the strategy."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from drakerock.loading.field import HeightField, calc_pile_profile


@dataclass(frozen=True)
class PileFeatures:
    """Features of a height field (method section 5: front, centre of mass and slope of each slice).

    Attributes:
        volume_m3: under the heights, before the brow [m3].
        front_mean_m, front_std_m: mean and spread across the drift of the front curve x_f(y) [m]; 0 is the brow.
        front_tilt: slope of the front curve across the drift [1].
        mass_x_m: mean of the centre-of-mass curve x_m(y) [m].
        slope_mean_deg, slope_std_deg, slope_max_deg: of the local slope xi(y) [deg].
        height_brow_m: mean height of the row of cells at the brow [m].
        roughness_m: rms of the heights about their 3 x 3 mean, where there is pile [m].
        loose_volume_m3: under heights that are no part of the pile: rocks on the floor [m3].
    """

    volume_m3: float
    front_mean_m: float
    front_std_m: float
    front_tilt: float
    mass_x_m: float
    slope_mean_deg: float
    slope_std_deg: float
    slope_max_deg: float
    height_brow_m: float
    roughness_m: float
    loose_volume_m3: float

    @classmethod
    def list_names(cls) -> list[str]:
        """Return the features' names, in order."""
        return [item.name for item in fields(cls)]


def calc_pile_features(field: HeightField, front_height: float) -> PileFeatures:
    """Return the features of a height field; NaN for those of a pile where there is none.

    Args:
        field: the height field.
        front_height: the pile is what is higher [m] (``loading.planning.front_height``).
    """
    profile = calc_pile_profile(field, front_height)
    area = field.cell**2
    there = np.isfinite(profile.x_front)
    in_pile = (field.h > front_height) & (
        field.x[:, None] >= np.where(there, profile.x_front, np.inf)[None, :]
    )
    loose = np.where(in_pile, 0.0, field.h)
    volume, brow = float(area * field.h.sum()), float(field.h[-1].mean())
    if not there.any():
        nothing = dict.fromkeys(PileFeatures.list_names(), float("nan"))
        return PileFeatures(
            **(nothing | {"volume_m3": volume, "height_brow_m": brow, "loose_volume_m3": volume})
        )
    y, front, slope = profile.y[there], profile.x_front[there], np.degrees(profile.slope[there])
    tilt = float(np.polyfit(y, front, 1)[0]) if len(y) > 1 else 0.0
    return PileFeatures(
        volume_m3=volume,
        front_mean_m=float(front.mean()),
        front_std_m=float(front.std()),
        front_tilt=tilt,
        mass_x_m=float(profile.x_mass[there].mean()),
        slope_mean_deg=float(slope.mean()),
        slope_std_deg=float(slope.std()),
        slope_max_deg=float(slope.max()),
        height_brow_m=brow,
        roughness_m=_calc_roughness(field.h, in_pile),
        loose_volume_m3=float(area * loose.sum()),
    )


def _calc_roughness(h: np.ndarray, where: np.ndarray) -> float:
    from scipy.ndimage import uniform_filter

    return float(np.sqrt(np.mean((h - uniform_filter(h, 3, mode="nearest"))[where] ** 2)))
