#!/bin/sh
# Drake 1.58.0 (pip drake==1.58.0, Python >= 3.12), reading SDFormat 1.11.
#
# Expected: XML namespaces. An element is Drake's if its prefix is bound to Drake's URI, "drake.mit.edu", whatever the
# prefix is called; a prefix bound to another URI is somebody else's; an unbound prefix is an error.
# Seen: the URI counts for nothing, the five letters "drake" for everything. With xmlns:d="drake.mit.edu" and d:ball_constraint
# the loop stays open, with a warning in the log; with xmlns:drake="elsewhere", or with no xmlns at all, it is closed.
# Why it matters: a file that went through an XML tool, which may rename prefixes, is a mechanism with one loop less. And
# a program that reads such a file by namespace sees other elements than Drake does.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet "drake==1.58.0"
cat > "$folder/run.py" <<'PY'
import logging

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

logging.getLogger("drake").setLevel(logging.ERROR)
BALL = """<{p}:ball_constraint><{p}:ball_constraint_body_A>a</{p}:ball_constraint_body_A>
<{p}:ball_constraint_p_AP>0 0 0</{p}:ball_constraint_p_AP><{p}:ball_constraint_body_B>b</{p}:ball_constraint_body_B>
<{p}:ball_constraint_p_BQ>0 0 1</{p}:ball_constraint_p_BQ></{p}:ball_constraint>"""
for prefix, declaration in (
    ("drake", 'xmlns:drake="drake.mit.edu"'),
    ("d", 'xmlns:d="drake.mit.edu"'),
    ("drake", 'xmlns:drake="elsewhere"'),
    ("drake", ""),
):
    plant = MultibodyPlant(0.01)
    model = f'<model name="m"><link name="a"/><link name="b"/>{BALL.format(p=prefix)}</model>'
    Parser(plant).AddModelsFromString(f'<sdf version="1.11" {declaration}>{model}</sdf>', "sdf")
    print(f"{prefix}:ball_constraint, {declaration or 'no xmlns'}: {plant.num_constraints()} constraint(s)")
PY
cat > "$folder/expected" <<'TEXT'
drake:ball_constraint, xmlns:drake="drake.mit.edu": 1 constraint(s)
d:ball_constraint, xmlns:d="drake.mit.edu": 0 constraint(s)
drake:ball_constraint, xmlns:drake="elsewhere": 1 constraint(s)
drake:ball_constraint, no xmlns: 1 constraint(s)
TEXT
"$folder/venv/bin/python" "$folder/run.py" | tee "$folder/seen"
cmp "$folder/seen" "$folder/expected"
