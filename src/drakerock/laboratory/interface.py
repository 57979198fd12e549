"""What a test of the laboratory is: one specimen measured, and all of them made a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from drakerock.laboratory.beds import MakeRig
from drakerock.laboratory.config import LabSettings
from drakerock.laboratory.material import Material
from drakerock.laboratory.results import Known, Panel, Row, Specimen


class MaterialTest(Protocol):
    """A test; it keeps nothing between calls."""

    @property
    def name(self) -> str:
        """How it is called."""

    @property
    def title(self) -> str:
        """What it is, in a line."""

    @property
    def settings(self) -> type[LabSettings]:
        """What it can be told."""

    def measure(self, material: Material, settings: LabSettings, seed: int, make_rig: MakeRig) -> Specimen:
        """Make one specimen and test it."""

    def evaluate(
        self, specimens: Sequence[Specimen], material: Material, settings: LabSettings
    ) -> tuple[tuple[Row, ...], tuple[Panel, ...]]:
        """Return the table and the diagrams of all specimens."""


def make_row(
    specimens: Sequence[Specimen], key: str, name: str, unit: str, known: Known | None = None
) -> Row:
    """Return the row of a value that specimens hold under a key."""
    return Row(name, unit, np.array([specimen.values[key] for specimen in specimens], float), known)


def make_rows(
    specimens: Sequence[Specimen], names: Mapping[str, tuple[str, str]], known: Mapping[str, Known]
) -> tuple[Row, ...]:
    """Return rows by (name, unit) under their keys, with what is known of some."""
    return tuple(make_row(specimens, key, name, unit, known.get(key)) for key, (name, unit) in names.items())
