"""Contract: errors have one root, and the library does not speak of the command line's options."""

import ast
import re
from pathlib import Path

import drakerock
from drakerock import errors
from drakerock.errors import DrakerockError

SOURCE = Path(drakerock.__file__).parent


def test_all_errors_have_one_root():
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    assert len(kinds) >= 4
    assert all(issubclass(kind, DrakerockError) for kind in kinds)


def test_messages_of_the_library_name_no_option():
    found = []
    for path in set(SOURCE.rglob("*.py")) - {SOURCE / "cli.py"}:
        for node in ast.walk(ast.parse(path.read_text())):
            texts = ast.walk(node) if isinstance(node, ast.Raise) else ()
            texts = [part.value for part in texts if isinstance(part, ast.Constant)]
            found += [f"{path.name}: {text}" for text in texts if re.search(r"(^|[\s`'])--[a-z]", str(text))]
    assert found == []
