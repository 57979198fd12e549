#!/usr/bin/env bash
# pydrake never frees a context that its own Diagram was asked for, nor a builder with a plant that was not built
#
# Versions: drake 1.58.0 (pip), CPython 3.12 or newer, Linux x86-64.
#
# Expected: a context, a builder, a plant that nothing in Python refers to any more are freed by the garbage collector.
#
# Seen:
#   - Diagram.GetMyContextFromRoot(context) and GetMyMutableContextFromRoot(context), called on the Diagram that the
#     context belongs to, return that same context (as they should), and it is never freed afterwards: the result keeps
#     its argument alive, and they are one object. Asked of a subsystem, or of a Diagram within a larger one, nothing is
#     kept.
#   - A DiagramBuilder with AddMultibodyPlantSceneGraph whose Build() is not called is never freed, nor are its plant
#     and scene graph, as when a plant is only made to look something up.
#
# Why it matters: code that works for a Diagram on its own and as a part of a larger one calls GetMyContextFromRoot.
# Then each simulation in a loop leaves its whole context behind, states and cached values of all systems included.
# Way around: ValidateContext tells whether the context is the Diagram's own already; build what is not needed.
#
# Run: bash findings/drake-context-of-root-never-freed.sh   (a virtual environment in a temporary folder; two minutes)
set -euo pipefail
PYTHON="${PYTHON:-python3.12}"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
"$PYTHON" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install --quiet --disable-pip-version-check "drake==1.58.*"

cat > "$work/leak.py" <<'PROGRAM'
import gc
import weakref

from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder


def make_diagram(*parts):
    builder = DiagramBuilder()
    for part in parts:
        builder.AddSystem(part)
    return builder.Build()


def ask(diagram, get_name, *parts):
    whole = make_diagram(*parts) if parts else diagram
    context = whole.CreateDefaultContext()
    if get_name:
        getattr(parts[0] if parts else diagram, get_name)(context)
    return weakref.ref(context)


def leave(build):
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.01)
    plant.Finalize()
    if build:
        builder.Build()
    return weakref.ref(plant)


CASES = {
    "context, its Diagram not asked": lambda: ask(make_diagram(Adder(1, 1)), None),
    "context, its Diagram asked": lambda: ask(make_diagram(Adder(1, 1)), "GetMyContextFromRoot"),
    "context, asked for a mutable one": lambda: ask(make_diagram(Adder(1, 1)), "GetMyMutableContextFromRoot"),
    "context, a system in it asked": lambda: ask(None, "GetMyContextFromRoot", Adder(1, 1)),
    "context, a Diagram in it asked": lambda: ask(None, "GetMyContextFromRoot", make_diagram(Adder(1, 1))),
    "plant of a builder that was built": lambda: leave(True),
    "plant of a builder that was not": lambda: leave(False),
}
for name, case in CASES.items():
    part = case()
    for _ in range(5):
        gc.collect()
    print(f"{name:<36}{'freed' if part() is None else 'kept for good'}")
PROGRAM

cat > "$work/expected" <<'SEEN'
context, its Diagram not asked      freed
context, its Diagram asked          kept for good
context, asked for a mutable one    kept for good
context, a system in it asked       freed
context, a Diagram in it asked      freed
plant of a builder that was built   freed
plant of a builder that was not     kept for good
SEEN
"$work/venv/bin/python" "$work/leak.py" | tee "$work/seen"
diff "$work/expected" "$work/seen" && echo "as seen before"
