"""The LHD under a controller of your own, slower where rocks press on the bucket: python examples/admittance.py"""

import numpy as np
import pydrake.all as drake
import typer

from drakerock import FeedforwardController, get_pile, load_scenario, make_station, run_cycle, save_cycle
from drakerock.viewing.replay import write_replay


class Admittance(drake.LeafSystem):
    def __init__(self, force: float):
        super().__init__()
        planned, sensed = (self.DeclareVectorInputPort(*it) for it in (("planned", 3), ("bucket_force", 6)))
        self.DeclareVectorOutputPort("motor_speeds", 3, lambda context, speeds: speeds.SetFromVector(
            planned.Eval(context) / (1.0 + np.linalg.norm(sensed.Eval(context)[3:]) / force)))  # fmt: skip


def make_controller(view, force: float = 50e3) -> drake.System:
    """Return our controller followed by an admittance, which halves the speed at a bucket force of `force` [N]."""
    builder, admittance = drake.DiagramBuilder(), Admittance(force)
    ours = builder.AddSystem(FeedforwardController(view.digger.kinematics))
    builder.Connect(ours.get_output_port(), builder.AddSystem(admittance).GetInputPort("planned"))
    for system, name in ((ours, "plan"), (ours, "mode"), (ours, "measurement"), (admittance, "bucket_force")):
        builder.ExportInput(system.GetInputPort(name), name)
    builder.ExportOutput(admittance.get_output_port(), "motor_speeds")
    return builder.Build()


def main(out: str = ""):
    scenario = load_scenario("examples/narrow_drift.yaml")
    station = make_station(scenario, get_pile(scenario), make_controller, visible=False)
    result = run_cycle(scenario, station.rocks.pile, station=station)
    print(f"{result.outcome.bucket_mass_kg:.0f} kg in the bucket at s4")
    write_replay(save_cycle(result, out)[0].parent) if out else None
    return result


if __name__ == "__main__":
    typer.run(main)
