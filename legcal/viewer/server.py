"""A page served to a browser: its address, and who may read it and post to it."""

from __future__ import annotations

import errno
import http.server
import json
import secrets
import socket
import sys
from dataclasses import dataclass
from functools import partial
from typing import Any
from urllib.parse import parse_qs, urlsplit

from legcal.errors import UsageError

TOKEN_HEADER = "X-Legcal-Token"
LOCAL = "127.0.0.1"  # this machine alone
MAX_POST = 2**20  # largest posted content [bytes]
HTML = "text/html; charset=utf-8"


@dataclass(frozen=True)
class Address:
    """A host and a port; port 0 means any free port."""

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}"


def check_address(address: Address) -> None:
    """Refuse a host or a port that cannot be served."""
    host, port = address.host, address.port
    try:
        places = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError) as error:
        raise UsageError(
            f"--host could not be used: found '{host}', which is no name of a host here, needed "
            "127.0.0.1 (this machine alone), 0.0.0.0 (all who reach it) or an address of this "
            "machine; correct it."
        ) from error
    for family, kind, protocol, _, place in places:
        with socket.socket(family, kind, protocol) as tried:
            tried.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                tried.bind(place)
            except OSError as error:
                raise UsageError(_why_not(address, error)) from error


def _why_not(address: Address, error: OSError) -> str:
    """Return the error of an address that cannot be served."""
    start = f"The viewer could not be served at {address}: found"
    if error.errno == errno.EADDRINUSE:
        return (
            f"{start} that port {address.port} is in use, needed a free one; give another with "
            "--port, or --port 0 for any that is free."
        )
    if error.errno in (errno.EACCES, errno.EPERM):
        return (
            f"{start} that port {address.port} is not allowed, needed one from 1024 on; give "
            "another with --port."
        )
    return (
        f"{start} '{error.strerror}', needed an address of this machine; give 127.0.0.1 (this "
        "machine alone) or 0.0.0.0 (all who reach it) with --host."
    )


class PageServer:
    """A server of one page and of what belongs to it, until it is closed.

    Posts need the token of the page. A server for this machine alone refuses requests for other
    hosts, whose names may belong to pages of other sites.
    """

    def __init__(self, address: Address) -> None:
        self.token = secrets.token_urlsafe(16)
        self._host = address.host
        self._server = _Server((address.host, address.port), partial(_Handler, self))

    @property
    def address(self) -> Address:
        """The address of the page."""
        return Address(self._host, self._server.server_port)

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

    def __init__(self, address: tuple[str, int], handler: Any) -> None:
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        super().__init__(address, handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class _Handler(http.server.BaseHTTPRequestHandler):
    server_version, sys_version = "legcal", ""

    def __init__(self, page: PageServer, *args: Any) -> None:
        self.page = page
        super().__init__(*args)

    def do_GET(self) -> None:
        path = urlsplit(self.path).path
        content = self.page.content(path) if self._is_for_here() else None
        if content is None and path == "/favicon.ico":  # browsers ask for it
            content = "image/x-icon", b""
        if content is None:
            self.send_error(404)
            return
        self._send(*content)

    def do_POST(self) -> None:
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
        place, posted = urlsplit(self.path), self.rfile.read(int(length))
        answer = self.page.answer(place.path, parse_qs(place.query), posted)
        if answer is None:
            self.send_error(404)
            return
        self._send("application/json", json.dumps(answer).encode())

    def _is_for_here(self) -> bool:
        """Return whether a request names this machine; any name will do if others may connect."""
        here = self.page.address
        names = (f"{name}:{here.port}" for name in (LOCAL, "localhost"))
        return here.host != LOCAL or self.headers.get("Host", "") in names

    def _send(self, kind: str, content: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""
