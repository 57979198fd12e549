"""An excavator digs rocks out of a bay: python examples/excavator.py --out out/excavator.html"""

import numpy as np
import pydrake.all as drake
import typer
from show import add_box, simulate

from drakerock import AddRocks, RocksConfig, scatter_rocks
from drakerock.resources import find_data

MOTION = np.array([  # time [s], boom, stick and bucket angles [deg]
    [0.0, 93, -116, -67], [2.5, 93, -116, -67], [5.0, 33, -53, -40], [6.5, 26, -61, -35], [9.5, 37, -107, -30],
    [11.0, 34, -112, -71], [12.0, 38, -119, -94], [13.0, 49, -119, -108], [13.5, 49, -119, -108],
])  # fmt: skip


def main(out: str = "", seed: int = 0):
    plant, scene_graph = drake.AddMultibodyPlantSceneGraph(builder := drake.DiagramBuilder(), time_step=0.01)
    (excavator,) = drake.Parser(plant).AddModels(str(find_data("models", "excavator", "excavator.sdf")))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("house"))
    for size, y, z in (([20, 20, 1], 0, -0.5), ([5, 0.1, 1.6], -1.25, 0.8), ([5, 0.1, 1.6], 1.25, 0.8)):
        add_box(plant, plant.world_body(), size, [4.0, y, z])
    plant.Finalize()
    path = drake.PiecewisePolynomial.CubicShapePreserving(MOTION[:, 0], np.radians(MOTION[:, 1:].T), True)
    motion = builder.AddSystem(drake.TrajectorySource(path, output_derivative_order=1))
    builder.Connect(motion.get_output_port(), plant.get_desired_state_input_port(excavator))
    plant.SetDefaultPositions(excavator, path.value(0.0))
    sizes = ({"size_m": 0.12, "mass_fraction": 0.5}, {"size_m": 0.2, "mass_fraction": 0.5})
    pile = scatter_rocks(2100, [2.5, -1.1, 0], [5.0, 1.1, 9], config := RocksConfig(gradation=sizes), seed)
    rocks = AddRocks(builder, plant, scene_graph, pile, config)
    force = rocks.get_body_force_output_port(plant.GetBodyByName("bucket").index())
    log = drake.LogVectorOutput(force, builder, 0.01)
    data = log.FindLog(simulate(builder, 13.5, out).get_context()).data()
    load = -data[5, -50:].mean() / 9.81
    print(f"{load:.0f} kg in the bucket")
    return load


if __name__ == "__main__":
    typer.run(main)
