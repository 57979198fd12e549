"""Inverse kinematics of arm.sdf."""

import numpy as np

SHOULDER, UPPER_ARM, FOREARM, HAND = 0.3, 0.45, 0.4, 0.2  # height and lengths [m]


def reach(x: float, y: float, z: float, grip: float) -> list[float]:
    """Return the joint positions with the hand above a point and each finger `grip` [m] to its side."""
    r, h = np.hypot(x, y), z + HAND - SHOULDER
    elbow = np.arccos((r * r + h * h - UPPER_ARM**2 - FOREARM**2) / (2 * UPPER_ARM * FOREARM))
    pitch = np.arctan2(r, h) - np.arctan2(FOREARM * np.sin(elbow), UPPER_ARM + FOREARM * np.cos(elbow))
    return [np.arctan2(y, x), pitch, elbow, 0.0, np.pi - pitch - elbow, 0.0, grip, grip]
