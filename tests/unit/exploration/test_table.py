import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drakerock.errors import InputError
from drakerock.exploration.problem import Objective, Problem, Variable
from drakerock.exploration.problems import make_noisy_loading, make_noisy_table
from drakerock.exploration.table import ResponseTable, average_loadings

PROBLEM = make_noisy_loading().problem


def make_table(n=12, seed=0):
    X = PROBLEM.unscale(np.random.default_rng(seed).uniform(-1, 1, (n, 4)))
    return make_noisy_table(X, np.random.default_rng(seed), n_validation=3)


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_round_trip(tmp_path, suffix):
    table = make_table()
    Y = table.Y.copy()
    Y[2] = np.nan
    table = ResponseTable(
        PROBLEM, table.X, Y, table.noise, table.point, table.role, table.n_loadings, (0, 0, 20) + (0,) * 9,
        ("", "", "rock, stuck") + ("",) * 9, ("replays/p000.html",) + ("",) * 11,
    )  # fmt: skip
    back = ResponseTable.load(table.save(tmp_path / f"responses.{suffix}"))
    for name in ("X", "Y", "noise"):
        assert np.array_equal(getattr(back, name), getattr(table, name), equal_nan=True)
    for name in ("point", "role", "n_loadings", "n_failed", "failure", "replay"):
        assert getattr(back, name) == getattr(table, name)
    assert ResponseTable.load(tmp_path).point == table.point, "a folder stands for the table in it"


def test_other_problems_come_with_the_file_or_with_study_json(tmp_path):
    problem = Problem(
        variables=(Variable(name="gain", low=0, high=5, unit="1/s"),),
        objectives=(Objective(name="time", unit="s"),),
    )
    table = ResponseTable(problem, np.array([[1.0], [2.0]]), np.array([[3.0], [np.nan]]))
    assert ResponseTable.load(table.save(tmp_path / "a.parquet")).problem == problem
    path = table.save(tmp_path / "a.csv")
    with pytest.raises(InputError, match="no column 'alpha'"):
        ResponseTable.load(path)
    assert ResponseTable.load(path, problem).problem == problem
    (tmp_path / "study.json").write_text(
        json.dumps({"name": "x", "problem": problem.model_dump(mode="json")})
    )
    back = ResponseTable.load(path)
    assert back.problem == problem
    assert back.provenance["name"] == "x"


def test_one_row_per_loading_is_averaged(tmp_path):
    rows = ["point,loading,alpha,beta,gamma,kappa,production,damage,debris,failure"]
    for i in range(20):
        rows.append(f"a,{i},1,0.5,0.5,0.5,{200 + i % 2},{0.5},{10 * i},")
    rows += ["b,0,0.2,0,0,0,100,1,5,", "b,1,0.2,0,0,0,,,,solver gave up"]
    path = tmp_path / "cycles.csv"
    path.write_text("\n".join(rows))
    table = ResponseTable.load(path)
    assert table.point == ("a", "b")
    assert table.Y[0] == pytest.approx([200.5, 0.5, 95.0])
    assert table.n_loadings == (20, 2)
    assert table.n_failed == (0, 1)
    assert table.failure == ("", "solver gave up")
    assert np.isnan(table.noise[1]).all()
    assert table.noise[0, 1] == 0.0
    assert table.noise[0, 2] > 0.0


def test_empty_cells_of_parquet(tmp_path):
    arrow = make_table(3).to_arrow()
    for name in ("failure", "replay", "production", "n_failed"):
        column = arrow.column(name)
        arrow = arrow.set_column(arrow.column_names.index(name), name, pa.nulls(3, column.type))
    pq.write_table(arrow, tmp_path / "responses.parquet")
    table = ResponseTable.load(tmp_path)
    assert table.failure == table.replay == ("", "", "")
    assert table.n_failed == (0, 0, 0)
    assert np.isnan(table.Y[:, 0]).all()


def test_loadings_are_put_in_order():
    """Autocorrelation is along the loading number, whatever the order of the rows."""
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.standard_normal((40, 20)), axis=1)
    X = np.repeat(PROBLEM.unscale(rng.uniform(-1, 1, (40, 4))), 20, axis=0)
    Y = np.repeat(walk.reshape(-1, 1), 3, axis=1)
    point, loading = [f"{i}" for i in range(40) for _ in range(20)], np.tile(np.arange(20), 40)
    table = average_loadings(PROBLEM, point, loading, X, Y)
    mix = rng.permutation(800)
    mixed = average_loadings(PROBLEM, [point[i] for i in mix], loading[mix], X[mix], Y[mix])
    back = [mixed.point.index(name) for name in table.point]
    assert mixed.noise[back] == pytest.approx(table.noise)


@settings(deadline=None, max_examples=20)
@given(st.lists(st.sampled_from(["sample", "validation"]), max_size=12))
def test_roles_part_the_table(roles):
    table = make_table(12).take(list(range(len(roles))))
    if roles:
        table = ResponseTable(PROBLEM, table.X, table.Y, table.noise, table.point, tuple(roles))
    parts = [table.select(role) for role in ("sample", "validation")]
    assert sorted(p for part in parts for p in part.point) == sorted(table.point)
    assert [len(part) for part in parts] == [roles.count("sample"), roles.count("validation")]


class TestErrors:
    def write(self, tmp_path, text):
        path = tmp_path / "responses.csv"
        path.write_text(text)
        return path

    header = "point,role,alpha,beta,gamma,kappa,production,damage,debris\n"

    def test_no_such_file(self, tmp_path):
        with pytest.raises(InputError, match="no such file or folder"):
            ResponseTable.load(tmp_path / "none.csv")
        with pytest.raises(InputError, match="study export"):
            ResponseTable.load(tmp_path)
        (tmp_path / "a.xlsx").write_text("")
        with pytest.raises(InputError, match=r"\.csv or \.parquet"):
            ResponseTable.load(tmp_path / "a.xlsx")

    def test_missing_column_names_the_nearest(self, tmp_path):
        path = self.write(tmp_path, self.header.replace("debris", "debri") + "a,sample,1,0,0,0,1,1,1\n")
        with pytest.raises(
            InputError, match=r"responses\.csv: no column 'debris' \(did you mean 'debri'\?\)"
        ):
            ResponseTable.load(path)

    def test_text_in_a_number_column(self, tmp_path):
        path = self.write(tmp_path, self.header + "a,sample,1,0,0,0,much,1,1\n")
        with pytest.raises(InputError, match="column 'production' has a value that is no number"):
            ResponseTable.load(path)

    def test_out_of_range(self, tmp_path):
        path = self.write(tmp_path, self.header + "a,sample,2.5,0,0,0,1,1,1\n")
        with pytest.raises(InputError, match=r"point 'a': alpha = 2.5 is not in \[0.2, 2\]"):
            ResponseTable.load(path)
        path = self.write(tmp_path, self.header + "a,sample,,0,0,0,1,1,1\nb,sample,1,0,0,0,1,1,1\n")
        with pytest.raises(InputError, match="alpha = nan"):
            ResponseTable.load(path)

    def test_unknown_role(self, tmp_path):
        path = self.write(tmp_path, self.header + "a,spare,1,0,0,0,1,1,1\n")
        with pytest.raises(InputError, match="role 'spare' is not one of sample, validation"):
            ResponseTable.load(path)

    def test_unreadable(self, tmp_path):
        path = tmp_path / "responses.parquet"
        path.write_bytes(b"no parquet")
        with pytest.raises(InputError, match="cannot be read as a table"):
            ResponseTable.load(path)
        (tmp_path / "study.json").write_text("{")
        with pytest.raises(InputError, match="not valid JSON"):
            ResponseTable.load(self.write(tmp_path, self.header + "a,sample,1,0,0,0,1,1,1\n"))

    def test_bad_problem_in_study_json(self, tmp_path):
        (tmp_path / "study.json").write_text(
            json.dumps({"problem": {"variables": [{"name": "a", "low": 1, "high": 0}]}})
        )
        with pytest.raises(InputError, match=r"study\.json: problem\.variables"):
            ResponseTable.load(self.write(tmp_path, self.header))

    def test_loadings_of_one_point_must_share_it(self, tmp_path):
        header = self.header.replace("role", "loading")
        path = self.write(tmp_path, header + "a,0,1,0,0,0,1,1,1\na,1,0.9,0,0,0,1,1,1\n")
        with pytest.raises(InputError, match="point 'a' has loadings with different design variables"):
            ResponseTable.load(path)
