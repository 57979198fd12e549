"""Modules that a user names: importable ones, or Python files."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType


def import_named(name: str) -> ModuleType:
    """Import a module by its name, or from the path of a .py file, which is run anew each time.

    Raises:
        Exception: whatever the module dies of; FileNotFoundError for a file that is not there.
    """
    if not name.endswith(".py"):
        return importlib.import_module(name)
    spec = importlib.util.spec_from_file_location(f"drakerock user's {name}", name)
    if spec is None or spec.loader is None or not Path(name).is_file():
        raise FileNotFoundError("no such file")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up by its name.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
