"""The numbers that mines judge a loading by: payload, fill factor, energy per tonne, traction, slip, spillage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

JOULES_PER_KWH = 3.6e6

MINING: dict[str, str] = {
    "load_t": "t",
    "payload_percent": "%",
    "fill_factor": "1",
    "bucket_phase_kWh_per_t": "kWh/t",
    "loading_kWh_per_t": "kWh/t",
    "tractive_effort_mean_N": "N",
    "tractive_effort_peak_N": "N",
    "wheel_slip_m": "m",
    "breakout_use": "1",
    "spillage_share": "1",
}
"""Names and units: the load; the same over the machine's payload; the load's loose volume over the bucket's heaped
capacity; the motors' work per tonne over [t0, t3], until the bucket is tilted, and over [t0, t4]; the wheels' torque
over their radius in the push, [t0, t2]: mean and largest; by how much the tyres' way differs from the machine's over
[t0, t4]; the bucket motor's largest torque on [t0, t3] over its limit, which is the breakout force's; debris over load
and debris. None where a loading has no such number: energy per tonne of nothing, a waypoint that was not passed."""


@dataclass(frozen=True)
class MachineRating:
    """What the numbers are relative to.

    Attributes:
        payload: rated load [kg]; None: not known.
        capacity: heaped bucket volume [m^3].
        loose_density: of rock in the bucket, voids included [kg/m^3].
        wheel_radius: [m].
        bucket_effort: the largest torque of the bucket's motor [N m].
    """

    payload: float | None
    capacity: float
    loose_density: float
    wheel_radius: float
    bucket_effort: float


def calc_mining_numbers(
    signals: dict[str, Array], times: Array, load: float, spilled: float, rating: MachineRating
) -> dict[str, float | None]:
    """Return the numbers of `MINING` of a loading.

    Args:
        signals: columns of all steps.
        times: (5,) t0 to t4, nan where not passed [s].
        load, spilled: mass in the bucket at t4, and of the debris [kg].
        rating: of the machine.
    """
    tonnes = load / 1e3
    time = signals["time"]
    push = slice(*np.searchsorted(time, times[[0, 2]] - 1e-9))
    dig = slice(*np.searchsorted(time, times[[0, 3]] - 1e-9))
    whole = slice(*np.searchsorted(time, times[[0, 4]] - 1e-9))
    effort = signals["torque_wheels"][push] / rating.wheel_radius
    torque = np.abs(signals["torque_bucket"][dig])
    step = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    finite = bool(np.all(np.isfinite(times)))

    def calc_energy(end: float) -> float | None:
        if not finite or tonnes == 0.0:
            return None
        joules = np.interp([times[0], end], time, signals["work"])
        return float(joules[1] - joules[0]) / JOULES_PER_KWH / tonnes

    return {
        "load_t": tonnes,
        "payload_percent": None if rating.payload is None else 100.0 * load / rating.payload,
        "fill_factor": load / rating.loose_density / rating.capacity,
        "bucket_phase_kWh_per_t": calc_energy(float(times[3])),
        "loading_kWh_per_t": calc_energy(float(times[4])),
        "tractive_effort_mean_N": float(effort.mean()) if finite and len(effort) else None,
        "tractive_effort_peak_N": float(effort.max()) if finite and len(effort) else None,
        "wheel_slip_m": float(np.abs(signals["wheel_slip"][whole]).sum() * step) if finite else None,
        "breakout_use": float(torque.max()) / rating.bucket_effort if finite and len(torque) else None,
        "spillage_share": spilled / (load + spilled) if load + spilled > 0.0 else None,
    }


def describe_mining(numbers: dict[str, float | None]) -> list[tuple[str, str]]:
    """Return labels and values of a loading's numbers, as people read them."""

    def show(name: str, form: str, factor: float = 1.0) -> str:
        value = numbers.get(name)
        return "-" if value is None else form.format(factor * value)

    return [
        ("load", f"{show('load_t', '{:.2f}')} t, {show('payload_percent', '{:.0f}')} % of the payload"),
        ("fill factor", show("fill_factor", "{:.2f}")),
        (
            "energy, bucket phase and whole",
            f"{show('bucket_phase_kWh_per_t', '{:.3f}')}, {show('loading_kWh_per_t', '{:.3f}')} kWh/t",
        ),
        (
            "tractive effort mean, peak",
            f"{show('tractive_effort_mean_N', '{:.0f}', 1e-3)}, {show('tractive_effort_peak_N', '{:.0f}', 1e-3)} kN",
        ),
        ("wheel slip", show("wheel_slip_m", "{:.2f} m")),
        ("breakout use", show("breakout_use", "{:.0f} %", 100.0)),
        ("spillage", show("spillage_share", "{:.1f} % of load and debris", 100.0)),
    ]
