"""Contact solvers on the same problems: how far from the solution after how many sweeps?

    python benchmarks/solvers.py --digs 3
    python benchmarks/solvers.py --size full --digs 1 --every 15

Problems are single steps out of digs, warm started as they were: of 300 rocks, all awake, or of the full-size pile with
`rest`. The solution is 6000 plain sweeps. Compared are the engine's solve with and without further sweeps about the
machine, and two ways of accelerating plain sweeps: nonlinear conjugate gradients (Silcowitz-Hansen, Niebe, Erleben
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

from drakerock.rocks.engine import contacts, resting, solver
from drakerock.rocks.engine.batches import make_batch_arrays
from drakerock.rocks.engine.compiling import allocating_kernel
from drakerock.rocks.engine.config import NonsmoothConfig

Array = NDArray[Any]
Accelerator = Callable[[Array, Array], Array]
CONVERGED = 6000
# Below this a rock is slow [m/s].
SLOW = 0.02
IMPULSES = slice(contacts.IMPULSE, contacts.IMPULSE + 3)


class Problem(NamedTuple):
    """The arguments of a solve, as far as they are data."""

    rows: Array
    body_a: Array
    body_b: Array
    awake: Array
    bodies: Array
    n_rocks: int
    machine: solver.MachineArrays
    velocity: Array

    def copy(self) -> Problem:
        parts = [np.array(part) if isinstance(part, np.ndarray) else part for part in self]
        parts[6] = solver.MachineArrays(*(part.copy() for part in self.machine))
        return Problem(*parts)


def find_problems(size: str, n_digs: int, every: int) -> list[Problem]:
    """Return every so many steps' problem of digs, as far as the machine touches rocks."""
    problems: list[Problem] = []
    usual, count = resting.solve_resting, 0

    def keep(
        rows: Array, n: int, a: Array, b: Array, awake: Array, bodies: Array, n_rocks: int, *rest: Any
    ) -> float:
        nonlocal count
        count += 1
        if count % every == 0 and (b[:n] > n_rocks).sum() > 3:
            problem = Problem(rows[:n], a[:n], b[:n], awake, bodies, n_rocks, rest[0], rest[1])
            problems.append(problem.copy())
        return float(usual(rows, n, a, b, awake, bodies, n_rocks, *rest))

    site, reduction = SIZES[size][1], "rest" if size == "full" else "none"
    for seed in range(n_digs):
        pile = clear_way(get_start(size, seed))
        depth, y = draw_dig(seed, site)
        resting.solve_resting = keep
        try:
            run_dig(pile, make_dig(depth), NonsmoothConfig(reduction=reduction), 12.0, TIME_STEP, site, y)
        finally:
            resting.solve_resting = usual
    return problems


@allocating_kernel
def sweep(
    rows: Array, n_free: int, order: Array, body_a: Array, body_b: Array, bodies: Array, n_rocks: int,
    machine: solver.MachineArrays, velocity: Array, forwards: bool,
) -> None:  # fmt: skip
    """One sweep in double precision; `order` of the machine's contacts."""
    solver.solve_machine_rows(machine, velocity)
    if forwards:
        for k in range(n_free):
            solver.solve_contact(rows[k], bodies[body_a[k]], bodies[body_b[k]])
        solver.solve_machine_contacts(
            rows, order, body_a, body_b, bodies, n_rocks, machine, velocity, np.empty((3, 6))
        )
    else:
        solver.solve_machine_contacts(
            rows, order[::-1].copy(), body_a, body_b, bodies, n_rocks, machine, velocity, np.empty((3, 6))
        )
        for k in range(n_free - 1, -1, -1):
            solver.solve_contact(rows[k], bodies[body_a[k]], bodies[body_b[k]])


def gather(problem: Problem) -> Array:
    """Return all that a sweep changes: impulses of the contacts and the machine's rows, velocities."""
    return np.concatenate(
        [
            problem.rows[:, IMPULSES].reshape(-1),
            problem.machine.row_values[:, solver.ROW_IMPULSE],
            problem.bodies[problem.awake, :6].reshape(-1),
            problem.velocity,
        ]
    )


def scatter(problem: Problem, x: Array) -> None:
    n, m = len(problem.rows), len(problem.machine.row_values)
    impulses, row_impulses, velocities, velocity = np.split(x, np.cumsum([3 * n, m, 6 * len(problem.awake)]))
    problem.rows[:, IMPULSES] = impulses.reshape(-1, 3)
    problem.machine.row_values[:, solver.ROW_IMPULSE] = row_impulses
    problem.bodies[problem.awake, :6] = velocities.reshape(-1, 6)
    problem.velocity[:] = velocity


def make_weights(problem: Problem) -> Array:
    """Return what an iterate's squared change is measured by: impulses by inverse inertia, velocities not at all."""
    masses = np.concatenate(
        [
            np.repeat(problem.rows[:, contacts.NORMAL_MASS], 3),
            problem.machine.row_values[:, solver.ROW_MASS],
        ]
    )
    weights = np.zeros(len(gather(problem)))
    weights[: len(masses)] = 1.0 / np.maximum(masses, 1e-30)
    return weights


def make_conjugate(problem: Problem) -> Accelerator:
    """Nonlinear conjugate gradients: a sweep's change counts as the preconditioned gradient."""
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


def solve(problem: Problem, sweeps: int, make: Callable[[Problem], Accelerator] | None = None) -> Problem:
    """Solve by plain or accelerated sweeps."""
    problem = problem.copy()
    rows, body_a, body_b, _, bodies, n_rocks, machine, velocity = problem
    solver.apply_impulses(rows, len(rows), body_a, body_b, bodies, n_rocks, machine, velocity)
    n_free = int((body_b <= n_rocks).sum())
    order = np.arange(n_free, len(rows))
    accelerate = make(problem) if make else None
    for k in range(sweeps):
        before = gather(problem) if accelerate else np.zeros(0)
        sweep(rows, n_free, order, body_a, body_b, bodies, n_rocks, machine, velocity, k % 2 == 0)
        if accelerate and k < sweeps - 1:
            scatter(problem, accelerate(before, gather(problem)))
    return problem


def solve_as_engine(
    problem: Problem, iterations: int, machine_sweeps: int, momentum: float
) -> tuple[Problem, float]:
    """Solve by the engine's kernel; return the CPU time [s] as well."""
    problem = problem.copy()
    rows, body_a, body_b, awake, bodies, n_rocks, machine, velocity = problem
    scratch = (
        make_batch_arrays(len(rows)),
        np.zeros(bodies.shape, np.float32),
        np.zeros(n_rocks + 1 + len(machine.jacobian), np.int64),
    )
    start = time.process_time()
    resting.solve_resting(
        rows, len(rows), body_a, body_b, awake, bodies, n_rocks, machine, velocity, iterations, machine_sweeps,
        momentum, *scratch, 0.0,
    )  # fmt: skip
    return problem, time.process_time() - start


def calc_push(problem: Problem) -> float:
    """Return the rocks' force on the machine along x [kN]."""
    rows = problem.rows[problem.body_b > problem.n_rocks]
    axes = rows[:, contacts.NORMAL : contacts.NORMAL + 9].reshape(-1, 3, 3)
    return float(np.einsum("kc,kc->", rows[:, IMPULSES], axes[:, :, 0])) / TIME_STEP / 1e3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", choices=SIZES, default="300")
    parser.add_argument("--digs", type=int, default=3)
    parser.add_argument("--every", type=int, default=60)
    arguments = parser.parse_args()
    problems = find_problems(arguments.size, arguments.digs, arguments.every)
    exact = [solve(problem, CONVERGED) for problem in problems]
    mean = np.mean([len(problem.rows) for problem in problems])
    size = np.mean([abs(calc_push(problem)) for problem in exact])
    print(f"{len(problems)} problems of {mean:.0f} contact points on average; push {size:.0f} kN")

    def show(name: str, solved: list[Problem], cpu: float | None = None) -> None:
        push, speed, slow = [], [], []
        for one, true in zip(solved, exact, strict=True):
            push.append(abs(calc_push(one) - calc_push(true)))
            mass = 1.0 / one.bodies[one.awake, solver.INVERSE_MASS]
            found, right = (
                problem.bodies[problem.awake, solver.LINEAR : solver.LINEAR + 3] for problem in (one, true)
            )
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
