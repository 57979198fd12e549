import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

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


def write_plain(path, table, header=None, separator=",", comma=False, before="", role=str):
    """Write a table by hand: as a spreadsheet or another program would."""
    names = ["point", "role", *PROBLEM.variable_names, *PROBLEM.objective_names]
    lines = [separator.join(header or names)]
    for i in range(len(table)):
        numbers = [repr(float(v)) for v in (*table.X[i], *table.Y[i])]
        numbers = [number.replace(".", ",") for number in numbers] if comma else numbers
        lines.append(separator.join([table.point[i], role(table.role[i]), *numbers]))
    path.write_text(before + "\n".join(lines) + "\n", encoding="utf-8")
    return path


def spell(name):
    """Ways to write a name that leave no doubt."""
    return st.sampled_from([name, name.upper(), name.title(), f" {name}", f"{name} ", f"{name} [-]"])


class TestDialects:
    """What is not the plain form is taken where there is one reading, and said."""

    @settings(deadline=None, max_examples=60)
    @given(data=st.data())
    def test_every_spelling_gives_the_same_table(self, tmp_path_factory, data):
        path, table = tmp_path_factory.mktemp("table") / "responses.csv", make_table(6)
        separator = data.draw(st.sampled_from([",", ";", "\t"]))
        comma = separator != "," and data.draw(st.booleans())
        names = ["point", "role", *PROBLEM.variable_names, *PROBLEM.objective_names]
        header = [data.draw(spell(name)) for name in names]
        order = data.draw(st.permutations(["\ufeff", "# a comment; with, marks\n", "\n"]))
        before = "".join(sorted(order[: data.draw(st.integers(0, 3))], key=lambda part: part != "\ufeff"))
        words = data.draw(
            st.sampled_from(
                [("sample", "validation"), ("Sample", "Validation"), ("train", "test"), ("", "VAL ")]
            )
        )
        role = {"sample": words[0], "validation": words[1]}.get
        back = ResponseTable.load(write_plain(path, table, header, separator, comma, before, role))
        assert np.array_equal(back.X, table.X)
        assert np.array_equal(back.Y, table.Y)
        assert (back.point, back.role) == (table.point, table.role)

    def test_what_is_assumed_is_said(self, tmp_path, caplog):
        path = tmp_path / "responses.csv"
        header = ["point", "role", "Alpha", "beta", "gamma", "kappa", "production [kg/s]", "damage", "debris"]
        write_plain(path, make_table(4), header, ";", True, "# made by hand\n", str.upper)
        ResponseTable.load(path)
        for part in (
            "separated by semicolons", "decimal commas", "column 'Alpha' is taken as 'alpha'",
            "role 'SAMPLE' is taken as sample", "begin with # are taken as comments",
        ):  # fmt: skip
            assert part in caplog.text, part
        caplog.clear()
        ResponseTable.load(make_table(4).save(path))
        assert caplog.text == "", "nothing is said of the plain form"

    def test_utf_16_and_the_separator_line_of_spreadsheets(self, tmp_path):
        path, table = tmp_path / "responses.csv", make_table(4)
        write_plain(path, table, separator=";", before="sep=;\n")
        assert ResponseTable.load(path).point == table.point
        path.write_bytes(path.read_text(encoding="utf-8").encode("utf-16"))
        assert ResponseTable.load(path).point == table.point

    def test_a_row_of_units(self, tmp_path):
        path, table = tmp_path / "responses.csv", make_table(4)
        lines = write_plain(path, table).read_text().splitlines()
        path.write_text("\n".join([lines[0], ",,-,-,-,-,[kg/s],-,kg", *lines[1:]]))
        assert np.array_equal(ResponseTable.load(path).Y, table.Y)
        path.write_text("\n".join([lines[0], ",,-,-,-,-,t/h,-,kg", *lines[1:]]))
        with pytest.raises(InputError, match="production is in t/h, and must be in kg/s"):
            ResponseTable.load(path)
        path.write_text("\n".join([lines[0].replace("debris", "debris (t)"), *lines[1:]]))
        with pytest.raises(InputError, match="debris is in t, and must be in kg"):
            ResponseTable.load(path)

    def test_a_header_behind_a_hash(self, tmp_path):
        path = tmp_path / "responses.csv"
        write_plain(path, make_table(4), before="# ")
        assert len(ResponseTable.load(path)) == 4


HEADER = "point,role,alpha,beta,gamma,kappa,production,damage,debris"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{HEADER},alpha\na,,1,0,0,0,1,1,1,1\n", r"several columns are called 'alpha' \(columns 3 and 10\)"),
        (f"{HEADER.replace('alpha', 'Alpha')},ALPHA\na,,1,0,0,0,1,1,1,1\n", "'Alpha' and 'ALPHA' may both be"),
        (f"{HEADER}\na,,2024-05-01,0,0,0,1,1,1\n", r"'2024-05-01' in line 2 \(a date"),
        (f"{HEADER}\na,,1,0,0,0,1e300,1,1\n", r"'production' .* '1e300' in line 2 \(too large"),
        (f"{HEADER}\na,,1,0,0,0,inf,1,1\n", r"no number: 'inf'"),
        (f"{HEADER}\na,,1,0,0,0,1,1\n", "line 2 has 8 cells, the header 9"),
        (f"{HEADER}\na,,1,0,0,0,1,5,1,1\n", "decimal commas need semicolons"),
        (f"{HEADER}\na,,1,0,0,0,\"1,5\",1.5,1\n", r"a comma \('1,5'\) and with a decimal point \('1.5'\)"),
        (f"{HEADER}\na,,1,0,0,0,\"1,500\",1,1\n", "'1,500' may be a number with a decimal comma or a large one"),
        (f"{HEADER}\n#a,,1,0,0,0,1,1,1\n", "line 2 may be a comment or a point called '#a'"),
        (f"{HEADER}\na,,1,0,0,0,1,1,1\na,,1,0,0,0,1,1,1\n", r"point 'a' has two rows \(line 2 and line 3\)"),
        (f"{HEADER},n_failed\na,,1,0,0,0,1,1,1,0.5\n", "line 2: n_failed is 0.5; needed is a whole number"),
        (f"{HEADER},loading\na,,1,0,0,0,1,1,1,\n", "line 2: loading is nan"),
        (f"{HEADER},loading\na,,1,0,0,0,1,1,1,0\na,,1,0,0,0,1,1,1,0\n", "point 'a' has the loading 0 twice"),
        ("", "an empty file"),
        (f'{HEADER}\n"a,,1,0,0,0,1,1,1\n', "line 2: unexpected end of data"),
        (f"{HEADER}\na,,1,0,0,0,1,1,1\0\n", "holds zero bytes"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_in_one_way_is_refused(tmp_path, text, message):
    path = tmp_path / "responses.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=r"responses\.csv: .*" + message):
        ResponseTable.load(path)


def test_a_file_in_another_encoding_is_refused(tmp_path):
    path = tmp_path / "responses.csv"
    path.write_bytes(f"{HEADER}\nGrün,,1,0,0,0,1,1,1\n".encode("latin-1"))
    with pytest.raises(InputError, match=r"not UTF-8 text \(byte 0xfc in line 2\)"):
        ResponseTable.load(path)


@pytest.mark.parametrize(
    ("column", "kind"),
    [
        (pa.array([19000, 19001, 19002], pa.date32()), "date32"),
        (pa.array([1, 2, 3], pa.timestamp("ns")), "timestamp"),
        (pa.array([True, False, True]), "bool"),
        (pa.array([[1.0], [2.0], [3.0]]), "list"),
        (pa.array([b"1", b"2", b"3"]), "binary"),
        (pa.array([{"a": 1}] * 3), "struct"),
    ],
)
def test_odd_columns_of_parquet_are_refused(tmp_path, column, kind):
    arrow = make_table(3).to_arrow()
    arrow = arrow.set_column(arrow.column_names.index("damage"), "damage", column)
    pq.write_table(arrow, tmp_path / "responses.parquet")
    with pytest.raises(InputError, match=f"column 'damage' holds {kind}.*; allowed are numbers"):
        ResponseTable.load(tmp_path)


@pytest.mark.parametrize(
    "kind", [pa.string(), pa.float32(), pa.int8(), pa.decimal128(9, 2), pa.dictionary(pa.int8(), pa.string())]
)
def test_numbers_in_other_types_of_parquet_are_read(tmp_path, kind):
    arrow = make_table(3).to_arrow()
    values = pa.array(["1", "2", "3"]).cast(kind) if not pa.types.is_dictionary(kind) else pa.array(
        ["1", "2", "3"]).dictionary_encode()  # fmt: skip
    arrow = arrow.set_column(arrow.column_names.index("damage"), "damage", values)
    pq.write_table(arrow, tmp_path / "responses.parquet")
    assert list(ResponseTable.load(tmp_path).Y[:, 1]) == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("name", ["point", "role", "loading", "failure", "Role", "seconds", "p_optimal"])
def test_names_of_the_tables_own_columns_are_refused(tmp_path, name):
    variable, objective = Variable(name="x", low=0, high=1), Objective(name="y")
    with pytest.raises(ValidationError, match=f"may be called '{name}', a column of the tables"):
        Problem(variables=(Variable(name=name, low=0, high=1),), objectives=(objective,))
    with pytest.raises(ValidationError, match=f"may be called '{name}'"):
        Problem(variables=(variable,), objectives=(Objective(name=name),))
    path = tmp_path / "responses.csv"
    path.write_text(f"{name},y\n0.5,1\n")
    problem = {"variables": [{"name": name, "low": 0, "high": 1}], "objectives": [{"name": "y"}]}
    (tmp_path / "study.json").write_text(json.dumps({"problem": problem}))
    with pytest.raises(InputError, match=rf"study\.json: problem.*may be called '{name}'"):
        ResponseTable.load(path)


@pytest.mark.parametrize("suffix", ["_se", "_std", "_predicted", "_z"])
def test_names_beside_an_objective_are_refused(suffix):
    with pytest.raises(ValidationError, match=f"'y{suffix}', a column that belongs to 'y'"):
        Problem(variables=(Variable(name=f"y{suffix}", low=0, high=1),), objectives=(Objective(name="y"),))


def test_a_loading_without_a_value_of_one_objective_has_not_failed(tmp_path):
    rows = [
        f"{HEADER.replace('role', 'loading')},failure",
        "a,0,1,0,0,0,10,,1,",
        "a,1,1,0,0,0,20,4,1,",
        "a,2,1,0,0,0,,,,stuck",
    ]
    path = tmp_path / "cycles.csv"
    path.write_text("\n".join(rows))
    table = ResponseTable.load(path)
    assert list(table.Y[0]) == [15.0, 4.0, 1.0]
    assert (table.n_loadings, table.n_failed) == ((3,), (1,))
