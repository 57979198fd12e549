"""Cost and physics of the default pile, in CPU time of one core.

    OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python benchmarks/pile.py make
    ... benchmarks/pile.py rest refill physics

`make` makes the pile from nothing; the others take the shipped one.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.rocks.making.cache import fetch_pile
from drakerock.rocks.making.emission import calc_level, make_emitter
from drakerock.rocks.making.make import make_pile
from drakerock.rocks.making.refill import refill
from drakerock.rocks.making.settle import calc_creep, settle
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.site import make_site
from drakerock.rocks.state import save_pile
from drakerock.rocks.summary import calc_summary

RECIPE = make_recipe(Scenario())
SHAPES = load_rock_shapes(RECIPE.rocks)


def bench_make() -> None:
    # The kernels are compiled (or read from the cache) beforehand.
    make_pile(RECIPE.replace(**{"pile.rocks": 5}))
    start = time.process_time()
    pile = make_pile(RECIPE)
    cpu = time.process_time() - start
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pile.npz"
        save_pile(pile, path)
        size = path.stat().st_size / 1e6
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"make: {(~pile.fixed).sum()} moving and {pile.fixed.sum()} static rocks, {cpu:.0f} s CPU, "
        f"peak memory {memory:.2f} GB, file {size:.2f} MB"
    )
    shipped, _ = fetch_pile(RECIPE)
    print("make: the shipped pile, bit for bit:", np.array_equal(pile.p_WRs, shipped.p_WRs))


def bench_rest() -> None:
    pile, _ = fetch_pile(RECIPE)
    start = time.process_time()
    moved = 1e3 * calc_creep(pile, SHAPES, RECIPE, 5.0)
    print(
        f"rest: all woken for 5 s: mean {moved.mean():.2f} mm, p99 {np.percentile(moved, 99):.2f} mm, "
        f"{(moved > 30).sum()} rocks more than 30 mm; {time.process_time() - start:.1f} s CPU"
    )


def bench_refill() -> None:
    """A bucket's rocks taken from the slope; and the same where the void has sunk."""
    pile, _ = fetch_pile(RECIPE)
    moving = ~pile.fixed
    emitter = make_emitter(RECIPE.site, RECIPE.pile)
    order = np.argsort(np.linalg.norm(pile.p_WRs - [-3.0, 0.0, 0.5], axis=1))
    order = order[moving[order]]
    top = np.argsort(-pile.p_WRs[:, 2] * (moving & (pile.p_WRs[:, 0] > 0)))
    for name, chosen in (("from the slope", order[:120]), ("from the void's top", top[:200])):
        removed = np.zeros(len(pile), bool)
        removed[chosen] = True
        start = time.process_time()
        after = refill(pile, removed, SHAPES, RECIPE, np.random.default_rng(0))
        print(
            f"refill: {removed.sum()} rocks taken {name}, {len(after) - len(pile) + removed.sum()} emitted, level "
            f"{calc_level(pile.select(~removed), emitter):.2f} -> {calc_level(after, emitter):.2f} m, "
            f"{time.process_time() - start:.1f} s CPU"
        )
        place = pile.p_WRs[removed].mean(axis=0)
        near = np.argsort(np.linalg.norm(after.p_WRs - place, axis=1))
        chosen = near[~after.fixed[near]][:300]
        resting = ~after.fixed
        resting[chosen] = False
        assert after.contacts is not None
        woken = replace(after, contacts=replace(after.contacts, resting=resting))
        later, _ = settle(woken, SHAPES, RECIPE.replace(**{"dynamics.nonsmooth.rest.time": 1e9}), 5.0)
        moved = 1e3 * np.linalg.norm(later.p_WRs - after.p_WRs, axis=1)[chosen]
        print(
            f"refill: the 300 rocks nearest to the hole woken for 5 s: mean {moved.mean():.2f} mm, "
            f"p99 {np.percentile(moved, 99):.2f} mm, most {moved.max():.0f} mm"
        )


def bench_physics() -> None:
    pile, _ = fetch_pile(RECIPE)
    for key, value in calc_summary(
        pile, SHAPES, RECIPE.rocks, make_site(RECIPE.site), RECIPE.dynamics.time_step
    ).items():
        print(f"physics: {key}: {value}")


CASES: dict[str, Callable[[], None]] = {
    "make": bench_make,
    "rest": bench_rest,
    "refill": bench_refill,
    "physics": bench_physics,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="+", choices=[*CASES, "all"])
    arguments = parser.parse_args()
    for case in CASES if "all" in arguments.cases else arguments.cases:
        CASES[case]()


if __name__ == "__main__":
    main()
