"""Contract: in either engine a rig moves its tools as told, weighs what lies on them, and rubs as its slabs say."""

import numpy as np
import pytest

from drakerock.laboratory.material import make_material
from drakerock.laboratory.rig import DrakeRig
from drakerock.laboratory.scene import Mover, Scene, Slab
from drakerock.rocks.config import GRAVITY, RocksConfig
from drakerock.rocks.engine.config import DynamicsConfig
from drakerock.rocks.making.scatter import scatter_rocks


@pytest.fixture(params=["nonsmooth", "plant"])
def material(request):
    return make_material(RocksConfig(), DynamicsConfig(rocks=request.param))


def test_a_tray_weighs_its_rocks_and_moves_as_told(material):
    pile = scatter_rocks(6, (-1, -1, 0.1), (1, 1, 2.5), material.config, seed=2)
    weight = GRAVITY * material.calc_masses(pile).sum()
    tray = Mover("tray", (Slab((6.0, 6.0, 1.0), (0.0, 0.0, -0.5)),), (0.0, 0.0, 1.0))
    rig = DrakeRig(Scene((), (tray,)), pile, material)
    rig.advance(2.5)
    at_rest = rig.advance(0.5)
    assert -at_rest.forces["tray"][:, 2].mean() == pytest.approx(weight, rel=0.03)
    lifted = rig.advance(1.0, {"tray": 0.25})
    assert lifted.travels["tray"][-1] == pytest.approx(0.25, abs=0.01)
    assert rig.get_pile().p_WRs[:, 2].min() > 0.25


def test_a_rock_on_a_sliding_plate_is_dragged_by_the_pairs_friction():
    # Not with the plant's single points: a rock that slides trips over its edge there (docs/validation.md).
    material = make_material(RocksConfig(), DynamicsConfig())
    pile = scatter_rocks(1, (-0.5, -0.5, 0.0), (0.5, 0.5, 1.0), material.config, seed=1)
    weight = GRAVITY * material.calc_masses(pile).sum()
    stop = Slab((0.5, 4.0, 4.0), (0.9, 0.0, 2.02), friction=0.0)
    belt = Mover("belt", (Slab((40.0, 6.0, 1.0), (0.0, 0.0, -0.5), friction=0.25),), (1.0, 0.0, 0.0))
    rig = DrakeRig(Scene((stop,), (belt,)), pile, material)
    rig.advance(0.7)
    record = rig.advance(2.5, {"belt": 0.5})
    # Held by the smooth stop, it rubs on the belt.
    assert -record.forces["belt"][-50:, 0].mean() == pytest.approx(0.25 * weight, rel=0.1)


def test_a_lid_that_is_pressed_carries_its_force(material):
    pile = scatter_rocks(3, (-0.6, -0.6, 0.1), (0.6, 0.6, 2.0), material.config, seed=3)
    lid = Mover(
        "lid",
        (Slab((8.0, 8.0, 1.0), (0.0, 0.0, 5.0)),),
        (0.0, 0.0, 1.0),
        drive="force",
        mass=500.0,
        damping=1e4,
    )
    rig = DrakeRig(Scene((Slab((20.0, 20.0, 2.0), (0.0, 0.0, -1.0)),), (lid,)), pile, material)
    rig.advance(0.8)
    record = rig.advance(5.0, {"lid": -1e4})
    assert record.forces["lid"][-100:, 2].mean() == pytest.approx(1e4, rel=0.1)
    assert record.travels["lid"][-1] < -1.0


def test_a_tilted_box_turns_about_its_pivot():
    material = make_material(RocksConfig(), DynamicsConfig())
    pile = scatter_rocks(4, (0.2, -0.8, 0.1), (2.0, 0.8, 2.0), material.config, seed=4)
    walls = (
        Slab((4.0, 4.0, 1.0), (1.2, 0.0, -0.5)),
        Slab((1.0, 4.0, 4.0), (-0.5, 0.0, 1.5)),
    )
    box = Mover("box", walls, (0.0, -1.0, 0.0), joint="turn")
    rig = DrakeRig(Scene((), (box,), floor=-50.0), pile, material)
    rig.advance(1.5)
    record = rig.advance(2.0, {"box": np.deg2rad(15.0)})
    assert np.rad2deg(record.travels["box"][-1]) == pytest.approx(30.0, abs=0.1)
    # All rocks are above the box's floor, which has come up.
    p = rig.get_pile().p_WRs
    assert (p[:, 2] > np.tan(np.deg2rad(30.0)) * p[:, 0]).all()
