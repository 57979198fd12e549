"""Pile sensing: the height field before the machine, seen from above (method section 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, LeafSystem

from drakerock.loading.config import SensingConfig
from drakerock.loading.field import HeightField
from drakerock.pile.config import SiteConfig
from drakerock.pile.geometry import cast_rays, make_pile_mesh
from drakerock.pile.shapes import RockShape
from drakerock.pile.site import calc_roof_height
from drakerock.pile.state import PileState

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
    x, y = make_grid(site, cell, length)
    grid_x, grid_y = np.meshgrid(x, y, indexing="ij")
    roof = np.broadcast_to(calc_roof_height(site, grid_y), grid_x.shape)
    origins = np.column_stack([grid_x.ravel(), grid_y.ravel(), roof.ravel()])
    down = np.tile([0.0, 0.0, -1.0], (len(origins), 1))
    distance = cast_rays(make_pile_mesh(pile, shapes), origins, down)
    h = np.where(np.isfinite(distance), origins[:, 2] - distance, 0.0)
    return HeightField(x, y, np.maximum(h, 0.0).reshape(grid_x.shape), cell)


class PileSensor(LeafSystem):
    """Sees the pile as an ideal height field.

    Input port:
        ``rock_poses``: (7 n,) per rock the quaternion (w, x, y, z) and position in W [m].

    Output port:
        ``height_field``: abstract, a `HeightField` in W, of the rocks at this instant.
    """

    def __init__(
        self,
        pile: PileState,
        shapes: tuple[RockShape, ...],
        site: SiteConfig,
        config: SensingConfig,
        length: float,
    ) -> None:
        """Make the sensor for the rocks of `pile` (shapes and sizes; the poses come by the port)."""
        super().__init__()
        self.set_name("pile_sensor")
        self._pile = pile
        self._shapes = shapes
        self._site = site
        self._config = config
        self._length = length
        self._rock_poses = self.DeclareVectorInputPort("rock_poses", 7 * len(pile))
        empty = HeightField(np.zeros(0), np.zeros(0), np.zeros((0, 0)), config.cell)
        self.DeclareAbstractOutputPort(
            "height_field",
            lambda: AbstractValue.Make(empty),
            self._calc_height_field,
            prerequisites_of_calc={self._rock_poses.ticket()},
        )

    def _calc_height_field(self, context: Context, output: AbstractValue) -> None:
        poses = self._rock_poses.Eval(context).reshape(-1, 7)
        pile = PileState(
            p_WRs=poses[:, 4:],
            q_WRs=poses[:, :4],
            V_WRs=np.zeros((len(poses), 6)),
            shape=self._pile.shape,
            size=self._pile.size,
            fixed=self._pile.fixed,
        )
        output.set_value(calc_height_field(pile, self._shapes, self._site, self._config.cell, self._length))
