"""What processes of ours print of what is logged: drakerock's own warnings, as they are, and nothing of dependencies.

A script that uses the library sets its own logging up; nothing here is called then.
"""

from __future__ import annotations

import logging
import sys
from functools import cache


class _PlainLines(logging.Handler):
    """Prints on what standard error is at the moment: a progress bar or a live table may stand in for it."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr)


@cache
def show_only_ours() -> None:
    """Print what drakerock logs, and keep to itself what Drake and others do: what matters of it comes as an error."""
    # With a handler there neither Python's last resort prints nor basicConfig, which pydrake calls.
    logging.getLogger().addHandler(logging.NullHandler())
    logging.getLogger("drakerock").addHandler(_PlainLines(logging.WARNING))
