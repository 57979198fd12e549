"""drakerock: simulation-based development of robotic rock loading, built on Drake.

Frames, in Drake's monogram notation (``X_WB`` pose of B in W, ``p_WT`` position, ``V_WB`` spatial velocity,
``F_B_W`` spatial force on B expressed in W):

- W: world. Origin on the drift floor, on the centreline, under the brow; x along the drift towards the
  pile, y across, z up.
- F: front unit of the machine; L: boom; B: bucket, origin on the hinge axis; T: bucket tip, the middle of the
  lip's edge.
- R: a rock, origin at its centre of mass. P: the pile's toe.

A batch of rocks takes a plural: ``X_WRs``, ``p_WRs`` (n, 3). SI units and radians everywhere; another unit
only at an input edge, and then in the name (``_deg``).
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

# Imported on first use, so that `import drakerock` and `drakerock --help` stay fast.
_LAZY: dict[str, str] = {
    "AddDrift": "drakerock.rocks.drake.drift",
    "AddRockBodies": "drakerock.rocks.drake.plant_engine",
    "AddRocks": "drakerock.rocks.drake.add_rocks",
    "DigPlanner": "drakerock.loading.planning",
    "FIRST_ROCK_LABEL": "drakerock.rocks.drake.scene",
    "FeedforwardController": "drakerock.loading.control",
    "NonsmoothConfig": "drakerock.rocks.engine.config",
    "PileSensor": "drakerock.loading.sensing",
    "PileState": "drakerock.rocks.state",
    "RockContactVisualizer": "drakerock.rocks.drake.contact_visualizer",
    "RocksConfig": "drakerock.rocks.config",
    "Surrogate": "drakerock.exploration.surrogate",
    "choose_strategy": "drakerock.exploration.strategy",
    "get_pile": "drakerock.study.jobs",
    "load_scenario": "drakerock.loading.scenario",
    "load_study": "drakerock.study.schema",
    "make_station": "drakerock.loading.station",
    "pareto_front": "drakerock.exploration.pareto",
    "run_cycle": "drakerock.loading.cycle",
    "run_study": "drakerock.study.runner",
    "save_cycle": "drakerock.loading.cycle",
    "scatter_rocks": "drakerock.rocks.making.scatter",
}

__all__ = ["__version__", *_LAZY]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version("drakerock")
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'drakerock' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
