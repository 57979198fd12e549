"""A pile in numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from drakerock.pile.config import RocksConfig
from drakerock.pile.shapes import RockShape
from drakerock.pile.state import PileState


def calc_summary(pile: PileState, shapes: tuple[RockShape, ...], rocks: RocksConfig) -> dict[str, Any]:
    """Return number, mass, mass shares by size (made and wanted), extent and height of a pile."""
    volumes = np.array([shape.volume for shape in shapes])
    mass = pile.calc_masses(volumes, rocks.density)
    free = ~pile.fixed
    total = float(mass[free].sum())
    summary: dict[str, Any] = {
        "rocks": int(free.sum()),
        "fixed_rocks": int(pile.fixed.sum()),
        "mass_kg": round(total, 1),
    }
    for item in rocks.gradation:
        share = float(mass[free & np.isclose(pile.size, item.size_m)].sum()) / max(total, 1e-9)
        summary[f"share_of_{item.size_m:g}_m"] = (
            f"{100 * share:.1f} % (wanted {100 * item.mass_fraction:.0f} %)"
        )
    if len(pile):
        summary["toe_x_m"] = round(float(pile.p_WRs[free, 0].min()), 2)
        summary["top_z_m"] = round(float((pile.p_WRs[:, 2] + 0.5 * pile.size)[free].max()), 2)
    return summary
