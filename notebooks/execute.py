"""Run the notebooks and store them with what they show: python notebooks/execute.py [NAME.ipynb ...]"""

import sys
from pathlib import Path

import nbclient
import nbformat

FOLDER = Path(__file__).parent
# Small pictures: the notebooks are kept in the repository.
DPI = "%config InlineBackend.rc = {'figure.dpi': 55}"


def execute(path: Path) -> nbformat.NotebookNode:
    """Return the notebook of a file with what it shows."""
    notebook = nbformat.read(path, as_version=4)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(DPI))
    nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(path.parent)}}
    ).execute()
    del notebook.cells[0]
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # the clock's
        if cell.cell_type == "code":
            cell.execution_count = None
    return notebook


if __name__ == "__main__":
    for name in sys.argv[1:] or sorted(path.name for path in FOLDER.glob("*.ipynb")):
        nbformat.write(execute(FOLDER / name), FOLDER / name)
        print(f"{name}: {(FOLDER / name).stat().st_size / 1e3:.0f} kB")
