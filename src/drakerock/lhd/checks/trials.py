"""What the checks share: making benches, placing the machine on them, running them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from drakerock.lhd.checks.bench import Bench, CheckConfig, Record, make_bench
from drakerock.lhd.config import MachineConfig
from drakerock.lhd.kinematics import Kinematics
from drakerock.lhd.placement import set_machine_angles, set_machine_pose

MARGIN = 0.01
"""Kept from the stops when the bench sets a pose [rad]."""


@dataclass(frozen=True)
class Trials:
    """What the checks share; `records` collects every run for the checks that hold throughout."""

    config: MachineConfig
    checks: CheckConfig
    kin: Kinematics
    records: list[tuple[Bench, Record]]

    @property
    def payload(self) -> float:
        """What the boom has to lift [kg]."""
        payload = self.config.data.payload
        assert payload is not None, "checked by run_machine_checks"
        return payload

    def make(self, **options: Any) -> Bench:
        """Build a bench (`make_bench`)."""
        return make_bench(self.config, self.checks, kin=self.kin, **options)

    def run(self, bench: Bench, duration: float, **targets: float) -> Record:
        """Run a bench and keep the record."""
        record = bench.run(duration, **targets)
        self.records.append((bench, record))
        return record


def place(bench: Bench, **pose: float) -> None:
    """Put the bench's machine on the floor (`set_machine_pose`)."""
    set_machine_pose(bench.plant, bench.plant_context, bench.machine, kin=bench.kin, **pose)


def set_angles(bench: Bench, phi_l: float, phi_b: float) -> None:
    """Set boom and bucket angle [rad] with the linkage closed."""
    set_machine_angles(
        bench.plant, bench.plant_context, bench.machine, phi_l=phi_l, phi_b=phi_b, kin=bench.kin
    )


def calc_carry_pose(kin: Kinematics) -> dict[str, float]:
    """Return z_tip and psi with the bucket level, its tip a tenth of its length above the floor."""
    return {"z_tip": 0.1 * kin.bucket_length, "psi": 0.0}
