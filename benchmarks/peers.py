"""Rapier and MuJoCo beside our engine: the same pile, one core, the same process, blocks of steps in turn.

    pip install rapier3d mujoco
    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python benchmarks/peers.py
    ... benchmarks/peers.py --rounds 3 --peers rapier

The pile is the shipped one: its hulls (sharp in the peers, their edges rounded in ours), sizes, poses, and the site's
half-spaces and convex pieces; the static rocks are static in all. Step 10 ms, density 2 500 kg/m^3, gravity 9.81 m/s^2,
friction 0.9 (ours 2 a b / (a + b) of 0.9 and the site's 1.125; Rapier the mean, MuJoCo the greater one of 0.9 and 0.9).
Everything else is as the libraries have it: ours 50 iterations, Rapier 4 substeps, MuJoCo a pyramidal cone, but its
conjugate gradients of at most 50 iterations: its default, Newton's method, factors a matrix of all rocks in contact
(`--mujoco-solver NEWTON`: nine seconds a step of 1 500 rocks).

Each first runs for `--settle` seconds of the pile's own time, untimed, or until that has taken `--settle-cpu`: `awake`
without sleep in any, `rest` with sleep as each has it (Rapier lets bodies sleep after half a second of rest, so
less than that says nothing of it). Reported are CPU time per step, median over blocks, how many rocks are awake, and
how far rocks have gone since the stored pile: what does not hold the pile still is not the same task.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rocks import ROCKS, SHAPES, SITE, TIME_STEP, get_pile, make_engine

from drakerock.rocks.site import make_site
from drakerock.rocks.state import PileState

Array = NDArray[np.float64]
FRICTION = ROCKS.friction


class World(Protocol):
    """A pile in an engine."""

    def step(self) -> None: ...

    def get_positions(self) -> Array: ...

    def count_awake(self) -> int: ...


class Ours:
    def __init__(self, pile: PileState, sleeps: bool) -> None:
        self._engine = make_engine(pile) if sleeps else make_engine(pile, reduction="none")
        self._arrays = self._engine.make_arrays(replace(pile, V_WRs=np.zeros((len(pile), 6))))
        self._awake = 0

    def step(self) -> None:
        self._arrays, report = self._engine.advance(self._arrays)
        self._awake = report.n_awake

    def get_positions(self) -> Array:
        return np.asarray(self._engine.make_pile(self._arrays).p_WRs)

    def count_awake(self) -> int:
        return self._awake


class Rapier:
    def __init__(self, pile: PileState, sleeps: bool) -> None:
        import rapier3d as rapier

        self._world = world = rapier.PhysicsWorld(gravity=(0.0, 0.0, -9.81))
        world.set_num_threads(1)
        world.integration_parameters.dt = TIME_STEP
        self._handles = []
        for k in range(len(pile)):
            pose = rapier.Isometry3(tuple(pile.p_WRs[k]), rapier.Rotation3(*pile.q_WRs[k]))
            kind = rapier.RigidBodyType.FIXED if pile.fixed[k] else rapier.RigidBodyType.DYNAMIC
            hull = rapier.Collider.convex_hull(SHAPES[pile.shape[k]].vertices * pile.size[k])
            collider = hull.density(ROCKS.density).friction(FRICTION)
            self._handles.append(
                world.add_body(rapier.RigidBodyBuilder(kind).position(pose).can_sleep(sleeps), [collider])
            )
        ground = world.add_body(rapier.RigidBodyBuilder(rapier.RigidBodyType.FIXED))
        site = make_site(SITE)
        for plane in site.planes:
            place = rapier.Isometry3(tuple(plane.normal * plane.offset))
            half_space = rapier.Collider.halfspace(tuple(plane.normal))
            world.add_collider(half_space.position(place).friction(FRICTION), ground)
        for piece in site.pieces:
            world.add_collider(rapier.Collider.convex_hull(piece.vertices).friction(FRICTION), ground)

    def step(self) -> None:
        self._world.step()

    def get_positions(self) -> Array:
        bodies = self._world.rigid_bodies
        places = [bodies[handle].translation for handle in self._handles]
        return np.array([(place.x, place.y, place.z) for place in places])

    def count_awake(self) -> int:
        return len(self._world.active_bodies())


class Mujoco:
    solver = "CG"

    def __init__(self, pile: PileState, sleeps: bool) -> None:
        import mujoco

        spec = mujoco.MjSpec()
        spec.option.timestep = TIME_STEP
        spec.option.gravity = [0.0, 0.0, -9.81]
        spec.option.solver = getattr(mujoco.mjtSolver, f"mjSOL_{self.solver}")
        if self.solver == "CG":
            spec.option.iterations = 50
        if sleeps:
            spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        spec.memory = 8 << 30
        friction = [FRICTION, 0.005, 0.0001]
        mesh = mujoco.mjtGeom.mjGEOM_MESH
        site = make_site(SITE)
        for plane in site.planes:
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], pos=plane.normal * plane.offset,
                quat=turn_up_to(plane.normal), friction=friction,
            )  # fmt: skip
        for piece in site.pieces:
            spec.add_mesh(name=piece.name, uservert=piece.vertices.ravel())
            spec.worldbody.add_geom(type=mesh, meshname=piece.name, friction=friction)
        for k in range(len(pile)):
            spec.add_mesh(name=f"rock_{k}", uservert=(SHAPES[pile.shape[k]].vertices * pile.size[k]).ravel())
            body = spec.worldbody.add_body(name=f"rock_{k}", pos=pile.p_WRs[k], quat=pile.q_WRs[k])
            if not pile.fixed[k]:
                body.add_freejoint()
            body.add_geom(type=mesh, meshname=f"rock_{k}", density=ROCKS.density, friction=friction)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._step = mujoco.mj_step
        self._first = self._model.body("rock_0").id
        self._n = len(pile)

    def step(self) -> None:
        self._step(self._model, self._data)

    def get_positions(self) -> Array:
        return np.array(self._data.xpos[self._first : self._first + self._n])

    def count_awake(self) -> int:
        # Trees asleep hold a cycle of indices, those awake a negative count.
        return int((self._data.tree_asleep < 0).sum())


def turn_up_to(normal: Array) -> Array:
    """Return the quaternion w x y z that turns z to a unit vector."""
    quaternion = np.array([1.0 + normal[2], -normal[1], normal[0], 0.0])
    size = np.linalg.norm(quaternion)
    return np.array([0.0, 1.0, 0.0, 0.0]) if size < 1e-9 else quaternion / size


MAKERS: dict[str, tuple[str, Callable[[PileState, bool], World]]] = {
    "ours": ("drakerock", Ours),
    "rapier": ("rapier3d", Rapier),
    "mujoco": ("mujoco", Mujoco),
}


def run_block(world: World, seconds: float, least: int = 3) -> float:
    """Step for about so long; return CPU time per step [s]."""
    start = time.process_time()
    n = 0
    while n < least or time.process_time() - start < seconds:
        world.step()
        n += 1
    return (time.process_time() - start) / n


def compare(pile: PileState, names: list[str], sleeps: bool, arguments: Any) -> None:
    worlds: dict[str, World] = {}
    for name in names:
        start = time.process_time()
        worlds[name] = MAKERS[name][1](pile, sleeps)
        made = time.process_time() - start
        # An engine that takes most of a second for a step gets as many as fit in so long.
        start, n = time.process_time(), 0
        while n < round(arguments.settle / TIME_STEP) and time.process_time() - start < arguments.settle_cpu:
            worlds[name].step()
            n += 1
        print(f"  {name}: made in {made:.1f} s, {n} untimed steps", flush=True)
    times: dict[str, list[float]] = {name: [] for name in names}
    for k in range(arguments.rounds):
        for name in names if k % 2 == 0 else reversed(names):
            times[name].append(run_block(worlds[name], arguments.block))
    moving = ~pile.fixed
    ours = np.array(times["ours"])
    for name, world in worlds.items():
        step = float(np.median(times[name]))
        moved = np.linalg.norm(world.get_positions() - pile.p_WRs, axis=1)[moving]
        ratio = float(np.median(ours / np.array(times[name])))
        print(
            f"| {'rest' if sleeps else 'awake'} | {MAKERS[name][0]} {version(MAKERS[name][0])} | {1e3 * step:.2f} ms | "
            f"{1e6 * step / moving.sum():.2f} us | {world.count_awake()} | {1 / ratio:.1f} | "
            f"{1e3 * np.median(moved):.1f} / {1e3 * np.percentile(moved, 99):.1f} mm |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", choices=["awake", "rest"], default=["awake", "rest"])
    parser.add_argument("--peers", nargs="*", choices=["rapier", "mujoco"], default=["rapier", "mujoco"])
    parser.add_argument("--rounds", type=int, default=5, help="blocks of each")
    parser.add_argument("--block", type=float, default=2.0, help="CPU time of a block [s]")
    parser.add_argument("--settle", type=float, default=5.0, help="untimed before [s of the pile's time]")
    parser.add_argument(
        "--settle-cpu", type=float, default=150.0, help="no more than so long for that [CPU s]"
    )
    parser.add_argument("--mujoco-solver", choices=["NEWTON", "CG"], default="CG")
    arguments = parser.parse_args()
    Mujoco.solver = arguments.mujoco_solver
    pile = get_pile()
    print(f"{len(pile)} rocks, {(~pile.fixed).sum()} of them moving")
    print(
        "| case | engine | CPU per step | per moving rock and step | awake | times ours | moved, median / p99 |"
    )
    print("|---|---|---|---|---|---|---|")
    for case in arguments.cases:
        compare(pile, ["ours", *arguments.peers], case == "rest", arguments)


if __name__ == "__main__":
    main()
