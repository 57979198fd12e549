"""What a loading came to, in the words and units of those who read it."""

from __future__ import annotations

from dataclasses import dataclass

from drakerock.loading.config import PerformanceConfig
from drakerock.viewing.histories import get_payload
from drakerock.viewing.stored_cycle import StoredCycle


@dataclass(frozen=True)
class Result:
    """A number of a loading.

    Attributes:
        key: short name.
        label: what it is.
        unit: its unit; "" without one.
        value: None where the loading has none.
        digits: decimals worth showing.
    """

    key: str
    label: str
    unit: str
    value: float | None
    digits: int

    def show(self) -> str:
        """Return the number as text, without its unit; a dash where there is none."""
        return "–" if self.value is None else f"{self.value:.{self.digits}f}"


def make_results(cycle: StoredCycle) -> list[Result]:
    """Return strategy and outcome of a cycle as numbers, the most wanted of the outcome first."""
    o = cycle.outcome
    load, payload = o.get("bucket_mass_kg"), get_payload(cycle)
    objectives = o.get("objectives") or {}

    def scale(value: float | None, factor: float | None) -> float | None:
        return None if value is None or factor is None else factor * value

    return [
        *(Result(name, name, "", float(value), 2) for name, value in o["strategy"].items()),
        Result("load", "bucket load", "t", scale(load, 1e-3), 2),
        Result("payload_share", "bucket load", "% of payload", scale(load, payload and 100.0 / payload), 0),
        Result("fill_factor", "fill factor", "", scale(load, calc_fill_per_kg(cycle)), 2),
        Result("time", "loading time t4 - t0", "s", o.get("loading_time_s"), 2),
        Result("production", "production", "kg/s", objectives.get("production"), 0),
        Result("damage", "damage", "", objectives.get("damage"), 4),
        Result("debris", "debris", "kg", objectives.get("debris"), 0),
        Result("push_mean", "push, mean", "kN", scale(o.get("mean_push_force_N"), 1e-3), 0),
        Result("push_peak", "push, peak", "kN", scale(o.get("peak_push_force_N"), 1e-3), 0),
        Result("work", "motors' work", "kJ", scale(o.get("energy_J"), 1e-3), 0),
    ]


def calc_fill_per_kg(cycle: StoredCycle) -> float | None:
    """Return the fill factor of a load of 1 kg: its loose volume over the bucket's heaped capacity.

    As the outcome has it among the numbers of mining, so that both agree. Where it has none, or nothing was loaded: of
    the scenario's packing, and of the plan's wanted volume, alpha times the capacity; None without a plan.
    """
    load, known = cycle.outcome.get("bucket_mass_kg"), (cycle.outcome.get("mining") or {}).get("fill_factor")
    if load and known:
        return float(known / load)
    wanted, alpha = cycle.outcome.get("plan", {}).get("volume_wanted_m3"), cycle.outcome["strategy"]["alpha"]
    if not wanted or not alpha:
        return None
    packing = cycle.scenario["loading"]["performance"].get("loose_packing", PerformanceConfig().loose_packing)
    return float(alpha / (wanted * packing * cycle.scenario["rocks"]["density"]))


def make_title(cycle: StoredCycle) -> str:
    """Return strategy and result in one line, for titles."""
    results = {result.key: result for result in make_results(cycle)}
    strategy = ", ".join(f"{name} {value:g}" for name, value in cycle.outcome["strategy"].items())
    reason = cycle.outcome["reason"]
    if results["load"].value is None or results["time"].value is None:
        return f"{strategy}: {reason}"
    share = f" ({results['payload_share'].show()} % of payload)" if results["payload_share"].value else ""
    return (
        f"{strategy}: {results['load'].show()} t{share} in "
        f"{results['time'].show()} s, damage {results['damage'].show()}, debris {results['debris'].show()} kg; {reason}"
    )
