"""A page with a slider for each variable of the strategy: the plan is drawn as they move. On this machine only."""

from __future__ import annotations

import json
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from pydantic import ValidationError

from drakerock.errors import InputError
from drakerock.loading.config import StrategyConfig
from drakerock.study.preview import Preview
from drakerock.viewing.plan_page import make_plan_page


def make_server(preview: Preview, port: int = 0) -> ThreadingHTTPServer:
    """Return the server of a preview's page, not yet serving.

    ``/`` is the page, ``/plan?alpha=1.3&...`` the plan of a strategy as JSON (`PreviewedStrategy.to_dict`); what is
    left out is the scenario's.

    Args:
        preview: what to show.
        port: where to listen, on the loopback interface; 0: any free one.
    """
    start = preview.scenario.loading.strategy

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            address = urlsplit(self.path)
            if address.path == "/":
                self._answer(200, "text/html; charset=utf-8", make_plan_page(preview.field, start))
            elif address.path == "/plan":
                self._answer(*_describe(preview, dict(parse_qsl(address.query))))
            else:
                self._answer(404, "text/plain", "not found")

        def _answer(self, status: int, kind: str, text: str) -> None:
            data = text.encode()
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, *args: Any) -> None:
            """Say nothing for each request."""

    return ThreadingHTTPServer(("127.0.0.1", port), Handler)


def serve_preview(preview: Preview, say: Callable[[str], None], port: int = 0) -> None:
    """Serve a preview's page until Ctrl-C.

    Args:
        preview: what to show.
        say: told the page's address.
        port: see `make_server`.
    """
    with make_server(preview, port) as server:
        say(f"http://127.0.0.1:{server.server_address[1]}/")
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return


def _describe(preview: Preview, query: dict[str, str]) -> tuple[int, str, str]:
    try:
        given = preview.scenario.loading.strategy.model_dump() | {
            name: float(value) for name, value in query.items()
        }
        shown = preview.describe(StrategyConfig.model_validate(given))
    except (ValidationError, ValueError, InputError) as error:
        return 400, "application/json", json.dumps({"error": str(error).splitlines()[0]})
    return 200, "application/json", json.dumps(shown.to_dict())
