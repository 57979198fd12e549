"""Angle of repose: the slope that a withdrawn wall leaves, and the tilt at which a bed in a box lets go."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drakerock.laboratory.beds import (
    Bin,
    MakeRig,
    calc_profile,
    fill_bin,
    fit_slope,
    make_bin,
    settle,
    take_out,
)
from drakerock.laboratory.config import LabSettings, ReposeSettings
from drakerock.laboratory.interface import make_rows
from drakerock.laboratory.material import Material
from drakerock.laboratory.results import Curve, Known, Panel, Row, Specimen, take_snapshot
from drakerock.laboratory.scene import Mover, Rig, Scene, Slab
from drakerock.laboratory.theory import REPOSE
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]

# The withdrawn wall goes so far, the bench so much farther [bed heights].
WITHDRAWAL, REACH = 2.0, 4.0
# A tilted bed has let go when this share of its mass has gone a mean size down the box.
GONE_SHARE = 0.02
MOST_TILT = np.deg2rad(60.0)


def make_slope(
    material: Material, room: Bin, rocks: int, seed: int, make_rig: MakeRig, gate_speed: float
) -> tuple[Rig, PileState, tuple[Slab, ...]]:
    """Fill a bin behind a wall at x = 0, withdraw the wall towards -x, and wait for rest.

    Side walls are smooth, so that the slope is as if it were wide.

    Returns:
        The rig, the slope's rocks, and the bench.
    """
    reach = REACH * room.height
    bench = room.make_walls("flre", 0.0, reach)
    gate = Mover("gate", room.make_walls("a", 0.0), (-1.0, 0.0, 0.0))
    rig = make_rig(Scene(bench, (gate,)), fill_bin(material, rocks, room, seed), material)
    settle(rig, material)
    rig.advance(WITHDRAWAL * room.height / gate_speed, {"gate": gate_speed})
    settle(rig, material)
    return rig, take_out(rig.get_pile(), -0.5), bench


class ReposeTest:
    """Angles of a slope at rest and of a bed that starts to slide."""

    name = "repose"
    title = "Angle of repose: slope behind a withdrawn wall, and a tilted box"
    settings = ReposeSettings

    def measure(self, material: Material, settings: LabSettings, seed: int, make_rig: MakeRig) -> Specimen:
        """Withdraw a wall, then tilt a box of the same rocks."""
        assert isinstance(settings, ReposeSettings)
        room = make_bin(material, settings.rocks, 2.2, 1.3)
        _, pile, bench = make_slope(material, room, settings.rocks, seed, make_rig, settings.gate_speed)
        x = np.arange(-REACH * room.height, room.length, 0.25 * material.mean_size)
        h = calc_profile(pile, material, x, 0.4 * room.width)
        slope, offset = fit_slope(x, h)
        tilt = self._tilt(material, settings, seed, make_rig)
        return Specimen(
            {"wall": float(np.rad2deg(np.arctan(slope))), **tilt},
            {"profile": (x, h), "line": (x, slope * x + offset)},
            take_snapshot(pile, bench),
        )

    def _tilt(
        self, material: Material, settings: ReposeSettings, seed: int, make_rig: MakeRig
    ) -> dict[str, float]:
        room = make_bin(material, settings.rocks, 2.6, 1.1)
        rate = np.deg2rad(settings.tilt_rate_deg)
        # Turning about -y lifts the end at x = length: rocks go down towards x = 0.
        box = Mover("box", room.make_walls("flrae", 0.0), (0.0, -1.0, 0.0), joint="turn")
        rig = make_rig(
            Scene((), (box,), floor=-50.0), fill_bin(material, settings.rocks, room, seed), material
        )
        settle(rig, material)
        start = rig.get_pile()
        masses = material.calc_masses(start)
        tilt, look = 0.0, 0.1
        gone = False
        while tilt < MOST_TILT and not gone:
            record = rig.advance(look, {"box": rate})
            tilt = float(record.travels["box"][-1])
            down = start.p_WRs[:, 0] - _turn_back(rig.get_pile().p_WRs, tilt)[:, 0]
            gone = bool(masses[down > material.mean_size].sum() > GONE_SHARE * masses.sum())
        settle(rig, material)
        pile = rig.get_pile()
        # The middle of the surface, by the box; seen from above.
        ends = np.array([0.25, 0.75]) * room.length * np.cos(tilt) - 0.8 * room.height * np.sin(tilt)
        x = np.arange(float(ends[0]), float(ends[1]), 0.25 * material.mean_size)
        after = float("nan")
        if len(x) > 2:
            after = float(np.arctan(np.polyfit(x, calc_profile(pile, material, x, 0.4 * room.width), 1)[0]))
        return {"start": float(np.rad2deg(tilt)) if gone else float("nan"), "after": float(np.rad2deg(after))}

    def evaluate(
        self, specimens: Sequence[Specimen], material: Material, settings: LabSettings
    ) -> tuple[tuple[Row, ...], tuple[Panel, ...]]:
        """Return the angles beside those of dumped rock."""
        names = {
            "wall": ("slope behind the withdrawn wall", "deg"),
            "start": ("tilt at which the bed lets go", "deg"),
            "after": ("its surface afterwards", "deg"),
        }
        known = {key: Known(*REPOSE) for key in ("wall", "after")}
        curves = [
            Curve(*specimen.curves["profile"], f"specimen {k + 1}") for k, specimen in enumerate(specimens)
        ]
        x, line = specimens[0].curves["line"]
        shown = (line > 0) & (line < specimens[0].curves["profile"][1].max())
        curves.append(Curve(x[shown], line[shown], "fit, specimen 1", "dashed"))
        return make_rows(specimens, names, known), (Panel("x [m]", "surface [m]", tuple(curves)),)


def _turn_back(p_WRs: Array, tilt: float) -> Array:
    """Return positions (n, 3) in the frame of a box tilted by an angle about -y."""
    c, s = np.cos(tilt), np.sin(tilt)
    return np.column_stack(
        [c * p_WRs[:, 0] + s * p_WRs[:, 2], p_WRs[:, 1], c * p_WRs[:, 2] - s * p_WRs[:, 0]]
    )
