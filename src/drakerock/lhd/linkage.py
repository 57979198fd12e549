"""The closed loops behind boom, bucket and articulation: closing and measuring them.

In a machine's reference pose (level on the floor, straight, the bucket level on the floor) every passive
joint (cylinders, rods, cranks) is at 0 and the loops are closed; from there they are followed step by step.
"""

from __future__ import annotations

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, Joint, ModelInstanceIndex
from pydrake.systems.framework import Context

from drakerock.lhd import names
from drakerock.lhd.model_file import Loop

Array = np.ndarray

# Newton stops at a closure error of 1 micrometre; continuation moves by at most this many radians a step.
_TOLERANCE = 1e-6
_MAX_ITERATIONS = 12
_MAX_STEP = 0.15


def find_passive_joints(plant: MultibodyPlant, instance: ModelInstanceIndex) -> list[Joint]:
    """Return the machine's joints of one degree of freedom that no motor drives."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices(instance)]
    return [joint for joint in joints if joint.num_velocities() == 1 and joint.name() not in names.JOINTS]


class Linkage:
    """Closes the loops of a machine in a plant's context, from the reference pose by continuation.

    Args:
        plant: the finalized plant.
        context: a context of it; positions of the machine's joints are read and written.
        instance: the machine.
        loops: its loops.
    """

    def __init__(
        self, plant: MultibodyPlant, context: Context, instance: ModelInstanceIndex, loops: tuple[Loop, ...]
    ) -> None:
        self._plant, self._context = plant, context
        passive = find_passive_joints(plant, instance)
        driven = [plant.GetJointByName(name, instance) for name in names.JOINTS[:3]]
        self._passive = [joint.position_start() for joint in passive]
        self._columns = [joint.velocity_start() for joint in passive]
        self._driven = [joint.position_start() for joint in driven]
        self._limited = self._passive + self._driven
        self._lower = plant.GetPositionLowerLimits()[self._limited]
        self._upper = plant.GetPositionUpperLimits()[self._limited]
        self._points = [
            (plant.GetFrameByName(body, instance), np.array(p))
            for loop in loops
            for body, p in ((loop.body_A, loop.p_AP), (loop.body_B, loop.p_BQ))
        ]

    def reset(self, phi_l: float, phi_b: float) -> None:
        """Go to the reference pose, whose boom and bucket angles [rad] are given."""
        q = self._plant.GetPositions(self._context).copy()
        q[self._passive] = 0.0
        q[self._driven] = 0.0, phi_l, phi_b
        self._plant.SetPositions(self._context, q)

    def move(self, articulation: float, phi_l: float, phi_b: float) -> bool:
        """Move to these angles [rad] with the loops closed; False where they can't be (nothing is moved then)."""
        before = self._plant.GetPositions(self._context).copy()
        start = before[self._driven]
        target = np.array([articulation, phi_l, phi_b])
        steps = max(1, int(np.ceil(np.abs(target - start).max() / _MAX_STEP)))
        for k in range(1, steps + 1):
            q = self._plant.GetPositions(self._context).copy()
            q[self._driven] = start + (target - start) * k / steps
            self._plant.SetPositions(self._context, q)
            if not self._close():
                self._plant.SetPositions(self._context, before)
                return False
        return True

    def calc_gap(self) -> Array:
        """Return (m, 3): the loops' closure errors [m] in the world."""
        points = [
            self._plant.CalcPointsPositions(self._context, frame, p, self._plant.world_frame())[:, 0]
            for frame, p in self._points
        ]
        return np.array(points[0::2]).reshape(-1, 3) - np.array(points[1::2]).reshape(-1, 3)

    def calc_margin(self) -> float:
        """Return the smallest distance of any joint from its stops [m or rad]; negative beyond a stop."""
        q = self._plant.GetPositions(self._context)[self._limited]
        return float(np.minimum(q - self._lower, self._upper - q).min())

    def _close(self) -> bool:
        for _ in range(_MAX_ITERATIONS):
            gap = self.calc_gap().ravel()
            if np.abs(gap).max(initial=0.0) < _TOLERANCE:
                return True
            jacobians = [
                self._plant.CalcJacobianTranslationalVelocity(
                    self._context,
                    JacobianWrtVariable.kV,
                    frame,
                    p,
                    self._plant.world_frame(),
                    self._plant.world_frame(),
                )[:, self._columns]
                for frame, p in self._points
            ]
            J = np.vstack([a - b for a, b in zip(jacobians[0::2], jacobians[1::2], strict=True)])
            # Planar loops leave rows of zeros: least squares.
            q = self._plant.GetPositions(self._context).copy()
            q[self._passive] += np.linalg.lstsq(J, -gap, rcond=1e-9)[0]
            self._plant.SetPositions(self._context, q)
        return False
