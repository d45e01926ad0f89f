"""Opening what is read: regular files alone, and never more of them than a limit.

A pipe would be waited for without end, a device may have no end. Every file that legcal reads is
read here; what is larger than its kind ever is, is refused by its size before it is read.
"""

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any, BinaryIO

MAX_TEXT = 4_000_000  # bytes of a URDF or another file of text
MAX_TABLE = 16_000_000  # of a table: as many rows of outlines as one may have
MAX_YAML = 2_000_000  # of YAML, which is read more slowly
MAX_DOCUMENT = 32_000_000  # of a JSON document that legcal wrote
MAX_IMAGE = 256_000_000
MAX_MESH = 64_000_000


class NotRegular(OSError):
    """Something that is not a regular file."""


class TooLarge(OSError):
    """A file of more bytes than are read."""

    n_bytes = 0  # how many it has, as far as is known


def open_regular(path: Path, most: int | None = None) -> BinaryIO:
    """Open a file to read it, if it is a regular one of at most so many bytes.

    Raises
    ------
    OSError
        :class:`NotRegular`, :class:`TooLarge` or as the system says; ``strerror`` is what was
        found.
    """
    not_regular = NotRegular(errno.EINVAL, "a folder, pipe or device", str(path))
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise not_regular
    # another file may have taken its place: a pipe that is opened so is not waited for
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    file = os.fdopen(os.open(path, flags), "rb")
    found = os.fstat(file.fileno())
    if not stat.S_ISREG(found.st_mode):
        file.close()
        raise not_regular
    if most is not None and found.st_size > most:
        file.close()
        raise _too_large(path, found.st_size, most)
    return file


def _too_large(path: Path, n_bytes: int, most: int) -> TooLarge:
    """Return the error of a file of more than *most* bytes."""
    error = TooLarge(errno.EINVAL, f"{n_bytes} bytes, which are more than {most}", str(path))
    error.n_bytes = n_bytes
    return error


def read_bytes(path: Path, most: int) -> bytes:
    """Return the bytes of a regular file of at most so many bytes; OSError else."""
    with open_regular(path, most) as file:
        content = file.read(most + 1)
    if len(content) > most:  # it grew, or tells no size
        raise _too_large(path, len(content), most)
    return content


def read_json(path: Path) -> Any:
    """Return the content of a JSON file; OSError or ValueError where there is none."""
    try:
        return json.loads(read_bytes(path, MAX_DOCUMENT))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
