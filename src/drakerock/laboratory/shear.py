"""Triaxial compression: a specimen between six smooth platens, without gravity, squeezed at constant lateral stress."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drakerock.laboratory.beds import LOOSE, PACKING, THICKNESS, MakeRig, make_bin, scatter, settle
from drakerock.laboratory.config import LabSettings, ShearSettings
from drakerock.laboratory.interface import make_row
from drakerock.laboratory.material import Material
from drakerock.laboratory.results import Curve, Known, Panel, Row, Specimen, take_snapshot
from drakerock.laboratory.scene import Drive, Mover, Scene, Slab
from drakerock.laboratory.theory import (
    calc_dilation,
    calc_rockfill_friction,
    calc_triaxial_friction,
    fit_mohr_coulomb,
)
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]

AXES = ("x", "y", "z")
# Platens that squeeze come at most so fast [m/s]; of their mass and the specimen's.
CLOSING_SPEED, PLATEN_MASS = 1.0, 0.2
# The elastic slope is taken while the first of the strain goes slowly [strain, share of the rate], up to this share of
# the greatest stress difference.
SLOW_STRAIN, SLOW_SHARE, ELASTIC_SHARE = 0.004, 0.2, 0.4
# Curves are smoothed over so many steps; peak and end are means over this strain.
SMOOTH, END_STRAIN = 9, 0.03


class ShearTest:
    """Friction angle, dilation and elastic slope."""

    name = "shear"
    title = "Triaxial compression: friction angle, dilation, elastic slope"
    settings = ShearSettings

    def measure(self, material: Material, settings: LabSettings, seed: int, make_rig: MakeRig) -> Specimen:
        """Squeeze the rocks together, then test them at each stress, from states of the same specimen."""
        assert isinstance(settings, ShearSettings)
        make_bin(material, settings.rocks, 1.0, 1.0)  # as narrow as the specimen: refused if too narrow
        side = (settings.rocks * material.mean_volume / LOOSE) ** (1.0 / 3.0)
        pile = scatter(material, settings.rocks, (0.0, 0.0, 0.0), (side, side), seed)
        spans = np.full(3, side)
        spans[2] = float((pile.p_WRs[:, 2] + material.largest).max())
        slippery = replace(
            material,
            config=material.config.replace(friction=settings.filling_friction * material.config.friction),
        )
        values: dict[str, float] = {}
        curves: dict[str, tuple[Array, Array]] = {}
        axial = []
        stresses = 1e3 * np.array(sorted(settings.stresses_kPa))
        for stress in stresses:
            pile, spans = _compress(pile, spans, stress, slippery, make_rig)
            found, curve, end = _shear(pile, spans, stress, material, settings, make_rig)
            label = f"{stress / 1e3:g}"
            values |= {f"{key}_{label}": value for key, value in found.items()}
            curves |= {f"{key}_{label}": value for key, value in curve.items()}
            lateral = found["lateral"]
            sine = np.sin(np.deg2rad(found["peak"]))
            axial.append((lateral, lateral * (1 + sine) / (1 - sine)))
        pairs = np.array(axial)
        angle, cohesion = fit_mohr_coulomb(pairs[:, 1], pairs[:, 0])
        values |= {"friction": float(np.rad2deg(angle)), "cohesion": cohesion / 1e3}
        return Specimen(values, curves, take_snapshot(end, ()))

    def evaluate(
        self, specimens: Sequence[Specimen], material: Material, settings: LabSettings
    ) -> tuple[tuple[Row, ...], tuple[Panel, ...]]:
        """Return the angles by stress beside those of rockfill."""
        assert isinstance(settings, ShearSettings)
        rows, curves, volumes = [], [], []
        for stress in sorted(settings.stresses_kPa):
            label = f"{stress:g}"
            low, high = np.rad2deg(calc_rockfill_friction(1e3 * stress))
            rockfill = Known(float(low), float(high), "rockfill at that stress (Barton and Kjaernsli 1981)")
            for key, name, unit, known in (
                ("peak", "friction angle, peak", "deg", rockfill),
                ("end", "friction angle, end", "deg", None),
                ("dilation", "dilation angle", "deg", None),
                ("bolton", "peak less end, over dilation", "", Known(0.5, 1.1, "Bolton 1986: 0.8 for sands")),
                ("modulus", "elastic slope", "MPa", None),
                ("packing", "packing before", "", None),
            ):
                rows.append(make_row(specimens, f"{key}_{label}", f"{name}, {label} kPa", unit, known))
            for number, specimen in enumerate(specimens):
                shown = f"{label} kPa" if number == 0 else ""
                curves.append(Curve(*specimen.curves[f"stress_{label}"], shown))
                volumes.append(Curve(*specimen.curves[f"volume_{label}"], shown))
        rows.append(make_row(specimens, "friction", "Mohr-Coulomb, friction angle", "deg"))
        rows.append(make_row(specimens, "cohesion", "Mohr-Coulomb, cohesion", "kPa"))
        panels = (
            Panel("axial strain [%]", "axial over lateral stress", tuple(curves)),
            Panel("axial strain [%]", "swelling [%]", tuple(volumes)),
        )
        return tuple(rows), panels


def _make_platens(spans: Array, drives: Mapping[str, str], mass: float, damping: float) -> Scene:
    """Return three platens at rest at x, y, z = 0 and three at the far sides, driven along their axes."""
    t = THICKNESS
    wide = float(spans.max()) + 2 * t
    slabs, movers = [], []
    for k, axis in enumerate(AXES):
        size = [wide, wide, wide]
        size[k] = t
        at = 0.5 * spans
        near, far = at.copy(), at.copy()
        near[k], far[k] = -0.5 * t, spans[k] + 0.5 * t
        unit = (float(k == 0), float(k == 1), float(k == 2))
        shape = (size[0], size[1], size[2])
        slabs.append(Slab(shape, tuple(near), friction=0.0))
        far_slab = Slab(shape, tuple(far), friction=0.0)
        if drives[axis] == "speed":
            movers.append(Mover(axis, (far_slab,), unit))
        else:
            movers.append(Mover(axis, (far_slab,), unit, drive="force", mass=mass, damping=damping))
    return Scene(tuple(slabs), tuple(movers), gravity=False, floor=-50.0)


def _compress(
    pile: PileState, spans: Array, stress: float, material: Material, make_rig: MakeRig
) -> tuple[PileState, Array]:
    """Squeeze from all sides until rest; return the rocks and the platens' distances (3,) [m]."""
    volume = float(material.calc_volumes(pile).sum())
    area = (volume / PACKING) ** (2.0 / 3.0)
    damping = stress * area / CLOSING_SPEED
    scene = _make_platens(
        spans, dict.fromkeys(AXES, "force"), PLATEN_MASS * volume * material.config.density, damping
    )
    rig = make_rig(scene, pile, material)

    def drive(travels: Mapping[str, float]) -> dict[str, float]:
        sides = spans + np.array([travels[axis] for axis in AXES])
        # The full stress from the section on that the specimen will have: before, rocks hardly touch.
        return {axis: -stress * min(np.prod(sides) / sides[k], area) for k, axis in enumerate(AXES)}

    record = rig.advance(1.0, drive)
    for _ in range(24):
        record = rig.advance(0.25, drive)
        moved = [abs(record.travels[axis][-1] - record.travels[axis][0]) for axis in AXES]
        if max(moved) < 1e-3 * float(spans.min()) * 0.25:
            break
    settle(rig, material, drive, 1.0)
    pile = rig.get_pile()
    ways = np.array([rig.advance(material.dynamics.time_step, drive).travels[axis][-1] for axis in AXES])
    return replace(pile, contacts=None, V_WRs=np.zeros((len(pile), 6))), spans + ways


def _shear(
    pile: PileState,
    spans: Array,
    stress: float,
    material: Material,
    settings: ShearSettings,
    make_rig: MakeRig,
) -> tuple[dict[str, float], dict[str, tuple[Array, Array]], PileState]:
    """Press the z platen down at the strain rate with the stress on the others; return values, curves, the rocks."""
    volume = float(material.calc_volumes(pile).sum())
    # Platens that are pushed out are damped by a hundredth of what would hold them at the strain rate.
    damping = 0.01 * stress * float(spans[0]) / settings.strain_rate
    drives = {"x": "force", "y": "force", "z": "speed"}
    scene = _make_platens(spans, drives, PLATEN_MASS * volume * material.config.density, damping)
    rig = make_rig(scene, pile, material)
    speed = settings.strain_rate * float(spans[2])

    def drive_at(share: float) -> Drive:
        def drive(travels: Mapping[str, float]) -> dict[str, float]:
            sides = spans + np.array([travels[axis] for axis in AXES])
            return {
                "x": -stress * sides[1] * sides[2],
                "y": -stress * sides[0] * sides[2],
                "z": -share * speed,
            }

        return drive

    rig.advance(0.3, drive_at(0.0))
    duration = settings.strain / settings.strain_rate
    records = [
        rig.advance(SLOW_STRAIN / settings.strain_rate / SLOW_SHARE, drive_at(SLOW_SHARE)),
        rig.advance(duration, drive_at(1.0)),
    ]
    sides = np.column_stack(
        [spans[k] + np.concatenate([r.travels[axis] for r in records]) for k, axis in enumerate(AXES)]
    )
    loads = np.column_stack(
        [np.concatenate([r.forces[axis][:, k] for r in records]) for k, axis in enumerate(AXES)]
    )
    stresses = loads * sides / np.prod(sides, axis=1)[:, None]
    kernel = np.full(SMOOTH, 1.0 / SMOOTH)
    axial, lateral = (
        np.convolve(one, kernel, mode="valid") for one in (stresses[:, 2], stresses[:, :2].mean(axis=1))
    )
    cut = slice(SMOOTH // 2, SMOOTH // 2 + len(axial))
    strain = 1.0 - sides[cut, 2] / spans[2]
    swelling = np.prod(sides[cut], axis=1) / np.prod(spans) - 1.0
    return (
        _read_curves(strain, axial, lateral, swelling, volume / float(np.prod(spans))),
        {"stress": (100 * strain, axial / lateral), "volume": (100 * strain, 100 * swelling)},
        rig.get_pile(),
    )


def _read_curves(
    strain: Array, axial: Array, lateral: Array, swelling: Array, packing: float
) -> dict[str, float]:
    """Return angles [deg], elastic slope [MPa], lateral stress [Pa] and packing from curves over the strain (k,)."""
    friction = np.rad2deg(calc_triaxial_friction(axial, lateral))
    late = strain > strain[-1] - END_STRAIN
    # The peak as the greatest mean over a window of strain.
    window = max(int(0.5 * END_STRAIN / max(float(np.diff(strain).mean()), 1e-9)), 1)
    means = np.convolve(friction, np.full(window, 1.0 / window), mode="valid")
    at = int(np.argmax(means))
    near = slice(at, at + window)
    peak, end = float(means[at]), float(friction[late].mean())
    # Dilation about the peak, over a window wide enough for a slope.
    wide = np.abs(strain - strain[near].mean()) < END_STRAIN
    rate = -np.polyfit(strain[wide], swelling[wide], 1)[0]
    dilation = float(np.rad2deg(calc_dilation(float(rate))))
    difference = axial - lateral
    first = int(np.argmax(difference >= ELASTIC_SHARE * difference.max()))
    slope = float("nan")
    if first >= 3:
        slope = float(np.polyfit(strain[:first], difference[:first], 1)[0]) / 1e6
    return {
        "peak": peak,
        "end": end,
        "dilation": dilation,
        "bolton": (peak - end) / dilation if dilation > 1.0 else float("nan"),
        "modulus": slope,
        "packing": packing,
        "lateral": float(lateral[near].mean()),
    }
