"""A controller of your own: a Drake System with an output port `motor_speeds`.

The station connects its input ports by their names: measurement, plan, mode, progress, bucket_force, hinge_moment,
height_field, pile and others, see docs/drake.md. An output port `steering_angle` steers as well.
"""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drakerock.lhd.measurement import MEASUREMENT
from drakerock.loading.control import FeedforwardController
from drakerock.loading.parts import StationView


class CautiousController(FeedforwardController):
    """Ours, with the wheels slowed down as the push on the bucket nears `limit` [N]."""

    def __init__(self, view: StationView, limit: float) -> None:
        super().__init__(view.digger.kinematics)
        self._limit = limit
        # (6,) torque and force of the rocks on the bucket, in W, of the step that ended.
        self._force = self.DeclareVectorInputPort("bucket_force", 6)

    def _calc_motor_speeds(self, context: Context, output: BasicVector) -> None:
        super()._calc_motor_speeds(context, output)
        speeds = np.array(output.value())  # wheels, boom, bucket [rad/s]
        push = -float(self._force.Eval(context)[3])
        if speeds[0] > 0.0:
            speeds[0] *= min(max(1.5 - push / self._limit, 0.2), 1.0)
        output.SetFromVector(speeds)


def make_controller(view: StationView, limit: float = 3.0e5) -> LeafSystem:
    """What the scenario names; `limit` comes from its parameters, and can be a study's variable."""
    assert "v_F" in MEASUREMENT  # what a controller can measure: print MEASUREMENT
    return CautiousController(view, limit)
