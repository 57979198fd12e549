"""A world of formulas for loadings: what is true in it is known, so that a model can be held against it."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter

from drakerock.autonomy.data import LoadingData
from drakerock.exploration.problem import Problem
from drakerock.loading.features import PileFeatures, calc_pile_features
from drakerock.loading.field import HeightField, calc_pile_profile
from drakerock.loading.planning import choose_entry_slice
from drakerock.loading.scenario import Scenario
from drakerock.loading.sensing import make_grid

CELL = 0.5
HALF_ROOM = 1.55
SCENARIO = Scenario.model_validate({"loading": {"sensing": {"cell": CELL}}, "site": {"drift_length": 20.0}})
X, Y = make_grid(SCENARIO.site, CELL, 10.0)


class World:
    """Piles whose slope, toe and skew differ; production wants the alpha that suits the entry's front.

    A cut takes away the front where it was made, and the pile slides back half-way: where was just dug there is less.
    """

    def __init__(self, seed=0, noise=0.02):
        self.rng = np.random.default_rng(seed)
        self.noise = noise

    def make_pile(self):
        slope, toe, skew = (
            self.rng.uniform(0.6, 1.1),
            self.rng.uniform(-5.5, -3.5),
            self.rng.uniform(-0.3, 0.3),
        )
        h = np.maximum(slope * (X[:, None] - toe - skew * Y[None, :]), 0.0)
        return np.minimum(h, 3.5)

    def find_entry(self, h, gamma):
        profile = calc_pile_profile(HeightField(X, Y, h, CELL), 0.15)
        j = choose_entry_slice(profile, gamma, HALF_ROOM)
        under = np.abs(Y - Y[j]) <= 1.5
        return Y[j], float(np.mean(profile.slope[under])), float(np.mean(profile.x_front[under]))

    def expect(self, h, x):
        """Return the expected objectives of a loading: production, damage, debris."""
        alpha, beta, gamma, kappa = x
        _, slope, _ = self.find_entry(h, gamma)
        fit = np.exp(-(((alpha - 0.4 - 1.2 * slope) / 0.5) ** 2))
        production = 400.0 + 500.0 * fit - 60.0 * (beta - 0.5) ** 2
        return np.array([production, 0.2 + 0.3 * alpha * (1.0 - beta), 100.0 + 200.0 * kappa])

    def load(self, h, x):
        """Return what came, and the piles after and before the next loading."""
        y, _, x_front = self.find_entry(h, x[2])
        came = self.expect(h, x) * (1.0 + self.noise * self.rng.standard_normal(3))
        there = np.exp(-(((Y[None, :] - y) / 1.2) ** 2) - ((X[:, None] - x_front - 1.0) / 1.5) ** 2)
        after = np.maximum(h - 0.8 * x[0] * there, 0.0)
        following = (
            after + 0.5 * (h - after) + gaussian_filter(self.rng.normal(0.0, 0.15, h.shape), 2.0) * (h > 0.1)
        )
        return came, after, np.maximum(following, 0.0)


def make_data(n_points=60, n_loadings=4, seed=0, world=None):
    world = world or World(seed)
    problem = Problem()
    rows = []
    for p in range(n_points):
        x = problem.low + world.rng.uniform(size=4) * (problem.high - problem.low)
        h = world.make_pile()
        for n in range(n_loadings):
            came, after, following = world.load(h, x)
            last = n == n_loadings - 1
            rows.append((x, came, h, after, np.full_like(h, np.nan) if last else following, f"s{p:04d}", n))
            h = following
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    fields = [HeightField(X, Y, h, CELL) for h in columns[2]]
    features = np.array(
        [[getattr(calc_pile_features(f, 0.15), k) for k in PileFeatures.list_names()] for f in fields]
    )
    n = len(rows)
    return LoadingData(
        problem, SCENARIO, X, Y, CELL, *columns[:5], features, columns[5], np.zeros(n, int), columns[6],
        np.where(np.arange(n) % 6 == 0, "sample", "sample"),
    )  # fmt: skip
