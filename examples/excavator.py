"""An excavator digs rocks out of a trench: python examples/excavator.py --out out/excavator.html"""

import numpy as np
import pydrake.all as drake
import typer
from show import add_box, simulate

from drakerock import AddRocks, RocksConfig, scatter_rocks
from drakerock.resources import find_data

MOTION = np.array([  # time [s], boom, stick and bucket angles [deg]
    [0.0, 93, -116, -67], [2.5, 93, -116, -67], [4.5, 36, -54, -67], [5.5, 28, -61, -59], [7.5, 36, -89, -52],
    [9.0, 38, -97, -91], [10.5, 51, -91, -141], [12.0, 51, -91, -141],
])  # fmt: skip


def main(out: str = ""):
    plant, scene_graph = drake.AddMultibodyPlantSceneGraph(builder := drake.DiagramBuilder(), time_step=0.01)
    (excavator,) = drake.Parser(plant).AddModels(str(find_data("models", "excavator", "excavator.sdf")))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("house"))
    for size, p in (([12, 6, 1], [2, 0, -0.5]), ([0.4, 2.4, 1.2], [2.4, 0, 0.6]), ([0.4, 2.4, 1.2], [5.4, 0, 0.6]),
                    ([2.6, 0.4, 1.2], [3.9, 1, 0.6]), ([2.6, 0.4, 1.2], [3.9, -1, 0.6])):  # fmt: skip
        add_box(plant, plant.world_body(), size, p)
    plant.Finalize()
    path = drake.PiecewisePolynomial.CubicShapePreserving(MOTION[:, 0], np.radians(MOTION[:, 1:].T), True)
    motion = builder.AddSystem(drake.TrajectorySource(path, output_derivative_order=1))
    builder.Connect(motion.get_output_port(), plant.get_desired_state_input_port(excavator))
    plant.SetDefaultPositions(excavator, path.value(0.0))
    config = RocksConfig(gradation=({"size_m": 0.2, "mass_fraction": 0.5}, {"size_m": 0.3, "mass_fraction": 0.5}))
    rocks = AddRocks(builder, plant, scene_graph, scatter_rocks(300, [2.7, -0.75, 0], [5.1, 0.75, 8], config), config)
    force = rocks.get_body_force_output_port(plant.GetBodyByName("bucket").index())
    log = drake.LogVectorOutput(force, builder, 0.01)
    data = log.FindLog(simulate(builder, 12.0, out).get_context()).data()
    load = -data[5, -50:].mean() / 9.81
    print(f"{load:.0f} kg in the bucket")
    return load


if __name__ == "__main__":
    typer.run(main)
