"""`drakerock study ...` as a user meets it: what is printed and written, and one clear line where it cannot be done.

The simulation is the stand-in of `study_work`.
"""

import csv
import json
import re
import shlex
import shutil
import sqlite3
from pathlib import Path

import jsonschema
import pyarrow.parquet as pq
import pytest
from typer.main import get_command

import study_work
from drakerock import cli
from drakerock.config import parse_config
from drakerock.loading.scenario import Scenario
from drakerock.resources import find_data
from drakerock.study.resimulation import Resimulation
from drakerock.study.runner import run_study
from drakerock.study.schema import StudyConfig
from drakerock.viewing import report
from drakerock.yaml_reader import YamlDocument
from report_helpers import save_confirmation

STUDY = """
name: trial
seed: 3
loadings: 2
executor: {kind: serial}
exploration:
  sampling: {n_initial: 12, n_corners: 0, n_samples: 12, n_validation: 3}
  surrogate: {n_starts: 1}
  pareto: {population: 20, evaluations: 400, n_draws: 0}
  n_confirm: 2
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study") / "store"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(study_work, "DURATION", 0.0)
        run_study(parse_config(STUDY, StudyConfig), folder, work="study_work:run")
    return folder


@pytest.fixture
def store(finished, tmp_path, monkeypatch):
    """A copy of the finished study, `store` in the working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(study_work, "DURATION", 0.0)
    monkeypatch.setattr(report, "save_figures", save_confirmation)
    for function in (run_study, Resimulation.__init__):
        monkeypatch.setitem(function.__kwdefaults__, "work", "study_work:run")
    Path("trial.yaml").write_text(STUDY)
    return shutil.copytree(finished, tmp_path / "store")


@pytest.fixture
def run(run_command):
    return run_command


def test_status_in_words_and_as_json(store, run):
    code, out, _ = run("study", "status", "store")
    assert code == 0
    assert "Study trial" in out
    assert "15 done, 0 running, 0 failed, 0 to do, of 15" in out
    code, out, _ = run("study", "status", "store", "--json")
    status = json.loads(out)
    assert code == 0
    assert status["complete"]
    assert status["cycles"] == {"total": 30, "recorded": 30, "failed": 0}


def test_running_a_finished_study_again_shows_the_same(store, run):
    before = (store / "responses.csv").read_bytes()
    code, out, err = run("study", "run", "trial.yaml", "--out", "store")
    assert code == 0
    assert "complete" in out
    assert "running on this process" in err
    assert (store / "responses.csv").read_bytes() == before


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_export_writes_what_it_says(store, run, suffix):
    for path in store.glob(f"*.{suffix}"):
        path.unlink()
    code, out, _ = run("study", "export", "store", "--format", suffix)
    assert code == 0
    names = ["responses", "loadings"] + ["height_fields"] * (suffix == "parquet")
    assert out.splitlines() == [f"wrote store/{name}.{suffix}" for name in names]
    if suffix == "csv":
        with open(store / "responses.csv") as file:
            rows = list(csv.DictReader(file))
    else:
        rows = pq.read_table(store / "responses.parquet").to_pylist()
        assert pq.read_table(store / "loadings.parquet").num_rows == 30
    assert len(rows) == 15
    assert {"point", "role", "alpha", "production", "production_se", "n_loadings"} <= set(rows[0])


def test_verify_says_what_is_wrong_and_where(store, run):
    assert run("study", "verify", "store")[:2] == (0, "no faults\n")
    (store / "points/s0001/attempt_0/loading_00/signals.bin").unlink()
    (store / "points/s0002/attempt_0/loading_01/signals.bin").write_bytes(b"other")
    (store / "points/left_over.txt").write_text("?")
    code, out, _ = run("study", "verify", "store")
    assert code == 1
    assert out.splitlines() == [
        "missing: points/s0001/attempt_0/loading_00/signals.bin is recorded but not there",
        "damaged: points/s0002/attempt_0/loading_01/signals.bin is not as it was recorded (checksum)",
        "orphan: points/left_over.txt belongs to nothing that is recorded",
        "3 faults",
    ]
    code, out, _ = run("study", "verify", "store", "--json")
    assert code == 1
    assert [item["kind"] for item in json.loads(out)] == ["missing", "damaged", "orphan"]


def read_shipped(name):
    path = find_data("studies", f"{name}.yaml")
    return YamlDocument(path.read_text(), str(path)).data


def test_schema_describes_the_shipped_studies(run):
    code, out, _ = run("schema", "study")
    schema = json.loads(out)
    assert code == 0
    jsonschema.Draft202012Validator.check_schema(schema)
    for name in ("smoke", "reduced", "full_size", "paper", "control_parameters"):
        jsonschema.validate(read_shipped(name), schema)
    jsonschema.validate({"executor": {"memory_limit": 0, "slurm": {"account": 17}}}, schema)
    for wrong in ({"laodings": 3}, {"loadings": True}, {"scenario": {"seed": -1}}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, schema)


def test_schema_describes_the_shipped_scenarios(run):
    code, out, _ = run("schema", "scenario")
    schema = json.loads(out)
    assert code == 0
    jsonschema.Draft202012Validator.check_schema(schema)
    for name in ("demo", "small"):
        jsonschema.validate(read_shipped(name), schema)
    jsonschema.validate(Scenario().model_dump(mode="json"), schema)
    for wrong in ({"laoding": {}}, {"rocks": {"friction": "yes"}, "seed": "x"}, {"pile": {"rocks": True}}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, schema)


def test_confirm_report_strategy(store, run):
    code, out, err = run("study", "confirm", "store")
    assert code == 0
    assert out.count("simulated") == 6
    assert "wrote store/confirmation.json" in out
    assert "2 of 2 points simulated" in err
    code, out, err = run("study", "confirm", "store", "--json")
    assert (code, len(json.loads(out)), err) == (0, 2, "")  # nothing was left to simulate
    code, out, _ = run("strategy", "store", "--weights", "production=1", "--json")
    assert code == 0
    assert json.loads(out)["objectives"]["production"] > 0


def test_confirm_in_several_processes_gives_the_same(store, run):
    code, serial, _ = run("study", "confirm", "store", "--json")
    assert code == 0
    study = json.loads((store / "study.json").read_text())
    study["study"]["executor"]["kind"] = "local"
    (store / "study.json").write_text(json.dumps(study))
    shutil.rmtree(store / "confirmation")
    code, local, err = run("study", "confirm", "store", "--workers", "2", "--json")
    assert code == 0, err
    assert "running on this machine, 2 workers" in err
    assert local == serial


def remove_database(store):
    (store / "study.db").unlink()


def empty_database(store):
    (store / "study.db").write_bytes(b"")


def replace_database(store):
    (store / "study.db").write_bytes(b"not a database, but some bytes" * 100)


def foreign_database(store):
    (store / "study.db").unlink()
    with sqlite3.connect(store / "study.db") as db:
        db.execute("CREATE TABLE songs (title TEXT)")


def damage_database(store):
    """Overwrite all but the first page."""
    data = (store / "study.db").read_bytes()
    (store / "study.db").write_bytes(data[:4096] + b"\xff" * (len(data) - 4096))


def remove_study(store):
    (store / "study.json").unlink()


def damage_study(store):
    (store / "study.json").write_text('{"study": {"loadings": "many"}}')


HARMS = [
    (remove_database, ["study.db"]),
    (empty_database, ["study.db", "not a readable study database"]),
    (replace_database, ["study.db", "not a readable study database"]),
    (foreign_database, ["study.db", "not a readable study database"]),
    (damage_database, ["study.db"]),
    (remove_study, ["study.json", "no such file"]),
    (damage_study, ["study.json", "not a readable study"]),
]


def is_one_line(text):
    return len(text.splitlines()) == 1


@pytest.mark.parametrize("command", ["status", "export", "verify", "confirm"])
@pytest.mark.parametrize(("harm", "parts"), HARMS, ids=lambda item: getattr(item, "__name__", ""))
def test_a_harmed_store_is_one_line(store, run, command, harm, parts):
    harm(store)
    code, out, err = run("study", command, "store")
    if harm is damage_database and command == "verify":
        assert code == 1  # that is what it looks for
        assert out.startswith("database: study.db")
        return
    assert code == 2, (out, err)
    assert is_one_line(err), err
    assert out == ""
    for part in ["error: ", *parts]:
        assert part in err


@pytest.mark.parametrize("command", ["status", "export", "verify", "confirm", "report"])
def test_no_study_there_is_one_line(store, run, command, tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/cat.png").write_bytes(b"?")
    for folder in ("nowhere", "photos"):
        code, out, err = run("study", command, folder)
        assert (code, out) == (2, "")
        assert is_one_line(err), err
        assert folder in err
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["cat.png"]
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (["export", "store", "--format", "xlsx"], ["format xlsx", "csv or parquet"]),
        (["confirm", "store", "--points", "0"], ["at least one"]),
        (["run", "nothing.yaml", "--out", "new"], ["nothing.yaml", "no such file"]),
        (["run", "wrong.yaml", "--out", "new"], ["wrong.yaml:1", "laodings", "did you mean 'loadings'?"]),
        (["run", "trial.yaml", "--out", "trial.yaml"], ["trial.yaml: the folder cannot be written"]),
        (["run", "trial.yaml", "--out", "store", "--set", "seed=4"], ["another study", "seed"]),
        (["run", "trial.yaml", "--out", "new", "--set", "sede=4"], ["sede", "did you mean 'seed'?"]),
    ],
)  # fmt: skip
def test_bad_words_are_one_line(store, run, words, parts):
    Path("wrong.yaml").write_text("laodings: 3\n")
    code, out, err = run("study", *words)
    assert (code, out) == (2, "")
    assert is_one_line(err), err
    for part in parts:
        assert part in err
    assert not Path("new").exists()


ROOT = Path(__file__).resolve().parents[2]


def parse(words):
    """Parse a command line as the command would, without doing it; its errors come through."""
    command, path = get_command(cli.app), ["drakerock"]
    while hasattr(command, "commands"):
        assert words, f"{' '.join(path)} is no command of its own"
        path.append(words[0])
        assert words[0] in command.commands, f"no command {' '.join(path)}"
        command, words = command.commands[words[0]], words[1:]
    command.make_context(" ".join(path), list(words))


def list_leaves(command, path=()):
    if hasattr(command, "commands"):
        for name, child in command.commands.items():
            yield from list_leaves(child, (*path, name))
    else:
        yield path, command


def test_the_examples_of_the_help_texts_are_valid_commands():
    for path, command in list_leaves(get_command(cli.app)):
        examples = re.findall(r"Example: drakerock (.*)", command.help)
        assert examples
        for example in examples:
            words = shlex.split(example.split(">")[0] if " > " in example else example)
            assert tuple(words[: len(path)]) == path
            parse(words)
            for word in words:
                assert not word.startswith("studies/") or (ROOT / word).exists(), word


def test_the_commands_in_the_documentation_are_valid():
    found = 0
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        text = path.read_text().replace("\\\n", " ")  # a backslash at a line's end: it goes on
        for line in re.findall(r"^ *drakerock (.*)$", text, re.MULTILINE):
            words = shlex.split(line.split(" > ")[0], comments=True)
            # DIR|TABLE is one of the two, [--out DIR] may be left out, ... stands for more.
            words = [word.strip("[]") for word in words if word != "..."]
            # A shell loop's variables are numbers.
            words = [re.sub(r"\$\w+", "1", word) for word in words]
            try:
                parse(words)
            except Exception as error:
                pytest.fail(f"{path.name}: drakerock {line}: {getattr(error, 'message', error)}")
            found += 1
    assert found > 20
