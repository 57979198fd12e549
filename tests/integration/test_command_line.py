"""The command, as a user runs it: in processes of its own where that is the point, else by its `main`."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from typer.testing import CliRunner

from drakerock.cli import app
from drakerock.errors import InputError
from drakerock.loading.plan import DigPlan
from drakerock.loading.scenario import load_scenario
from drakerock.rocks.state import load_pile

COMMAND = Path(sys.executable).with_name("drakerock")


def start(*args, cwd):
    """Run the command as a process."""
    environment = os.environ | {"COLUMNS": "200", "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [str(COMMAND), *map(str, args)], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def place(tmp_path_factory, small_scenario):
    # The engine of the shipped scenarios, and the cheaper one; `test_cycle` runs a cycle with the other.
    folder = tmp_path_factory.mktemp("cli")
    scenario = small_scenario.replace(**{"dynamics.rocks": "nonsmooth"})
    (folder / "small.yaml").write_text(yaml.safe_dump(scenario.model_dump(mode="json")))
    return folder


@pytest.fixture
def run(place, monkeypatch, run_command):
    """Return a function that runs the command in this process, in the folder of `place`."""
    monkeypatch.chdir(place)
    return run_command


@pytest.fixture(scope="module")
def loaded(place):
    return start("load", "small.yaml", "--out", "out", "--alpha", "0.4", cwd=place)


def test_load_writes_everything_it_says(place, loaded):
    assert loaded.returncode == 0, loaded.stderr
    out = place / "out"
    names = [
        "outcome.json",
        "signals.parquet",
        "pile_before.npz",
        "pile_after.npz",
        "recording.npz",
        "scenario.json",
        "replay.html",
    ]
    for name in names:
        assert (out / name).stat().st_size > 0
        assert f"wrote out/{name}" in loaded.stdout
    assert "production" in loaded.stdout
    outcome = json.loads((out / "outcome.json").read_text())
    assert outcome["status"] == "done"
    assert outcome["reason"] in ("s4 reached", "s4 timed out")
    assert outcome["strategy"]["alpha"] == 0.4
    assert outcome["phi1"] == -outcome["objectives"]["production"]
    assert outcome["phi1"] == pytest.approx(-outcome["bucket_mass_kg"] / outcome["loading_time_s"])
    rocks = outcome["rocks"]
    assert 0 < rocks["awake_mean"] <= rocks["awake_max"] <= rocks["total"]
    assert 0.0 < rocks["penetration_max_m"] < 0.3
    assert rocks["lost"] == rocks["flagged_steps"] == 0
    assert np.all(np.diff(outcome["waypoint_times_s"]) >= 0)
    assert {"drakerock", "drake"} <= set(outcome["versions"])


def test_signals_have_units_and_obey_the_limits(place, loaded):
    table = pq.read_table(place / "out" / "signals.parquet")
    assert all(field.metadata[b"unit"] for field in table.schema)
    columns = {name: np.array(table[name]) for name in table.column_names}
    assert np.all(np.isfinite(np.column_stack(list(columns.values()))))
    assert np.allclose(np.diff(columns["time"]), 0.01)
    assert np.abs(columns["torque_wheels"]).max() <= 4 * 190e3 * (1 + 1e-9)
    assert np.abs(columns["torque_boom"]).max() <= 1.07 * 2000e3 * (1 + 1e-9)  # the relief
    assert np.abs(columns["torque_bucket"]).max() <= 1.07 * 800e3 * (1 + 1e-9)
    # Nothing is prescribed: before the rocks the machine is at the planned speed, by its wheels' grip.
    free = (columns["mode"] == 0) & (columns["time"] > 0.6)
    assert np.allclose(columns["v_F"][free], 1.3, atol=0.05)
    # The bucket's load is there over time, and at s4 it is what counts.
    outcome = json.loads((place / "out" / "outcome.json").read_text())
    at_s4 = np.interp(outcome["waypoint_times_s"][4], columns["time"], columns["bucket_load"])
    assert at_s4 == pytest.approx(outcome["bucket_mass_kg"], rel=1e-6, abs=1.0)
    assert columns["bucket_load"][0] == 0.0
    # The first row is of the machine in its place.
    assert abs(columns["x_T"][1] - columns["x_T"][0]) < 0.05


def test_pile_after_has_the_same_rocks_and_the_plan_is_readable(place, loaded):
    before, after = (load_pile(place / "out" / f"pile_{when}.npz") for when in ("before", "after"))
    assert np.array_equal(before.size, after.size)
    assert np.linalg.norm(after.p_WRs - before.p_WRs, axis=1).max() > 0.3
    assert after.p_WRs[:, 2].min() > 0.0
    data = json.loads((place / "out" / "plan.json").read_text())
    plan = DigPlan.from_dict(data)
    assert plan.waypoint_x[4] < plan.waypoint_x[0]


@pytest.fixture(scope="module")
def sequence(place):
    """A loading, then the same sequence asked to go on; in this process, whose kernels are compiled once."""
    args = ["load", str(place / "small.yaml"), "--alpha", "0.4", "--out", str(place / "sequence")]
    return [
        (CliRunner().invoke(app, [*args, *more]), sorted(path.name for path in place.glob("sequence/*/*")))
        for more in (["--loadings", "1", "--no-replay"], ["--loadings", "2", "--figures"])
    ]


def test_sequence_writes_loadings_and_summary_and_goes_on(place, sequence):
    (first, _), (second, _) = sequence
    assert first.exit_code == 0, first.output
    assert second.exit_code == 0, second.output
    assert "spread" in second.stdout
    assert "production [kg/s]" in second.stdout
    assert f"wrote {place}/sequence/loading_01" in second.stdout
    summary = json.loads((place / "sequence" / "sequence.json").read_text())
    assert summary["loadings"] == 2
    productions = [
        json.loads((place / "sequence" / f"loading_0{k}" / "outcome.json").read_text())["objectives"][
            "production"
        ]
        for k in (0, 1)
    ]
    row = summary["quantities"]["production"]
    assert row["values"] == productions
    assert row["mean"] == pytest.approx(np.mean(productions))
    assert row["standard_error"] == pytest.approx(np.std(productions, ddof=1) / np.sqrt(2))


def test_each_loading_of_a_sequence_has_its_replay_unless_not_wanted(place, sequence):
    (_, without), (_, both) = sequence
    assert "outcome.json" in without
    assert "replay.html" not in without
    assert both.count("replay.html") == both.count("outcome.json") == 2


def test_figures_and_resolved_scenario_are_written(place, sequence):
    for number in (0, 1):
        folder = place / "sequence" / f"loading_0{number}"
        for name in ("height_field", "plan", "tip_path", "histories", "side", "top"):
            assert (folder / f"figure_{name}.png").stat().st_size > 10_000
        stored = load_scenario(folder / "scenario.json")
        assert stored.loading.strategy.alpha == 0.4
        assert stored.dynamics.rocks == "nonsmooth"


def test_stored_plan_is_executed(place, sequence):
    first, second = (place / "sequence" / f"loading_0{k}" for k in (0, 1))
    result = CliRunner().invoke(
        app,
        ["load", str(first / "scenario.json"), "--plan", str(second / "plan.json"), "--json"]
        + ["--out", str(place / "planned")],
    )
    assert result.exit_code == 0, result.output
    other = json.loads((second / "outcome.json").read_text())
    outcome = json.loads((place / "planned" / "outcome.json").read_text())
    assert outcome["plan"] == other["plan"]


def test_replay_opens_without_network_and_can_be_made_anew(place, loaded):
    path = place / "out" / "replay.html"
    text = path.read_text()
    assert "<html" in text.lower()
    assert not re.search(r"<(script|link|img|iframe)[^>]*(src|href)\s*=\s*[\"']?(https?:)?//", text)
    path.unlink()
    again = start("replay", "out", cwd=place)
    assert again.returncode == 0, again.stderr
    assert again.stderr.strip() == ""  # no notes of Drake's
    assert path.stat().st_size > 100_000


def test_replays_of_a_sequence_can_be_made_anew(place, sequence):
    pages = [place / "sequence" / f"loading_0{k}" / "replay.html" for k in (0, 1)]
    for page in pages:
        page.unlink()
    result = CliRunner().invoke(app, ["replay", str(place / "sequence")])
    assert result.exit_code == 0, result.output
    assert all(page.exists() for page in pages)


def test_two_loadings_are_compared(place, sequence):
    folders = [str(place / "sequence" / f"loading_0{k}") for k in (0, 1)]
    page = place / "compared" / "page.html"
    result = CliRunner().invoke(app, ["compare", *folders, "--out", str(page), "--json"])
    assert result.exit_code == 0, result.output
    rows = {row["key"]: row for row in json.loads(result.stdout)}
    for key, folder in zip("ab", folders, strict=True):
        outcome = json.loads((Path(folder) / "outcome.json").read_text())
        assert float(rows["load"][key]) == pytest.approx(outcome["bucket_mass_kg"] / 1e3, abs=0.005)
        assert float(rows["damage"][key]) == pytest.approx(outcome["objectives"]["damage"], abs=5e-5)
    assert page.stat().st_size > 100_000
    table = CliRunner().invoke(app, ["compare", *folders, "--out", str(page)])
    assert "% of payload" in table.stdout


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["compare", "nowhere", "nowhere"], "nowhere: no finished loading here"),
        (["replay", "."], "no finished loading here (outcome.json is missing)"),
        (["replay", "file"], "file: no finished loading here"),
        (["film", "nowhere", "--size", "wide"], "--size wide: width x height"),
        (["film", "nowhere", "--out", "frames"], "nowhere: no finished loading here"),
        (["film", "nowhere", "--out", "film.mp4"], "nowhere: no finished loading here"),
        (["film", "nowhere", "--out", "film.gif"], "nowhere: no finished loading here"),
    ],
)
def test_what_cannot_be_shown_is_said(tmp_path, monkeypatch, args, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    result = CliRunner().invoke(app, args)
    assert isinstance(result.exception, InputError)
    assert message in str(result.exception)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_json_prints_only_json_and_the_same_cycle_again(place, loaded):
    again = start("load", "small.yaml", "--out", "again", "--alpha", "0.4", "--json", cwd=place)
    assert again.returncode == 0, again.stderr
    outcome = json.loads(again.stdout)
    first = json.loads((place / "out" / "outcome.json").read_text())
    for key in ("wall_time_s", "cpu_time_s", "ms_per_step"):
        outcome.pop(key)
        first.pop(key)
    assert outcome == first
    one, two = (load_pile(place / name / "pile_after.npz") for name in ("out", "again"))
    assert np.array_equal(one.p_WRs, two.p_WRs)  # bit for bit
    assert np.array_equal(one.q_WRs, two.q_WRs)


def test_pile_command(place, run):
    code, out, error = run("pile", "small.yaml", "--out", "pile", "--json")
    assert code == 0, error
    assert json.loads(out)["rocks"] <= 60
    for name in ("pile.npz", "pile.json", "pile.png", "pile.html"):
        assert (place / "pile" / name).stat().st_size > 0


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        (["load", "nothing.yaml"], ["nothing.yaml", "no such file"]),
        (["load", "bad.yaml"], ["bad.yaml:2", "site.drift_widht", "did you mean 'drift_width'?"]),
        (
            ["load", "small.yaml", "--alpha", "5"],
            ["override: loading.strategy.alpha", "less than or equal to 2"],
        ),
        (
            ["load", "small.yaml", "--set", "machine.model=nothing.sdf"],
            ["machine.model", "nothing.sdf", "no such file"],
        ),
        (["load", "small.yaml", "--set", "machine.model=broken.sdf"], ["broken.sdf:1", "no valid XML"]),
        (["load", "small.yaml", "--set", "machine.model=empty.sdf"], ["empty.sdf:1", "no <inertial>"]),
        (
            ["load", "small.yaml", "--set", "machine.model=package://drakerock/lhd_small/lhd_small.sdf"],
            ["machine.expected.critical_moment", "lhd_small.sdf"],
        ),
        (["load", "small.yaml", "--set", "pile.source=nothing.npz"], ["nothing.npz", "no such file"]),
        (["load", "small.yaml", "--set", "pile.source=broken.npz"], ["broken.npz", "not a readable"]),
        (["load", "small.yaml", "--set", "rocks.shapes=[broken.sdf]"], ["rocks.shapes", "broken.sdf"]),
        (["load", "small.yaml", "--out", "small.yaml/x"], ["small.yaml/x", "cannot be written"]),
        (["pile", "small.yaml", "--set", "pile.emission_height=0.3"], ["pile.rocks", "emission_height"]),
        (["load", "small.yaml", "--plan", "nothing.json"], ["nothing.json", "no such file"]),
        (["load", "small.yaml", "--plan", "bad.yaml"], ["bad.yaml", "not a readable plan"]),
        (
            ["load", "small.yaml", "--plan", "bad.json"],
            ["bad.json", "not a readable plan", "'height_field' is missing"],
        ),
        (["load", "small.yaml", "--set", "foo.bar=1"], ["override: unknown key 'foo'"]),
        (["load", "."], ["cannot be read: Is a directory"]),
        (["replay", "nowhere"], ["nowhere", "no finished loading here"]),
        (["machine", "check", "bad.yaml"], ["bad.yaml:2", "drift_widht"]),
    ],
)
def test_bad_input_gets_one_message_and_exit_code_two(place, run, args, parts):
    (place / "bad.yaml").write_text("site:\n  drift_widht: 5\n")
    (place / "bad.json").write_text("{}")
    (place / "broken.sdf").write_text("<sdf><model>")
    (place / "empty.sdf").write_text('<sdf version="1.9"><model name="m"><link name="a"/></model></sdf>')
    (place / "broken.npz").write_bytes(b"PK\x03\x04 broken")
    code, out, error = run(*args)
    assert code == 2, error + out
    message = error.replace("\n", " ")
    for part in parts:
        assert part in message, message


def test_bad_input_ends_the_process_with_exit_code_two(place):
    result = start("load", "nothing.yaml", cwd=place)
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr == "error: nothing.yaml: no such file\n"


def test_every_command_has_help_with_an_example(run):
    commands = (
        "load",
        "pile",
        "plan",
        "replay",
        "compare",
        "film",
        "machine check",
        "machine show",
        "study pack",
    )
    for command in commands:
        code, out, _ = run(*command.split(), "--help")
        assert code == 0
        assert "Example: drakerock " + command in out


def test_empty_drift_ends_with_its_reason(run):
    # All rocks behind the brow: nothing to be seen, nothing to be dug.
    code, out, error = run(
        "load", "small.yaml", "--out", "none", "--json", "--set", "pile.emission_reach=0", "--set", "site.void_depth=6",
        "--set", "pile.rocks=3",
    )  # fmt: skip
    assert code == 0, error
    outcome = json.loads(out)
    assert outcome["reason"].startswith("no candidate slice")
    assert outcome["objectives"]["production"] == 0.0
