"""Pile sensing: the height field before the machine, ideal or from a scan (method section 5)."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, LeafSystem
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from drakerock.errors import InputError
from drakerock.loading.config import ScannerConfig, SensingConfig
from drakerock.loading.field import HeightField
from drakerock.memory import weak
from drakerock.randomness import make_generator
from drakerock.rocks.config import SiteConfig
from drakerock.rocks.geometry import cast_rays, make_pile_mesh
from drakerock.rocks.shapes import RockShape
from drakerock.rocks.site import calc_roof_height
from drakerock.rocks.state import PileState, make_empty_pile

Array = NDArray[np.float64]


def make_grid(site: SiteConfig, cell: float, length: float) -> tuple[Array, Array]:
    """Return the cell centres (x, y) that cover the last `length` of the drift before the brow."""
    # A hair's room, so that a width of a whole number of cells is not one short by rounding.
    nx = max(1, int(np.ceil(length / cell - 1e-9)))
    ny = max(1, int(np.floor(site.drift_width / cell + 1e-9)))
    x = -cell * (np.arange(nx, dtype=np.float64)[::-1] + 0.5)
    y = cell * (np.arange(ny, dtype=np.float64) - 0.5 * (ny - 1))
    return x, y


def calc_height_field(
    pile: PileState, shapes: tuple[RockShape, ...], site: SiteConfig, cell: float, length: float
) -> HeightField:
    """Return the ideal height field: vertical rays from the roof onto the rocks' true geometry.

    Args:
        pile: all rocks.
        shapes: the rock shapes.
        site: the drift (roof height, width).
        cell: grid spacing [m].
        length: how much of the drift is seen, back from the brow [m].
    """
    return look_down(pile, shapes, site, *make_grid(site, cell, length), cell)


def look_down(
    pile: PileState, shapes: tuple[RockShape, ...], site: SiteConfig, x: Array, y: Array, cell: float
) -> HeightField:
    """Return the ideal height field on a grid of one's own; arguments as of `calc_height_field`, cell centres x, y."""
    grid_x, grid_y = np.meshgrid(x, y, indexing="ij")
    roof = np.broadcast_to(calc_roof_height(site, grid_y), grid_x.shape)
    origins = np.column_stack([grid_x.ravel(), grid_y.ravel(), roof.ravel()])
    down = np.tile([0.0, 0.0, -1.0], (len(origins), 1))
    distance = cast_rays(make_pile_mesh(pile, shapes), origins, down)
    h = np.where(np.isfinite(distance), origins[:, 2] - distance, 0.0)
    return HeightField(x, y, np.maximum(h, 0.0).reshape(grid_x.shape), cell)


def make_ray_directions(config: ScannerConfig) -> Array:
    """Return the scan's rays (m, 3) as unit vectors in the scanner's frame S: x its axis, z up."""
    half = 0.5 * np.deg2rad([config.horizontal_field_deg, config.vertical_field_deg])
    step = np.deg2rad(config.resolution_deg)
    across, up = (np.arange(-size, size + 1e-9, step) for size in half)
    azimuth, elevation = (angles.ravel() for angles in np.meshgrid(across, up, indexing="ij"))
    return np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )


def calc_scan(
    pile: PileState,
    shapes: tuple[RockShape, ...],
    config: ScannerConfig,
    X_WF: RigidTransform,
    rng: np.random.Generator,
) -> Array:
    """Return the points (m, 3) that the scanner sees, in W [m].

    Each ray ends at the first rock or on the floor, so rocks hide what is behind them. The machine's own body hides
    nothing, as if it had looked with the bucket out of the way; walls and roof return nothing, since
    from inside the drift they hide no rock of the drift. Ranges have Gaussian noise, and a share of the rays
    is lost.

    Args:
        pile: all rocks.
        shapes: the rock shapes.
        config: mounting pose, field of view, resolution, noise.
        X_WF: pose of the front unit.
        rng: source of noise and dropouts.
    """
    pitch = RollPitchYaw(0.0, np.deg2rad(config.pitch_deg), 0.0)
    X_WS = X_WF.multiply(RigidTransform(pitch, np.array(config.position)))
    directions = make_ray_directions(config) @ X_WS.rotation().matrix().T
    origin = X_WS.translation()
    distance = cast_rays(make_pile_mesh(pile, shapes), np.tile(origin, (len(directions), 1)), directions)
    downward = np.minimum(directions[:, 2], -1e-9)
    distance = np.minimum(distance, np.where(directions[:, 2] < -1e-9, -origin[2] / downward, np.inf))
    noisy = distance + config.range_noise * rng.standard_normal(len(distance))
    seen = (distance <= config.range) & (rng.random(len(distance)) >= config.dropout)
    return origin + noisy[seen, None] * directions[seen]


def estimate_height_field(points: Array, site: SiteConfig, cell: float, length: float) -> HeightField:
    """Return the height field estimated from points on the surface.

    A cell's height is the median of its points'. Cells without points are filled linearly between those that
    have some (over the triangles of their centres), and outside of them like the nearest one; without any points
    all heights are 0.

    Args:
        points: (m, 3) in W [m].
        site: the drift.
        cell: grid spacing [m].
        length: how much of the drift is covered, back from the brow [m].
    """
    x, y = make_grid(site, cell, length)
    edges = [np.append(axis - 0.5 * cell, axis[-1] + 0.5 * cell) for axis in (x, y)]
    h = np.zeros((len(x), len(y)))
    low, high = (np.array([edges[0][k], edges[1][k]]) for k in (0, -1))
    covered = np.all((points[:, :2] >= low) & (points[:, :2] <= high), axis=1)
    if np.any(covered):
        inside = points[covered]
        from scipy.stats import binned_statistic_2d  # takes long to import, and only scans need it

        h = binned_statistic_2d(*inside.T, "median", bins=edges).statistic
        seen = np.isfinite(h)
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        # Three cells in a line, or fewer, span no triangle.
        spans = all(len(np.unique(axis)) > 1 for axis in np.nonzero(seen)) and seen.sum() > 3
        if spans:
            h[~seen] = LinearNDInterpolator(grid[seen], h[seen])(grid[~seen])
        seen = np.isfinite(h)
        h[~seen] = NearestNDInterpolator(grid[seen], h[seen])(grid[~seen])
    return HeightField(x, y, np.maximum(h, 0.0), cell)


class PileSensor(LeafSystem):
    """Sees the pile as a height field: ideal, or estimated from a scan with a scanner on the machine.

    Input ports:
        ``pile``: abstract, the rocks as a `PileState`.
        ``body_poses``: only with a scanner; list of RigidTransform, the plant's output.

    Output port:
        ``height_field``: abstract, a `HeightField` in W, of the rocks at this instant. A scan's noise follows
            from the seed and the rocks' poses: the same scene gives the same scan, another one new noise.
    """

    def __init__(
        self,
        shapes: tuple[RockShape, ...],
        site: SiteConfig,
        config: SensingConfig,
        length: float,
        *,
        seed: int = 0,
        front_unit: BodyIndex | None = None,
    ) -> None:
        """Make the sensor.

        Args:
            shapes: the rock shapes.
            site: the drift.
            config: which sensor, and its settings.
            length: how much of the drift is covered, back from the brow [m].
            seed: of a scan's noise.
            front_unit: the body in ``body_poses`` that carries the scanner.

        Raises:
            InputError: a scanner without the body that carries it.
        """
        super().__init__()
        self.set_name("pile_sensor")
        self._shapes = shapes
        self._site = site
        self._config = config
        self._length = length
        self._seed = seed
        self._front_unit = front_unit
        self._pile = self.DeclareAbstractInputPort("pile", Value[object](make_empty_pile()))
        inputs = {self._pile.ticket()}
        if config.kind == "scanner":
            if front_unit is None:
                raise InputError("loading.sensing.kind: a scanner needs the front unit that carries it")
            self._body_poses = self.DeclareAbstractInputPort(
                "body_poses", AbstractValue.Make([RigidTransform()])
            )
            inputs.add(self._body_poses.ticket())
        empty = HeightField(np.zeros(0), np.zeros(0), np.zeros((0, 0)), config.cell)
        self.DeclareAbstractOutputPort(
            "height_field",
            lambda: AbstractValue.Make(empty),
            weak(self._calc_height_field),
            prerequisites_of_calc=inputs,
        )

    def _calc_height_field(self, context: Context, output: AbstractValue) -> None:
        pile: PileState = self._pile.Eval(context)
        if self._config.kind == "ideal":
            field = calc_height_field(pile, self._shapes, self._site, self._config.cell, self._length)
        else:
            X_WF = self._body_poses.Eval(context)[int(self._front_unit)]  # type: ignore[arg-type]
            poses = np.hstack([pile.q_WRs, pile.p_WRs])
            scene = hashlib.sha256(poses.tobytes()).hexdigest()
            rng = make_generator(self._seed, "scanner", scene)
            points = calc_scan(pile, self._shapes, self._config.scanner, X_WF, rng)
            field = estimate_height_field(points, self._site, self._config.cell, self._length)
        output.set_value(field)
