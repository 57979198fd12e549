"""What a test finds: quantities with their repeats and intervals, beside what is known, and curves to be drawn."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from drakerock.laboratory.scene import Slab
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]

LEVEL = 0.90
"""Of all intervals."""


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of a quantity from elsewhere.

    Attributes:
        low, high: the range.
        source: who says so, or the law it follows from.
    """

    low: float
    high: float
    source: str


@dataclass(frozen=True, eq=False)
class Row:
    """A quantity.

    Attributes:
        name: what it is, with its case.
        unit: "" for none.
        values: (repeats,) in it.
        known: what is known of it.
    """

    name: str
    unit: str
    values: Array
    known: Known | None = None

    @property
    def mean(self) -> float:
        """Over the repeats that gave a value; nan if none did."""
        found = self.values[np.isfinite(self.values)]
        return float(found.mean()) if len(found) else float("nan")

    @property
    def half_width(self) -> float:
        """Of the mean's interval, by Student's t; nan with less than two values."""
        found = self.values[np.isfinite(self.values)]
        if len(found) < 2:
            return float("nan")
        spread = found.std(ddof=1) / np.sqrt(len(found))
        return float(student.ppf(0.5 + 0.5 * LEVEL, len(found) - 1) * spread)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data; what is not a number is None."""
        known = self.known and {"low": self.known.low, "high": self.known.high, "source": self.known.source}
        return {
            "name": self.name,
            "unit": self.unit,
            "mean": _plain(self.mean),
            "half_width": _plain(self.half_width),
            "values": [_plain(value) for value in self.values],
            "known": known,
        }


@dataclass(frozen=True, eq=False)
class Curve:
    """Points (k,) of a panel; `label` "" is not in its legend."""

    x: Array
    y: Array
    label: str = ""
    style: Literal["line", "points", "dashed"] = "line"


@dataclass(frozen=True, eq=False)
class Panel:
    """A diagram of curves."""

    x_label: str
    y_label: str
    curves: tuple[Curve, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        curves = [
            {
                "label": curve.label,
                "style": curve.style,
                "x": [_plain(v) for v in curve.x],
                "y": [_plain(v) for v in curve.y],
            }
            for curve in self.curves
        ]
        return {"x_label": self.x_label, "y_label": self.y_label, "curves": curves}


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A specimen to be drawn: its rocks, and the slabs' corners (8, 3) that are in the way of them [m]."""

    pile: PileState
    slabs: tuple[Array, ...] = ()


def take_snapshot(
    pile: PileState, slabs: Iterable[Slab], travel: Iterable[float] = (0.0, 0.0, 0.0)
) -> Snapshot:
    """Return a snapshot of rocks and of the slabs that y = 0 cuts, these moved by a way (3,) [m]."""
    corners = [slab.calc_corners() + np.array(list(travel)) for slab in slabs]
    return Snapshot(pile, tuple(one for one in corners if one[:, 1].min() < 0.0 < one[:, 1].max()))


@dataclass(frozen=True, eq=False)
class Specimen:
    """What one repeat gave.

    Attributes:
        values: by name.
        curves: (x, y) by name.
        snapshot: how it looked.
    """

    values: dict[str, float]
    curves: dict[str, tuple[Array, Array]] = field(default_factory=dict)
    snapshot: Snapshot | None = None


@dataclass(frozen=True, eq=False)
class LabResult:
    """A finished test.

    Attributes:
        test: its name.
        title: what it is, in a line.
        rows: the table.
        panels: diagrams.
        snapshots: specimens to be drawn.
        facts: settings, material, engine, seed, versions, cost.
    """

    test: str
    title: str
    rows: tuple[Row, ...]
    panels: tuple[Panel, ...]
    snapshots: tuple[Snapshot, ...]
    facts: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, without the snapshots."""
        return {
            "test": self.test,
            "title": self.title,
            "level": LEVEL,
            **self.facts,
            "rows": [row.to_dict() for row in self.rows],
            "panels": [panel.to_dict() for panel in self.panels],
        }


def _plain(value: float) -> float | None:
    return float(f"{value:.6g}") if np.isfinite(value) else None
