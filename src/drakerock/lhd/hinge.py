"""What the bucket's hinge carries."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, LeafSystem

from drakerock.lhd.model import Machine


class HingeMoment(LeafSystem):
    """The bending and twisting moment in the bucket's hinge, motor axis excluded, unfiltered (section 5).

    Input ports:
        reaction_forces: the plant's reaction_forces output.
    Output ports:
        moment: (1,) norm of the two components normal to the hinge axis, at the hinge's mid-point [N m].
        components: (2,) moment on the bucket about the x and z axis of the joint's frame on it [N m].
    """

    def __init__(self, plant: MultibodyPlant, machine: Machine) -> None:
        super().__init__()
        self._joint = int(plant.GetJointByName("bucket_joint", machine.instance).index())
        self._forces = self.DeclareAbstractInputPort("reaction_forces", Value([SpatialForce()]))
        self.DeclareVectorOutputPort("moment", 1, self._calc_moment)
        self.DeclareVectorOutputPort("components", 2, self._calc_components)

    def _eval(self, context: Context) -> np.ndarray:
        # The axis is the joint's frame's y axis: `check_machine_file` sees to it.
        force: SpatialForce = self._forces.Eval(context)[self._joint]  # type: ignore[index]
        return force.rotational()[[0, 2]]

    def _calc_moment(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(np.linalg.norm(self._eval(context))))

    def _calc_components(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._eval(context))


def add_hinge_moment(builder: DiagramBuilder, plant: MultibodyPlant, machine: Machine) -> HingeMoment:
    """Add a `HingeMoment` and connect it to the plant."""
    system = HingeMoment(plant, machine)
    builder.AddSystem(system)
    system.set_name("hinge_moment")
    builder.Connect(plant.get_reaction_forces_output_port(), system.GetInputPort("reaction_forces"))
    return system
