"""Calibration: a study's variables fitted to measured curves; what is simulated is kept in a study's store."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drakerock.errors import InputError
from drakerock.exploration.calibration import Calibration, calibrate, propose_points
from drakerock.exploration.problem import Array
from drakerock.exploration.sampling import make_initial_design
from drakerock.files import make_folder, write_text
from drakerock.lhd.measurement import MEASUREMENT
from drakerock.loading.folder import PILE_BEFORE, SIGNALS
from drakerock.loading.signal_table import load_signals
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.state import load_pile
from drakerock.rocks.summary import calc_profile
from drakerock.study.db import Store
from drakerock.study.display import Display
from drakerock.study.measured import MeasuredCurve, load_measured
from drakerock.study.runner import RUN_SEQUENCE, run_study
from drakerock.study.schema import CalibrationConfig, CurveConfig, StudyConfig

Mask = NDArray[np.bool_]

# The pile's profile is a curve, too, though no signal: mean height over x.
PROFILE = "profile"
# Units of the signals of `drakerock.loading.signals` that a measurement may name.
SIGNAL_UNITS = {
    "time": "s", "x": "m", PROFILE: "m", "mode": "1", "hinge_moment": "N m", "work": "J", "wheel_slip": "m/s",
    "target_wheel_rate": "rad/s", "target_boom_rate": "rad/s", "target_bucket_rate": "rad/s",
    **MEASUREMENT,
    **{f"bucket_torque_{axis}": "N m" for axis in "xyz"}, **{f"bucket_force_{axis}": "N" for axis in "xyz"},
    **{f"torque_{name}": "N m" for name in ("wheels", "boom", "bucket")},
    **{f"power_{name}": "W" for name in ("wheels", "boom", "bucket")},
}  # fmt: skip
# A bin is compared when so large a share of the simulations reach it; those that do not are left out.
REACHED_SHARE = 0.8
# At least so large a share of the measured bins must be compared.
COMPARED_SHARE = 0.5
# Points of the initial design of a calibration, as a share of all.
INITIAL_SHARE = 0.4


def run_calibration(
    study: StudyConfig,
    measured: str | Path,
    folder: str | Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    display: Display | None = None,
    work: str = RUN_SEQUENCE,
    say: Callable[[str], None] = lambda _text: None,
) -> tuple[dict[str, Any], list[Path]]:
    """Fit a study's variables to measured curves. Interrupted, the same call goes on.

    The points of a Latin hypercube are simulated first, then batches of points where the fit so far says that the
    parameters are, until there are `exploration.sampling.n_samples`.

    Args:
        study: variables, scenario, `calibration`; made whole by `load_study`.
        measured: the CSV file.
        folder: the study's store, and where calibration.json, calibration.png and residuals.csv are written.
        workers, scheduler, display, work: as in `run_study`.
        say: told what was done to the measurement.

    Returns:
        The result as plain data, and the paths written.

    Raises:
        InputError: no `calibration` in the study, a measurement of no use, simulations that do not reach it.
        RunStopped, KeyboardInterrupt: as `run_study`.
    """
    config = _check(study)
    curves, notes = load_measured(measured, config.curves, SIGNAL_UNITS, config.bins)
    for note in notes:
        say(f"{measured}: {note}")
    sampling = study.exploration.sampling
    n_initial = max(round(INITIAL_SHARE * sampling.n_samples), 2 * len(study.variables) + 2)

    def ask(store: Store) -> Array:
        n = len(store.list_points("sample"))
        if n < n_initial:
            design = sampling.replace(n_initial=n_initial, n_corners=0)
            return make_initial_design(study.problem, design, study.seed)[n : sampling.n_samples]
        fit = _fit(store, curves, config)[0]
        return propose_points(fit, min(sampling.batch_size, sampling.n_samples - n), study.seed + n)

    plain = study.replace(exploration=study.exploration.replace(sampling=sampling.replace(n_validation=0)))
    run_study(plain, folder, workers=workers, scheduler=scheduler, display=display, work=work, ask=ask)
    with Store.open(folder) as store:
        fit, X, F, kept = _fit(store, curves, config)
    return _write(fit, X, F, kept, curves, notes, Path(folder))


def _check(study: StudyConfig) -> CalibrationConfig:
    if study.calibration is None:
        raise InputError("the study has no 'calibration': say which curves were measured")
    if study.storage.keep != "everything":
        raise InputError("storage.keep: a calibration needs the signals; everything")
    return study.calibration


def _fit(
    store: Store, curves: list[MeasuredCurve], config: CalibrationConfig
) -> tuple[Calibration, Array, Array, Mask]:
    """Return the fit to all that is simulated, points (n, d), curves (n, m), and which bins (b,) these are of."""
    X, F = read_curves(store, curves)
    reached = np.isfinite(F)
    kept = reached.mean(axis=0) >= REACHED_SHARE if len(F) else np.zeros(F.shape[1], bool)
    if kept.mean() < COMPARED_SHARE:
        raise InputError(
            f"calibration: only {100 * kept.mean():.0f} % of the measured curves lie where most simulations get to; "
            "the measurement is of another run, or its abscissa has another zero (calibration.curves: shift)"
        )
    whole = reached[:, kept].all(axis=1)
    measured, noise = (
        np.concatenate([getattr(c, name) for c in curves])[kept] for name in ("means", "noise")
    )
    fit = calibrate(
        store.study.problem, X[whole], F[whole][:, kept], measured, noise, config.confidence, store.study.seed
    )
    return fit, X[whole], F[whole][:, kept], kept


def read_curves(store: Store, curves: list[MeasuredCurve]) -> tuple[Array, Array]:
    """Return the finished points (n, d) and their curves' bins in line (n, b); NaN: not reached."""
    X, rows = [], []
    for point in store.list_points("sample"):
        if point.status != "done":
            continue
        folder = store.find_sequence_folder(point.name, point.attempt)
        places = sorted(path.parent for path in folder.glob("loading_*/signals.parquet"))
        loadings = [np.concatenate([_read_curve(place, c, store.study) for c in curves]) for place in places]
        if loadings:
            X.append(point.x)
            rows.append(np.mean(loadings, axis=0))
    d, b = len(store.study.variables), sum(len(c.means) for c in curves)
    return np.array(X).reshape(-1, d), np.array(rows).reshape(-1, b)


def _read_curve(place: Path, curve: MeasuredCurve, study: StudyConfig) -> Array:
    config: CurveConfig = curve.config
    if config.signal == PROFILE:
        rocks = study.scenario.rocks
        shapes = load_rock_shapes(rocks)
        over, values = calc_profile(load_pile(place / PILE_BEFORE), shapes, study.scenario.site)
    else:
        columns, _ = load_signals(place / SIGNALS)
        for name in (config.signal, config.over):
            if name not in columns:
                raise InputError(
                    f"calibration.curves: no signal '{name}'; there are: {', '.join(sorted(columns))}"
                )
        over, values = columns[config.over], columns[config.signal]
        # Over a position: where the machine gets there first. What comes after it has turned back does not count.
        first = np.concatenate([[True], over[1:] > np.maximum.accumulate(over)[:-1]])
        over, values = over[first], values[first]
    at = np.interp(curve.over, over, values, left=np.nan, right=np.nan)
    return curve.average(at)


def _write(
    fit: Calibration,
    X: Array,
    F: Array,
    kept: Mask,
    curves: list[MeasuredCurve],
    notes: list[str],
    folder: Path,
) -> tuple[dict[str, Any], list[Path]]:
    from drakerock.viewing.calibration_figures import CurveView, write_calibration_picture

    make_folder(folder)
    views, lines, summaries = [], ["curve,over,measured,noise,predicted,residual"], []
    begin, at = 0, 0
    for curve in curves:
        mask = kept[begin : begin + len(curve.means)]
        n = int(mask.sum())
        predicted = fit.predicted[at : at + n]
        over, means, noise = curve.middles[mask], curve.means[mask], curve.noise[mask]
        residual = means - predicted
        label = curve.config.signal
        views.append(CurveView(
            f"{label} [{curve.unit}]", f"{curve.config.over} [{curve.over_unit}]", over, means, noise, predicted,
            F[:, at : at + n],
        ))  # fmt: skip
        lines += [
            f"{label},{a!r},{b!r},{c!r},{d!r},{e!r}"
            for a, b, c, d, e in zip(
                *(v.tolist() for v in (over, means, noise, predicted, residual)), strict=True
            )
        ]
        summaries.append({
            "signal": label, "over": curve.config.over, "compared_bins": n, "measured_bins": len(mask),
            "residual_rms": float(np.sqrt(np.mean(residual**2))) if n else None,
            "noise_rms": float(np.sqrt(np.mean(noise**2))) if n else None, "unit": curve.unit,
        })  # fmt: skip
        begin, at = begin + len(mask), at + n
    result = fit.to_dict() | {"simulations": len(X), "curves": summaries, "notes": notes}
    paths = [folder / name for name in ("calibration.json", "residuals.csv", "calibration.png")]
    write_text(paths[0], json.dumps(result, indent=2, allow_nan=False) + "\n")
    write_text(paths[1], "\n".join(lines) + "\n")
    write_calibration_picture(fit.problem, fit.draws, fit.weights, fit.best, X, views, paths[2])
    return result, paths
