"""The table of checks: one row a measured value, to print or as plain data."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table


@dataclass(frozen=True)
class CheckRow:
    """A line of the table: what was measured, against what.

    Attributes:
        name: what.
        measured: the value, in `unit`.
        unit: its unit.
        expected: what it is compared with; None: reported only.
        rule: how the comparison goes, in words.
        passed: the verdict; None: reported only.
    """

    name: str
    measured: float
    unit: str
    expected: float | None = None
    rule: str = "reported"
    passed: bool | None = None


def make_check_table(rows: list[CheckRow]) -> Table:
    """Return the rows as a table to print with rich."""
    table = Table("check", "measured", "expected", "unit", "rule", "", title="Machine check")
    for row in rows:
        verdict = {True: "[green]ok[/]", False: "[red]FAILED[/]", None: ""}[row.passed]
        expected = "" if row.expected is None else f"{row.expected:.5g}"
        table.add_row(row.name, f"{row.measured:.5g}", expected, row.unit, row.rule, verdict)
    return table


def make_check_data(rows: list[CheckRow]) -> dict[str, Any]:
    """Return the rows as plain data for JSON: {"passed": ..., "checks": [...]}."""
    return {
        "passed": all(row.passed is not False for row in rows),
        "checks": [asdict(row) for row in rows],
    }


def compare(name: str, value: float, unit: str, expected: float | None, tolerance: float) -> CheckRow:
    """Return a row that passes within a relative tolerance; without `expected` it is reported only."""
    if expected is None:
        return CheckRow(name, float(value), unit)
    passed = bool(abs(value - expected) <= tolerance * abs(expected))
    return CheckRow(name, float(value), unit, float(expected), f"within {100 * tolerance:g} %", passed)


def bound(name: str, value: float, unit: str, limit: float) -> CheckRow:
    """Return a row that passes up to `limit`."""
    return CheckRow(name, value, unit, limit, "at most", bool(value <= limit))


def require(name: str, value: float, unit: str, limit: float) -> CheckRow:
    """Return a row that passes from `limit` on."""
    return CheckRow(name, value, unit, limit, "at least", bool(value >= limit))


def scale(value: float | None, factor: float) -> float | None:
    """Return `value` in another unit."""
    return None if value is None else value * factor
