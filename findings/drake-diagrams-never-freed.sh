#!/usr/bin/env bash
# pydrake keeps a Diagram for good when one of its Python LeafSystems holds certain things
#
# Versions: drake 1.58.0 (pip), CPython 3.12 or newer, Linux x86-64.
#
# Expected: once nothing in Python refers to a Diagram any more, the garbage collector frees it, whatever its systems
# hold, as it does where a system holds nothing, its plant, or gives a bound method to DeclareVectorOutputPort or to
# an event (mended before 1.58).
#
# Seen: it is never freed, after any number of gc.collect(), when a system
#   - gives a bound method to DeclareAbstractOutputPort (calc or alloc), or to a ValueProducer of DeclareCacheEntry;
#   - keeps what DeclareCacheEntry returned;
#   - keeps a RigidBody, Frame, Joint or OutputPort of the plant in the same Diagram, or a GeometryId that
#     GetCollisionGeometriesForBody returned (an id is a number, yet it refers to its plant).
# Each is a reference back to the system or plant that pydrake holds in C++ (a std::function, a keep_alive), where the
# collector cannot follow it. Related upstream: RobotLocomotion/drake#24162 (callbacks; open).
#
# Why it matters: a process that builds Diagrams in a loop, such as a parameter study, grows by the size of each plant,
# scene and context without bound. Way around: weak references to bound methods; indices instead of what they stand for.
#
# Run: bash findings/drake-diagrams-never-freed.sh   (a virtual environment in a temporary folder; two minutes)
set -euo pipefail
PYTHON="${PYTHON:-python3.12}"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
"$PYTHON" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install --quiet --disable-pip-version-check "drake==1.58.*"

cat > "$work/leak.py" <<'PROGRAM'
import gc
import weakref

from pydrake.common.value import Value
from pydrake.geometry import Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.framework import DiagramBuilder, LeafSystem, ValueProducer


def add_vector_port(system, plant):
    system.DeclareVectorOutputPort("y", 1, system.calc)


def add_event(system, plant):
    system.DeclarePerStepPublishEvent(system.publish)


def add_abstract_port(system, plant):
    system.DeclareAbstractOutputPort("y", lambda: Value(0), system.calc)


def add_abstract_port_allocator(system, plant):
    system.DeclareAbstractOutputPort("y", system.allocate, lambda context, value: None)


def add_cache_entry(system, plant):
    system.DeclareCacheEntry("e", ValueProducer(allocate=system.allocate, calc=system.calc), {system.nothing_ticket()})


def keep_cache_entry(system, plant):
    producer = ValueProducer(allocate=lambda: Value(0), calc=lambda context, value: None)
    system.kept = system.DeclareCacheEntry("e", producer, {system.nothing_ticket()})


def keep(find):
    def setup(system, plant):
        system.kept = find(plant)

    return setup


CASES = {
    "nothing": lambda system, plant: None,
    "the plant": keep(lambda plant: plant),
    "a body's index": keep(lambda plant: plant.GetBodyByName("ball").index()),
    "method of a vector port": add_vector_port,
    "method of an event": add_event,
    "method of an abstract port (calc)": add_abstract_port,
    "method of an abstract port (alloc)": add_abstract_port_allocator,
    "methods of a cache entry": add_cache_entry,
    "a cache entry": keep_cache_entry,
    "a body": keep(lambda plant: plant.GetBodyByName("ball")),
    "a frame": keep(lambda plant: plant.GetFrameByName("ball")),
    "a joint": keep(lambda plant: plant.get_joint(plant.GetJointIndices()[0])),
    "an output port": keep(lambda plant: plant.get_state_output_port()),
    "a collision geometry's id": keep(lambda plant: plant.GetCollisionGeometriesForBody(plant.GetBodyByName("ball"))[0]),
}


class Holder(LeafSystem):
    def __init__(self, setup, plant):
        super().__init__()
        setup(self, plant)

    def allocate(self):
        return Value(0)

    def calc(self, context, value):
        pass

    def publish(self, context):
        pass


def build(setup):
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.01)
    ball = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(0.1), "ball", CoulombFriction(0.5, 0.5))
    plant.Finalize()
    builder.AddSystem(Holder(setup, plant))
    return weakref.ref(builder.Build())


for name, setup in CASES.items():
    diagram = build(setup)
    for _ in range(5):
        gc.collect()
    print(f"{name:<36}{'freed' if diagram() is None else 'kept for good'}")
PROGRAM

cat > "$work/expected" <<'SEEN'
nothing                             freed
the plant                           freed
a body's index                      freed
method of a vector port             freed
method of an event                  freed
method of an abstract port (calc)   kept for good
method of an abstract port (alloc)  kept for good
methods of a cache entry            kept for good
a cache entry                       kept for good
a body                              kept for good
a frame                             kept for good
a joint                             kept for good
an output port                      kept for good
a collision geometry's id           kept for good
SEEN
"$work/venv/bin/python" "$work/leak.py" | tee "$work/seen"
diff "$work/expected" "$work/seen" && echo "as seen before"
