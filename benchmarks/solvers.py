"""Contact solvers on the same problems: how far from the solution after how many iterations?

    python benchmarks/solvers.py --digs 3
    python benchmarks/solvers.py --size full --digs 1 --every 15

Problems are single steps out of digs, warm started as they were: of 300 rocks, all awake, or of the full-size pile with
`rest`. The solution is 6000 plain iterations. Compared are the engine's solve with and without further ones about the
machine, and two ways of accelerating plain ones: nonlinear conjugate gradients (Silcowitz-Hansen, Niebe, Erleben
2010) and Anderson's mixing of the last iterates, both measured by impulses times their rows' inverse inertia.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from faithfulness import SIZES, draw_dig, get_start
from numpy.typing import NDArray
from rocks import TIME_STEP, clear_way, make_dig, run_dig

from drakerock.rocks.engine import engine
from drakerock.rocks.engine.compiling import allocating_kernel
from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.rocks.engine.records import BODY
from drakerock.rocks.engine.solve.batches import make_batch_arrays, make_single_bodies
from drakerock.rocks.engine.solve.gauss_seidel import IterationSettings, solve_contacts
from drakerock.rocks.engine.solve.machine_rows import (
    MachineArrays,
    solve_machine_contacts,
    solve_machine_rows,
)
from drakerock.rocks.engine.solve.rows import (
    ContactRows,
    apply_impulses,
    make_contact_rows,
    solve_contact,
)

Array = NDArray[Any]
Accelerator = Callable[[Array, Array], Array]
CONVERGED = 6000
# Below this a rock is slow [m/s].
SLOW = 0.02


class Problem(NamedTuple):
    """The arguments of a solve, as far as they are data."""

    rows: ContactRows
    awake: Array
    bodies: Array
    machine: MachineArrays
    velocity: Array

    def copy(self) -> Problem:
        n = len(self.rows.values)
        rows = make_contact_rows(n)
        for target, source in zip(rows, self.rows, strict=True):
            target[:] = source
        machine = MachineArrays(*(part.copy() for part in self.machine))
        return Problem(rows, self.awake.copy(), self.bodies.copy(), machine, self.velocity.copy())


def find_problems(size: str, n_digs: int, every: int) -> list[Problem]:
    """Return every so many steps' problem of digs, as far as the machine touches rocks."""
    problems: list[Problem] = []
    count = 0

    def keep(
        n: int, awake: Array, settings: Any, weight: float, rows: ContactRows, bodies: Array, *rest: Any
    ) -> float:
        nonlocal count
        count += 1
        if count % every == 0 and (rows.body_b[:n] >= len(bodies)).sum() > 3:
            first = ContactRows(*(part[:n] for part in rows))
            problems.append(Problem(first, awake, bodies, rest[0], rest[1]).copy())
        return float(solve_contacts(n, awake, settings, weight, rows, bodies, *rest))

    site, reduction = SIZES[size][1], "rest" if size == "full" else "none"
    for seed in range(n_digs):
        pile = clear_way(get_start(size, seed))
        depth, y = draw_dig(seed, site)
        engine.solve_contacts = keep
        try:
            run_dig(pile, make_dig(depth), NonsmoothConfig(reduction=reduction), 12.0, TIME_STEP, site, y)
        finally:
            engine.solve_contacts = solve_contacts
    return problems


@allocating_kernel
def iterate(
    n_free: int, order: Array, forwards: bool, rows: ContactRows, bodies: Array, machine: MachineArrays,
    velocity: Array,
) -> None:  # fmt: skip
    """One iteration in double precision; `order` of the machine's contacts."""
    a, b, scratch, scratch_body = rows.body_a, rows.body_b, np.empty((2, 6)), np.empty(1, BODY)
    solve_machine_rows(machine, velocity)
    if forwards:
        for k in range(n_free):
            solve_contact(rows.values[k], bodies[a[k]], bodies[b[k]])
    solve_machine_contacts(order, a, b, machine, rows.values, bodies, velocity, scratch, scratch_body)
    if not forwards:
        for k in range(n_free - 1, -1, -1):
            solve_contact(rows.values[k], bodies[a[k]], bodies[b[k]])


def gather(problem: Problem) -> Array:
    """Return all that an iteration changes: impulses of the contacts and the machine's rows, velocities."""
    bodies = problem.bodies[problem.awake]
    return np.concatenate(
        [
            problem.rows.values["impulse"].reshape(-1),
            problem.machine.row_values["impulse"],
            bodies["angular"].reshape(-1),
            bodies["linear"].reshape(-1),
            problem.velocity,
        ]
    )


def scatter(problem: Problem, x: Array) -> None:
    n, m, k = len(problem.rows.values), len(problem.machine.row_values), len(problem.awake)
    impulses, row_impulses, angular, linear, velocity = np.split(x, np.cumsum([3 * n, m, 3 * k, 3 * k]))
    problem.rows.values["impulse"] = impulses.reshape(-1, 3)
    problem.machine.row_values["impulse"] = row_impulses
    problem.bodies["angular"][problem.awake] = angular.reshape(-1, 3)
    problem.bodies["linear"][problem.awake] = linear.reshape(-1, 3)
    problem.velocity[:] = velocity


def make_weights(problem: Problem) -> Array:
    """Return what an iterate's squared change is measured by: impulses by inverse inertia, velocities not at all."""
    masses = np.concatenate(
        [np.repeat(problem.rows.values["normal_mass"], 3), problem.machine.row_values["mass"]]
    )
    weights = np.zeros(len(gather(problem)))
    weights[: len(masses)] = 1.0 / np.maximum(masses, 1e-30)
    return weights


def make_conjugate(problem: Problem) -> Accelerator:
    """Nonlinear conjugate gradients: an iteration's change counts as the preconditioned gradient."""
    weights, last, direction = make_weights(problem), 0.0, np.zeros(0)

    def accelerate(before: Array, after: Array) -> Array:
        nonlocal last, direction
        change = after - before
        size = float(weights @ change**2)
        beta = size / last if last > 0.0 else np.inf
        last = size
        if beta > 1.0:
            direction = change
            return after
        after = after + beta * direction
        direction = beta * direction + change
        return after

    return accelerate


def make_anderson(problem: Problem, depth: int = 5) -> Accelerator:
    """Anderson's mixing: the mean of the last iterates whose changes all but cancel."""
    weights = np.sqrt(make_weights(problem))
    changes: list[Array] = []
    results: list[Array] = []

    def accelerate(before: Array, after: Array) -> Array:
        changes.append(after - before)
        results.append(after)
        del changes[: -depth - 1], results[: -depth - 1]
        if len(changes) < 2:
            return after
        steps = np.diff(changes, axis=0).T
        share = np.linalg.lstsq(weights[:, None] * steps, weights * changes[-1], rcond=1e-8)[0]
        return np.asarray(after - np.diff(results, axis=0).T @ share)

    return accelerate


def solve(problem: Problem, iterations: int, make: Callable[[Problem], Accelerator] | None = None) -> Problem:
    """Solve by plain or accelerated iterations."""
    problem = problem.copy()
    rows, _, bodies, machine, velocity = problem
    apply_impulses(len(rows.values), rows, machine, bodies, velocity)
    n_free = int((rows.body_b < len(bodies)).sum())
    order = np.arange(n_free, len(rows.values))
    accelerate = make(problem) if make else None
    for k in range(iterations):
        before = gather(problem) if accelerate else np.zeros(0)
        forwards = k % 2 == 0
        iterate(n_free, order if forwards else order[::-1].copy(), forwards, rows, bodies, machine, velocity)
        if accelerate and k < iterations - 1:
            scatter(problem, accelerate(before, gather(problem)))
    return problem


def solve_as_engine(
    problem: Problem, iterations: int, machine_iterations: int, acceleration: float
) -> tuple[Problem, float]:
    """Solve by the engine's kernel; return the CPU time [s] as well."""
    problem = problem.copy()
    rows, awake, bodies, machine, velocity = problem
    scratch = (
        make_batch_arrays(len(rows.values)),
        make_single_bodies(len(bodies)),
        np.zeros(len(bodies) + len(machine.jacobian), np.int64),
    )
    settings = IterationSettings(iterations, machine_iterations, acceleration)
    start = time.process_time()
    solve_contacts(len(rows.values), awake, settings, 0.0, rows, bodies, machine, velocity, *scratch)
    return problem, time.process_time() - start


def calc_push(problem: Problem) -> float:
    """Return the rocks' force on the machine along x [kN]."""
    rows = problem.rows.values[problem.rows.body_b >= len(problem.bodies)]
    axes = np.stack([rows["normal"], rows["tangent_1"], rows["tangent_2"]], axis=1)
    return float(np.einsum("kc,kc->", rows["impulse"], axes[:, :, 0])) / TIME_STEP / 1e3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", choices=SIZES, default="300")
    parser.add_argument("--digs", type=int, default=3)
    parser.add_argument("--every", type=int, default=60)
    arguments = parser.parse_args()
    problems = find_problems(arguments.size, arguments.digs, arguments.every)
    exact = [solve(problem, CONVERGED) for problem in problems]
    mean = np.mean([len(problem.rows.values) for problem in problems])
    size = np.mean([abs(calc_push(problem)) for problem in exact])
    print(f"{len(problems)} problems of {mean:.0f} contact points on average; push {size:.0f} kN")

    def show(name: str, solved: list[Problem], cpu: float | None = None) -> None:
        push, speed, slow = [], [], []
        for one, true in zip(solved, exact, strict=True):
            push.append(abs(calc_push(one) - calc_push(true)))
            mass = 1.0 / one.bodies["inverse_mass"][one.awake]
            found, right = (problem.bodies["linear"][problem.awake] for problem in (one, true))
            speeds, true_speeds = np.linalg.norm(found, axis=1), np.linalg.norm(right, axis=1)
            chosen = true_speeds < SLOW
            slow.append(speeds[chosen].sum() / true_speeds[chosen].sum() - 1.0)
            speed.append(1e3 * np.sqrt(mass @ ((found - right) ** 2).sum(axis=1) / mass.sum()))
        cost = "" if cpu is None else f", {1e3 * cpu:.2f} ms"
        print(
            f"{name:50s} push off by {np.mean(push):5.1f} kN, 90th percentile {np.percentile(push, 90):5.1f}; "
            f"rms speed by {np.median(speed):5.1f} mm/s, 90th percentile {np.percentile(speed, 90):5.1f}; "
            f"slow rocks' speed off by {100.0 * np.mean(slow):+5.1f} %{cost}",
            flush=True,
        )

    for iterations, machine_sweeps, momentum in (
        (50, 0, 0.0),
        (50, 1, 0.0),
        (50, 3, 0.0),
        (100, 3, 0.0),
        (200, 3, 0.0),
        (400, 0, 0.0),
        (30, 1, 0.8),
        (50, 0, 0.8),
        (50, 1, 0.8),
        (50, 3, 0.8),
        (75, 1, 0.8),
        (100, 0, 0.8),
        (100, 1, 0.8),
        (100, 3, 0.6),
        (100, 3, 0.8),
        (100, 3, 0.9),
        (200, 1, 0.8),
        (200, 3, 0.8),
    ):
        results = [solve_as_engine(problem, iterations, machine_sweeps, momentum) for problem in problems]
        show(
            f"engine {iterations}, machine_sweeps {machine_sweeps}, momentum {momentum:g}",
            [problem for problem, _ in results],
            float(np.mean([cpu for _, cpu in results])),
        )
    for sweeps in (50, 100, 200):
        show(
            f"conjugate gradients {sweeps}", [solve(problem, sweeps, make_conjugate) for problem in problems]
        )
        show(f"Anderson {sweeps}", [solve(problem, sweeps, make_anderson) for problem in problems])


if __name__ == "__main__":
    main()
