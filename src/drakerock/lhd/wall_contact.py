"""Where the machine touches the drift's walls, roof or rear wall: with everything but the floor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import GeometryId, SceneGraph
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem

from drakerock.lhd.model import Machine

WALL_CONTACT: dict[str, str] = {"wall_force": "N", "wall_part": "1"}
"""The elements of port ``wall_contact`` with their units: the sum of the forces' magnitudes, and which body of the
machine carries most of it, as its place among the machine's bodies (-1: none)."""

FLOOR = "floor"
"""Name of the drift's floor (`AddDrift`)."""


class WallContact(LeafSystem):
    """Tells how hard the machine leans on the drift.

    Input port ``contact_results``: the plant's.
    Output port ``wall_contact``: the vector of `WALL_CONTACT`.
    """

    def __init__(self, plant: MultibodyPlant, scene_graph: SceneGraph, machine: Machine) -> None:
        """Make it for `machine` in the finalized `plant`; the world's geometry but for its floor is wall."""
        super().__init__()
        self.set_name("wall_contact")
        bodies = plant.GetBodyIndices(machine.instance)
        self._places = {int(index): place for place, index in enumerate(bodies)}
        inspector = scene_graph.model_inspector()
        self._walls = frozenset(
            geometry.get_value()
            for geometry in plant.GetCollisionGeometriesForBody(plant.world_body())
            if inspector.GetName(geometry).split("::")[-1] != FLOOR
        )
        self._contacts = self.DeclareAbstractInputPort("contact_results", Value(ContactResults()))
        self.DeclareVectorOutputPort(
            "wall_contact", len(WALL_CONTACT), self._calc, {self.all_input_ports_ticket()}
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        forces = np.zeros(len(self._places))
        for place, force in self._find_forces(self._contacts.Eval(context)):
            forces[place] += force
        total = float(forces.sum())
        output.SetFromVector([total, float(forces.argmax()) if total > 0.0 else -1.0])

    def _find_forces(self, results: ContactResults) -> Iterator[tuple[int, float]]:
        """Return place of the body and magnitude of each force between machine and wall [N]."""
        for k in range(results.num_point_pair_contacts()):
            contact = results.point_pair_contact_info(k)
            pair = contact.point_pair()
            if self._is_wall(pair.id_A, pair.id_B):
                for body in (contact.bodyA_index(), contact.bodyB_index()):
                    if int(body) in self._places:
                        yield self._places[int(body)], float(np.linalg.norm(contact.contact_force()))
        for k in range(results.num_hydroelastic_contacts()):
            surface = results.hydroelastic_contact_info(k)
            ids = surface.contact_surface().id_M(), surface.contact_surface().id_N()
            if self._is_wall(*ids):
                for body in (surface.bodyA_index(), surface.bodyB_index()):
                    if int(body) in self._places:
                        yield self._places[int(body)], float(np.linalg.norm(surface.F_Ac_W().translational()))

    def _is_wall(self, id_A: GeometryId, id_B: GeometryId) -> bool:
        return id_A.get_value() in self._walls or id_B.get_value() in self._walls


def add_wall_contact(
    builder: DiagramBuilder, plant: MultibodyPlant, scene_graph: SceneGraph, machine: Machine
) -> WallContact:
    """Add a `WallContact` and connect it to the plant."""
    system = builder.AddSystem(WallContact(plant, scene_graph, machine))
    builder.Connect(plant.get_contact_results_output_port(), system.GetInputPort("contact_results"))
    return system
