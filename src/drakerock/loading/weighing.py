"""The machine on a scale: what it carries, from the floor's force on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context

from drakerock.loading.performance import Weighing
from drakerock.loading.station import Station


class Scale:
    """Collects what floor and rocks press on the standing machine with, and weighs it."""

    def __init__(self, station: Station) -> None:
        """Make an empty scale for `station`'s machine."""
        plant = station.plant
        self._station = station
        self._ground = frozenset(plant.GetCollisionGeometriesForBody(plant.world_body()))
        self._own = frozenset(
            geometry
            for index in plant.GetBodyIndices(station.machine.instance)
            for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(index))
        )
        self._bucket_force = station.diagram.GetOutputPort("bucket_force")
        self._floor_forces: list[float] = []
        self._bucket_forces: list[float] = []

    def add(self, root_context: Context) -> None:
        """Read the scale at an instant of the Diagram's context."""
        self._floor_forces.append(self._calc_floor_force(root_context))
        self._bucket_forces.append(-float(self._bucket_force.Eval(root_context)[5]))

    def weigh(self, root_context: Context, masses: NDArray[np.float64], load: NDArray[np.bool_]) -> Weighing:
        """Return the means of what was read; `load` are the rocks that lie in the bucket now, of `masses` [kg]."""
        plant = self._station.plant
        gravity = float(np.linalg.norm(plant.gravity_field().gravity_vector()))
        plant_context = plant.GetMyContextFromRoot(root_context)
        own = plant.CalcTotalMass(plant_context, [self._station.machine.instance])
        return Weighing(
            time_s=root_context.get_time(),
            weight_kg=float(np.mean(self._floor_forces)) / gravity - own,
            on_bucket_kg=float(np.mean(self._bucket_forces)) / gravity,
            counted_kg=float(masses[load].sum()),
        )

    def _calc_floor_force(self, root_context: Context) -> float:
        """Return the site's vertical force on the machine at this instant [N]."""
        plant = self._station.plant
        results = plant.get_contact_results_output_port().Eval(plant.GetMyContextFromRoot(root_context))
        total = 0.0
        for k in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(k)
            pair = info.point_pair()
            if pair.id_B in self._own and pair.id_A in self._ground:
                total += float(info.contact_force()[2])
            elif pair.id_A in self._own and pair.id_B in self._ground:
                total -= float(info.contact_force()[2])
        return total
