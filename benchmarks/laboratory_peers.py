"""The laboratory's tests on Rapier, an engine of other people: python benchmarks/laboratory_peers.py repose plate drag

The same procedures, benches and rocks as `drakerock lab`, behind the laboratory's own interface of a rig. Needed:
pip install rapier3d. Results are added to a file of lines; specimens that are stored are skipped, and both engines' are
compared by pairs of specimens.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import rapier3d as rapier
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from drakerock.laboratory.lab import TESTS, find_test, make_settings
from drakerock.laboratory.material import Material, make_material
from drakerock.laboratory.rig import DrakeRig
from drakerock.laboratory.scene import Drive, Mover, Record, Scene, Slab
from drakerock.loading.scenario import load_scenario
from drakerock.randomness import derive_seed
from drakerock.rocks.config import GRAVITY
from drakerock.rocks.state import PileState

# Rapier's own time steps in one of ours, and its solver's iterations in each.
SUBSTEPS, ITERATIONS = 2, 16
# Mass of a mover whose speed is given, from whose loss of speed its force is read [kg].
MASS = 3e6
ROCK, SLAB = rapier.Group(1), rapier.Group(2)


class RapierRig:
    """A `Rig` of the laboratory in Rapier: sharp convex hulls, no restitution, Coulomb friction."""

    def __init__(
        self,
        scene: Scene,
        pile: PileState,
        material: Material,
        substeps: int = SUBSTEPS,
        iterations: int = ITERATIONS,
    ) -> None:
        gravity = -GRAVITY if scene.gravity else 0.0
        self.world = rapier.PhysicsWorld(gravity=(0.0, 0.0, gravity))
        self.pile, self.material, self.movers, self.substeps = pile, material, scene.movers, substeps
        settings = self.world.integration_parameters
        self.time_step = material.dynamics.time_step
        settings.dt = self.time_step / substeps
        settings.num_solver_iterations = iterations
        settings.friction_model = rapier.FrictionModel.COULOMB
        settings.length_unit = material.mean_size
        for slab in scene.slabs:
            self.world.add_body(rapier.RigidBody.fixed(), colliders=[self._make_slab(slab, np.zeros(3))])
        self.travels = {mover.name: 0.0 for mover in scene.movers}
        self.bodies = {mover.name: self._add_mover(mover) for mover in scene.movers}
        self.rocks = [self._add_rock(k) for k in range(len(pile))]
        self.steps = 0

    def _make_slab(self, slab: Slab, origin: np.ndarray) -> rapier.ColliderBuilder:
        half = 0.5 * np.array(slab.size)
        return rapier.Collider.cuboid(
            *half,
            translation=tuple(np.array(slab.p) - origin),
            rotation=(0.0, slab.pitch, 0.0),  # a rotation vector
            friction=slab.friction,
            friction_combine_rule=rapier.CoefficientCombineRule.MIN,
            restitution=0.0,
            density=0.0,
            collision_groups=rapier.InteractionGroups(SLAB, ROCK),
        )

    def _add_mover(self, mover: Mover) -> object:
        colliders = [self._make_slab(slab, np.array(mover.pivot)) for slab in mover.slabs]
        if mover.joint == "turn":
            body = rapier.RigidBody.kinematic_velocity_based(translation=mover.pivot)
        else:
            axis = [bool(value) for value in mover.axis]
            mass = MASS if mover.drive == "speed" else mover.mass
            body = (
                rapier.RigidBody.dynamic(translation=mover.pivot, gravity_scale=0.0, can_sleep=False)
                .enabled_translations(tuple(axis))
                .enabled_rotations((False, False, False))
                .additional_mass(mass)
                .linear_damping(mover.damping / mass)
            )
        return self.world.add_body(body, colliders=colliders)

    def _add_rock(self, k: int) -> object:
        pile, material = self.pile, self.material
        turn = Rotation.from_quat(pile.q_WRs[k], scalar_first=True).as_rotvec()
        make = rapier.RigidBody.fixed if pile.fixed[k] else rapier.RigidBody.dynamic
        body = make(
            translation=tuple(map(float, pile.p_WRs[k])),
            rotation=tuple(map(float, turn)),
            linvel=tuple(map(float, pile.V_WRs[k, 3:])),
            angvel=tuple(map(float, pile.V_WRs[k, :3])),
            can_sleep=False,
        )
        hull = rapier.Collider.convex_hull(
            pile.size[k] * material.shapes[pile.shape[k]].vertices,
            density=material.config.density,
            friction=material.config.friction,
            restitution=0.0,
            collision_groups=rapier.InteractionGroups(ROCK, ROCK | SLAB),
        )
        return self.world.add_body(body, colliders=[hull])

    def advance(self, duration: float, drive: Drive | None = None) -> Record:
        bodies = self.world.rigid_bodies
        names = [mover.name for mover in self.movers]
        times, travels, forces = [], [], []
        h = self.time_step / self.substeps
        for _ in range(round(duration / self.time_step)):
            values = drive(self.travels) if callable(drive) else drive or {}
            impulses = {name: np.zeros(3) for name in names}
            for _ in range(self.substeps):
                for mover in self.movers:
                    body, value = bodies[self.bodies[mover.name]], float(values.get(mover.name, 0.0))
                    axis = np.array(mover.axis)
                    if mover.joint == "turn":
                        body.angvel = tuple(value * axis)
                    elif mover.drive == "speed":
                        body.linvel = tuple(value * axis)
                    else:
                        body.reset_forces(True)
                        body.add_force(tuple(value * axis), True)
                        impulses[mover.name] += _to_array(body.linvel) * -mover.mass - value * axis * h
                self.world.step()
                for mover in self.movers:
                    body, value = bodies[self.bodies[mover.name]], float(values.get(mover.name, 0.0))
                    axis = np.array(mover.axis)
                    v = _to_array(body.linvel)
                    if mover.joint == "turn":
                        self.travels[mover.name] += value * h
                        continue
                    self.travels[mover.name] += float(v @ axis) * h
                    if mover.drive == "speed":
                        impulses[mover.name] += MASS * (v - value * axis)
                    else:
                        impulses[mover.name] += mover.mass * v + mover.damping * v * h
            self.steps += 1
            times.append(self.steps * self.time_step)
            travels.append([self.travels[name] for name in names])
            forces.append([impulses[name] / self.time_step for name in names])
        table, loads = np.array(travels), np.array(forces)
        return Record(
            np.array(times),
            {name: table[:, k] for k, name in enumerate(names)},
            {name: loads[:, k] for k, name in enumerate(names)},
        )

    def get_pile(self) -> PileState:
        bodies = [self.world.rigid_bodies[rock] for rock in self.rocks]
        p = np.array([_to_array(body.translation) for body in bodies])
        q = np.array([[r.w, r.i, r.j, r.k] for r in (body.rotation for body in bodies)])
        V = np.array([[*_to_array(body.angvel), *_to_array(body.linvel)] for body in bodies])
        q /= np.linalg.norm(q, axis=1)[:, None]
        return replace(self.pile, p_WRs=p, q_WRs=q, V_WRs=V, contacts=None)


def _to_array(vector: object) -> np.ndarray:
    return np.array([vector.x, vector.y, vector.z])  # type: ignore[attr-defined]


ENGINES = {"drakerock": DrakeRig, "rapier": RapierRig}


def read_lines(path: Path) -> dict[tuple[str, str, int], dict]:
    """Return stored specimens by test, engine and number."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = path.read_text().splitlines() if path.exists() else []
    found = [json.loads(line) for line in lines]
    return {(one["test"], one["engine"], one["specimen"]): one for one in found}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tests", nargs="+", choices=list(TESTS))
    parser.add_argument("--engines", nargs="+", choices=[*ENGINES, "plant"], default=list(ENGINES))
    parser.add_argument("--specimens", type=int, default=4)
    parser.add_argument("--with", dest="overrides", nargs="*", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--set", dest="keys", nargs="*", default=[], metavar="KEY=VALUE", help="of the scenario"
    )
    parser.add_argument("--label", default="", help="kept with the results, to tell settings apart")
    parser.add_argument("--out", type=Path, default=Path("build/laboratory_peers.jsonl"))
    options = parser.parse_args(arguments)
    stored = read_lines(options.out)
    for name in options.tests:
        test = find_test(name)
        settings = make_settings(test, options.overrides)
        for number in range(options.specimens):
            for engine in options.engines:
                key = (name, engine + options.label, number)
                if key in stored:
                    continue
                keys = [*options.keys, *(["dynamics.rocks=plant"] if engine == "plant" else [])]
                scenario = load_scenario(None, keys)
                material = make_material(scenario.rocks, scenario.dynamics)
                cpu = time.process_time()
                found = test.measure(
                    material, settings, derive_seed(0, "lab", number) % 2**31, ENGINES.get(engine, DrakeRig)
                )
                entry = {
                    "test": name,
                    "engine": key[1],
                    "specimen": number,
                    "settings": settings.model_dump(mode="json"),
                    "cpu_s": round(time.process_time() - cpu, 1),
                    "values": {k: round(float(v), 5) for k, v in found.values.items()},
                }
                with open(options.out, "a", encoding="utf-8") as file:
                    file.write(json.dumps(entry) + "\n")
                stored[key] = entry
                print(name, key[1], number, entry["cpu_s"], entry["values"], flush=True)
        show(stored, name, [engine + options.label for engine in options.engines])


def show(stored: dict[tuple[str, str, int], dict], name: str, engines: list[str]) -> None:
    """Print each quantity in all engines, and the others' difference from the first with its 90 % interval."""
    numbers = sorted(
        set.intersection(*({n for t, e, n in stored if t == name and e == engine} for engine in engines))
    )
    if not numbers:
        return
    for key in stored[name, engines[0], numbers[0]]["values"]:
        columns = [np.array([stored[name, e, n]["values"][key] for n in numbers]) for e in engines]
        text = f"{name} {key}: " + ", ".join(
            f"{e} {np.nanmean(c):.4g}" for e, c in zip(engines, columns, strict=True)
        )
        for column in columns[1:]:
            pairs = (column - columns[0])[np.isfinite(column - columns[0])]
            if len(pairs) > 1:
                half = student.ppf(0.95, len(pairs) - 1) * pairs.std(ddof=1) / np.sqrt(len(pairs))
                text += f"; difference {pairs.mean():+.3g} +- {half:.2g}"
        print(text)


if __name__ == "__main__":
    main()
