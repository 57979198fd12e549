"""From a pile's arrays to Drake's poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation


def make_pose(q_WR: np.ndarray, p_WR: np.ndarray) -> RigidTransform:
    """Return the pose of a quaternion (w, x, y, z), normalised here, and a position [m]."""
    return RigidTransform(Quaternion(q_WR / np.linalg.norm(q_WR)), p_WR)


def make_poses(q_WRs: NDArray[np.float64], p_WRs: NDArray[np.float64]) -> list[RigidTransform]:
    """Return the poses of quaternions (n, 4) and positions (n, 3) [m]; faster than one by one."""
    if len(p_WRs) == 0:
        return []
    R_WRs = Rotation.from_quat(q_WRs, scalar_first=True).as_matrix()
    return [RigidTransform(X_WR) for X_WR in np.concatenate([R_WRs, p_WRs[:, :, None]], axis=2)]
