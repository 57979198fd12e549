"""A page in a browser that needs no display: Chromium or Chrome, driven by choreographer."""

from __future__ import annotations

import base64
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

from drakerock.errors import InputError


class Page:
    """A page that is open.

    Attributes:
        faults: what its console has said of errors and warnings so far, and what it asked the network for.
    """

    def __init__(self, tab: Any) -> None:
        """Wrap choreographer's `tab`; `open_page` does."""
        self._tab = tab
        self.faults: list[str] = []

    async def evaluate(self, code: str) -> Any:
        """Return what JavaScript comes to, as a plain value; promises are waited for.

        Raises:
            RuntimeError: the script failed.
        """
        reply = await self._send("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in reply:
            raise RuntimeError(f"{code}: {_describe(reply['exceptionDetails'])}")
        return reply["result"].get("value")

    async def resize(self, width: int, height: int) -> None:
        """Set the size of the page's window [pixels]."""
        await self._send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    async def take_picture(self) -> bytes:
        """Return what the window shows as PNG."""
        reply = await self._send("Page.captureScreenshot", format="png")
        return base64.b64decode(reply["data"])

    async def _open(self, address: str) -> None:
        own = ("data:", "blob:", address if address.startswith("http:") else "file:")

        async def note_console(message: Any) -> None:
            details = message["params"]
            if details["type"] in ("error", "warning", "assert"):
                self.faults.append(" ".join(str(item.get("value", item)) for item in details["args"]))

        async def note_exception(message: Any) -> None:
            self.faults.append(_describe(message["params"]["exceptionDetails"]))

        async def note_log(message: Any) -> None:
            entry = message["params"]["entry"]
            # The software renderer tells how slow it is.
            if entry["level"] in ("error", "warning") and "GPU stall" not in entry["text"]:
                self.faults.append(entry["text"])

        async def note_request(message: Any) -> None:
            url = message["params"]["request"]["url"]
            if not url.startswith(own):
                self.faults.append(f"asks for {url}")

        for event, note in (
            ("Runtime.consoleAPICalled", note_console),
            ("Runtime.exceptionThrown", note_exception),
            ("Log.entryAdded", note_log),
            ("Network.requestWillBeSent", note_request),
        ):
            self._tab.subscribe(event, note)
        for domain in ("Runtime", "Log", "Network", "Page"):
            await self._send(f"{domain}.enable")
        await self._send(
            "Network.emulateNetworkConditions",
            offline=address.startswith("file:"),
            latency=0,
            downloadThroughput=0,
            uploadThroughput=0,
        )
        loaded = self._tab.subscribe_once("Page.loadEventFired")
        await self._send("Page.navigate", url=address)
        await loaded

    async def _send(self, command: str, **params: Any) -> dict[str, Any]:
        reply = await self._tab.send_command(command, params or None)
        if "error" in reply:
            raise RuntimeError(f"{command}: {reply['error']['message']}")
        return dict(reply["result"])


def _describe(details: dict[str, Any]) -> str:
    return str(details.get("exception", {}).get("description") or details.get("text"))


@contextlib.asynccontextmanager
async def open_page(page: Path | str, width: int = 1280, height: int = 720) -> AsyncIterator[Page]:
    """Open an HTML file in a browser of its own, without a network, until the context ends.

    Args:
        page: the file; or the address of a server of one's own, http:, which alone is asked then.
        width, height: of the window [pixels].

    Raises:
        InputError: choreographer is not installed, or there is no browser.
    """
    try:
        import choreographer
        from choreographer.errors import BrowserFailedError, ChromeNotFoundError
    except ImportError:
        raise InputError("this needs the package choreographer: pip install 'drakerock[film]'") from None
    try:
        # Root, as in containers, gets no sandbox; the page is our own.
        browser = choreographer.Browser(headless=True, enable_gpu=False, enable_sandbox=False)
        await browser.open()
    except (ChromeNotFoundError, BrowserFailedError) as error:
        first = str(error).strip().splitlines()[:1]
        raise InputError(
            "this needs Chromium or Chrome, which was not found or does not start"
            + (f" ({first[0]})" if first else "")
            + ": install it (apt install chromium; or choreo_get_chrome), or name it in BROWSER_PATH"
        ) from None
    try:
        tab = Page(await browser.create_tab("about:blank"))
        await tab.resize(width, height)
        await tab._open(page if isinstance(page, str) else page.resolve().as_uri())
        yield tab
    finally:
        await browser.close()
