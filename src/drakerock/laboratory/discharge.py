"""Discharge: how fast rocks run out of a slot in a flat floor, and out of a hopper."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drakerock.laboratory.beds import (
    THICKNESS,
    Bin,
    MakeRig,
    calc_packing,
    fill_bin,
    make_bin,
    settle,
    take_out,
)
from drakerock.laboratory.config import DischargeSettings, LabSettings
from drakerock.laboratory.interface import make_row
from drakerock.laboratory.material import Material
from drakerock.laboratory.results import Curve, Known, Panel, Row, Snapshot, Specimen, take_snapshot
from drakerock.laboratory.scene import Scene, Slab
from drakerock.laboratory.theory import BEVERLOO_K, calc_beverloo_rate, calc_hopper_factor
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]

# The rate is taken between these shares of the bed: neither the start nor the end.
STEADY = (0.1, 0.5)
# It is watched so long at most [s]; rocks below this are out [m].
LONGEST, OUT = 8.0, -0.3
# For the hopper's factor: friction angle of the material [rad], which enters with the power 0.35 only.
FRICTION = np.deg2rad(42.0)
LAW = "Beverloo's law for a slot, C 1.03, k 1.4 (Nedderman 1992), within 30 %"


class DischargeTest:
    """Rates out of slots of several widths, and out of a hopper with the middle one of them."""

    name = "discharge"
    title = "Discharge through a slot and out of a hopper"
    settings = DischargeSettings

    def measure(self, material: Material, settings: LabSettings, seed: int, make_rig: MakeRig) -> Specimen:
        """Fill a bin, open a slot of each width from the same state; fill a hopper and open it."""
        assert isinstance(settings, DischargeSettings)
        openings = np.array(sorted(settings.openings)) * material.mean_size
        room = make_bin(material, settings.rocks, 1.0, 0.7)
        length = max(room.length, 1.3 * float(openings[-1]))
        room = Bin(length, room.width, room.height * room.length / length)
        walls = room.make_walls("lrae", 0.0)
        shut = Scene((*walls, *room.make_walls("f", 0.0)))
        rig = make_rig(shut, fill_bin(material, settings.rocks, room, seed), material)
        settle(rig, material)
        bed = take_out(rig.get_pile(), OUT)
        values: dict[str, float] = {"density": _calc_density(bed, material, room)}
        curves: dict[str, tuple[Array, Array]] = {}
        for opening in openings:
            floor = _make_slotted_floor(room, float(opening))
            rate, curve, _ = _discharge(bed, Scene((*walls, *floor)), material, make_rig)
            label = f"{opening / material.mean_size:g}"
            law = calc_beverloo_rate(float(opening), room.width, material.mean_size, values["density"])
            values |= {f"rate_{label}": rate / 1e3, f"share_{label}": rate / law}
            curves[f"slot_{label}"] = curve
        rates = np.array([values[f"rate_{opening / material.mean_size:g}"] for opening in openings])
        wide = openings - BEVERLOO_K * material.mean_size
        if (wide > 0).all() and (rates > 0).all():
            values["exponent"] = float(np.polyfit(np.log(wide), np.log(rates), 1)[0])
        else:
            values["exponent"] = float("nan")
        middle = float(openings[len(openings) // 2])
        rate, curves["hopper"], snapshot = self._empty_hopper(
            material, settings, middle, room, seed, make_rig
        )
        values |= {
            "hopper": rate / 1e3,
            "hopper_share": rate / 1e3 / rates[len(openings) // 2] if rates[len(openings) // 2] else np.nan,
        }
        return Specimen(values, curves, snapshot)

    def _empty_hopper(
        self,
        material: Material,
        settings: DischargeSettings,
        opening: float,
        room: Bin,
        seed: int,
        make_rig: MakeRig,
    ) -> tuple[float, tuple[Array, Array], Snapshot]:
        """Return the rate [kg/s], its curve, and how it looks halfway."""
        lean = np.deg2rad(settings.hopper_angle_deg)
        walls = (*room.make_walls("lr", 0.0), *room.make_walls("ae", 0.0))
        slopes = _make_hopper(room, opening, lean)
        plug = Slab((opening, room.width, THICKNESS), (0.5 * room.length, 0.0, -0.5 * THICKNESS))
        pile = fill_bin(material, settings.rocks, room, seed)
        # Above the hopper's walls.
        rise = 0.5 * (room.length - opening) / np.tan(lean)
        pile.p_WRs[:, 2] += rise
        rig = make_rig(Scene((*walls, *slopes, plug)), pile, material)
        settle(rig, material)
        bed = take_out(rig.get_pile(), OUT)
        rate, curve, last = _discharge(bed, Scene((*walls, *slopes)), material, make_rig)
        return rate, curve, take_snapshot(last, (*slopes,))

    def evaluate(
        self, specimens: Sequence[Specimen], material: Material, settings: LabSettings
    ) -> tuple[tuple[Row, ...], tuple[Panel, ...]]:
        """Return the rates beside Beverloo's, their exponent, and the hopper's beside Rose and Tanaka's."""
        assert isinstance(settings, DischargeSettings)
        labels = [f"{opening:g}" for opening in sorted(settings.openings)]
        rows = []
        for label in labels:
            rows.append(make_row(specimens, f"rate_{label}", f"rate, slot of {label} mean sizes", "t/s"))
            known = Known(0.7, 1.3, LAW)
            rows.append(make_row(specimens, f"share_{label}", "... over Beverloo's", "", known))
        rows.append(
            make_row(
                specimens, "exponent", "exponent of the slot's width", "", Known(1.25, 1.75, "Beverloo: 1.5")
            )
        )
        factor = calc_hopper_factor(np.deg2rad(settings.hopper_angle_deg), FRICTION)
        middle = labels[len(labels) // 2]
        rows.append(make_row(specimens, "hopper", f"rate, hopper, slot of {middle}", "t/s"))
        known = Known(0.85 * factor, 1.15 * factor, "Rose and Tanaka 1959, within 15 %")
        rows.append(make_row(specimens, "hopper_share", "... over the flat floor's", "", known))
        curves = [Curve(*specimens[0].curves[f"slot_{label}"], f"slot {label}") for label in labels]
        curves.append(Curve(*specimens[0].curves["hopper"], "hopper", "dashed"))
        density = float(np.mean([specimen.values["density"] for specimen in specimens]))
        x = np.array([float(label) for label in labels])
        measured = np.array(
            [np.mean([specimen.values[f"rate_{label}"] for specimen in specimens]) for label in labels]
        )
        room = make_bin(material, settings.rocks, 1.0, 0.7)
        law = [
            calc_beverloo_rate(one * material.mean_size, room.width, material.mean_size, density) / 1e3
            for one in x
        ]
        panels = (
            Panel("time [s]", "out [t], specimen 1", tuple(curves)),
            Panel(
                "slot [mean size]",
                "rate [t/s]",
                (Curve(x, measured, "measured", "points"), Curve(x, np.array(law), "Beverloo", "dashed")),
            ),
        )
        return tuple(rows), panels


def _calc_density(bed: PileState, material: Material, room: Bin) -> float:
    """Return the bed's density away from its surface [kg/m^3]."""
    margin = 0.3 * material.mean_size
    top = float(np.quantile(bed.p_WRs[:, 2], 0.85))
    low = np.array([0.0, -0.5 * room.width, margin])
    high = np.array([room.length, 0.5 * room.width, top])
    return material.config.density * calc_packing(bed, material, low, high)


def _make_slotted_floor(room: Bin, opening: float) -> tuple[Slab, Slab]:
    """Return the two halves of a floor with a slot across its middle; thin, so that what is through falls."""
    half = 0.5 * (room.length - opening)
    t = min(THICKNESS, 0.5)
    size = (half + THICKNESS, room.width + 2 * THICKNESS, t)
    middle = 0.5 * (half - THICKNESS)
    return (
        Slab(size, (middle, 0.0, -0.5 * t)),
        Slab(size, (room.length - middle, 0.0, -0.5 * t)),
    )


def _make_hopper(room: Bin, opening: float, lean: float) -> tuple[Slab, Slab]:
    """Return two walls that lean by an angle to the vertical [rad] and leave a slot between their lower edges."""
    long, t = 40.0, 2.0
    steep = 0.5 * np.pi - lean
    slabs = []
    for side in (-1.0, 1.0):
        edge = np.array([0.5 * room.length + side * 0.5 * opening, 0.0, 0.0])
        up = np.array([side * np.cos(steep), 0.0, np.sin(steep)])
        out = np.array([side * np.sin(steep), 0.0, -np.cos(steep)])
        centre = edge + 0.5 * long * up + 0.5 * t * out
        slabs.append(Slab((long, room.width + 2 * THICKNESS, t), tuple(centre), pitch=-side * steep))
    return slabs[0], slabs[1]


def _discharge(
    bed: PileState, scene: Scene, material: Material, make_rig: MakeRig
) -> tuple[float, tuple[Array, Array], PileState]:
    """Return the steady rate [kg/s], the mass that is out [t] over the time [s], and the rocks halfway.

    The rate is 0 where the slot is bridged before the steady part is over.
    """
    rig = make_rig(scene, bed, material)
    masses = material.calc_masses(bed)
    total, look = float(masses.sum()), 0.05
    gone = np.zeros(len(bed), bool)
    times, out = [0.0], [0.0]
    halfway = bed
    while times[-1] < LONGEST and out[-1] < STEADY[1] * total:
        rig.advance(look)
        halfway = rig.get_pile()
        gone |= halfway.p_WRs[:, 2] < OUT
        times.append(times[-1] + look)
        out.append(float(masses[gone].sum()))
    t, m = np.array(times), np.array(out)
    steady = (m > STEADY[0] * total) & (m < STEADY[1] * total)
    done = out[-1] >= STEADY[1] * total and steady.sum() >= 3
    rate = float(np.polyfit(t[steady], m[steady], 1)[0]) if done else 0.0
    return rate, (t, m / 1e3), halfway.select(~gone)
