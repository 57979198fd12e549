"""What of a loading is shown over time: the same quantities in figures, replay and comparison."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drakerock.viewing.stored_cycle import StoredCycle

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class History:
    """Quantities of one unit over the steps of a cycle.

    Attributes:
        key: short name.
        label: what it is.
        unit: of the lines.
        lines: (k,) by name, as stored but for the unit; nan where not known.
        limit: name and value of a level to compare with; None if there is none.
    """

    key: str
    label: str
    unit: str
    lines: dict[str, Array]
    limit: tuple[str, float] | None = None


def make_histories(cycle: StoredCycle) -> list[History]:
    """Return the histories of a cycle; bucket load is nan where an older version did not store it."""
    s, payload = cycle.signals, get_payload(cycle)
    load = s.get("bucket_load", np.full(len(s["time"]), np.nan))
    tau_c = float(cycle.scenario["loading"]["performance"]["tau_c"])
    return [
        History(
            "load",
            "bucket load",
            "t",
            {"load": load / 1e3},
            None if payload is None else ("payload", payload / 1e3),
        ),
        History(
            "force",
            "rocks on bucket",
            "kN",
            {"push": -s["bucket_force_x"] / 1e3, "down": -s["bucket_force_z"] / 1e3},
        ),
        History("hinge", "hinge moment", "kN m", {"hinge": s["hinge_moment"] / 1e3}, ("τc", tau_c / 1e3)),
        History("speed", "speed and slip", "m/s", {"speed": s["v_F"], "slip": s["wheel_slip"]}),
        History(
            "torque",
            "motor torque",
            "kN m",
            {name: s[f"torque_{name}"] / 1e3 for name in ("wheels", "boom", "bucket")},
        ),
    ]


def get_payload(cycle: StoredCycle) -> float | None:
    """Return the machine's payload [kg]; None if it is not known."""
    payload = cycle.scenario["machine"]["expected"]["payload"]
    return None if payload is None else float(payload)
