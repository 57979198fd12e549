"""The notebooks run on the data beside them, and are committed without outputs."""

from pathlib import Path

import nbclient
import nbformat
import pytest

NOTEBOOKS = Path(__file__).resolve().parents[2] / "notebooks"
N_FIGURES = {"read_study.ipynb": 4, "read_cycle.ipynb": 3}


@pytest.mark.parametrize("name", N_FIGURES)
def test_notebook_runs_and_draws(name):
    notebook = nbformat.read(NOTEBOOKS / name, as_version=4)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook.cells)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(NOTEBOOKS)}}
    )
    client.execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == N_FIGURES[name]
    errors = [output for output in outputs if output.get("name") == "stderr"]
    assert errors == []


def test_every_notebook_is_tried_and_the_data_are_small():
    assert {path.name for path in NOTEBOOKS.glob("*.ipynb")} == set(N_FIGURES)
    assert sum(path.stat().st_size for path in NOTEBOOKS.rglob("data/**/*")) < 300_000
