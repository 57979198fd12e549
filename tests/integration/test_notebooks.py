"""The notebooks run from start to end, and are stored with what they show: text, and small pictures."""

import importlib.util
from pathlib import Path

import nbformat
import pytest

NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
N_FIGURES = {"run_loading.ipynb": 3, "build_diagram.ipynb": 2, "read_study.ipynb": 4, "read_cycle.ipynb": 3}


def load_execute():
    spec = importlib.util.spec_from_file_location("execute", NOTEBOOKS / "execute.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.execute


def list_outputs(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def count_figures(notebook):
    return sum("image/png" in output.get("data", {}) for output in list_outputs(notebook))


@pytest.mark.parametrize("name", N_FIGURES)
def test_notebook_runs_and_draws(name):
    notebook = load_execute()(NOTEBOOKS / name)
    assert count_figures(notebook) == N_FIGURES[name]
    said = "".join(output.text for output in list_outputs(notebook) if output.get("name") == "stderr")
    # A pile that is not in the cache yet is made, and that is said.
    assert all("(once)" in line for line in said.splitlines()), said


@pytest.mark.parametrize("name", N_FIGURES)
def test_notebook_is_stored_with_small_outputs(name):
    notebook = nbformat.read(NOTEBOOKS / name, as_version=4)
    assert count_figures(notebook) == N_FIGURES[name]
    assert all(cell.outputs or "import" in cell.source for cell in notebook.cells if cell.cell_type == "code")
    assert (NOTEBOOKS / name).stat().st_size < 300_000


def test_every_notebook_is_tried_and_the_data_are_small():
    assert {path.name for path in NOTEBOOKS.glob("*.ipynb")} == set(N_FIGURES)
    assert sum(path.stat().st_size for path in NOTEBOOKS.rglob("data/**/*")) < 300_000
