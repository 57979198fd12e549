"""A test's quantities as a table for the console."""

from __future__ import annotations

import math

from rich.table import Table
from rich.text import Text

from drakerock.laboratory.results import LEVEL, LabResult, Row


def make_lab_table(result: LabResult) -> Table:
    """Return the rows with their intervals, beside what is known."""
    repeats = len(result.rows[0].values) if result.rows else 0
    table = Table(
        title=f"{result.title}; {repeats} specimens, {100 * LEVEL:g} % intervals", title_justify="left"
    )
    table.add_column("quantity")
    table.add_column("mean", justify="right")
    table.add_column("unit")
    table.add_column("known")
    table.add_column("by")
    for row in result.rows:
        known = f"{row.known.low:.3g} to {row.known.high:.3g}" if row.known else ""
        source = row.known.source if row.known else ""
        # Text, not markup: brackets stay.
        table.add_row(Text(row.name), Text(format_mean(row)), row.unit, known, Text(source))
    return table


def format_mean(row: Row) -> str:
    """Return mean and half width of a row, to the same digit; a dash where there is no mean."""
    if not math.isfinite(row.mean):
        return "-"
    if not math.isfinite(row.half_width) or row.half_width == 0.0:
        return f"{row.mean:.3g}"
    digits = max(1 - math.floor(math.log10(row.half_width)), 0)
    return f"{row.mean:.{digits}f} +- {row.half_width:.{digits}f}"
