"""Measured curves from a CSV file, as a calibration compares them: units converted, gaps left out, averaged in bins."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drakerock.errors import InputError
from drakerock.exploration.problem import Array
from drakerock.exploration.table_file import TableFile, read_csv
from drakerock.study.schema import CurveConfig

# To SI; a column's unit stands in its header in brackets, or in a row below it.
UNITS = {
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "in": 0.0254},
    "m/s": {"m/s": 1.0, "km/h": 1 / 3.6, "mm/s": 1e-3, "mph": 0.44704},
    "rad": {"rad": 1.0, "deg": np.pi / 180, "°": np.pi / 180},
    "rad/s": {"rad/s": 1.0, "deg/s": np.pi / 180, "°/s": np.pi / 180, "rpm": np.pi / 30},
    "N": {"N": 1.0, "kN": 1e3, "MN": 1e6, "tf": 9806.65, "lbf": 4.4482216},
    "N m": {"N m": 1.0, "Nm": 1.0, "N*m": 1.0, "kN m": 1e3, "kNm": 1e3, "MN m": 1e6, "MNm": 1e6},
    "W": {"W": 1.0, "kW": 1e3, "MW": 1e6},
    "J": {"J": 1.0, "kJ": 1e3, "MJ": 1e6, "kWh": 3.6e6},
    "kg": {"kg": 1.0, "t": 1e3},
    "1": {"1": 1.0, "-": 1.0, "%": 1e-2},
}
# So few values are no curve.
LEAST_VALUES = 5


@dataclass(frozen=True, eq=False)
class MeasuredCurve:
    """One measured curve.

    Attributes:
        config: what it is.
        unit, over_unit: SI units of values and abscissae.
        over: (m,) rising abscissae.
        values: (m,) values.
        bins: (m,) the bin of each; a bin's mean is what is compared.
        noise: (b,) standard deviation of each bin's mean.
    """

    config: CurveConfig
    unit: str
    over_unit: str
    over: Array
    values: Array
    bins: np.ndarray
    noise: Array

    @property
    def means(self) -> Array:
        """(b,) the bins' means."""
        return self.average(self.values)

    @property
    def middles(self) -> Array:
        """(b,) the bins' mean abscissae."""
        return self.average(self.over)

    def average(self, values: Array) -> Array:
        """Return the bins' means (b,) of values (m,) at the measured abscissae."""
        return np.bincount(self.bins, values) / np.bincount(self.bins)


def load_measured(
    path: str | Path, curves: tuple[CurveConfig, ...], units: dict[str, str], n_bins: int
) -> tuple[list[MeasuredCurve], list[str]]:
    """Read the measured curves, and return what was taken for what.

    Args:
        path: the CSV file.
        curves: which columns belong to which signals.
        units: SI units of the signals, by name.
        n_bins: a curve is averaged in at most so many parts of equal length.

    Raises:
        InputError: a missing column, an unknown unit, no numbers, an abscissa that turns back.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    needed = tuple(dict.fromkeys(name for c in curves for name in (c.measured_over, c.measured)))
    file = read_csv(path, needed)
    file.find_columns(needed)
    missing = [name for name in needed if name not in file]
    if missing:
        raise InputError(
            f"{path}: no column '{missing[0]}'; there are: {', '.join(file.headers)}. Name the measured columns in the "
            "study: calibration.curves: column, over_column"
        )
    file.find_decimal_comma(needed)
    known = {name: file.get_header_unit(name) for name in needed}
    # A row of units below the header: whatever stands there instead of numbers.
    first = {name: file.cells[file._found[name]][0].strip() for name in needed if len(file)}
    if first and all(text and not _is_number(text) for text in first.values()):
        known = {name: text.strip("[]() ") for name, text in first.items()}
        file.cells = [column[1:] for column in file.cells]
        file.places = file.places[1:]
        file.notes.append("the first row is taken as the columns' units")
    result = [_make_curve(file, curve, known, units, n_bins) for curve in curves]
    return result, file.notes


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return text.casefold() in ("", "nan", "na", "-")
    return True


def _make_curve(
    file: TableFile, curve: CurveConfig, known: dict[str, str], units: dict[str, str], n_bins: int
) -> MeasuredCurve:
    for name in (curve.signal, curve.over):
        if name not in units:
            raise InputError(f"calibration.curves: no signal '{name}'; there are: {', '.join(sorted(units))}")
    over = file.get_numbers(curve.measured_over) * _find_factor(
        file, curve.measured_over, known, units[curve.over]
    )
    values = file.get_numbers(curve.measured) * _find_factor(file, curve.measured, known, units[curve.signal])
    over = over + curve.shift
    good = np.isfinite(over) & np.isfinite(values)
    if not good.all():
        file.notes.append(
            f"{curve.measured}: {np.sum(~good)} of {len(good)} rows without a number are left out"
        )
    over, values = over[good], values[good]
    if len(over) < LEAST_VALUES:
        raise InputError(
            f"{file.source}: {curve.measured}: {len(over)} values; at least {LEAST_VALUES} are needed"
        )
    if curve.over == "time" and (np.diff(over) < 0.0).any():
        row = int(np.flatnonzero(np.diff(over) < 0.0)[0])
        raise InputError(
            f"{file.source}: {curve.measured_over} turns back from {over[row]:g} to {over[row + 1]:g} s: one run's "
            "measurement a file, in its order"
        )
    order = np.argsort(over, kind="stable")
    over, values = over[order], values[order]
    if not over[-1] > over[0]:
        raise InputError(f"{file.source}: {curve.measured_over} does not change")
    steps = np.diff(over)
    if len(steps) and steps.max() > 10.0 * np.median(steps) and np.median(steps) > 0.0:
        file.notes.append(
            f"{curve.measured}: a gap of {steps.max():.3g} {units[curve.over]}; nothing is compared inside it"
        )
    bins = np.minimum(((over - over[0]) / (over[-1] - over[0]) * n_bins).astype(int), n_bins - 1)
    bins = np.unique(bins, return_inverse=True)[1]
    counts = np.bincount(bins)
    single = curve.noise
    if single is None:
        # From one value to the next the curve changes little, noise does: half the mean squared second difference.
        second = values[2:] - 2.0 * values[1:-1] + values[:-2]
        single = max(float(np.sqrt(np.mean(second**2) / 6.0)), 1e-3 * float(np.ptp(values)), 1e-12)
        file.notes.append(f"{curve.measured}: noise from its scatter, {single:.3g} {units[curve.signal]}")
    noise = np.maximum(single / np.sqrt(counts), curve.model_error)
    return MeasuredCurve(curve, units[curve.signal], units[curve.over], over, values, bins, noise)


def _find_factor(file: TableFile, name: str, known: dict[str, str], wanted: str) -> float:
    unit = known[name]
    if not unit or unit == wanted:
        return 1.0
    factors = UNITS.get(wanted, {wanted: 1.0})
    if unit not in factors:
        raise InputError(
            f"{file.source}: {name} is in {unit}; what is simulated is in {wanted}, and understood are "
            f"{', '.join(factors)}"
        )
    file.notes.append(f"{name}: {unit} is converted to {wanted}")
    return factors[unit]
