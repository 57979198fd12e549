"""Contact forces of rocks in Meshcat."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Meshcat, Rgba
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem

from drakerock.rocks.drake.interface import RockContacts, RockSystem, make_empty_contacts

ROCK_FORCE_COLOR = (0.9, 0.3, 0.1, 1.0)
BODY_FORCE_COLOR = (0.1, 0.4, 0.9, 1.0)


class RockContactVisualizer(LeafSystem):
    """Draws a line per loaded contact, along its force: those between rocks and those on bodies, each in a colour.

    Drake's own `ContactVisualizer` shows the contacts of a plant, which rocks of the nonsmooth engine are not in.

    Input port ``contacts``: abstract, `RockContacts`.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        publish_period: float = 1.0 / 30.0,
        newtons_per_meter: float = 10e3,
        prefix: str = "rock_contacts",
    ) -> None:
        """Make it.

        Args:
            meshcat: where to draw.
            publish_period: between two drawings [s]; each solves the coming step once more.
            newtons_per_meter: force that a line of 1 m stands for [N/m].
            prefix: path in Meshcat; lines are in ``prefix/rocks`` and ``prefix/bodies``.
        """
        super().__init__()
        self.set_name("rock_contact_visualizer")
        self._meshcat = meshcat
        self._newtons_per_meter = newtons_per_meter
        self._prefix = prefix
        self._contacts = self.DeclareAbstractInputPort("contacts", Value[object](make_empty_contacts()))
        self.DeclarePeriodicPublishEvent(publish_period, 0.0, self._draw)
        self.DeclareForcedPublishEvent(self._draw)

    @classmethod
    def AddToBuilder(
        cls,
        builder: DiagramBuilder,
        rocks: RockSystem,
        meshcat: Meshcat,
        publish_period: float = 1.0 / 30.0,
        newtons_per_meter: float = 10e3,
        prefix: str = "rock_contacts",
    ) -> Self:
        """Add one to a Diagram and connect it with its rocks; arguments as for the class."""
        visualizer = builder.AddSystem(cls(meshcat, publish_period, newtons_per_meter, prefix))
        builder.Connect(rocks.GetOutputPort("contacts"), visualizer.GetInputPort("contacts"))
        return visualizer

    def _draw(self, context: Context) -> None:
        contacts: RockContacts = self._contacts.Eval(context)
        reach = contacts.f_WCs / self._newtons_per_meter
        for name, drawn, color in (
            ("rocks", contacts.other >= 0, ROCK_FORCE_COLOR),
            ("bodies", contacts.other < 0, BODY_FORCE_COLOR),
        ):
            start = contacts.p_WCs[drawn]
            self._meshcat.SetLineSegments(
                f"{self._prefix}/{name}",
                np.asfortranarray(start.T),
                np.asfortranarray((start + reach[drawn]).T),
                rgba=Rgba(*color),
            )
