"""What tests of pages share: whether a browser is there, visits, and what a user does to a page."""

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


def act(element: str, event: str, value: float | None = None) -> str:
    """Return JavaScript that does what a user would do to an element."""
    assign = f"e.value = {value}; " if value is not None else ""
    return (
        f"{{ const e = document.querySelector('{element}'); {assign}e.dispatchEvent(new Event('{event}')); }}"
    )


def visit(
    page: Path | str, steps: dict[str, str], look: str, *, width: int = 1280, ready: str = "true"
) -> dict:
    """Open a page, take the steps (JavaScript by name) one after the other, and look after each.

    Args:
        page: as of `open_page`.
        steps: what is done, by name; "" only looks.
        look: what is looked at, as JavaScript that may return a promise.
        width: of the window [pixels].
        ready: JavaScript that is true once the page can be used.

    Returns:
        What was seen, by the steps' names, and ``faults``: of the console and the network.
    """
    need_browser()

    async def go() -> dict:
        async with open_page(page, width, 900) as tab:
            for _ in range(200):
                if await tab.evaluate(f"Boolean({ready})"):
                    break
                await asyncio.sleep(0.1)
            else:
                raise AssertionError(f"{page}: not ready after 20 s: {ready}")
            seen = {}
            for name, step in steps.items():
                if step:
                    await tab.evaluate(step)
                seen[name] = await tab.evaluate(look)
            return seen | {"faults": tab.faults}

    return asyncio.run(go())
