"""The range of boom and bucket: the closed linkage is moved until a joint meets its stop.

Tracing takes a second or two, so what was found is kept in the user's cache folder.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from platformdirs import user_cache_path
from pydrake.multibody.plant import MultibodyPlant
from scipy.optimize import brentq

import drakerock
from drakerock.errors import InputError
from drakerock.lhd.linkage import Linkage
from drakerock.lhd.model import Machine

Array = np.ndarray

# To be raised when the same machine gets other numbers.
_FORMAT = 1
# Distance of the boom angles of the bucket's range [rad]; linear interpolation errs by less than 2 mrad.
_GRID_STEP = 0.08
# No boom or bucket turns further than this from where a search begins [rad].
_FARTHEST = np.pi
# A linkage that cannot be closed further, with this much left to its stops [m or rad], toggles.
_TOGGLE_MARGIN = 1e-3


def find_range(plant: MultibodyPlant, machine: Machine, phi_l: float, phi_b: float) -> Array:
    """Return the range of boom and bucket, out of the cache if it is there.

    Args:
        plant: the finalized plant.
        machine: the machine in it.
        phi_l, phi_b: boom and bucket angle of the reference pose [rad].

    Returns:
        (k, 3) rows of boom angle, bucket angle at full tilt and at full dump [rad], from the boom's upper to its
        lower stop.

    Raises:
        InputError: the linkage is not closed in the reference pose, toggles, or boom or bucket meet no stop.
    """
    key = _describe(plant, machine, phi_l, phi_b)
    path = user_cache_path("drakerock") / "machines" / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.json"
    table = _load(path)
    if table is None:
        table = trace_range(plant, machine, phi_l, phi_b)
        _save(path, table)
    return table


def trace_range(plant: MultibodyPlant, machine: Machine, phi_l: float, phi_b: float) -> Array:
    """Trace what `find_range` returns."""
    name = machine.config.model
    if not np.isfinite([phi_l, phi_b]).all():
        raise InputError(f"{name}: the bucket cannot lie level on the floor: its boom is too short")
    return np.array(_Tracer(plant, machine).trace(phi_l, phi_b))


class _Tracer:
    def __init__(self, plant: MultibodyPlant, machine: Machine) -> None:
        self._name = machine.config.model
        self._open = False  # whether the loops could not be closed somewhere in the search under way
        self._linkage = Linkage(plant, plant.CreateDefaultContext(), machine.instance, machine.loops)

    def trace(self, phi_l: float, phi_b: float) -> list[tuple[float, float, float]]:
        self._linkage.reset(phi_l, phi_b)
        if not self._linkage.move(0.0, phi_l, phi_b) or self._linkage.calc_margin() < 0:
            raise InputError(
                f"{self._name}: the linkage isn't closed within its stops in the reference pose (bucket level on the "
                "floor, passive joints at 0)"
            )
        self._require_boom_stops(phi_l, phi_b)
        self._linkage.reset(phi_l, phi_b)
        self._linkage.move(0.0, phi_l, phi_b)
        rows = [self._make_row(phi_l, phi_b)]
        for sign in (-1.0, 1.0):
            row, done = rows[0] if sign < 0 else rows[-1], False
            while not done:
                row, done = self._make_next_row(row, sign)
                if abs(row[0] - phi_l) > _FARTHEST:
                    raise self._miss_stop("boom")
                rows.insert(0, row) if sign < 0 else rows.append(row)
        return rows

    def _require_boom_stops(self, phi_l: float, phi_b: float) -> None:
        """Raise and lower the bucket with its pitch kept until any stop is met: soon said where none is."""
        for sign in (-1.0, 1.0):
            self._linkage.reset(phi_l, phi_b)
            steps: Iterable[float] = np.arange(_GRID_STEP, _FARTHEST, _GRID_STEP)
            if all(
                self._linkage.move(0.0, phi_l + sign * s, phi_b - sign * s)
                and self._linkage.calc_margin() > 0
                for s in steps
            ):
                raise self._miss_stop("boom")

    def _miss_stop(self, what: str) -> InputError:
        return InputError(
            f"{self._name}: the {what} meets no stop within half a turn: write <lower> and <upper> in the <limit> of "
            f"{what}_joint, or of the cylinder that moves it, with its loop closed by <drake:ball_constraint>"
        )

    def _calc_margin(self, phi_l: float, phi_b: float) -> float:
        """Return the distance from the stops there [m or rad]; where the loops cannot be closed, well beyond."""
        if self._linkage.move(0.0, phi_l, phi_b):
            return self._linkage.calc_margin()
        self._open = True
        return -1.0

    def _find_stop(self, start: tuple[float, float], direction: tuple[float, float], what: str) -> float:
        """Return how far one can go from `start` along `direction` to a stop."""
        if self._calc_margin(*start) <= 0:
            return 0.0

        def calc_margin(s: float) -> float:
            return self._calc_margin(start[0] + s * direction[0], start[1] + s * direction[1])

        self._open = False
        far = _GRID_STEP
        while calc_margin(far) > 0:
            far += _GRID_STEP
            if far > _FARTHEST:
                raise self._miss_stop(what)
        stop = float(brentq(calc_margin, far - _GRID_STEP, far, xtol=1e-6))
        if self._open and calc_margin(stop - 2e-6) > _TOGGLE_MARGIN:
            raise InputError(
                f"{self._name}: the linkage toggles before it meets a stop, near phi_l = "
                f"{start[0] + stop * direction[0]:.2f}, phi_b = {start[1] + stop * direction[1]:.2f}: give the "
                "cylinders stops that keep it from there"
            )
        return stop

    def _make_row(self, phi_l: float, phi_b: float) -> tuple[float, float, float]:
        tilt = phi_b - self._find_stop((phi_l, phi_b), (0.0, -1.0), "bucket")
        return phi_l, tilt, phi_b + self._find_stop((phi_l, phi_b), (0.0, 1.0), "bucket")

    def _make_next_row(
        self, row: tuple[float, float, float], sign: float
    ) -> tuple[tuple[float, float, float], bool]:
        """Return the row at the next boom angle, and whether the boom's stop is there."""
        # From the middle of the bucket's range, so that the boom's own stop is met first; pitch is kept.
        middle = (row[0], (row[1] + row[2]) / 2)
        self._calc_margin(*middle)
        step = _GRID_STEP
        done = self._calc_margin(middle[0] + sign * step, middle[1] - sign * step) < 0
        if done:
            step = max(self._find_stop(middle, (sign, -sign), "boom") - 1e-6, 0.0)
        return self._make_row(middle[0] + sign * step, middle[1] - sign * step), done


# -- the cache


def _describe(plant: MultibodyPlant, machine: Machine, phi_l: float, phi_b: float) -> str:
    """Return all that the range depends on as text: joints, their frames and stops, loops, reference pose."""
    joints = []
    for index in plant.GetJointIndices(machine.instance):
        joint = plant.get_joint(index)
        frames = [
            [frame.body().name(), frame.GetFixedPoseInBodyFrame().GetAsMatrix34().tolist()]
            for frame in (joint.frame_on_parent(), joint.frame_on_child())
        ]
        limits = [joint.position_lower_limits().tolist(), joint.position_upper_limits().tolist()]
        axis = [
            getattr(joint, get)().tolist()
            for get in ("revolute_axis", "translation_axis")
            if hasattr(joint, get)
        ]
        joints.append([joint.name(), joint.type_name(), axis, frames, limits])
    loops = [[loop.body_A, loop.p_AP, loop.body_B, loop.p_BQ] for loop in machine.loops]
    return json.dumps([_FORMAT, drakerock.__version__, joints, loops, phi_l, phi_b])


def _load(path: Path) -> Array | None:
    """Return a stored table; none where there is no good one."""
    try:
        table = np.array(json.loads(path.read_text(encoding="utf-8")), dtype=float)
    except (OSError, ValueError, TypeError):
        return None
    good = table.ndim == 2 and table.shape[1] == 3 and len(table) > 1 and np.isfinite(table).all()
    return table if good and (np.diff(table[:, 0]) >= 0).all() else None


def _save(path: Path, table: Array) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(f".{os.getpid()}.partial")  # workers may find the same range at once
        partial.write_text(json.dumps(table.tolist()), encoding="utf-8")
        partial.replace(path)
    except OSError:
        pass  # a cache that cannot be written only costs time
