"""An excavator digs rocks out of a heap: python examples/excavator.py --out out/excavator.html"""

import numpy as np
import pydrake.all as drake
import typer
from show import add_box, simulate

from drakerock import AddRocks, RocksConfig, scatter_rocks
from drakerock.resources import find_data

MOTION = np.array([  # time [s], boom, stick and bucket angles [deg]
    [0.0, 93, -116, -67], [2.5, 93, -116, -67], [4.5, 45, -99, 24], [5.5, 35, -101, 21], [7.5, 38, -103, -30],
    [9.0, 39, -109, -74], [10.5, 54, -101, -136], [12.0, 54, -101, -136],
])  # fmt: skip


def main(out: str = ""):
    plant, scene_graph = drake.AddMultibodyPlantSceneGraph(builder := drake.DiagramBuilder(), time_step=0.01)
    (excavator,) = drake.Parser(plant).AddModels(str(find_data("models", "excavator", "excavator.sdf")))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("house"))
    add_box(plant, plant.world_body(), size=[20.0, 20.0, 1.0], p=[4.0, 0.0, -0.5])
    plant.Finalize()
    path = drake.PiecewisePolynomial.CubicShapePreserving(MOTION[:, 0], np.radians(MOTION[:, 1:].T), True)
    motion = builder.AddSystem(drake.TrajectorySource(path, output_derivative_order=1))
    builder.Connect(motion.get_output_port(), plant.get_desired_state_input_port(excavator))
    plant.SetDefaultPositions(excavator, path.value(0.0))
    sizes = ({"size_m": 0.2, "mass_fraction": 0.5}, {"size_m": 0.3, "mass_fraction": 0.5})
    pile = scatter_rocks(300, [2.7, -0.75, 0], [5.1, 0.75, 8], config := RocksConfig(gradation=sizes))
    rocks = AddRocks(builder, plant, scene_graph, pile, config)
    force = rocks.get_body_force_output_port(plant.GetBodyByName("bucket").index())
    log = drake.LogVectorOutput(force, builder, 0.01)
    data = log.FindLog(simulate(builder, 12.0, out).get_context()).data()
    load = -data[5, -50:].mean() / 9.81
    print(f"{load:.0f} kg in the bucket")
    return load


if __name__ == "__main__":
    typer.run(main)
