"""Whether pages can be opened in a browser here, and if not, why; tests of pages are skipped then."""

from __future__ import annotations

import asyncio
import tempfile
from functools import cache
from pathlib import Path

import pytest

from drakerock.errors import InputError
from drakerock.viewing.browser import open_page


@cache
def find_fault() -> str:
    """Return why no page can be opened, "" if one can."""

    async def visit(path: Path) -> None:
        async with open_page(path, 64, 64):
            pass

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "empty.html")
        path.write_text('<!DOCTYPE html><link rel="icon" href="data:,">')
        try:
            asyncio.run(visit(path))
        except InputError as error:
            return str(error)
    return ""


def need_browser() -> None:
    """Skip a test that opens pages where there is no browser."""
    if fault := find_fault():
        pytest.skip(fault)
