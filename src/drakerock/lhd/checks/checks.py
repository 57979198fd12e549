"""The machine measured against its data (section 2), by simulation on a `bench`."""

from __future__ import annotations

from drakerock.errors import InputError
from drakerock.lhd.checks.balances import check_free_flight, check_records
from drakerock.lhd.checks.bench import CheckConfig, make_bench
from drakerock.lhd.checks.forces import (
    check_balance,
    check_breakout,
    check_lift,
    check_motion,
    check_traction,
)
from drakerock.lhd.checks.hinge import check_corner, check_hinge
from drakerock.lhd.checks.rows import CheckRow
from drakerock.lhd.checks.trials import Trials
from drakerock.lhd.checks.workspace import check_geometry
from drakerock.lhd.config import MachineConfig


def run_machine_checks(config: MachineConfig, checks: CheckConfig | None = None) -> list[CheckRow]:
    """Measure the machine by simulation (some seconds) and compare with `config.data`.

    Args:
        config: the machine.
        checks: the bench.

    Returns:
        The table's rows, in the order of the table.

    Raises:
        InputError: the machine's SDFormat file is not usable, or its payload is not known.
    """
    if config.data.payload is None:
        raise InputError(
            f"machine.expected.payload: not known of {config.model}; what its boom has to lift is checked [kg]"
        )
    checks = checks or CheckConfig()
    bench = make_bench(config, checks)
    trials = Trials(config, checks, bench.kin, [])
    rows = [
        *check_geometry(bench, config.data),
        *check_balance(trials),
        *check_traction(trials),
        *check_breakout(trials),
        *check_lift(trials),
        *check_motion(trials),
        *check_hinge(trials),
        *check_corner(trials),
        *check_free_flight(trials),
    ]
    return [*rows, *check_records(trials)]
