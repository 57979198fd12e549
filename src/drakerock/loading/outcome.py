"""What a cycle came to, in numbers."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class CycleOutcome:
    """What a cycle came to; `outcome.json` is this as JSON.

    Attributes:
        status: ``done`` (the cycle ended as the method allows) or ``failed`` (solver failure).
        reason: why it ended: ``s4 reached``, ``s4 timed out``, ``no candidate slice: ...``, or the failure.
        objectives: production [kg/s, positive], damage, debris [kg].
        phi1, phi2, phi3: minus production [kg/s], damage, debris [kg]; all minimised.
        strategy: alpha, beta, gamma, kappa.
        bucket_mass_kg, bucket_rocks: the load at t4.
        weighed_mass_kg: the machine's weight on the floor as it stands after t4, less its own: what rocks it
            carries, a cross-check of the load; null where it did not come to that.
        counted_when_weighed_kg: the bucket's load by geometry at that time, t4 plus weighing delay and time.
        loading_time_s: t4 - t0.
        waypoint_times_s: t0 to t4; null where not passed.
        plan: swept and wanted volume, whether the wanted one could be reached, entry point, slope, dig height.
        peak_push_force_N, mean_push_force_N: of the rocks against the bucket's motion into the pile.
        energy_J: the motors' work over [t0, t4].
        mining: the numbers that mines judge a loading by, see `drakerock.loading.mining.MINING`; null after a failure.
        events: stalls, slips, time-outs, a load that changed after s4 or differs from its weight, and rocks
            that still moved when debris was counted, with their times.
        rocks: number in all, awake at most and on average; the deepest penetration [m]; how many left the site;
            steps that had to be solved again or were beyond the bound of penetration.
        wall_time_s, cpu_time_s, sim_time_s, steps, ms_per_step: cost of the cycle; the last is CPU time.
        files: names of the files with the planned and the actual tip path.
        seed, versions, scenario_hash: what the cycle depended on.
    """

    status: str
    reason: str
    objectives: dict[str, float | None]
    phi1: float | None
    phi2: float | None
    phi3: float | None
    strategy: dict[str, float]
    bucket_mass_kg: float | None
    bucket_rocks: int | None
    weighed_mass_kg: float | None
    counted_when_weighed_kg: float | None = field(default=None, kw_only=True)
    loading_time_s: float | None
    waypoint_times_s: list[float | None]
    plan: dict[str, Any]
    peak_push_force_N: float | None
    mean_push_force_N: float | None
    energy_J: float | None
    mining: dict[str, float | None] | None = field(default=None, kw_only=True)
    events: list[dict[str, Any]]
    rocks: dict[str, float]
    wall_time_s: float
    cpu_time_s: float | None = field(default=None, kw_only=True)
    sim_time_s: float
    steps: int
    ms_per_step: float
    files: dict[str, str]
    seed: int
    versions: dict[str, str]
    scenario_hash: str

    @classmethod
    def from_json(cls, text: str) -> CycleOutcome:
        """Return the outcome that `to_json` wrote."""
        return cls(**json.loads(text))

    def to_json(self) -> str:
        """Return the outcome as JSON text."""
        return json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"
