"""A tall block on a tilted slab: faces that carry moments, in both engines."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from drakerock.rocks.config import RocksConfig
from drakerock.rocks.drake.add_rocks import AddRocks
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.drake.plant_engine import AddRockBodies
from drakerock.rocks.engine.config import DynamicsConfig, NonsmoothConfig
from rock_helpers import make_box, make_engine, make_pile, make_plane_site, run

WIDTH, HEIGHT = 0.4, 1.0
SHAPES = (make_box(WIDTH, WIDTH, HEIGHT), make_box(3.0, 3.0, 0.4))
ROCKS = RocksConfig(friction=2.0)


def make_block_on_slab(tilt):
    rotation = Rotation.from_euler("y", tilt)
    quaternion = np.roll(rotation.as_quat(), 1)
    return make_pile(
        [rotation.apply([0.0, 0.0, 0.5 * HEIGHT + 0.2]), [0.0, 0.0, 0.0]],
        shape=[0, 1],
        fixed=[False, True],
        quaternions=[quaternion, quaternion],
    )


def stand_on_nonsmooth(pile, **settings):
    config = NonsmoothConfig(reduction="none", **settings)
    engine = make_engine(pile, SHAPES, rocks=ROCKS, site=make_plane_site(planes=0), config=config)
    arrays, _ = run(engine, engine.make_arrays(pile), 2.0)
    return engine.make_pile(arrays)


def stand_on_plant(pile):
    dynamics = DynamicsConfig.model_validate({"rocks": "plant", "plant": {"contact_model": "hydroelastic"}})
    builder = DiagramBuilder()
    plant, scene_graph = add_plant(builder, dynamics)
    bodies = AddRockBodies(plant, pile, ROCKS, dynamics.plant, shapes=SHAPES)
    plant.Finalize()
    rocks = AddRocks(builder, plant, scene_graph, pile, ROCKS, engine=bodies)
    simulator = Simulator(builder.Build())
    root = simulator.get_mutable_context()
    rocks.set_pile(root, pile)
    simulator.AdvanceTo(2.0)
    return rocks.get_pile(root)


def stands(stand, tilt):
    """Whether the block is still upright on the slab after two seconds."""
    pile = make_block_on_slab(tilt)
    axis = Rotation.from_quat(np.roll(stand(pile).q_WRs[0], -1)).as_matrix()[2, 2]
    return axis > np.cos(tilt) - 0.05


@pytest.mark.parametrize("stand", [stand_on_nonsmooth, stand_on_plant])
def test_a_tall_block_topples_where_its_weight_passes_its_edge(stand):
    # Edges are rounded, in the nonsmooth engine, or give way: the block topples somewhat before its width says.
    limit = np.arctan(WIDTH / HEIGHT)
    assert stands(stand, 0.8 * limit)
    assert not stands(stand, 1.02 * limit)


def test_a_single_point_carries_less():
    limit = np.arctan(WIDTH / HEIGHT)
    assert not stands(lambda pile: stand_on_nonsmooth(pile, manifold_points=1), 0.8 * limit)
