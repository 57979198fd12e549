"""From a scan's file to a surface in the site: aligned, checked, cleaned (each step says what it did)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from drakerock.errors import InputError
from drakerock.rocks.config import PileConfig, RocksConfig, ScanConfig, SiteConfig
from drakerock.rocks.site import calc_roof_height
from drakerock.rocks.surveying.cloud import read_cloud
from drakerock.rocks.surveying.surface import FLOOR_HEIGHT, Surface, make_surface

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "ft": 0.3048}
# Fewer points are no scan.
LEAST_POINTS = 100
# A cloud so many times as long as the site is in another unit; and one so short is [m].
TOO_LONG, TOO_SHORT = 20.0, 0.5
# Points so far below the floor are wrong; a few are outliers, more mean a wrong alignment.
BELOW_FLOOR, MANY_BELOW = 0.3, 0.02
# A cloud is taken to be upside down when so large a share of its points lies within this of its highest ones [m], as
# those of a floor do, and less than this part of that share within this of its lowest.
FLAT, FLAT_SHARE, FLAT_RATIO = 0.05, 0.3, 0.25
# Points so near to roof or walls are theirs [m].
LINING = 0.1
# An outlier is judged by its distance to so many neighbours; more outliers than the share are no outliers any more.
NEIGHBOURS, MANY_OUTLIERS = 8, 0.1


@dataclass(frozen=True, eq=False)
class Survey:
    """A measured surface in the site.

    Attributes:
        points: (n, 3) the points it was made from, in W [m].
        surface: the height field.
        notes: what was dropped, filled, inferred.
    """

    points: Array
    surface: Surface
    notes: list[str] = field(default_factory=list)


def calc_median_rock(rocks: RocksConfig) -> float:
    """Return d50 [m]: half of the mass is in rocks of this sieve width or smaller ones."""
    total = 0.0
    for item in sorted(rocks.gradation, key=lambda item: item.size_m):
        total += item.mass_fraction
        if total >= 0.5 - 1e-9:
            return item.size_m
    raise ValueError("the gradation's mass fractions do not sum to 1")


def make_transform(scan: ScanConfig) -> tuple[Array, Array]:
    """Return rotation (3, 3) and translation (3,) [m] from the cloud's frame, in metres, to W."""
    if scan.matrix is not None:
        matrix = np.array(scan.matrix)
        return matrix[:3, :3], matrix[:3, 3]
    # Roll, pitch, yaw about the fixed axes x, y, z, as Drake's RollPitchYaw.
    turn = Rotation.from_euler("xyz", scan.rotation_deg, degrees=True).as_matrix()
    return turn, np.array(scan.translation)


def survey_scan(scan: ScanConfig, site: SiteConfig, pile: PileConfig, rocks: RocksConfig) -> Survey:
    """Read a scan and return its surface in the site.

    Raises:
        InputError: what makes the scan useless, with its file: unreadable, empty, not finite, another unit, upside
            down, outside of the site, too small, too many outliers, too large a hole.
    """
    try:
        return _survey(read_cloud(scan.file), scan, site, pile, rocks)
    except InputError as error:
        text = str(error)
        raise InputError(text if scan.file in text else f"{scan.file}: {text}") from None


def _survey(
    points: Array, scan: ScanConfig, site: SiteConfig, pile: PileConfig, rocks: RocksConfig
) -> Survey:
    notes = list[str]()

    def keep(mask: Mask, what: str) -> None:
        nonlocal points
        if not mask.all():
            notes.append(f"{np.sum(~mask)} of {len(mask)} points dropped: {what}")
            points = points[mask]

    total = len(points)
    keep(np.isfinite(points).all(axis=1), "not finite")
    if len(points) < LEAST_POINTS:
        raise InputError(f"{len(points)} of {total} points are numbers; a scan needs at least {LEAST_POINTS}")
    turn, shift = make_transform(scan)
    points = points * UNITS[scan.unit] @ turn.T + shift
    if not scan.trust:
        _check_unit(points, site, scan)
    half = 0.5 * site.drift_width
    inside = (
        (points[:, 0] > -site.drift_length) & (points[:, 0] < site.void_depth) & (np.abs(points[:, 1]) < half)
        & (points[:, 2] < site.void_height)
    )  # fmt: skip
    if inside.sum() < LEAST_POINTS or (inside.mean() < 0.05 and not scan.trust):
        low, high = points.min(axis=0), points.max(axis=0)
        raise InputError(
            f"{100 * inside.mean():.2g} % of the points lie in the site: aligned, the cloud is at x {low[0]:.1f} to "
            f"{high[0]:.1f}, y {low[1]:.1f} to {high[1]:.1f}, z {low[2]:.1f} to {high[2]:.1f} m; the site at x "
            f"{-site.drift_length:g} to {site.void_depth:g}, y {-half:g} to {half:g}, z 0 to {site.void_height:g} m "
            "(pile.scan.translation, rotation_deg, unit)"
        )
    keep(inside, "outside of the site")
    if not scan.trust:
        _check_upright(points)
    keep(points[:, 2] > -BELOW_FLOOR, "below the floor")
    lining = (np.abs(points[:, 1]) > half - LINING) | (
        (points[:, 0] < 0.0) & (points[:, 2] > calc_roof_height(site, points[:, 1]) - LINING)
    )
    keep(~lining, "of walls and roof")
    if len(points) < LEAST_POINTS:
        raise InputError(f"{len(points)} points are left of {total}: {'; '.join(notes)}")
    outliers = find_outliers(points, scan.outlier_deviations)
    if outliers.mean() > MANY_OUTLIERS:
        raise InputError(
            f"{100 * outliers.mean():.0f} % of the points are outliers (pile.scan.outlier_deviations = "
            f"{scan.outlier_deviations:g}); clean the cloud, or raise it"
        )
    keep(~outliers, "outliers")
    surface, more = make_surface(points, site, pile, scan)
    height, median = float(surface.h[surface.seen].max()), calc_median_rock(rocks)
    if height < median:
        raise InputError(
            f"the scan shows no pile: it is {height:.2f} m high, and the median rock is {median:g} m wide"
        )
    return Survey(points, surface, notes + more)


def _check_unit(points: Array, site: SiteConfig, scan: ScanConfig) -> None:
    low, high = np.percentile(points, [1, 99], axis=0)
    extent = float((high - low).max())
    longest = max(site.drift_length + site.void_depth, site.drift_width)
    if extent > TOO_LONG * longest:
        hint = "it may be in millimetres (pile.scan.unit: mm)" if scan.unit == "m" else "check pile.scan.unit"
        raise InputError(f"the cloud is {extent:.4g} m long, the site {longest:.4g} m; {hint}")
    if extent < TOO_SHORT:
        raise InputError(
            f"the cloud is {extent:.2g} m long, less than a rock; check pile.scan.unit ({scan.unit})"
        )


def _check_upright(points: Array) -> None:
    z = points[:, 2]
    below = float(np.mean(z < -BELOW_FLOOR))
    if below > MANY_BELOW:
        raise InputError(
            f"{100 * below:.0f} % of the points lie up to {-z.min():.2f} m below the floor (z = 0): upside down "
            "(pile.scan.rotation_deg: [180, 0, 0]), or shift it (pile.scan.translation)"
        )
    low, high = np.percentile(z, [0.5, 99.5])
    above, beneath = float(np.mean(z > high - FLAT)), float(np.mean(z < low + FLAT))
    if high - low > FLOOR_HEIGHT and above > FLAT_SHARE and beneath < FLAT_RATIO * above:
        raise InputError(
            f"{100 * above:.0f} % of the points lie in the plane of the highest ones, as the floor would of a cloud "
            "that is upside down (pile.scan.rotation_deg: [180, 0, 0]); pile.scan.trust: true if it is not"
        )


def find_outliers(points: Array, deviations: float) -> Mask:
    """Return which points (n,) stand apart: their mean distance to their neighbours is beyond mean plus deviations.

    Statistical outlier removal over eight neighbours (Rusu et al. 2008), mean and deviation taken robustly: median and
    1.48 times the median deviation, and at least the median itself, so that a scan whose density varies stays whole.
    """
    distance = cKDTree(points).query(points, k=NEIGHBOURS + 1)[0][:, 1:].mean(axis=1)
    median = float(np.median(distance))
    deviation = max(1.48 * float(np.median(np.abs(distance - median))), median)
    return np.asarray(distance > median + deviations * deviation)
