"""Performance of a cycle: production, structural damage, debris, and the events of the record (section 5)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drakerock.lhd.geometry import BucketGeometry
from drakerock.loading.config import PerformanceConfig
from drakerock.rocks.config import SiteConfig
from drakerock.rocks.contact_graph import find_loose
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]


def find_bucket_load(pile: PileState, bucket: BucketGeometry, X_WB: RigidTransform) -> NDArray[np.bool_]:
    """Return which rocks are in the bucket (n,): centre of mass in the load region, between the side plates."""
    p_BRs = X_WB.inverse().multiply(np.asfortranarray(pile.p_WRs.T)).T if len(pile) else pile.p_WRs
    x, y, z = p_BRs.T
    low, high = bucket.load_region.min(axis=0), bucket.load_region.max(axis=0)
    inside = (np.abs(y) <= 0.5 * bucket.inner_width) & ~pile.fixed
    inside &= (x >= low[0]) & (x <= high[0]) & (z >= low[1]) & (z <= high[1])
    # Few rocks are left to be looked at one by one: this is asked in each frame of a recording.
    inside[inside] = shapely.contains_xy(shapely.Polygon(bucket.load_region), x[inside], z[inside])
    return inside


def calc_damage(time: Array, moment: Array, start: float, end: float, tau_c: float, t_char: float) -> float:
    """Return phi2 = 1/t_char * integral over [start, end] of max(|tau| - tau_c, 0) / tau_c dt (section 5).

    Args:
        time: (k,) step times, evenly spaced [s].
        moment: (k,) bending and twisting moment of the bucket hinge over the step that begins then [N m].
        start, end: t0 and t4 [s].
        tau_c: critical moment [N m].
        t_char: characteristic time [s].
    """
    excess = np.maximum(np.abs(moment) - tau_c, 0.0) / tau_c
    step = float(np.median(np.diff(time)))
    inside = (time >= start - 1e-9) & (time < end - 1e-9)
    return float(np.sum(excess[inside]) * step / t_char)


@dataclass(frozen=True)
class Weighing:
    """The standing machine on a scale, some time after s4.

    Attributes:
        time_s: when it ended.
        weight_kg: the floor's force on the machine less its own weight, over g: all that it carries.
        on_bucket_kg: the rocks' downward force on the bucket, over g.
        counted_kg: what lay in the bucket then, by geometry.
    """

    time_s: float
    weight_kg: float
    on_bucket_kg: float
    counted_kg: float


def find_weighing_events(weighing: Weighing, load: float, tolerance: float) -> list[dict[str, Any]]:
    """Return events for a load that changed after s4, and for one that differs from the weight.

    Args:
        weighing: the cross-check.
        load: mass counted at s4 [kg].
        tolerance: smallest difference that is an event [kg].

    Returns:
        ``load changed after s4`` with ``mass_kg`` (below 0: lost); ``load and weight differ`` with ``difference_kg``
        (counted less weighed) and ``cause``.
    """
    events: list[dict[str, Any]] = []
    if abs(weighing.counted_kg - load) > 1e-6:
        change = weighing.counted_kg - load
        events.append({"event": "load changed after s4", "time_s": weighing.time_s, "mass_kg": change})
    difference = weighing.counted_kg - weighing.weight_kg
    if abs(difference) > tolerance:
        held = weighing.counted_kg - weighing.on_bucket_kg
        elsewhere = weighing.weight_kg - weighing.on_bucket_kg
        if abs(elsewhere) > abs(held):
            cause = "rocks bear on other parts of the machine than the bucket"
        elif held > 0:
            cause = "the pile holds up part of the load"
        else:
            cause = "rocks that are not in the bucket bear on it"
        event = {"event": "load and weight differ", "time_s": weighing.time_s, "difference_kg": difference}
        events.append(event | {"cause": cause})
    return events


def find_lost(pile: PileState, site: SiteConfig) -> NDArray[np.bool_]:
    """Return which rocks (n,) are not in drift or void: those that left the site lie on no floor."""
    half = 0.5 * site.drift_width
    low, high = [-site.drift_length, -half, 0.0], [site.void_depth, half, np.inf]
    return np.any((pile.p_WRs < low) | (pile.p_WRs > high), axis=1)


def find_debris(
    pile: PileState, shapes: tuple[RockShape, ...], gone: NDArray[np.bool_], gap: float
) -> NDArray[np.bool_]:
    """Return which rocks (n,) are debris: neither gone nor connected to the pile by contacts.

    Args:
        pile: all rocks at rest, fixed ones included.
        shapes: the rock shapes.
        gone: (n,) rocks in the bucket or out of the site.
        gap: rocks nearer than this touch [m].
    """
    debris = np.zeros(len(pile), bool)
    debris[~gone] = find_loose(pile.select(~gone), shapes, gap)
    return debris


def find_events(
    signals: dict[str, Array],
    timeouts: Array,
    waypoint_times: Array,
    config: PerformanceConfig,
    v_x_max: float,
    parts: Sequence[str],
) -> list[dict[str, Any]]:
    """Return stalls, slips, wall contacts and time-outs in the order of their times; none of them ends a cycle.

    Args:
        signals: columns of the cycle.
        timeouts: (5,) 1 for each segment that ended by its time-out, the approach first.
        waypoint_times: (5,) t0 to t4 [s].
        config: thresholds.
        v_x_max: scale of the slip threshold [m/s].
        parts: names of the machine's bodies, in the order that `wall_part` counts.

    Returns:
        One dict each: ``event`` (stall, slip, wall contact, timeout), ``time_s``, and ``duration_s`` or ``waypoint``; a
        wall contact has ``part`` (that was pressed hardest) and ``force_N`` (the largest) as well.
    """
    time = signals["time"]
    told = np.abs(signals["target_wheel_rate"]) > 1e-9
    driving = told & (signals["mode"] >= 1)
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    found: list[dict[str, Any]] = []
    for name, mask in (
        ("stall", driving & (np.abs(signals["v_F"]) < config.stall_speed)),
        ("slip", told & (np.abs(signals["wheel_slip"]) > config.slip_ratio * v_x_max)),
    ):
        for first, last in _find_runs(mask):
            duration = (last - first) * step
            # Shorter than this it is the start or the turn of the drive, not an event.
            if duration >= config.event_time:
                found.append({"event": name, "time_s": float(time[first]), "duration_s": float(duration)})
    found += _find_wall_contacts(signals, config.wall_gap, step, parts)
    for k, late in enumerate(timeouts):
        if late:
            found.append({"event": "timeout", "time_s": float(waypoint_times[k]), "waypoint": f"s{k}"})
    return sorted(found, key=lambda item: item["time_s"])


def _find_wall_contacts(
    signals: dict[str, Array], gap: float, step: float, parts: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the machine's contacts with walls, roof and rear wall; those less than `gap` [s] apart are one."""
    time, force = signals["time"], signals["wall_force"]
    touching = force > 0.0
    for first, last in list(_find_runs(~touching)):
        if first > 0 and last < len(time) and (last - first) * step < gap:
            touching[first:last] = True
    found = []
    for first, last in _find_runs(touching):
        hardest = first + int(np.argmax(force[first:last]))
        found.append(
            {
                "event": "wall contact",
                "time_s": float(time[first]),
                "duration_s": float((last - first) * step),
                "part": parts[int(signals["wall_part"][hardest])],
                "force_N": float(force[hardest]),
            }
        )
    return found


def _find_runs(mask: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Return first and one past the last index of each run of true values."""
    edges = np.diff(np.concatenate([[False], mask, [False]]).astype(int))
    return zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True)
