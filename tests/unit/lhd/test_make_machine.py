"""The script that writes a machine: it touches its own files only, and what it writes can be used where it lies."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydrake.multibody.plant import MultibodyPlant

from drakerock.lhd.config import MachineConfig
from drakerock.lhd.model import add_machine
from drakerock.models.make_machine import main
from drakerock.resources import find_data


@pytest.fixture
def design(tmp_path) -> Path:
    file = tmp_path / "own" / "design.yaml"
    file.parent.mkdir()
    file.write_text(find_data("models", "lhd_small", "design.yaml").read_text())
    return file


def test_other_files_stay_and_all_that_is_written_is_told(design, capsys):
    others = [design.with_name(name) for name in ("scan.obj", "other.sdf")]
    for file in others:
        file.write_text("mine")
    before = set(design.parent.iterdir())
    assert main([str(design)]) == 0
    lines = capsys.readouterr().out.splitlines()
    written = {Path(line.removeprefix("wrote ")) for line in lines if line.startswith("wrote ")}
    assert written == set(design.parent.iterdir()) - before
    assert [file.read_text() for file in others] == ["mine", "mine"]
    assert main([str(design)]) == 0, "its own files it writes again"
    machine = add_machine(MultibodyPlant(0.01), MachineConfig(model=str(design.with_name("lhd_small.sdf"))))
    assert len(machine.loops) == 6


def test_a_foreign_model_of_the_same_name_stays(design, capsys):
    model = design.with_name("lhd_small.sdf")
    model.write_text("<sdf/>")
    assert main([str(design)]) == 2
    assert "lhd_small.sdf: not written by make_machine.py" in capsys.readouterr().err
    assert model.read_text() == "<sdf/>"
    assert set(design.parent.iterdir()) == {design, model}


@pytest.mark.parametrize(
    ("change", "message"), [("name:", "'name'"), ("wheel:", "'wheel'"), ("- [", "design.yaml")]
)
def test_a_design_that_lacks_something_is_one_message(design, capsys, change, message):
    text = design.read_text()
    design.write_text(text.replace(change, "spare_" + change, 1) if change.endswith(":") else text + "\n- [")
    assert main([str(design)]) == 2
    assert message in capsys.readouterr().err
    assert list(design.parent.iterdir()) == [design]


def test_help(capsys):
    with pytest.raises(SystemExit, match="0"):
        main(["--help"])
    assert "nothing is deleted" in " ".join(capsys.readouterr().out.split())
