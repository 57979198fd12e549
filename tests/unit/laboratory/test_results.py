"""Contract: a row tells mean, interval and nothing that was not measured."""

import json

import numpy as np
import pytest
from scipy.stats import t

from drakerock.laboratory.results import Known, Row
from drakerock.viewing.lab_table import format_mean


def test_a_row_has_students_interval_of_what_was_measured():
    row = Row("angle", "deg", np.array([38.0, 40.0, np.nan, 42.0]))
    low, high = t.interval(0.9, 2, loc=40.0, scale=2.0 / np.sqrt(3))
    assert row.mean == 40.0
    assert row.half_width == pytest.approx(0.5 * (high - low))
    assert format_mean(row) == "40.0 +- 3.4"


def test_a_row_without_a_value_is_none_in_json():
    row = Row("angle", "deg", np.array([np.nan, np.nan]), Known(30.0, 40.0, "somebody"))
    data = json.loads(json.dumps(row.to_dict(), allow_nan=False))
    assert data["mean"] is data["half_width"] is None
    assert data["known"] == {"low": 30.0, "high": 40.0, "source": "somebody"}
    assert format_mean(row) == "-"


def test_one_repeat_has_no_interval():
    assert np.isnan(Row("angle", "deg", np.array([38.0])).half_width)
