"""A robot arm picks one rock out of twenty before a camera: python examples/robot_arm.py --out out/robot_arm.html"""

import numpy as np
import pydrake.all as drake
import typer
from models.arm import reach
from show import add_box, simulate

from drakerock import FIRST_ROCK_LABEL, AddRocks, RocksConfig, scatter_rocks


def main(out: str = ""):
    plant, scene_graph = drake.AddMultibodyPlantSceneGraph(builder := drake.DiagramBuilder(), time_step=0.005)
    (parser := drake.Parser(plant)).package_map().Add("examples", "examples/models")
    (arm,) = drake.ProcessModelDirectives(drake.LoadModelDirectives("examples/models/arm.dmd.yaml"), parser)
    add_box(plant, plant.world_body(), size=[3.0, 3.0, 0.5], p=[0.0, 0.0, -0.25])
    plant.Finalize()
    config = RocksConfig(gradation=({"size_m": 0.06, "mass_fraction": 1.0},))
    p = (pile := scatter_rocks(20, [0.3, -0.35, 0.0], [0.7, 0.35, 0.09], config)).p_WRs
    rock = np.argmax(np.sort(np.linalg.norm(p[:, None] - p, axis=2))[:, 1])  # the farthest from all others
    stops = [reach(*p[rock, :2], z, grip) for z, grip in ((0.3, 0.07), (0.03, 0.07), (0.03, 0.0), (0.4, 0.0))]
    path = drake.PiecewisePolynomial.CubicShapePreserving([0.0, 1.5, 2.0, 3.5], np.array(stops).T, True)
    motion = builder.AddSystem(drake.TrajectorySource(path, output_derivative_order=1))
    builder.Connect(motion.get_output_port(), plant.get_desired_state_input_port(arm.model_instance))
    plant.SetDefaultPositions(arm.model_instance, path.value(0.0))
    scene_graph.AddRenderer("vtk", drake.MakeRenderEngineVtk(drake.RenderEngineVtkParams()))
    X_WC = drake.RigidTransform(drake.RollPitchYaw(-1.9, 0.0, np.pi / 2), [1.7, 0.0, 0.6])
    lenses = drake.CameraConfig(width=320, height=240, renderer_name="vtk").MakeCameras()
    camera = builder.AddSystem(drake.RgbdSensor(scene_graph.world_frame_id(), X_WC, *lenses))
    builder.Connect(scene_graph.get_query_output_port(), camera.query_object_input_port())
    rocks = AddRocks(builder, plant, scene_graph, pile, config)
    root = simulate(builder, 4.0, out).get_context()
    labels = camera.label_image_output_port().Eval(camera.GetMyContextFromRoot(root)).data[:, :, 0]
    pixels, lift = labels == FIRST_ROCK_LABEL + rock, rocks.get_pile(root).p_WRs[rock, 2] - p[rock, 2]
    print(f"the rock is lifted by {lift:.2f} m, the camera sees it in {pixels.sum()} pixels")
    return rocks.get_pile(root), rock, labels


if __name__ == "__main__":
    typer.run(main)
