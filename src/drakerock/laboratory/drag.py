"""Drag: a vertical blade as wide as the bed, drawn through it at a constant depth."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drakerock.errors import InputError
from drakerock.laboratory.beds import (
    LEAST_WIDTH,
    PACKING,
    THICKNESS,
    Bin,
    MakeRig,
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
from drakerock.laboratory.theory import FEE_RESIDUAL, calc_blade_force, calc_curved_blade_force
from drakerock.rocks.config import GRAVITY

Array = NDArray[np.float64]

# Of the blade, and its edge's gap over the floor [mean size]: rocks that fit under it would jam.
BLADE, UNDER = 0.2, 0.06
# Before the blade's last place there is so much of the bed [depth]: a wedge against a rough blade is three to four
# long, and one that reaches the bed's end is jammed.
AHEAD = 6.0
# The force is taken after this share of the travel; forces are means over so many slices of it.
STARTED, SLICES = 0.25, 6
# Of the surface that the curved slip comes out of [m].
CELL = 0.02
# The shear test that is made for the prediction's friction angle: stresses [kPa], about those in the wedge and above.
SHEAR = ShearSettings(repeats=1, stresses_kPa=(25.0, 50.0))


@dataclass(frozen=True, eq=False)
class _Drag:
    """A drag: forces on the blade, and what they are predicted from, over slices of its travel (k,).

    Attributes:
        force, lift: on the blade against its way, and upwards [N].
        places: of the slices' middles [m].
        heaps: volume heaped up before the blade [m^3].
        surfaces: heights over the blade's edge from the blade on, at steps of CELL [m].
        cut, width: of the blade in the bed [m].
        weight: of the bed [N/m^3].
        x, curve: travel [m] and force [N], step by step.
        snapshot: how it looked.
    """

    force: Array
    lift: Array
    places: Array
    heaps: Array
    surfaces: tuple[Array, ...]
    cut: float
    width: float
    weight: float
    x: Array
    curve: Array
    snapshot: Snapshot

    def predict(self, angle: float, wall: float) -> Array:
        """Return the force by the earth-moving equation (k,) [N] from both friction angles [rad]."""
        return np.array(
            [
                calc_blade_force(self.cut, self.width, self.weight, self.weight * heap, angle, wall)
                for heap in self.heaps
            ]
        )

    def predict_curved(self, angle: float, wall: float) -> Array:
        """Return the force by a curved slip surface (k,) [N] from both friction angles [rad]."""
        return self.width * np.array(
            [
                calc_curved_blade_force(np.arange(len(h), dtype=float) * CELL, h, self.weight, angle, wall)
                for h in self.surfaces
            ]
        )


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
            # A wedge is sheared far beyond its peak.
            angle = shear.values[f"end_{min(SHEAR.stresses_kPa):g}"]
        values: dict[str, float] = {"angle": angle}
        curves: dict[str, tuple[Array, Array]] = {}
        errors: dict[str, list[Array]] = {"residual": [], "mobilised_residual": [], "curved_residual": []}
        last: Snapshot | None = None
        for ratio in settings.depths:
            drag = _drag(material, settings, ratio * material.mean_size, seed, make_rig)
            label, last = f"{ratio:g}", drag.snapshot
            friction, given = np.deg2rad(angle), float(np.arctan(settings.blade_friction))
            found = max(float(np.arctan2(drag.lift.mean(), drag.force.mean())), 0.0)
            predictions = {
                "residual": drag.predict(friction, given),
                "mobilised_residual": drag.predict(friction, found),
                "curved_residual": drag.predict_curved(friction, found),
            }
            values |= {
                f"force_{label}": float(drag.force.mean()) / 1e3,
                f"predicted_{label}": float(predictions["residual"].mean()) / 1e3,
                f"mobilised_{label}": float(predictions["mobilised_residual"].mean()) / 1e3,
                f"curved_{label}": float(predictions["curved_residual"].mean()) / 1e3,
                f"wall_{label}": float(np.tan(found)),
                f"heap_{label}": float(drag.heaps.mean()),
            }
            for key, predicted in predictions.items():
                errors[key].append((drag.force - predicted) / drag.force.mean())
            curves[f"force_{label}"] = (drag.x, drag.curve / 1e3)
            curves[f"predicted_{label}"] = (drag.places, predictions["residual"] / 1e3)
        for key, parts in errors.items():
            values[key] = 100 * float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
            values[key.replace("residual", "bias")] = 100 * float(np.mean(np.concatenate(parts)))
        return Specimen(values, curves, last)

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
            rows.append(
                make_row(specimens, f"predicted_{label}", "... predicted from the blade's friction", "kN")
            )
            rows.append(
                make_row(
                    specimens, f"wall_{label}", "... blade's friction that is mobilised (lift over force)", ""
                )
            )
            rows.append(make_row(specimens, f"mobilised_{label}", "... predicted from that", "kN"))
            rows.append(make_row(specimens, f"curved_{label}", "... and with a curved slip surface", "kN"))
            rows.append(make_row(specimens, f"heap_{label}", "... heap before the blade", "m3"))
            for number, specimen in enumerate(specimens):
                shown = f"{label} deep" if number == 0 else ""
                curves.append(Curve(*specimen.curves[f"force_{label}"], shown))
            x, y = (
                np.mean([one.curves[f"predicted_{label}"][k] for one in specimens], axis=0) for k in (0, 1)
            )
            curves.append(Curve(x, y, f"{label} deep, predicted", "dashed"))
        known = Known(*FEE_RESIDUAL)
        for key, name in (
            ("", "from the blade's friction"),
            ("mobilised_", "from the mobilised friction"),
            ("curved_", "from that and a curved slip surface"),
        ):
            rows.append(make_row(specimens, f"{key}residual", f"residual, rms, {name}", "%", known))
            rows.append(make_row(specimens, f"{key}bias", "... measured less predicted, mean", "%"))
        return tuple(rows), (Panel("travel [m]", "force [kN]", tuple(curves)),)


def _drag(material: Material, settings: DragSettings, depth: float, seed: int, make_rig: MakeRig) -> _Drag:
    """Drag a blade through a bed at a depth [m]."""
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
    # By the surface that is seen, as all weights are.
    bed_mass = float(material.calc_masses(bed).sum())
    weight = GRAVITY * bed_mass / (room.length * room.width * float(before.mean()))
    records, heaps, profiles = [], [], []
    for _ in range(2 * SLICES):
        records.append(rig.advance(travel / settings.speed / (2 * SLICES), {"blade": settings.speed}))
        at = float(records[-1].travels["blade"][-1])
        now = calc_profile(rig.get_pile(), material, ahead, 0.45 * room.width)
        profiles.append(now)
        front = ahead > at
        raised = float(
            np.maximum(now - surface, 0.0)[front].sum() - np.maximum(before - surface, 0.0)[front].sum()
        )
        heaps.append(max(raised, 0.0) * 0.25 * d * room.width)
    x = np.concatenate([record.travels["blade"] for record in records])
    forces = np.concatenate([record.forces["blade"] for record in records])
    edges = travel * (STARTED + (1 - STARTED) * np.linspace(0, 1, SLICES + 1))
    means = np.array([forces[(x > a) & (x <= b)].mean(axis=0) for a, b in itertools.pairwise(edges)])
    middles = 0.5 * (edges[1:] + edges[:-1])
    places = travel * (np.arange(2 * SLICES) + 1) / (2 * SLICES)
    surfaces = []
    for middle in middles:
        profile = np.array([np.interp(middle, places, column) for column in np.array(profiles).T])
        surfaces.append(_find_surface(ahead - middle, profile - edge, d))
    moved = take_snapshot(rig.get_pile(), (blade,), (float(x[-1]), 0.0, 0.0))
    still = take_snapshot(rig.get_pile(), walls)
    return _Drag(
        -means[:, 0], means[:, 2], middles, np.interp(middles, places, heaps), tuple(surfaces), cut, room.width,
        weight, x, -forces[:, 0], Snapshot(moved.pile, still.slabs + moved.slabs),
    )  # fmt: skip


def _find_surface(x: Array, h: Array, size: float) -> Array:
    """Return heights from the blade on at steps of CELL; at the blade, where rocks lean on it, the mean over a size."""
    fine = np.arange(0.0, float(x[-1]), CELL)
    surface = np.maximum(np.interp(fine, x, h), CELL)
    surface[0] = surface[fine < size].mean()
    return surface


def _make_bed(material: Material, rocks: int, length: float, height: float) -> Bin:
    """Return a bed of a length and a height, as wide as its rocks make it; InputError if that is too narrow."""
    width = rocks * material.mean_volume / (PACKING * length * height)
    if width < LEAST_WIDTH * material.largest:
        raise InputError("rocks: too few for this depth and travel; raise rocks, or lower travel or depths")
    return Bin(length, width, height)
