"""What a strategy would do to a pile, in under a second: its plan, and what a study predicts of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakerock.exploration.strategy import Strategy
from drakerock.files import make_folder
from drakerock.loading.config import StrategyConfig
from drakerock.loading.field import HeightField, calc_pile_profile
from drakerock.loading.folder import PLAN
from drakerock.loading.plan import DigPlan, NoPlan
from drakerock.loading.plan_file import save_plan
from drakerock.loading.preview import PlanPreview, read_height_field
from drakerock.loading.scenario import Scenario
from drakerock.study.analysis import Predictor


@dataclass(frozen=True, eq=False)
class PreviewedStrategy:
    """A strategy with its plan and prediction.

    Attributes:
        strategy: alpha, beta, gamma, kappa.
        field: the pile as it is seen.
        front_height: the pile is what is higher [m].
        bucket_width: [m].
        plan: what would be tried.
        predicted: by a study; None without one.
    """

    strategy: StrategyConfig
    field: HeightField
    front_height: float
    bucket_width: float
    plan: DigPlan | NoPlan
    predicted: Strategy | None

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON: numbers, path, swept section, surface at the entry."""
        data: dict[str, Any] = {"strategy": self.strategy.model_dump(), "plan": None, "reason": ""}
        if isinstance(self.plan, NoPlan):
            data["reason"] = self.plan.reason
        else:
            plan, field = self.plan, self.field
            slice_ = int(np.argmin(np.abs(field.y - plan.y)))
            data["plan"] = {
                "y_m": plan.y,
                "slope_deg": float(np.degrees(plan.slope)),
                "depth_m": float(plan.waypoint_x[1] - plan.waypoint_x[0]),
                "dig_height_m": plan.h_s2,
                "volume_m3": plan.volume,
                "volume_wanted_m3": plan.volume_wanted,
                "volume_reached": plan.reached,
                "times_s": plan.waypoint_t.tolist(),
                "waypoints": np.stack([plan.waypoint_x, plan.waypoint_z], axis=1).round(3).tolist(),
                "path": np.stack([plan.x, plan.z], axis=1).round(3).tolist(),
                "swept": plan.swept.round(3).tolist(),
                "surface": np.stack([field.x, field.h[:, slice_]], axis=1).round(3).tolist(),
            }
        data["predicted"] = None if self.predicted is None else self.predicted.to_dict()
        return data

    def to_text(self) -> str:
        """Return it as lines for a person."""
        values = "  ".join(f"{name} {value:g}" for name, value in self.strategy.model_dump().items())
        lines = [f"Strategy   {values}"]
        if isinstance(self.plan, NoPlan):
            lines.append(f"no plan    {self.plan.reason}")
        else:
            plan = self.plan
            note = "" if plan.reached else ", the nearest that can be reached"
            lines += [
                f"entry      y = {plan.y:.2f} m, slope {np.degrees(plan.slope):.0f} deg",
                f"push       {plan.waypoint_x[1] - plan.waypoint_x[0]:.2f} m deep, then {plan.h_s2:.2f} m up",
                f"cut        {plan.volume:.2f} of {plan.volume_wanted:.2f} m3 wanted{note}",
                f"time       {plan.waypoint_t[-1]:.1f} s planned, if nothing stalls",
            ]
        if self.predicted is not None:
            text = self.predicted.to_text()
            lines.append(text[text.index("Predicted") :])
        return "\n".join(lines)

    def save(self, folder: Path) -> list[Path]:
        """Write plan.json, which `drakerock load --plan` executes, and plan.png.

        Raises:
            InputError: the folder cannot be written.
        """
        from drakerock.viewing.cycle_figures import make_preview_figure

        make_folder(folder)
        save_plan(self.plan, self.field, folder / PLAN)
        profile = calc_pile_profile(self.field, self.front_height)
        plan = self.plan if isinstance(self.plan, DigPlan) else None
        make_preview_figure(self.field, profile, plan, self.bucket_width).savefig(
            folder / "plan.png", dpi=110
        )
        return [folder / PLAN, folder / "plan.png"]


class Preview:
    """Plans and predicts one strategy after the other on one pile.

    Args:
        scenario: machine, site, pile, planning.
        pile: a stored pile, or a plan whose height field is taken; None: the scenario's.
        study: study folder or response table that predicts; None: nothing is predicted.

    Raises:
        InputError: one of them cannot be read.
    """

    def __init__(self, scenario: Scenario, pile: Path | None = None, study: Path | None = None) -> None:
        self.scenario = scenario
        self.field = read_height_field(scenario, pile)
        self.predictor = None if study is None else Predictor(study)
        self._plans = PlanPreview(scenario, self.field)

    def describe(self, strategy: StrategyConfig) -> PreviewedStrategy:
        """Return a strategy's plan and prediction.

        Raises:
            InputError: the study has other variables, or does not cover the strategy.
        """
        predicted = None if self.predictor is None else self.predictor.predict(strategy.model_dump())
        front_height = self.scenario.loading.sensing.front_height
        plan = self._plans.plan(strategy)
        return PreviewedStrategy(
            strategy, self.field, front_height, self._plans.bucket_width, plan, predicted
        )
