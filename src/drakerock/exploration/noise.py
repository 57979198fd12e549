"""How sure the mean of a sequence of loadings is, when successive loadings resemble each other.

The loadings of a sequence share one pile, so they are no independent draws. Each sequence is taken as a
stationary first-order autoregressive process, corr(y_i, y_{i+k}) = rho^k. With n values,

    tau  = 1 + 2 sum_{k=1}^{n-1} (1 - k/n) rho^k          (inflation of the mean's variance)
    se^2 = s^2 / n * tau * (n - 1) / (n - tau)            (s^2 the sample variance, itself biased by rho)

A sequence of 20 tells little about its own rho (standard deviation about 0.22), so rho is pooled over the
sequences of all points of an objective where there are several.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Fewer values than this say nothing about rho; it is then taken as zero.
MIN_LENGTH = 5
# Outside these, n - tau comes near zero for the usual sequence lengths and the correction explodes.
_RHO_RANGE = (-0.5, 0.9)


def calc_autocorrelation(sequences: Iterable[ArrayLike]) -> float:
    """Return the lag-one autocorrelation rho [-] pooled over sequences of one response.

    Args:
        sequences: arrays (n_i,) in the order of the loadings; NaN (failed loadings) break a sequence's
            pairs but leave the rest usable. Sequences with fewer than five values are ignored.

    The downward bias of the estimate in short sequences, about (1 + 3 rho) / n, is removed (Kendall 1954).
    Returns 0 when nothing can be estimated.
    """
    lagged = total = bias_n = 0.0
    for sequence in sequences:
        y = np.asarray(sequence, dtype=float)
        good = np.isfinite(y)
        n = int(good.sum())
        if n < MIN_LENGTH:
            continue
        e = y - y[good].mean()
        pairs = good[1:] & good[:-1]
        if not pairs.any():
            continue
        # Scaled to n - 1 pairs, so that gaps do not count as absence of correlation.
        lagged += float(np.sum(e[1:][pairs] * e[:-1][pairs])) * (n - 1) / int(pairs.sum())
        total += float(np.sum(e[good] ** 2))
        bias_n += float(np.sum(e[good] ** 2)) * n
    if total == 0.0:
        return 0.0
    n_mean = bias_n / total
    rho = lagged / total
    corrected = (n_mean * rho + 1.0) / (n_mean - 3.0) if n_mean > 4 else rho
    return float(np.clip(corrected, *_RHO_RANGE))


def calc_means(Y: ArrayLike) -> NDArray[np.float64]:
    """Return the mean of each column of Y (n, k), NaN left out; NaN for a column of NaN only."""
    Y = np.asarray(Y, dtype=float)
    good = np.isfinite(Y)
    with np.errstate(invalid="ignore"):
        return np.where(good, Y, 0.0).sum(axis=0) / good.sum(axis=0)


def calc_standard_error(sequence: ArrayLike, autocorrelation: float | None = None) -> float:
    """Return the standard error of the mean of one sequence, corrected for autocorrelation.

    Args:
        sequence: (n,) values in the order of the loadings, NaN where a loading failed.
        autocorrelation: rho pooled over many sequences (`calc_autocorrelation`). None: estimated from this
            sequence alone, and then never taken below zero, since a short sequence must not make itself
            look surer than independent loadings would be.

    Returns:
        The standard error in the unit of the sequence; NaN for fewer than two values.
    """
    y = np.asarray(sequence, dtype=float)
    rho = max(calc_autocorrelation([y]), 0.0) if autocorrelation is None else autocorrelation
    y = y[np.isfinite(y)]
    n = y.size
    if n < 2:
        return float("nan")
    k = np.arange(1, n)
    tau = 1.0 + 2.0 * float(np.sum((1.0 - k / n) * rho**k))
    # n - tau -> 0 means that the whole sequence is one draw; the bound keeps the answer finite.
    correction = (n - 1) / max(n - tau, 0.25 * (n - 1))
    return float(np.sqrt(y.var(ddof=1) / n * tau * correction))
