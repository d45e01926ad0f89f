"""The address of the viewer: a free host and port."""

from __future__ import annotations

import errno
import socket
from dataclasses import dataclass

from legcal.errors import UsageError


@dataclass(frozen=True)
class Address:
    """A host and a port; port 0 means any free port."""

    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self.port}"


def check_address(address: Address) -> None:
    """Refuse a host or a port that cannot be served.

    Raises
    ------
    UsageError
        If the host is unknown or another machine, or the port is in use or not allowed.
    """
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
