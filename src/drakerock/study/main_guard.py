"""Whether the running script may be imported by the processes that it starts."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

from drakerock.errors import InputError


def check_main_guard() -> None:
    """Check that what is being called stands under ``if __name__ == "__main__"`` of the script that is running.

    A new process of Python's first imports the script that started it. What stands in it without that condition is
    done again, in each.

    Raises:
        InputError: it does not.
    """
    frame = inspect.currentframe()
    while frame is not None:
        if frame.f_code.co_name == "<module>" and frame.f_globals.get("__name__") == "__main__":
            path, line = frame.f_code.co_filename, frame.f_lineno
            if not _is_guarded(path, line):
                raise InputError(
                    f'{path}:{line}: put this under `if __name__ == "__main__":`; the local workers are processes that '
                    "import the script, and each would start the study again (or use `executor.kind: serial`)"
                )
        frame = frame.f_back


def _is_guarded(path: str, line: int) -> bool:
    try:
        module = ast.parse(Path(path).read_bytes())
    except (OSError, ValueError, SyntaxError):
        return True  # no script that could be imported
    for statement in module.body:
        if statement.lineno <= line <= (statement.end_lineno or line):
            tested = ast.walk(statement.test) if isinstance(statement, ast.If) else ()
            return any(isinstance(node, ast.Name) and node.id == "__name__" for node in tested)
    return True
