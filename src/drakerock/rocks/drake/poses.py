"""From a pile's arrays to Drake's poses."""

from __future__ import annotations

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform


def make_pose(q_WR: np.ndarray, p_WR: np.ndarray) -> RigidTransform:
    """Return the pose of a quaternion (w, x, y, z), normalised here, and a position [m]."""
    return RigidTransform(Quaternion(q_WR / np.linalg.norm(q_WR)), p_WR)
