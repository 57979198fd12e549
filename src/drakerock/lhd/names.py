"""The names that a machine's SDFormat file has to use.

SDFormat wants links and joints of a model to have different names, hence the joints' ``_joint``. Actuators
are named as their joints. Everything else in the file (cylinders, rods, cranks) may be named freely.
"""

from __future__ import annotations

WHEELS = ("wheel_front_left", "wheel_front_right", "wheel_rear_left", "wheel_rear_right")
"""Wheel bodies."""

BODIES = ("front_unit", "rear_unit", "boom", "bucket", *WHEELS)
"""Bodies, their frames of the same names. front_unit's origin is the middle of the front axle (x forward,
z up); the boom's is its hinge, z towards the bucket's hinge; the bucket's is its hinge, x along its floor."""

WHEEL_JOINTS = tuple(f"{wheel}_joint" for wheel in WHEELS)
"""Wheel joints, about +y: a positive rate drives forward."""

JOINTS = ("articulation", "boom_joint", "bucket_joint", *WHEEL_JOINTS)
"""Actuated joints. Positions of boom_joint and bucket_joint are the method's phi_l and phi_b."""

HINGES = {
    "articulation": ("", "rear_unit"),
    "boom_joint": ("front_unit", "boom"),
    "bucket_joint": ("boom", "bucket"),
    **{joint: ("", wheel) for joint, wheel in zip(WHEEL_JOINTS, WHEELS, strict=True)},
}
"""Parent (empty: any) and child of the actuated joints."""

FRAMES = ("floor", "tip")
"""floor: on front_unit, below the front axle's middle at the undeflected tyres' lowest point. tip: on the
bucket, the middle of the lip's edge."""

PROFILE = "profile_"
"""Frames profile_0, profile_1, ... on the bucket: its inside in side view from the lip over the back to the
top edge, all at the inner face of the left side plate."""

PAD = "pad_"
"""Collision geometries of the bucket named so touch the floor only: no part of `collision_pieces`."""
