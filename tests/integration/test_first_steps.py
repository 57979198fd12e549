"""The command for those who have none yet: first steps, version, projects, a folder in use, Ctrl-C."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from drakerock import terminal
from drakerock.cli import app
from drakerock.loading.mining import MINING


def test_command_alone_says_what_to_do_first_and_the_module_is_the_command():
    alone = CliRunner().invoke(app, [])
    assert alone.exit_code == 0
    assert "drakerock load studies/small.yaml" in alone.stdout
    told = subprocess.run(
        [sys.executable, "-m", "drakerock", "--version"], capture_output=True, text=True, check=True
    ).stdout
    assert told.split()[:2] == ["drakerock", version("drakerock")]


def test_new_writes_and_says_what_is_next(tmp_path):
    result = CliRunner().invoke(app, ["new", "study", str(tmp_path / "mine")])
    assert result.exit_code == 0, result.output
    assert "next: drakerock study run" in result.stdout.replace("\n", " ")
    assert {path.name for path in (tmp_path / "mine").iterdir()} == {"study.yaml", "scenario.yaml"}
    for kind in ("machine", "site", "study", "controller"):
        assert "Example: drakerock new " + kind in CliRunner().invoke(app, ["new", kind, "--help"]).stdout


def test_used_folder_is_refused(tmp_path):
    (tmp_path / "outcome.json").write_text("{}")
    result = CliRunner().invoke(app, ["load", "--out", str(tmp_path)])
    assert result.exit_code != 0
    assert "force it to be replaced" in str(result.exception)


def test_ctrl_c_says_where_it_stopped_and_what_that_means(monkeypatch, capsys):
    monkeypatch.setattr(terminal, "get_console", lambda: Console(file=sys.stdout, width=100))

    def work() -> None:
        with terminal.show_progress("load", "nothing was written to out") as advance:
            advance("s1", None, note="4.2 s simulated")
            raise KeyboardInterrupt

    with pytest.raises(typer.Exit) as stopped:
        work()
    assert stopped.value.exit_code == 130
    shown = capsys.readouterr().out
    assert "interrupted at: s1, 4.2 s simulated" in shown
    assert "nothing was written to out" in shown


@pytest.mark.parametrize("width", [80, 200])
def test_values_of_a_sequence_take_the_terminals_width(monkeypatch, capsys, width):
    row = {"mean": 300.0, "standard_error": 10.0, "spread": 20.0, "values": [301.0] * 8}
    names = (
        "production",
        "damage",
        "debris",
        "bucket_mass_kg",
        "weighed_mass_kg",
        "loading_time_s",
        "energy_J",
    )
    summary = {
        "loadings": 8,
        "strategy": {"alpha": 1.1},
        "events": {},
        "payload_spread_percent": 4.0,
        "quantities": dict.fromkeys((*names, *MINING, "wall_time_s"), row),
    }
    monkeypatch.setattr(terminal, "get_output", lambda: Console(file=sys.stdout, width=width))
    terminal.print_sequence(summary)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) == width
    if width == 200:
        assert any("  ".join(["301"] * 8) in line for line in lines)
    assert not any(line.count("301") == 1 for line in lines if "production" in line)
