"""Drag: a vertical blade as wide as the bed, drawn through it at a constant depth."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drakerock.errors import InputError
from drakerock.laboratory.beds import (
    LEAST_WIDTH,
    PACKING,
    THICKNESS,
    Bin,
    MakeRig,
    calc_packing,
    calc_profile,
    fill_bin,
    settle,
)
from drakerock.laboratory.config import DragSettings, LabSettings, ShearSettings
from drakerock.laboratory.interface import make_row
from drakerock.laboratory.material import Material
from drakerock.laboratory.results import Curve, Known, Panel, Row, Snapshot, Specimen, take_snapshot
from drakerock.laboratory.scene import Mover, Scene, Slab
from drakerock.laboratory.shear import ShearTest
from drakerock.laboratory.theory import FEE_RESIDUAL, calc_blade_force
from drakerock.rocks.config import GRAVITY

Array = NDArray[np.float64]

# Of the blade, and its edge's gap over the floor [mean size]: rocks that fit under it would jam.
BLADE, UNDER = 0.2, 0.06
# Before the blade's last place there is so much of the bed, for the wedge [depth].
AHEAD = 3.0
# The force is taken after this share of the travel; forces are means over so many slices of it.
STARTED, SLICES = 0.25, 6
# The shear test that is made for the prediction's friction angle: stresses [kPa], about those in the wedge and above.
SHEAR = ShearSettings(repeats=1, stresses_kPa=(25.0, 50.0))


class DragTest:
    """Force on the blade, and what the fundamental earth-moving equation predicts from the shear test's angle."""

    name = "drag"
    title = "Drag of a blade through a bed, against the fundamental earth-moving equation"
    settings = DragSettings

    def measure(self, material: Material, settings: LabSettings, seed: int, make_rig: MakeRig) -> Specimen:
        """Drag the blade at each depth through a bed of its own; predict the force from the heap before it."""
        assert isinstance(settings, DragSettings)
        angle = settings.friction_angle_deg
        if angle is None:
            shear = ShearTest().measure(
                material, SHEAR.replace(rocks=min(settings.rocks, 250)), seed, make_rig
            )
            angle = shear.values[f"peak_{min(SHEAR.stresses_kPa):g}"]
        values: dict[str, float] = {"angle": angle}
        curves: dict[str, tuple[Array, Array]] = {}
        errors = []
        for ratio in settings.depths:
            found, last = self._drag(material, settings, ratio * material.mean_size, angle, seed, make_rig)
            label = f"{ratio:g}"
            measured, predicted, x, force, heaped = found
            values |= {
                f"force_{label}": float(measured.mean()) / 1e3,
                f"predicted_{label}": float(predicted.mean()) / 1e3,
                f"heap_{label}": float(heaped.mean()),
            }
            errors.append((measured - predicted) / measured.mean())
            curves[f"force_{label}"] = (x, force / 1e3)
            middle = x[-1] * (STARTED + (1 - STARTED) * (np.arange(SLICES) + 0.5) / SLICES)
            curves[f"predicted_{label}"] = (middle, predicted / 1e3)
        values["residual"] = 100 * float(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
        values["bias"] = 100 * float(np.mean(np.concatenate(errors)))
        return Specimen(values, curves, last)

    def _drag(
        self,
        material: Material,
        settings: DragSettings,
        depth: float,
        angle: float,
        seed: int,
        make_rig: MakeRig,
    ) -> tuple[tuple[Array, Array, Array, Array, Array], Snapshot]:
        d = material.mean_size
        travel = settings.travel * depth
        room = _make_bed(material, settings.rocks, travel + AHEAD * depth, depth + UNDER * d)
        level, tall = room.height, 40.0
        thick, edge = BLADE * d, level - depth
        # The bed ends at the blade.
        step = Slab((THICKNESS, room.width, THICKNESS), (-0.5 * THICKNESS, 0.0, edge - 0.5 * THICKNESS))
        walls = (*room.make_walls("flre", 0.0), step)
        blade = Slab(
            (thick, room.width, tall),
            (-0.5 * thick, 0.0, edge + 0.5 * tall),
            friction=settings.blade_friction,
        )
        mover = Mover("blade", (blade,), (1.0, 0.0, 0.0))
        rig = make_rig(Scene(walls, (mover,)), fill_bin(material, settings.rocks, room, seed), material)
        settle(rig, material)
        bed = rig.get_pile()
        ahead = np.arange(0.0, room.length, 0.25 * d)
        before = calc_profile(bed, material, ahead, 0.45 * room.width)
        # The level that rocks really have before the blade, and so the depth.
        surface = float(before[(ahead > 0.5 * d) & (ahead < travel + depth)].mean())
        cut = surface - edge
        density = material.config.density * calc_packing(
            bed, material,
            np.array([0.0, -0.5 * room.width, 0.3 * d]),
            np.array([room.length, 0.5 * room.width, max(surface - 0.7 * d, d)]),
        )  # fmt: skip
        records, heaps = [], []
        for _ in range(2 * SLICES):
            records.append(rig.advance(travel / settings.speed / (2 * SLICES), {"blade": settings.speed}))
            at = float(records[-1].travels["blade"][-1])
            now = calc_profile(rig.get_pile(), material, ahead, 0.45 * room.width)
            front = ahead > at
            raised = float(
                np.maximum(now - surface, 0.0)[front].sum() - np.maximum(before - surface, 0.0)[front].sum()
            )
            heaps.append(max(raised, 0.0) * 0.25 * d * room.width)
        x = np.concatenate([record.travels["blade"] for record in records])
        force = -np.concatenate([record.forces["blade"][:, 0] for record in records])
        edges = travel * (STARTED + (1 - STARTED) * np.linspace(0, 1, SLICES + 1))
        measured = np.array([force[(x > a) & (x <= b)].mean() for a, b in itertools.pairwise(edges)])
        places = travel * (np.arange(2 * SLICES) + 1) / (2 * SLICES)
        heaped = np.interp(0.5 * (edges[1:] + edges[:-1]), places, heaps)
        weight = density * GRAVITY
        wall = float(np.arctan(settings.blade_friction))
        predicted = np.array(
            [
                calc_blade_force(cut, room.width, weight, weight * heap, np.deg2rad(angle), wall)
                for heap in heaped
            ]
        )
        moved = take_snapshot(rig.get_pile(), (blade,), (float(x[-1]), 0.0, 0.0))
        still = take_snapshot(rig.get_pile(), walls)
        snapshot = Snapshot(moved.pile, still.slabs + moved.slabs)
        return (measured, predicted, x, force, heaped), snapshot

    def evaluate(
        self, specimens: Sequence[Specimen], material: Material, settings: LabSettings
    ) -> tuple[tuple[Row, ...], tuple[Panel, ...]]:
        """Return measured and predicted forces and the prediction's residual."""
        assert isinstance(settings, DragSettings)
        source = "the prediction takes it" if settings.friction_angle_deg else "of the shear test made first"
        rows = [make_row(specimens, "angle", f"friction angle, {source}", "deg")]
        curves = []
        for ratio in settings.depths:
            label = f"{ratio:g}"
            rows.append(make_row(specimens, f"force_{label}", f"force, {label} mean sizes deep", "kN", None))
            rows.append(make_row(specimens, f"predicted_{label}", "... predicted", "kN"))
            rows.append(make_row(specimens, f"heap_{label}", "... heap before the blade", "m3"))
            for number, specimen in enumerate(specimens):
                shown = f"{label} deep" if number == 0 else ""
                curves.append(Curve(*specimen.curves[f"force_{label}"], shown))
            x, y = (
                np.mean([one.curves[f"predicted_{label}"][k] for one in specimens], axis=0) for k in (0, 1)
            )
            curves.append(Curve(x, y, f"{label} deep, predicted", "dashed"))
        rows.append(make_row(specimens, "residual", "prediction's residual, rms", "%", Known(*FEE_RESIDUAL)))
        rows.append(make_row(specimens, "bias", "... measured less predicted, mean", "%"))
        return tuple(rows), (Panel("travel [m]", "force [kN]", tuple(curves)),)


def _make_bed(material: Material, rocks: int, length: float, height: float) -> Bin:
    """Return a bed of a length and a height, as wide as its rocks make it; InputError if that is too narrow."""
    width = rocks * material.mean_volume / (PACKING * length * height)
    if width < LEAST_WIDTH * material.largest:
        raise InputError("rocks: too few for this depth and travel; raise rocks, or lower travel or depths")
    return Bin(length, width, height)
