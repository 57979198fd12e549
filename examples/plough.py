"""A plough on a rail pushes rocks, under a controller of your own: python examples/plough.py --out out/plough.html"""

import pydrake.all as drake
import typer
from show import add_box, simulate

from drakerock import AddRocks, scatter_rocks


class SpeedController(drake.LeafSystem):
    def __init__(self, speed: float, gain: float):
        super().__init__()
        state = self.DeclareVectorInputPort("state", 2)
        self.DeclareVectorOutputPort(
            "force", 1, lambda context, force: force.SetFromVector([gain * (speed - state.Eval(context)[1])])
        )


def main(out: str = ""):
    plant, scene_graph = drake.AddMultibodyPlantSceneGraph(builder := drake.DiagramBuilder(), time_step=0.01)
    plough = plant.AddRigidBody("plough", drake.SpatialInertia.SolidBoxWithMass(3000.0, 0.3, 2.0, 0.8))
    add_box(plant, plant.world_body(), size=[20.0, 9.0, 1.0], p=[0.0, 0.0, -0.5])
    add_box(plant, plough, size=[0.3, 2.0, 0.8], p=[0.0, 0.0, 0.45], friction=0.3)
    rail = plant.AddJoint(drake.PrismaticJoint("rail", plant.world_frame(), plough.body_frame(), [1, 0, 0]))
    plant.AddJointActuator("motor", rail)
    plant.Finalize()
    controller = builder.AddSystem(SpeedController(speed=0.5, gain=2e5))
    builder.Connect(plant.get_state_output_port(), controller.get_input_port())
    builder.Connect(controller.get_output_port(), plant.get_actuation_input_port())
    rocks = AddRocks(builder, plant, scene_graph, scatter_rocks(40, [0.5, -1, 0], [2.5, 1, 6]))
    log = drake.LogVectorOutput(rocks.get_body_force_output_port(plough.index()), builder, 0.01)
    root = simulate(builder, 6.0, out).get_context()
    push, path = -log.FindLog(root).data()[3, 300:].mean(), rocks.get_pile(root).p_WRs - rocks.pile.p_WRs
    print(f"rocks push back with {push / 1e3:.1f} kN; {(path[:, 0] > 0.5).sum()} of 40 went with the plough")
    return rocks.get_pile(root), log.FindLog(root).data()


if __name__ == "__main__":
    typer.run(main)
