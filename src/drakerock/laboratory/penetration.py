"""Penetration: a plate or a bucket pushed level into a slope at imposed speeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drakerock.laboratory.beds import MakeRig, calc_profile, fit_slope, make_bin
from drakerock.laboratory.config import LabSettings, PenetrationSettings
from drakerock.laboratory.interface import make_row
from drakerock.laboratory.material import Material
from drakerock.laboratory.repose import make_slope
from drakerock.laboratory.results import Curve, Known, Panel, Row, Snapshot, Specimen, take_snapshot
from drakerock.laboratory.scene import Mover, Scene, Slab
from drakerock.laboratory.theory import INSERTION_EXPONENT
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]

# Of the tools [mean size]: width (at most this share of the bed's), thickness, a bucket's height.
WIDTH, WIDTH_SHARE, THICK, BUCKET_HEIGHT = 3.0, 0.7, 0.2, 2.0
# Steel on rock.
FRICTION = 0.4
# A push starts so far before the first rock [mean size].
CLEARANCE = 0.1


@dataclass(frozen=True, eq=False)
class PenetrationTest:
    """Mean force down to a depth, its exponent, and what speed adds.

    Attributes:
        name: plate or bucket.
        title: what it is, in a line.
    """

    name: str
    title: str
    settings = PenetrationSettings

    def measure(self, material: Material, settings: LabSettings, seed: int, make_rig: MakeRig) -> Specimen:
        """Make a slope, and push the tool into it at each speed, always from the same state."""
        assert isinstance(settings, PenetrationSettings)
        d = material.mean_size
        room = make_bin(material, settings.rocks, 2.2, 1.3)
        _, pile, bench = make_slope(material, room, settings.rocks, seed, make_rig, 1.0)
        height = settings.height * d
        x = np.arange(-4.0 * room.height, room.length, 0.25 * d)
        slope, offset = fit_slope(x, calc_profile(pile, material, x, 0.4 * room.width))
        surface = (height - offset) / slope
        # Single rocks that rolled out before the slope's foot are no part of it.
        pile = pile.select(pile.p_WRs[:, 0] > -offset / slope - 0.5 * d)
        deepest = max(settings.depths) * d
        values: dict[str, float] = {}
        curves = {}
        last, tool, travel = pile, self._make_tool(0.0, height, 1.0, d), 0.0
        for speed in settings.speeds:
            width = min(WIDTH * d, WIDTH_SHARE * room.width)
            tip = _find_free_tip(pile, material, width, height, self._find_top(height, d), surface)
            tip -= CLEARANCE * d
            tool = self._make_tool(tip, height, width, d)
            mover = Mover("tool", tool, (1.0, 0.0, 0.0))
            rig = make_rig(Scene(bench, (mover,)), pile, material)
            record = rig.advance((surface + deepest - tip) / speed, {"tool": speed})
            travel = float(record.travels["tool"][-1])
            depth = (tip + record.travels["tool"] - surface) / d
            force = -record.forces["tool"][:, 0] / 1e3
            label = f"{speed:g}"
            curves[label] = (depth, force)
            means = []
            for wanted in settings.depths:
                inside = (depth > 0) & (depth < wanted)
                means.append(float(force[inside].mean()))
                values[f"force_{label}_{wanted:g}"] = means[-1]
            values[f"peak_{label}"] = float(force.max())
            positive = np.array(means) > 0
            fit = np.polyfit(np.log(settings.depths), np.log(means), 1)[0] if positive.all() else np.nan
            values[f"exponent_{label}"] = float(fit)
            last = rig.get_pile()
        slowest, fastest = f"{min(settings.speeds):g}", f"{max(settings.speeds):g}"
        totals = [
            sum(values[f"force_{one}_{wanted:g}"] for wanted in settings.depths) for one in (fastest, slowest)
        ]
        values["speed"] = totals[0] / totals[1] if totals[1] > 0 else float("nan")
        snapshot = take_snapshot(last, (*bench,))
        moved = take_snapshot(last, tool, (travel, 0.0, 0.0))
        return Specimen(values, curves, Snapshot(last, snapshot.slabs + moved.slabs))

    def _find_top(self, height: float, d: float) -> float:
        return height + (BUCKET_HEIGHT * d if self.name == "bucket" else THICK * d)

    def _make_tool(self, tip: float, height: float, width: float, d: float) -> tuple[Slab, ...]:
        """Return the tool's slabs with its edge at x = tip, its underside at a height [m]."""
        t, long = THICK * d, 40.0 * d
        floor = Slab((long, width, t), (tip - 0.5 * long, 0.0, height + 0.5 * t), friction=FRICTION)
        if self.name == "plate":
            return (floor,)
        # As deep as high; its sides start half a size behind the edge.
        deep, tall = BUCKET_HEIGHT * d, BUCKET_HEIGHT * d
        side = (deep - 0.5 * d, t, tall)
        at = tip - 0.5 * d - 0.5 * side[0], height + 0.5 * tall
        sides = tuple(
            Slab(side, (at[0], sign * 0.5 * (width - t), at[1]), friction=FRICTION) for sign in (-1.0, 1.0)
        )
        back = Slab((t, width, tall), (tip - deep - 0.5 * t, 0.0, at[1]), friction=FRICTION)
        return (floor, *sides, back)

    def evaluate(
        self, specimens: Sequence[Specimen], material: Material, settings: LabSettings
    ) -> tuple[tuple[Row, ...], tuple[Panel, ...]]:
        """Return forces by speed and depth, the exponent beside that of loader design, and what speed adds."""
        assert isinstance(settings, PenetrationSettings)
        rows, curves = [], []
        for speed in settings.speeds:
            label = f"{speed:g}"
            for depth in settings.depths:
                name = f"mean force at {label} m/s, to {depth:g} mean sizes deep"
                rows.append(make_row(specimens, f"force_{label}_{depth:g}", name, "kN"))
            rows.append(make_row(specimens, f"peak_{label}", f"greatest force at {label} m/s", "kN"))
            rows.append(
                make_row(
                    specimens, f"exponent_{label}", f"exponent of the depth at {label} m/s", "",
                    Known(*INSERTION_EXPONENT),
                )
            )  # fmt: skip
            for number, specimen in enumerate(specimens):
                curves.append(Curve(*specimen.curves[label], f"{label} m/s" if number == 0 else ""))
        rows.append(make_row(specimens, "speed", "force, fastest over slowest", ""))
        return tuple(rows), (Panel("depth of the tip [mean size]", "force [kN]", tuple(curves)),)


def _find_free_tip(
    pile: PileState, material: Material, width: float, bottom: float, top: float, surface: float
) -> float:
    """Return the largest x, at most the surface's, up to which no rock is in the way of a tool [m]."""
    R_WRs = Rotation.from_quat(pile.q_WRs, scalar_first=True).as_matrix()
    free = surface
    for rock in range(len(pile)):
        corners = (
            pile.size[rock] * material.shapes[pile.shape[rock]].vertices @ R_WRs[rock].T + pile.p_WRs[rock]
        )
        low, high = corners.min(axis=0), corners.max(axis=0)
        if high[2] > bottom and low[2] < top and high[1] > -0.5 * width and low[1] < 0.5 * width:
            free = min(free, float(low[0]))
    return free
