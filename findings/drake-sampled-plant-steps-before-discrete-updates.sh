#!/usr/bin/env bash
# A discrete system of the plant's period sees the plant after its step, when the plant's ports are sampled (the default)
#
# Versions: drake 1.58.0 (pip), CPython 3.12 or newer, Linux x86-64.
#
# Expected: the discrete updates of one instant t all see the state before t, the plant's as well as a controller's or
# recorder's beside it. So it is with use_sampled_output_ports=False.
#
# Seen: with sampled output ports, the default of a discrete MultibodyPlant, a LeafSystem with a periodic discrete update
# of the same period and offset reads, at t = 0, the state that the plant has after its first step. The plant then steps by
# an unrestricted update, and the Simulator does these before the discrete ones.
#
# Why it matters: a controller or a coupled solver that is written as x[n+1] = f(x[n], plant[n]) silently becomes
# x[n+1] = f(x[n], plant[n+1]), and changes with an option that says nothing of it. Way around: switch sampled ports off, or
# make the system's own update unrestricted, too.
#
# Run: bash findings/drake-sampled-plant-steps-before-discrete-updates.sh   (a virtual environment; two minutes)
set -euo pipefail
PYTHON="${PYTHON:-python3.12}"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
"$PYTHON" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install --quiet --disable-pip-version-check "drake==1.58.*"

cat > "$work/order.py" <<'PROGRAM'
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem

H = 0.1


class Reader(LeafSystem):
    """Remembers the falling speed that it read at its last update."""

    def __init__(self, size):
        super().__init__()
        self._state = self.DeclareVectorInputPort("state", size)
        self.DeclareDiscreteState(1)
        self.DeclarePeriodicDiscreteUpdateEvent(H, 0.0, self._update)

    def _update(self, context, values):
        values.set_value([self._state.Eval(context)[-1]])


for sampled in (False, True):
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(
        MultibodyPlantConfig(time_step=H, use_sampled_output_ports=sampled), builder
    )
    plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.Finalize()
    reader = builder.AddSystem(Reader(plant.num_multibody_states()))
    builder.Connect(plant.get_state_output_port(), reader.get_input_port())
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.5 * H)
    context = reader.GetMyContextFromRoot(simulator.get_context())
    print(f"sampled ports {sampled}: read at t = 0: {context.get_discrete_state_vector()[0]:.3f} m/s")
PROGRAM

expected="sampled ports False: read at t = 0: 0.000 m/s
sampled ports True: read at t = 0: -0.981 m/s"
seen="$("$work/venv/bin/python" "$work/order.py" 2>/dev/null)"
echo "$seen"
[ "$seen" = "$expected" ] || { echo "the output has changed; expected:"; echo "$expected"; exit 1; }
