"""Dig planning: from the observed pile and a strategy to a bucket path (method section 5)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import shapely
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem, State
from scipy.optimize import brentq

from drakerock.errors import InputError
from drakerock.lhd.geometry import BucketGeometry, calc_heaped_capacity
from drakerock.lhd.kinematics import (
    Kinematics,
    calc_full_tilt,
    calc_joint_angles,
    calc_pitch,
    calc_reach,
    calc_tip,
)
from drakerock.loading.config import PlanningConfig, SensingConfig, StrategyConfig
from drakerock.loading.field import HeightField, PileProfile, calc_pile_profile
from drakerock.loading.plan import DigPlan, NoPlan, SpeedTable, calc_motor_rates

Array = NDArray[np.float64]


REACH_SLOPE_DEG = 40.0
"""Slope at which the reach r_ft is taken where none is given: it hardly depends on it [deg]."""


@dataclass(frozen=True, eq=False)
class DiggingMachine:
    """What a plan needs to know of the machine.

    Attributes:
        kinematics: lengths, angles, limits.
        bucket: the bucket's geometry.
        width: the machine's largest width [m].
    """

    kinematics: Kinematics
    bucket: BucketGeometry
    width: float

    def check_room(self, drift_width: float, wall_clearance: float) -> None:
        """Raise InputError if the machine does not fit between the walls of a drift so wide [m]."""
        least = self.width + 2 * wall_clearance
        if drift_width < least:
            raise InputError(
                f"site.drift_width: {drift_width:g} m is too narrow for the machine, {self.width:.2f} m wide; "
                f"{wall_clearance:g} m stay free at each wall (loading.planning.wall_clearance); at least {least:.2f} m"
            )

    def calc_outline(self) -> Array:
        """Return the bucket's side profile (k, 2) relative to its tip, at pitch 0 [m]."""
        return self.bucket.profile - self.bucket.profile[0]


@dataclass(frozen=True, eq=False)
class _Path:
    """Tip path relative to the tip at its start, with the joint angles along it."""

    x: Array
    z: Array
    psi: Array
    phi_l: Array
    phi_b: Array
    t: Array


def choose_entry_slice(profile: PileProfile, gamma: float, half_room: float) -> int | None:
    """Return the index of the slice to enter at, or None if no candidate holds any pile.

    The candidates, slices at which the machine fits, are ordered by their centre of mass x_m; gamma = 1 takes
    the front-most (nearest to the machine), gamma = 0 the rear-most.

    Args:
        profile: the pile's curves.
        gamma: in [0, 1].
        half_room: largest |y| at which the machine fits between the walls [m].
    """
    fits = (np.abs(profile.y) <= half_room + 1e-9) & np.isfinite(profile.x_mass)
    candidates = np.flatnonzero(fits)
    if len(candidates) == 0:
        return None
    ordered = candidates[np.argsort(profile.x_mass[candidates], kind="stable")]
    return int(ordered[round((1.0 - gamma) * (len(ordered) - 1))])


def calc_halt(u: Array, ramp: float, floor: float) -> Array:
    """Return speed shares over a segment's progress u in [0, 1]: 1, with a smooth ramp to `floor` at the end.

    Args:
        u: (k,) progress.
        ramp: share of the segment that the ramp takes.
        floor: the share of the speed that is left at the end.
    """
    v = np.clip((1.0 - u) / ramp, 0.0, 1.0)
    return floor + (1.0 - floor) * v * v * (3.0 - 2.0 * v)


def calc_swept_volume(swept: shapely.Geometry, field: HeightField, y: float, width: float) -> float:
    """Return the volume of pile inside a swept section, over the bucket's width [m^3].

    Each grid column counts with the share of its cell under the width, each bit of pile once.

    Args:
        swept: polygon(s) in the plane of x and z [m].
        field: the undisturbed pile.
        y: the bucket's middle [m].
        width: the bucket's width [m].
    """
    half = 0.5 * field.cell
    overlap = np.minimum(field.y + half, y + 0.5 * width) - np.maximum(field.y - half, y - 0.5 * width)
    volume = 0.0
    left, right = field.x - half, field.x + half
    for j in np.flatnonzero(overlap > 0):
        full = field.h[:, j] > 0
        columns = shapely.box(left[full], 0.0, right[full], field.h[full, j])
        volume += overlap[j] * float(np.sum(shapely.area(shapely.intersection(columns, swept))))
    return volume


def sweep_profile(profile: Array, x: Array, z: Array, psi: Array) -> shapely.Geometry:
    """Return the union of a bucket's side profile over a path of its tip.

    Args:
        profile: (k, 2) outline relative to the tip, x forward and z up at pitch 0 [m].
        x, z, psi: (n,) tip positions [m] and pitches [rad] (nose-up).
    """
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(shapely.Polygon(profile)))
    corners = np.array([np.asarray(part.exterior.coords)[:3] for part in parts])
    c, s = np.cos(psi), np.sin(psi)
    turned = np.stack(
        [
            corners[None, ..., 0] * c[:, None, None] - corners[None, ..., 1] * s[:, None, None],
            corners[None, ..., 0] * s[:, None, None] + corners[None, ..., 1] * c[:, None, None],
        ],
        axis=-1,
    )
    turned += np.stack([x, z], axis=-1)[:, None, None, :]
    if len(x) == 1:
        return shapely.union_all(shapely.polygons(turned[0]))
    # Between two poses each convex part sweeps, to second order in the turn, the hull of both.
    pairs = np.concatenate([turned[:-1], turned[1:]], axis=2)
    hulls = shapely.convex_hull(shapely.multipoints(pairs.reshape(-1, 6, 2)))
    return shapely.union_all(hulls)


def make_dig_plan(
    field: HeightField,
    strategy: StrategyConfig,
    machine: DiggingMachine,
    config: PlanningConfig,
    sensing: SensingConfig,
    drift_width: float,
    speed_floor: float,
) -> DigPlan | NoPlan:
    """Plan one loading.

    Args:
        field: the sensed pile.
        strategy: alpha, beta, gamma, kappa.
        machine: the machine's geometry.
        config: speeds and limits.
        sensing: where the front is.
        drift_width: between the walls [m].
        speed_floor: lowest share of a segment's speed, as the controller keeps it.
    """
    profile = calc_pile_profile(field, sensing.front_height)
    kin, width = machine.kinematics, machine.bucket.outer_width
    half_room = 0.5 * (drift_width - machine.width) - config.wall_clearance
    if half_room < 0:
        return NoPlan(f"the machine ({machine.width:.2f} m wide) does not fit the drift ({drift_width:g} m)")
    entry = choose_entry_slice(profile, strategy.gamma, half_room)
    if entry is None:
        return NoPlan("none that the machine fits into holds any pile")
    y = float(profile.y[entry])
    near = np.isfinite(profile.slope) & (np.abs(profile.y - y) <= 0.5 * width)
    slope = float(np.mean(profile.slope[near]))
    x_s0 = float(np.min(profile.x_front[near])) - 0.5 * field.cell
    r_ft = config.r_ft or calc_reach(kin, np.radians(REACH_SLOPE_DEG))
    h_s2 = float(strategy.beta * r_ft * np.sin(slope))

    # The tip enters at the clearance above the floor, so that much less is left to lift.
    lift_height = max(h_s2 - config.floor_clearance, 0.0)

    @cache
    def plan_dig(height: float) -> tuple[_Path, float, _Tables]:
        return _plan_dig(strategy.kappa, height, slope, kin, config, speed_floor)

    def calc_overshoot(height: float) -> float:
        return x_s0 + float(np.max(plan_dig(height)[0].x)) - field.x_end

    if lift_height > 0.0 and calc_overshoot(lift_height) > 0.0:
        # Too little room before the drift's rear end for the whole lift: it ends lower.
        lift_height = float(brentq(calc_overshoot, 0.0, lift_height)) if calc_overshoot(0.0) < 0.0 else 0.0
        h_s2 = lift_height + config.floor_clearance
    dig, psi_m, tables = plan_dig(lift_height)
    outline = machine.calc_outline()
    swept_dig = sweep_profile(outline, dig.x, dig.z, dig.psi)

    def calc_swept(depth: float) -> shapely.Geometry:
        push = sweep_profile(outline, np.array([0.0, depth]), np.zeros(2), np.zeros(2))
        moved = shapely.affinity.translate(swept_dig, depth, 0.0)
        return shapely.affinity.translate(shapely.union(push, moved), x_s0, config.floor_clearance)

    wanted = strategy.alpha * calc_heaped_capacity(machine.bucket)
    depth_max = max(0.0, field.x_end - x_s0 - float(np.max(dig.x)))

    def calc_excess(depth: float) -> float:
        return calc_swept_volume(calc_swept(depth), field, y, width) - wanted

    depth = _solve_depth(calc_excess, depth_max, field.cell)
    swept = calc_swept(depth)
    volume = calc_swept_volume(swept, field, y, width)
    reached = bool(abs(volume - wanted) <= 0.01 * wanted)
    return _assemble(
        x_s0, depth, dig, tables, kin, config,
        y=y, slope=slope, h_s2=h_s2, psi_m=psi_m, volume=volume, volume_wanted=wanted, reached=reached,
        swept=swept,
    )  # fmt: skip


def _solve_depth(calc_excess: Callable[[float], float], depth_max: float, step: float) -> float:
    """Return a depth in [0, depth_max] [m] with no excess, or where there is none, that of the least one.

    Args:
        calc_excess: swept less wanted volume of a depth; it grows with the depth unless the pile has hollows.
        depth_max: [m].
        step: how densely an uneven pile's depths are looked through [m].
    """
    depths = np.array([0.0, depth_max])
    excess = np.array([calc_excess(depth) for depth in depths])
    if excess[0] * excess[1] > 0.0 and depth_max > step:
        depths = np.linspace(0.0, depth_max, 1 + int(np.ceil(depth_max / step)))
        inner = [calc_excess(float(depth)) for depth in depths[1:-1]]
        excess = np.array([excess[0], *inner, excess[1]])
    crossings = np.flatnonzero(excess[:-1] * excess[1:] <= 0.0)
    if len(crossings) == 0:
        return float(depths[np.argmin(np.abs(excess))])
    first = int(crossings[0])
    return float(brentq(calc_excess, depths[first], depths[first + 1], xtol=1e-4))


@dataclass(frozen=True, eq=False)
class _Tables:
    v_x: SpeedTable
    v_z: SpeedTable
    omega: SpeedTable
    n_lift: int  # path points on [s1, s2]


def _plan_dig(
    kappa: float, h_s2: float, slope: float, kin: Kinematics, config: PlanningConfig, floor: float
) -> tuple[_Path, float, _Tables]:
    """Integrate the joints from s1 to s3, the tip starting at x = z = 0; full tilt found by iteration."""
    phi_l, phi_b = (float(angle) for angle in calc_joint_angles(kin, config.floor_clearance, 0.0))
    psi_m = float(calc_full_tilt(kin, phi_l)) - config.stop_margin
    if h_s2 <= 0.0:
        lift = _Path(*(np.array([value]) for value in (0.0, 0.0, 0.0, phi_l, phi_b, 0.0)))
        tables = _make_tables(0.0, 0.0, 0.0, slope, kin, config, floor, n_lift=1)
    else:
        for _ in range(20):
            tables = _make_tables(h_s2, kappa * psi_m, h_s2 / np.tan(slope), slope, kin, config, floor, 0)
            lift = _integrate_lift(tables, phi_l, phi_b, kin, config)
            tables = _make_tables(
                h_s2, kappa * psi_m, h_s2 / np.tan(slope), slope, kin, config, floor, len(lift.x)
            )
            updated = float(calc_full_tilt(kin, float(lift.phi_l[-1]))) - config.stop_margin
            if abs(updated - psi_m) < 1e-6:
                break
            psi_m = updated
    # [s2, s3]: wheels and boom hold, the tip goes round the bucket hinge.
    turn = np.linspace(0.0, max(psi_m - lift.psi[-1], 0.0), config.n_segment + 1)
    psi = lift.psi[-1] + turn
    phi_l_s2, phi_b_s2 = float(lift.phi_l[-1]), float(lift.phi_b[-1])
    tip = calc_tip(kin, 0.0, phi_l_s2, phi_b_s2 - turn)
    tip = tip - tip[0]
    path = _Path(
        np.concatenate([lift.x, lift.x[-1] + tip[1:, 0]]),
        np.concatenate([lift.z, lift.z[-1] + tip[1:, 1]]),
        np.concatenate([lift.psi, psi[1:]]),
        np.concatenate([lift.phi_l, np.full(config.n_segment, phi_l_s2)]),
        np.concatenate([lift.phi_b, (phi_b_s2 - turn)[1:]]),
        np.concatenate([lift.t, lift.t[-1] + turn[1:] / config.tilt_rate]),
    )
    return path, float(psi_m), tables


def _make_tables(
    h_s2: float,
    psi_s2: float,
    length: float,
    slope: float,
    kin: Kinematics,
    config: PlanningConfig,
    floor: float,
    n_lift: int,
) -> _Tables:
    """Make the speeds on [s1, s2], each over its own coordinate, all three taking the same time.

    All share one shape: full speed from s1, where the machine is driving already, and a smooth ramp to the halt at
    s2. So the tip runs parallel to the slope, and the curl's integral is kept without rescaling.
    """
    u = np.linspace(0.0, 1.0, 201)
    drive = calc_halt(u, config.ramp, floor)
    v_z = np.tan(slope) * config.v_x_max
    omega = min(psi_s2 * v_z / h_s2 if h_s2 > 0 else 0.0, kin.bucket_speed)
    return _Tables(
        SpeedTable(u * length, config.v_x_max * drive),
        SpeedTable(u * h_s2, v_z * drive),
        SpeedTable(u * psi_s2, omega * drive),
        n_lift,
    )


def _integrate_lift(
    tables: _Tables, phi_l: float, phi_b: float, kin: Kinematics, config: PlanningConfig
) -> _Path:
    """Integrate [s1, s2] as the controller would drive it on a machine that follows exactly.

    The motors' limits bind here as they do there; beyond a joint's stop nothing moves.
    """
    length, height = tables.v_x.at[-1], tables.v_z.at[-1]
    psi_end = tables.omega.at[-1]
    # Fine steps, so that the three coordinates reach the waypoint together; one in eight is kept.
    fine = 8
    dt = length / config.v_x_max / (config.n_segment * fine)
    x_tip, z0 = (float(value) for value in calc_tip(kin, 0.0, phi_l, phi_b))
    rows = [(0.0, 0.0, 0.0, phi_l, phi_b, 0.0)]
    x = z = psi = t = 0.0
    while x < length - 1e-9 and z < height - 1e-9:
        v_x = tables.v_x.calc(x)
        # The last step ends at the waypoint; its lower bound lets the clamped wheels get there.
        step = min(dt, max((length - x) / v_x, 1e-3 * dt))
        v_z = tables.v_z.calc(z)
        omega = min(tables.omega.calc(psi), (psi_end - psi) / step) if psi < psi_end else 0.0
        wheel, boom, bucket = calc_motor_rates(kin, phi_l, phi_b, v_x, v_z, omega)
        phi_l = max(phi_l + boom * step, float(kin.phi_l_range[0]))
        phi_b = max(phi_b + bucket * step, float(np.interp(phi_l, kin.phi_l_grid, kin.phi_b_min)))
        t += step
        psi = float(calc_pitch(kin, phi_l, phi_b))
        x_last = x_tip
        x_tip, z_tip = (float(value) for value in calc_tip(kin, 0.0, phi_l, phi_b))
        x, z = x + kin.wheel_radius * wheel * step + x_tip - x_last, z_tip - z0
        rows.append((x, z, psi, phi_l, phi_b, t))
    rows = rows[:-1:fine] + rows[-1:]
    return _Path(*np.array(rows).T)


def _assemble(
    x_s0: float,
    depth: float,
    dig: _Path,
    tables: _Tables,
    kin: Kinematics,
    config: PlanningConfig,
    *,
    y: float,
    slope: float,
    h_s2: float,
    psi_m: float,
    volume: float,
    volume_wanted: float,
    reached: bool,
    swept: shapely.Geometry,
) -> DigPlan:
    n, n_lift = config.n_segment, tables.n_lift
    u = np.linspace(0.0, 1.0, n + 1)
    x_s1 = x_s0 + depth
    t_s1 = depth / config.v_x_max
    x_s3, x_s4 = x_s1 + dig.x[-1], x_s0 - kin.bucket_length
    t_s3 = t_s1 + dig.t[-1]
    t_s4 = t_s3 + abs(x_s3 - x_s4) / config.v_x_max
    x = np.concatenate([x_s0 + u * depth, x_s1 + dig.x[1:], (x_s3 + u * (x_s4 - x_s3))[1:]])
    z = np.concatenate([np.zeros(n + 1), dig.z[1:], np.full(n, dig.z[-1])]) + config.floor_clearance
    psi = np.concatenate([np.zeros(n + 1), dig.psi[1:], np.full(n, dig.psi[-1])])
    phi_l = np.concatenate([np.full(n + 1, dig.phi_l[0]), dig.phi_l[1:], np.full(n, dig.phi_l[-1])])
    phi_b = np.concatenate([np.full(n + 1, dig.phi_b[0]), dig.phi_b[1:], np.full(n, dig.phi_b[-1])])
    t = np.concatenate([u * t_s1, t_s1 + dig.t[1:], (t_s3 + u * (t_s4 - t_s3))[1:]])
    segment = np.repeat([0, 1, 2, 3], [n + 1, n_lift - 1, len(dig.x) - n_lift, n])
    at = [0, n, n + n_lift - 1, n + len(dig.x) - 1, len(x) - 1]
    largest = max(shapely.get_parts(swept), key=shapely.area)
    return DigPlan(
        y=y,
        slope=slope,
        h_s2=h_s2,
        psi_m=psi_m,
        volume=volume,
        volume_wanted=volume_wanted,
        reached=reached,
        waypoint_x=x[at],
        waypoint_z=z[at],
        waypoint_psi=psi[at],
        waypoint_t=t[at],
        x=x,
        z=z,
        psi=psi,
        phi_l=phi_l,
        phi_b=phi_b,
        t=t,
        segment=segment,
        v_x=SpeedTable(tables.v_x.at + x_s1, tables.v_x.speed),
        v_z=SpeedTable(tables.v_z.at + config.floor_clearance, tables.v_z.speed),
        omega=tables.omega,
        drive_speed=config.v_x_max,
        tilt_rate=config.tilt_rate,
        swept=np.asarray(largest.exterior.coords),
    )


NOT_INITIALISED = "not initialised"


class DigPlanner(LeafSystem):
    """Plans once, when its context is first initialised, from what the sensor sees then, or takes a stored plan.

    Input port:
        ``height_field``: abstract, a `HeightField` in W.

    Output port:
        ``plan``: abstract, a `DigPlan` (or `NoPlan`); held in the Context.
    """

    def __init__(
        self,
        strategy: StrategyConfig,
        machine: DiggingMachine,
        config: PlanningConfig,
        sensing: SensingConfig,
        drift_width: float,
        speed_floor: float,
        stored: DigPlan | NoPlan | None = None,
    ) -> None:
        """Make the planner of one strategy; arguments as of `make_dig_plan`, or a `stored` plan to give out."""
        super().__init__()
        self.set_name("dig_planner")
        self._arguments = (strategy, machine, config, sensing, drift_width, speed_floor)
        self._stored = stored
        empty = HeightField(np.zeros(0), np.zeros(0), np.zeros((0, 0)), sensing.cell)
        self._field = self.DeclareAbstractInputPort("height_field", AbstractValue.Make(empty))
        self._plan = self.DeclareAbstractState(AbstractValue.Make(NoPlan(NOT_INITIALISED)))
        self.DeclareInitializationUnrestrictedUpdateEvent(self._initialize)
        self.DeclareStateOutputPort("plan", self._plan)

    def _initialize(self, context: Context, state: State) -> None:
        # A plan stands until the context is reset: where the machine stands by now is no reason for another one.
        held = context.get_abstract_state(int(self._plan)).get_value()
        if isinstance(held, NoPlan) and held.reason == NOT_INITIALISED:
            plan = self._stored or make_dig_plan(self._field.Eval(context), *self._arguments)
            state.get_mutable_abstract_state(int(self._plan)).set_value(plan)
