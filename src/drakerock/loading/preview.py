"""What a strategy would do to a pile, without simulating it: the plan alone."""

from __future__ import annotations

from pathlib import Path

from pydrake.systems.framework import DiagramBuilder

from drakerock.errors import InputError
from drakerock.lhd.model import add_machine
from drakerock.loading.config import StrategyConfig
from drakerock.loading.field import HeightField
from drakerock.loading.plan import DigPlan, NoPlan
from drakerock.loading.plan_file import load_plan
from drakerock.loading.planning import make_dig_plan
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.loading.sensing import calc_height_field
from drakerock.loading.station import make_digging_machine
from drakerock.rocks.drake.plant import add_plant
from drakerock.rocks.making.cache import fetch_pile
from drakerock.rocks.shapes import load_rock_shapes
from drakerock.rocks.state import load_pile


class PlanPreview:
    """Plans loadings of one pile by one machine, one strategy after the other.

    Args:
        scenario: machine, site, planning.
        field: the pile as it is seen.

    Raises:
        InputError: the machine's file cannot be used.
    """

    def __init__(self, scenario: Scenario, field: HeightField) -> None:
        self.scenario, self.field = scenario, field
        plant, scene_graph = add_plant(DiagramBuilder(), scenario.dynamics)
        machine = add_machine(plant, scenario.machine)
        plant.Finalize()
        self._digger = make_digging_machine(plant, scene_graph, machine)

    @property
    def bucket_width(self) -> float:
        """Its outer width [m]."""
        return self._digger.bucket.outer_width

    def plan(self, strategy: StrategyConfig) -> DigPlan | NoPlan:
        """Return the plan of a strategy."""
        config = self.scenario.loading
        return make_dig_plan(
            self.field, strategy, self._digger, config.planning, config.sensing,
            self.scenario.site.drift_width, config.control.speed_floor,
        )  # fmt: skip


def read_height_field(scenario: Scenario, source: Path | None = None) -> HeightField:
    """Return a pile's height field.

    Args:
        scenario: its site and sensing; its pile where there is no source.
        source: a stored pile (``.npz``), or a plan (``.json``), whose height field is taken.

    Raises:
        InputError: the source cannot be read.
    """
    if source is not None and source.suffix == ".json":
        return load_plan(source)[1]
    if source is not None and source.suffix != ".npz":
        raise InputError(f"{source}: a pile (.npz) or a plan (.json)")
    pile = fetch_pile(make_recipe(scenario))[0] if source is None else load_pile(source)
    shapes = load_rock_shapes(scenario.rocks)
    cell, length = scenario.loading.sensing.cell, scenario.site.drift_length / 2
    return calc_height_field(pile, shapes, scenario.site, cell, length)
