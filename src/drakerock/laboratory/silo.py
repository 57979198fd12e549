"""A silo whose floor is let down a little, so that its walls carry what they can."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drakerock.laboratory.beds import MakeRig, calc_profile, fill_bin, make_bin, settle
from drakerock.laboratory.config import LabSettings, SiloSettings
from drakerock.laboratory.interface import make_rows
from drakerock.laboratory.material import Material
from drakerock.laboratory.results import Curve, Known, Panel, Row, Specimen, take_snapshot
from drakerock.laboratory.scene import Mover, Scene
from drakerock.laboratory.theory import JANSSEN_K, calc_janssen_share, fit_janssen_k
from drakerock.rocks.config import GRAVITY

# The floor is let down so fast and so far [m/s, mean size].
SPEED, WAY = 0.02, 0.06


class SiloTest:
    """The share of the weight on the floor, and the lateral stress that Janssen's law makes of it."""

    name = "silo"
    title = "Silo: what its floor carries"
    settings = SiloSettings

    def measure(self, material: Material, settings: LabSettings, seed: int, make_rig: MakeRig) -> Specimen:
        """Fill a silo, let its floor down, weigh what is on it."""
        assert isinstance(settings, SiloSettings)
        room = make_bin(material, settings.rocks, 1.0 / settings.slenderness, 1.0 / settings.slenderness)
        walls = room.make_walls("lrae", settings.wall_friction, top=80.0)
        floor = Mover("floor", room.make_walls("f", 0.0), (0.0, 0.0, -1.0))
        rig = make_rig(Scene(walls, (floor,)), fill_bin(material, settings.rocks, room, seed), material)
        settle(rig, material)
        record = rig.advance(WAY * material.mean_size / SPEED, {"floor": SPEED})
        pile = rig.get_pile()
        weight = GRAVITY * float(material.calc_masses(pile).sum())
        x = np.linspace(0.2, 0.8, 9) * room.length
        level = float(calc_profile(pile, material, x, 0.3 * room.width).mean())
        height = level + float(record.travels["floor"][-1])
        shares = -record.forces["floor"][:, 2] / weight
        share = float(shares[len(shares) // 2 :].mean())
        section = room.length * room.width, 2 * (room.length + room.width)
        k = fit_janssen_k(share, height, *section, settings.wall_friction)
        law = calc_janssen_share(height, *section, settings.wall_friction, 0.52)
        return Specimen(
            {
                "share": share,
                "k": k,
                "height": height / room.width,
                "law": law,
            },
            {"share": (1e3 * record.travels["floor"], shares)},
            take_snapshot(pile, (*walls, *floor.slabs)),
        )

    def evaluate(
        self, specimens: Sequence[Specimen], material: Material, settings: LabSettings
    ) -> tuple[tuple[Row, ...], tuple[Panel, ...]]:
        """Return what the floor carries beside Janssen's law."""
        names = {
            "height": ("height over width", ""),
            "share": ("share of the weight on the floor, let down", ""),
            "k": ("lateral over vertical stress (Janssen)", ""),
        }
        law = float(np.mean([specimen.values["law"] for specimen in specimens]))
        known = {
            "share": Known(0.85 * law, 1.15 * law, "Janssen with k = 0.52, within 15 %"),
            "k": Known(*JANSSEN_K),
        }
        curves = [Curve(*one.curves["share"], f"specimen {k + 1}") for k, one in enumerate(specimens)]
        way = specimens[0].curves["share"][0]
        curves.append(Curve(way[[0, -1]], np.array([law, law]), "Janssen", "dashed"))
        panel = Panel("floor down [mm]", "share of the weight on it", tuple(curves))
        return make_rows(specimens, names, known), (panel,)
