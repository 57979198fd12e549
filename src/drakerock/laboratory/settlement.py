"""Drop and settlement: how densely dropped rocks lie, and by how much a load settles them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drakerock.laboratory.beds import (
    THICKNESS,
    Bin,
    MakeRig,
    calc_packing,
    calc_profile,
    make_bin,
    scatter,
    settle,
    take_out,
)
from drakerock.laboratory.config import LabSettings, SettlementSettings
from drakerock.laboratory.interface import make_row
from drakerock.laboratory.material import Material
from drakerock.laboratory.results import Curve, Known, Panel, Row, Specimen, take_snapshot
from drakerock.laboratory.scene import Mover, Scene, Slab
from drakerock.laboratory.theory import PACKING
from drakerock.rocks.state import PileState, make_empty_pile

# Rocks come in so many layers.
LAYERS = 4
# The lid reaches its load within this time, and is then watched for as long [s]; a lid's mass over the bed's.
LOADING, LID_MASS = 0.5, 0.1
# Before it touches, the lid comes down at most so fast [m/s].
LID_SPEED = 0.5


class SettlementTest:
    """Packing by the height of fall; settlement under a lid by stress."""

    name = "settlement"
    title = "Drop and settlement: packing by height of fall, and under load"
    settings = SettlementSettings

    def measure(self, material: Material, settings: LabSettings, seed: int, make_rig: MakeRig) -> Specimen:
        """Drop a bed from each height; load each by a lid."""
        assert isinstance(settings, SettlementSettings)
        room = make_bin(material, settings.rocks, 1.0, 1.0)
        values: dict[str, float] = {}
        curves = {}
        for drop in settings.drops:
            pile = _drop(material, settings.rocks, room, drop, seed, make_rig)
            label = f"{drop:g}"
            margin = 0.35 * material.largest
            high = np.array([room.length, 0.5 * room.width, 0.0]) - margin
            low = np.array([0.0, -0.5 * room.width, 0.0]) + margin
            high[2] = float(np.quantile(pile.p_WRs[:, 2], 0.85))
            values[f"packing_{label}"] = calc_packing(pile, material, low, high)
            strains, stresses, pile = _load(material, room, pile, settings, make_rig)
            for stress, strain in zip(stresses, strains, strict=True):
                values[f"settled_{label}_{stress:g}"] = 100 * strain
            curves[label] = (np.array([0.0, *strains]) * 100, np.array([0.0, *stresses]))
        bench = (*room.make_walls("ae", 0.0), *room.make_walls("f", 0.0))
        return Specimen(values, curves, take_snapshot(pile, bench))

    def evaluate(
        self, specimens: Sequence[Specimen], material: Material, settings: LabSettings
    ) -> tuple[tuple[Row, ...], tuple[Panel, ...]]:
        """Return packing beside that of dumped rockfill, and settlement by stress."""
        assert isinstance(settings, SettlementSettings)
        rows, curves = [], []
        for drop in settings.drops:
            label = f"{drop:g}"
            rows.append(
                make_row(specimens, f"packing_{label}", f"packing, dropped {label} m", "", Known(*PACKING))
            )
            for stress in sorted(settings.stresses_kPa):
                name = f"settled under {stress:g} kPa, dropped {label} m"
                rows.append(make_row(specimens, f"settled_{label}_{stress:g}", name, "%"))
            for number, specimen in enumerate(specimens):
                curves.append(Curve(*specimen.curves[label], f"dropped {label} m" if number == 0 else ""))
        return tuple(rows), (Panel("settled [%]", "stress [kPa]", tuple(curves)),)


def _drop(material: Material, rocks: int, room: Bin, drop: float, seed: int, make_rig: MakeRig) -> PileState:
    """Drop rocks in layers, each from a height over the highest rock there."""
    walls = room.make_walls("flrae", 0.3)
    half = 0.5 * room.width
    pile = make_empty_pile()
    numbers = np.diff(np.linspace(0, rocks, LAYERS + 1).astype(int))
    for layer, number in enumerate(numbers):
        top = float((pile.p_WRs[:, 2] + 0.7 * pile.size).max(initial=0.0))
        falling = scatter(
            material, int(number), (0.0, -half, top + drop), (room.length, half), seed + 7919 * layer
        )
        rig = make_rig(Scene(walls), pile.join(falling), material)
        settle(rig, material)
        pile = take_out(rig.get_pile(), -0.5)
    return pile


def _load(
    material: Material, room: Bin, pile: PileState, settings: SettlementSettings, make_rig: MakeRig
) -> tuple[list[float], list[float], PileState]:
    """Press a lid on the bed with one stress after the other; return strains, stresses [kPa], the rocks.

    Strains are of the bed's mean height, from where the lid rests under a tenth of the least stress.
    """
    x = np.linspace(0.1, 0.9, 12) * room.length
    height = float(calc_profile(pile, material, x, 0.4 * room.width).mean())
    top = float((pile.p_WRs[:, 2] + material.largest).max())
    area = room.length * room.width
    stresses = sorted(settings.stresses_kPa)
    first = 0.1 * 1e3 * stresses[0] * area
    lid = Mover(
        "lid",
        (
            Slab(
                (room.length, room.width, THICKNESS),
                (0.5 * room.length, 0.0, top + 0.5 * THICKNESS),
                friction=0.3,
            ),
        ),
        (0.0, 0.0, 1.0),
        drive="force",
        mass=LID_MASS * float(material.calc_masses(pile).sum()),
        damping=first / LID_SPEED,
    )
    rig = make_rig(Scene(room.make_walls("flrae", 0.3), (lid,)), pile, material)
    way = top - 0.5 * height
    record = settle(rig, material, {"lid": -first}, 2.0 + way / LID_SPEED)
    for _ in range(20):
        if np.ptp(record.travels["lid"]) < 1e-4 * height:
            break
        record = rig.advance(0.25, {"lid": -first})
    start = float(record.travels["lid"][-1])
    load, strains = first, []
    for stress in stresses:
        target = 1e3 * stress * area
        for share in np.linspace(0.0, 1.0, 11)[1:]:
            rig.advance(0.1 * LOADING, {"lid": -(load + share * (target - load))})
        record = rig.advance(LOADING, {"lid": -target})
        strains.append((start - float(record.travels["lid"][-1])) / height)
        load = target
    return strains, stresses, rig.get_pile()
