"""Contract: a sequence goes on only with the inputs and versions that it began with. Caught: half sequences were
finished by another version of the program.
"""

import pytest

import study_work
from drakerock.errors import InputError
from drakerock.identity import RESULTS_REVISION, calc_config_hash
from drakerock.loading.scenario import Scenario
from drakerock.loading.sequence import _read_loading


def test_loadings_of_other_inputs_or_versions_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(study_work, "DURATION", 0.0)
    scenario = Scenario()
    study_work.run(scenario, 1, tmp_path)  # which notes no versions
    place = tmp_path / "loading_00"
    with pytest.raises(InputError, match="of another scenario"):
        _read_loading(place, calc_config_hash(scenario.replace(seed=1)))
    with pytest.raises(
        InputError, match=rf"made by other versions .*results {RESULTS_REVISION} .*; take another folder"
    ):
        _read_loading(place, calc_config_hash(scenario))
