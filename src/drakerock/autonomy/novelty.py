"""How unlike a pile is the piles that a model has learned from."""

from __future__ import annotations

import numpy as np

from drakerock.autonomy.data import LoadingData
from drakerock.autonomy.encoding import PileEncoder
from drakerock.exploration.problem import Array

_QUANTILE = 0.99


class Novelty:
    """Two distances of a height field from the training set, each over what 99 % of held-out fields have at most.

    One lies among the codes, the rms of Mahalanobis; the other is the rms of what the codes cannot describe. Held-out
    fields are those of design points that codes and covariance were not fitted to.

    Args:
        data: the training set.
        encoder: fitted to it.
        seed: of the folds.

    Attributes:
        limits: (2,) the two distances' 99 % quantiles.
    """

    def __init__(self, data: LoadingData, encoder: PileEncoder, seed: int = 0) -> None:
        held = []
        for train, test in data.iterate_folds(5, seed):
            part = PileEncoder(encoder.n_even, encoder.n_odd).fit(data.before[train])
            held.append(_measure(data.before[test], part, _calc_spread(data.before[train], part)))
        self._encoder, self._spread = encoder, _calc_spread(data.before, encoder)
        seen = np.vstack(held) if held else _measure(data.before, encoder, self._spread)
        self.limits = np.maximum(np.quantile(seen, _QUANTILE, axis=0), 1e-6)

    def calc(self, h: Array) -> float:
        """Return the greater of the distances of heights (nx, ny) over its limit: above 1 is unlike."""
        return float(np.max(_measure(h[None], self._encoder, self._spread)[0] / self.limits))


def _calc_spread(H: Array, encoder: PileEncoder) -> tuple[Array, Array]:
    """Return mean and standard deviation (p,) of the codes; mirror images belong to the set, so odd means are 0."""
    codes = encoder.encode(H)
    mean = np.where(encoder.mirror_ > 0, codes.mean(axis=0), 0.0)
    return mean, np.maximum(np.sqrt(np.mean((codes - mean) ** 2, axis=0)), 1e-3)


def _measure(H: Array, encoder: PileEncoder, spread: tuple[Array, Array]) -> Array:
    codes = encoder.encode(H)
    within = np.sqrt(np.mean(((codes - spread[0]) / spread[1]) ** 2, axis=1))
    beyond = np.sqrt(np.mean((H - encoder.decode(codes)) ** 2, axis=(1, 2)))
    return np.stack([within, beyond], axis=1)
