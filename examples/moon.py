"""The same rocks heap up on Earth and on the Moon: python examples/moon.py --out out/moon.html"""

import numpy as np
import pydrake.all as drake
import typer
from show import add_box, simulate

from drakerock import AddRocks, PileState, RocksConfig, scatter_rocks

EARTH, MOON = 9.81, 1.62


def drop(gravity: float, time: float, out: str = "") -> PileState:
    """Drop 60 rocks from a box 6 m high and return them as they are after `time` [s]."""
    plant, scene_graph = drake.AddMultibodyPlantSceneGraph(builder := drake.DiagramBuilder(), time_step=0.01)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -gravity])
    add_box(plant, plant.world_body(), size=[20.0, 20.0, 1.0], p=[0.0, 0.0, -0.5])
    plant.Finalize()
    config = RocksConfig(gradation=({"size_m": 0.3, "mass_fraction": 1.0},))
    pile = scatter_rocks(60, [-0.8, -0.8, 0], [0.8, 0.8, 6], config)
    rocks = AddRocks(builder, plant, scene_graph, pile, config)
    return rocks.get_pile(simulate(builder, time, out).get_context())


def calc_slope(pile: PileState) -> float:
    """Return the slope [deg] of the cone with the heap's mean height and mean distance from its axis."""
    x, y, z = (pile.p_WRs - [*pile.p_WRs.mean(axis=0)[:2], 0.0]).T
    return float(np.degrees(np.arctan(2.0 * z.mean() / np.hypot(x, y).mean())))


def main(out: str = ""):
    falls = [-drop(gravity, 0.2).V_WRs[:, 5].min() / 0.2 for gravity in (EARTH, MOON)]
    slopes = [calc_slope(drop(EARTH, 3.0)), calc_slope(drop(MOON, 3.0 * (EARTH / MOON) ** 0.5, out))]
    print(f"the first rocks fall with {falls[0]:.2f} and {falls[1]:.2f} m/s^2, and heap up at {slopes} deg")
    return falls, slopes


if __name__ == "__main__":
    typer.run(main)
