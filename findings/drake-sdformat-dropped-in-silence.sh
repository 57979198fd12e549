#!/bin/sh
# Drake 1.58.0 (pip drake==1.58.0, Python >= 3.12), reading SDFormat 1.11.
#
# Expected: what the parser does not support is either an error or a warning. It does warn of most: a <gearbox_ratio> in
# a <joint> gives "Ignoring unsupported SDFormat element in joint: gearbox_ratio".
# Seen: three standard elements of a joint vanish without an error or a warning: <mimic> of an <axis> (Drake has its own
# drake:mimic), <friction> of <dynamics>, and <stiffness> of a <limit>. The plant has no constraint, slides on as
# if there were no friction, and rests on its stop at the same place to the last digit, whatever the stiffness.
# Why it matters: a model moves, only otherwise than its file says, and nothing tells.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet "drake==1.58.0"
cat > "$folder/run.py" <<'PY'
import logging

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

heard = []


class Collector(logging.Handler):
    def emit(self, record):
        heard.append(record.getMessage())


log = logging.getLogger("drake")
log.handlers, log.propagate = [Collector()], False

INERTIAL = "<inertial><pose>0.5 0 0 0 0 0</pose><mass>1</mass></inertial>"
MODEL = """<sdf version="1.11"><model name="arms"><link name="a">{i}</link><link name="b">{i}</link>
<joint name="first" type="revolute"><parent>world</parent><child>a</child>
  <axis><xyz>0 1 0</xyz><limit><lower>-1</lower><upper>0.5</upper><effort>0</effort>{limit}</limit>
  <dynamics><damping>0</damping>{dynamics}</dynamics></axis></joint>
<joint name="second" type="revolute"><parent>a</parent><child>b</child>{joint}
  <axis><xyz>0 1 0</xyz><limit><effort>0</effort></limit>{axis}</axis></joint></model></sdf>"""


def show(name, **parts):
    """Let the arms fall for half a second; print constraints, warnings and where they are then."""
    heard.clear()
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.01)
    text = {"i": INERTIAL, "limit": "", "dynamics": "", "axis": "", "joint": ""} | parts
    Parser(plant).AddModelsFromString(MODEL.format(**text), "sdf")
    plant.Finalize()
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.5)
    q = plant.GetPositions(plant.GetMyContextFromRoot(simulator.get_context()))
    same = "reference" if not parts else str(bool((q == reference).all()))
    print(f"{name}: constraints {plant.num_constraints()}, warnings {len(heard)}, same motion {same}")
    return q


reference = show("plain")
show("gearbox_ratio", joint="<gearbox_ratio>2</gearbox_ratio>")
MIMIC = "<multiplier>1</multiplier><offset>0</offset><reference>0</reference>"
show("mimic", axis=f'<mimic joint="first">{MIMIC}</mimic>')
show("friction", dynamics="<friction>100</friction>")
show("stiffness", limit="<stiffness>10</stiffness>")
PY
cat > "$folder/expected" <<'TEXT'
plain: constraints 0, warnings 0, same motion reference
gearbox_ratio: constraints 0, warnings 1, same motion True
mimic: constraints 0, warnings 0, same motion True
friction: constraints 0, warnings 0, same motion True
stiffness: constraints 0, warnings 0, same motion True
TEXT
"$folder/venv/bin/python" "$folder/run.py" | tee "$folder/seen"
cmp "$folder/seen" "$folder/expected"
