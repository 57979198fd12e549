"""A height field in a few numbers and back: principal components, even and odd across the drift."""

from __future__ import annotations

from typing import Self

import numpy as np
from sklearn.base import BaseEstimator
from sklearn.decomposition import PCA

from drakerock.exploration.problem import Array


class PileEncoder(BaseEstimator):
    """Codes of height fields (n, nx, ny): principal components of their even and their odd part across the drift.

    A drift is as good as its mirror image. The even codes are the same for both, the odd ones change sign: what is
    learned of one side holds for the other.

    Args:
        n_even, n_odd: at most so many codes of each kind.

    Attributes after `fit`:
        mirror_: (p,) factors that make a field's codes those of its mirror image: 1 and -1.
        scale_: (p,) standard deviations of the codes in the data [m].
        residual_: rms of what the codes leave out, per cell (nx, ny) [m].
    """

    def __init__(self, n_even: int = 8, n_odd: int = 4) -> None:
        self.n_even = n_even
        self.n_odd = n_odd

    def fit(self, H: Array) -> Self:
        """Fit to fields (n, nx, ny), n >= 2."""
        self.shape_ = H.shape[1:]
        mirrored = H[:, :, ::-1]
        most = min(len(H) - 1, H[0].size)
        self.even_ = PCA(min(self.n_even, most), svd_solver="randomized", random_state=0).fit(
            _flatten(0.5 * (H + mirrored))
        )
        odd = _flatten(0.5 * (H - mirrored))
        # The odd parts of a field and of its mirror image are equal but for the sign: their mean is zero.
        self.odd_ = PCA(min(self.n_odd, most), svd_solver="randomized", random_state=0).fit(
            np.vstack([odd, -odd])
        )
        self.mirror_ = np.repeat([1.0, -1.0], [self.even_.n_components_, self.odd_.n_components_])
        codes = self.encode(H)
        self.scale_ = np.maximum(codes.std(axis=0), 1e-6)
        self.residual_ = np.sqrt(np.mean((H - self.decode(codes)) ** 2, axis=0))
        return self

    def encode(self, H: Array) -> Array:
        """Return the codes (n, p) of fields (n, nx, ny) [m], the even ones first."""
        mirrored = H[:, :, ::-1]
        even = self.even_.transform(_flatten(0.5 * (H + mirrored)))
        return np.hstack([even, self.odd_.transform(_flatten(0.5 * (H - mirrored)))])

    def decode(self, codes: Array) -> Array:
        """Return the fields (n, nx, ny) of codes (n, p); no height is below the floor."""
        n_even = self.even_.n_components_
        flat = self.even_.inverse_transform(codes[:, :n_even]) + self.odd_.inverse_transform(
            codes[:, n_even:]
        )
        return np.maximum(flat, 0.0).reshape(-1, *self.shape_)


def _flatten(H: Array) -> Array:
    return H.reshape(len(H), -1)
