"""A study in miniature to learn from: the stand-in simulation, on piles that the small scenario's sensor could see."""

import numpy as np
import pytest

import study_work
from drakerock.loading.field import HeightField
from drakerock.loading.sensing import make_grid
from drakerock.study.runner import run_study
from drakerock.study.schema import StudyConfig


def make_study(scenario, folder, n_points=9):
    """Run it in `folder`; production rises with alpha and beta, damage with gamma, debris with kappa."""
    x, y = make_grid(scenario.site, scenario.loading.sensing.cell, scenario.site.drift_length / 2)
    rng = np.random.default_rng(0)

    def make_height_field(state):
        toe = -2.0 - 0.3 * np.tanh(state)
        h = np.maximum(0.7 * (x - toe), 0.0)[:, None] * np.ones(len(y))
        return HeightField(x, y, h + 0.1 * rng.uniform(size=h.shape) * (h > 0), scenario.loading.sensing.cell)

    sampling = {"n_initial": n_points - 1, "n_corners": 0, "n_samples": n_points - 1, "n_validation": 1}
    study = StudyConfig.model_validate(
        {
            "name": "taught", "loadings": 4, "scenario": scenario.model_dump(mode="json"),
            "executor": {"kind": "serial"}, "exploration": {"sampling": sampling},
        }
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_work, "DURATION", 0.0)
        patch.setattr(study_work, "make_height_field", make_height_field)
        run_study(study, folder, work="study_work:run")
    return folder
