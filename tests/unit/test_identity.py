"""Contract: a configuration's identity is the content of what it names. Caught: an edited machine, mesh, pile or plan
went on with the cached piles and half sequences of the old one; the same file at another path was another.
"""

import shutil

import numpy as np
import pytest

from drakerock import identity
from drakerock.identity import calc_config_hash, calc_file_hash, get_versions
from drakerock.loading.scenario import Scenario, make_recipe
from drakerock.resources import find_data
from drakerock.rocks.state import load_pile
from drakerock.study.schema import StudyConfig


@pytest.fixture
def models(tmp_path):
    return shutil.copytree(find_data("models"), tmp_path / "models")


def test_the_same_files_elsewhere_are_the_same(models):
    shapes = tuple(str(models / f"rocks/rock_{k}.obj") for k in range(6))
    known = Scenario().replace(**{"machine.expected.critical_moment": 145e3})
    changes = {"machine.model": str(models / "lhd/lhd.sdf"), "rocks.shapes": shapes}
    assert calc_config_hash(known.replace(**changes)) == calc_config_hash(known)


def test_an_edited_file_is_another(models, tmp_path):
    pile, plan = tmp_path / "pile.npz", tmp_path / "plan.json"
    shutil.copy(find_data("data", "default_pile.npz"), pile)
    plan.write_text("{}")
    model = models / "lhd/lhd.sdf"
    model.write_text(model.read_text().replace("package://drakerock/lhd/", ""))
    scenario = Scenario().replace(
        **{
            "machine.model": str(model),
            "machine.expected.critical_moment": 145e3,
            "rocks.shapes": (str(models / "rocks/rock_0.obj"),),
            "pile.source": str(pile),
            "loading.planning.source": str(plan),
        }
    )
    seen = {calc_config_hash(scenario)}
    recipes = {calc_config_hash(make_recipe(scenario))}
    for path in (model, models / "lhd/bucket_1.obj", models / "rocks/rock_0.obj", pile, plan):
        path.write_bytes(path.read_bytes() + b" ")
        seen.add(calc_config_hash(scenario))
        recipes.add(calc_config_hash(make_recipe(scenario)))
    assert len(seen) == 6
    assert len(recipes) == 3  # rock and pile


def test_a_file_may_include_itself_or_miss_parts(tmp_path):
    path = tmp_path / "a.sdf"
    path.write_text("<sdf><include><uri>a.sdf</uri></include><uri>nothing.obj</uri></sdf>")
    before = calc_file_hash(str(path))
    (tmp_path / "nothing.obj").write_text("v 0 0 0")
    assert calc_file_hash(str(path)) != before
    assert calc_file_hash("no such file") != calc_file_hash("nor this")


def test_modules_of_a_study_count_by_content(tmp_path):
    module = tmp_path / "mine.py"
    module.write_text("")
    study = StudyConfig(modules=(str(module), "json"))
    before = calc_config_hash(study)
    module.write_text("x = 1\n")
    assert calc_config_hash(study) != before


def test_the_results_revision_is_part_of_every_hash_and_of_the_versions(monkeypatch):
    before = calc_config_hash(Scenario())
    monkeypatch.setattr(identity, "RESULTS_REVISION", identity.RESULTS_REVISION + 1)
    assert calc_config_hash(Scenario()) != before
    assert set(get_versions()) == {"results", "drakerock", "drake", "numba", "numpy"}


def test_the_shipped_pile_is_that_of_the_default_scenario():
    pile = load_pile(find_data("data", "default_pile.npz"))
    # Not so? See data/make_default_pile.py.
    assert pile.provenance["recipe"] == calc_config_hash(make_recipe(Scenario()))
    assert pile.provenance["versions"]["results"] == str(identity.RESULTS_REVISION)
    assert np.isfinite(pile.p_WRs).all()
