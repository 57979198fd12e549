"""The rocks as a material to be tested."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drakerock.rocks.config import RocksConfig
from drakerock.rocks.engine.config import DynamicsConfig
from drakerock.rocks.making.emission import calc_mean_volume
from drakerock.rocks.shapes import RockShape, load_rock_shapes
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Material:
    """Rocks by their configuration, and the dynamics that they are simulated by.

    Attributes:
        config: shapes, gradation, density, friction.
        dynamics: engine, time step, contact.
        shapes: the rock shapes.
    """

    config: RocksConfig
    dynamics: DynamicsConfig
    shapes: tuple[RockShape, ...]

    @property
    def mean_size(self) -> float:
        """Mean sieve width by mass [m]."""
        return sum(item.size_m * item.mass_fraction for item in self.config.gradation)

    @property
    def largest(self) -> float:
        """Largest sieve width [m]."""
        return max(item.size_m for item in self.config.gradation)

    @property
    def mean_volume(self) -> float:
        """Mean volume of a rock, by number [m^3]."""
        return calc_mean_volume(self.config, self.shapes)

    def calc_volumes(self, pile: PileState) -> Array:
        """Return the rocks' volumes (n,) [m^3]."""
        return pile.calc_masses(np.array([shape.volume for shape in self.shapes]), 1.0)

    def calc_masses(self, pile: PileState) -> Array:
        """Return the rocks' masses (n,) [kg]."""
        return self.config.density * self.calc_volumes(pile)


def make_material(rocks: RocksConfig, dynamics: DynamicsConfig) -> Material:
    """Return the material of a configuration.

    Raises:
        InputError: a rock mesh cannot be used.
    """
    return Material(rocks, dynamics, load_rock_shapes(rocks))
