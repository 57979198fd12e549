"""Contract: what is learned from is what the study stored, row for row, and no test row is of a point fitted to."""

import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest

import study_work
from drakerock.autonomy.data import read_loading_data
from drakerock.config import parse_config
from drakerock.errors import InputError
from drakerock.loading.features import PileFeatures, calc_pile_features
from drakerock.loading.field_file import load_height_fields
from drakerock.study.runner import run_study
from drakerock.study.schema import StudyConfig
from drakerock.study.tables import export_tables
from tests.unit.autonomy.synthetic import make_data

TEXT = """
name: trial
seed: 3
loadings: 3
executor: {kind: serial}
exploration: {sampling: {n_initial: 6, n_corners: 0, n_samples: 6, n_validation: 2}}
"""


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study") / "store"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_work, "DURATION", 0.0)
        run_study(parse_config(TEXT, StudyConfig), folder, work="study_work:run")
    return folder


@pytest.fixture(scope="module")
def data(store):
    return read_loading_data(store)


def test_rows_are_those_of_the_files(store, data):
    assert len(data) == 8 * 3
    for i in range(len(data)):
        place = (
            store / "points" / data.point[i] / f"attempt_{data.attempt[i]}" / f"loading_{data.loading[i]:02d}"
        )
        before, after = load_height_fields(place / "height_fields.npz")
        assert np.allclose(data.before[i], before.h, atol=1e-6)
        assert np.allclose(data.after[i], after.h, atol=1e-6)
        assert np.allclose(data.x, before.x)
        assert np.allclose(data.y, before.y)
        features = calc_pile_features(before, data.scenario.loading.sensing.front_height)
        for name, value in zip(PileFeatures.list_names(), data.features[i], strict=True):
            assert np.isclose(value, getattr(features, name), equal_nan=True)
        # The stand-in's production is a line in alpha and beta, up to noise.
        assert abs(data.Y[i, 0] - 100 * data.X[i, 0] - 30 * data.X[i, 1]) < 20


def test_the_following_pile_is_the_next_loading_s(data):
    for i in range(len(data)):
        if data.loading[i] == 2:
            assert np.isnan(data.following[i]).all()
        else:
            assert data.point[i + 1] == data.point[i]
            assert np.array_equal(data.following[i], data.before[i + 1])


def test_exported_tables_hold_the_same(store, data, tmp_path):
    export_tables(store, ["parquet"])
    for name in ("loadings.parquet", "height_fields.parquet", "study.json"):
        shutil.copy(store / name, tmp_path)
    again = read_loading_data(tmp_path)
    for name in ("X", "Y", "before", "after", "point", "loading", "role"):
        assert np.array_equal(getattr(again, name), getattr(data, name)), name
    assert again.problem == data.problem


def test_splits_share_no_point(data):
    fit, test = data.split()
    assert set(test.role) == {"validation"}
    assert not set(fit.point) & set(test.point)
    fit, test = data.split(0.5, seed=4)
    assert not set(fit.point) & set(test.point)
    assert len(np.unique(test.point)) == 4
    assert set(data.split(0.5, seed=5)[1].point) != set(test.point)


def test_folds_share_no_point_and_test_each_row_once():
    data = make_data(7, 3)
    folds = data.iterate_folds(3)
    assert np.array_equal(sum(test.astype(int) for _, test in folds), np.ones(len(data)))
    for fit, test in folds:
        assert not set(data.point[fit]) & set(data.point[test])


def test_a_split_that_leaves_nothing_is_refused(data):
    with pytest.raises(InputError, match="cannot be split"):
        data.split(0.0)


@pytest.mark.parametrize("missing", ["loadings.parquet", "height_fields.parquet", "study.json"])
def test_a_missing_file_is_named(store, tmp_path, missing):
    export_tables(store, ["parquet"])
    for name in {"loadings.parquet", "height_fields.parquet", "study.json"} - {missing}:
        shutil.copy(store / name, tmp_path)
    with pytest.raises(InputError, match=f"{missing}: no such file"):
        read_loading_data(tmp_path)


def test_a_damaged_table_and_one_without_a_column_are_named(store, tmp_path):
    export_tables(store, ["parquet"])
    for name in ("loadings.parquet", "height_fields.parquet", "study.json"):
        shutil.copy(store / name, tmp_path)
    pq.write_table(
        pq.read_table(tmp_path / "loadings.parquet").drop(["kappa"]), tmp_path / "loadings.parquet"
    )
    with pytest.raises(InputError, match="loadings has no column kappa"):
        read_loading_data(tmp_path)
    (tmp_path / "loadings.parquet").write_bytes(b"no table")
    with pytest.raises(InputError, match="not a readable table"):
        read_loading_data(tmp_path)
