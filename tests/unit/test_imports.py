"""Contract: reading a configuration, and asking how far a study is, costs no simulation. Caught: `study status` took
three seconds of imports, Drake, compiled kernels and scikit-learn among them.
"""

import subprocess
import sys
from pathlib import Path

import pytest

import drakerock

SOURCE = Path(drakerock.__file__).parent
HEAVY = (
    "pydrake",
    "numba",
    "sklearn",
    "scipy",
    "trimesh",
    "openturns",
    "pymoo",
    "pyarrow",
    "distributed",
    "matplotlib",
)


def find_heavy(statement):
    code = f"import sys; {statement}; print(*(name for name in {HEAVY} if name in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_schemas_import_no_simulation():
    files = [*SOURCE.rglob("config.py"), SOURCE / "loading/scenario.py", SOURCE / "study/schema.py"]
    names = [".".join(("drakerock", *path.relative_to(SOURCE).with_suffix("").parts)) for path in files]
    assert len(names) >= 8
    assert find_heavy(f"import {', '.join(names)}") == []


@pytest.mark.parametrize(
    "names", ["cli", "study.db, drakerock.study.status, drakerock.study.display", "identity"]
)
def test_looking_at_a_study_imports_no_simulation(names):
    assert find_heavy(f"import drakerock.{names}") == []


def test_the_version_is_that_of_the_package():
    assert drakerock.__version__.count(".") == 2
    assert "__version__" in dir(drakerock)
