"""Pictures of the force network before and during a dig into the benchmark's pile.

python benchmarks/force_network.py --out docs/validation/force_network.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
from rocks import TIME_STEP, build_dig, clear_way, get_pile, make_dig

from drakerock.rocks.engine.config import NonsmoothConfig
from drakerock.viewing.force_network import draw_force_network

# When the bucket pushes into the pile [s].
PUSHING = 4.2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    pile = clear_way(get_pile())
    simulator, plant, _, rocks = build_dig(pile, make_dig(2.5), NonsmoothConfig())
    root = simulator.get_mutable_context()
    figure, axes = plt.subplots(2, 1, figsize=(10, 10))
    draw_force_network(axes[0], rocks.get_pile(root), TIME_STEP, reference=2e4)
    while simulator.get_context().get_time() < PUSHING:
        simulator.AdvanceTo(simulator.get_context().get_time() + TIME_STEP)
    draw_force_network(axes[1], rocks.get_pile(root), TIME_STEP, reference=2e4)
    tip = plant.GetFrameByName("tip").CalcPoseInWorld(plant.GetMyContextFromRoot(root)).translation()
    axes[1].plot(tip[0], tip[2], "k>", markersize=8)
    for ax, name in zip(axes, ("at rest", "bucket driving in (arrow: its tip)"), strict=True):
        ax.set_xlim(-8, 7.5)
        ax.set_ylim(0, 9)
        ax.set_title(f"{name}: {ax.get_title()}")
    figure.tight_layout()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(arguments.out, dpi=80)


if __name__ == "__main__":
    main()
