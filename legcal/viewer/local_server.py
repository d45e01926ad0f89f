"""A page served to a local browser, until it is closed; its posts carry a token.

Anybody who reaches the page may change files: it is served to this machine alone, to requests that
name this host, and posts must have the token of the page.
"""

from __future__ import annotations

import http.server
import json
import secrets
import sys
from functools import partial
from typing import Any
from urllib.parse import parse_qs, urlsplit

from legcal.viewer.address import Address

HOST = "127.0.0.1"  # local only
TOKEN_HEADER = "X-Legcal-Token"
MAX_POST = 2**20  # largest posted text [bytes]
HTML = "text/html; charset=utf-8"


class LocalServer:
    """A server of one page; subclasses have its content and answers."""

    def __init__(self, port: int = 0) -> None:
        self.token = secrets.token_urlsafe(16)
        self._server = _Server((HOST, port), partial(_Handler, self))

    @property
    def address(self) -> Address:
        """The address of the page."""
        return Address(HOST, self._server.server_port)

    def run(self) -> None:
        """Serve until :meth:`close` or an interrupt."""
        self._server.serve_forever()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()

    def content(self, path: str) -> tuple[str, bytes] | None:
        """Return type and content of a path of the page; None for other paths."""
        raise NotImplementedError

    def answer(self, path: str, query: dict[str, list[str]], text: bytes) -> dict[str, Any] | None:
        """Return the answer to a posted text; None for other paths."""
        raise NotImplementedError


class _Server(http.server.ThreadingHTTPServer):
    """A server that ignores browsers that disconnect early."""

    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Report an error in a request."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(http.server.BaseHTTPRequestHandler):
    """The handler of the page; requests for other hosts, or without its token, are refused."""

    server_version, sys_version = "legcal", ""

    def __init__(self, page: LocalServer, *args: Any) -> None:
        self.page = page
        super().__init__(*args)

    def do_GET(self) -> None:
        """Send the page or one of its files."""
        path = urlsplit(self.path).path
        content = self.page.content(path) if self._is_for_here() else None
        if path == "/favicon.ico":  # browsers ask for it
            content = "image/x-icon", b""
        if content is None:
            self.send_error(404)
            return
        self._send(*content)

    def do_POST(self) -> None:
        """Answer a posted text."""
        token = self.headers.get(TOKEN_HEADER, "")
        if not self._is_for_here() or not secrets.compare_digest(
            token.encode(), self.page.token.encode()
        ):
            self.send_error(403)
            return
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > MAX_POST:
            self.send_error(413)
            return
        place, text = urlsplit(self.path), self.rfile.read(int(length))
        answer = self.page.answer(place.path, parse_qs(place.query), text)
        if answer is None:
            self.send_error(404)
            return
        self._send("application/json", json.dumps(answer).encode())

    def _is_for_here(self) -> bool:
        """Return whether a request names this host: other names may belong to other pages."""
        port = self.page.address.port
        return self.headers.get("Host", "") in (f"{HOST}:{port}", f"localhost:{port}")

    def _send(self, kind: str, content: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""
