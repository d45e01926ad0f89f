"""Reading files with a limit on their size: a video in place of a table is refused."""

import errno
import json
import os
from pathlib import Path
from typing import Any

MAX_TEXT = 16_000_000  # bytes of a table, YAML or URDF: enough for the largest table of outlines
MAX_DOCUMENT = 32_000_000  # bytes of a JSON document from legcal
MAX_IMAGE = 256_000_000
# Endings of photographs: read, read with pi-heif, and of other formats
SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
HEIC_SUFFIXES = (".heic", ".heif", ".hif")
FOREIGN_SUFFIXES = (".heic", ".heif", ".hif", ".avif", ".webp", ".gif", ".bmp", ".jp2", ".jxl",
                    ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")  # fmt: skip


class TooLarge(OSError):
    """A file of more bytes than its kind can have."""


def read_bytes(path: Path, most: int) -> bytes:
    """Return the bytes of a file; OSError where it cannot be read or has more than *most*."""
    n_bytes = os.path.getsize(path)
    if n_bytes > most:
        raise TooLarge(errno.EFBIG, f"{n_bytes} bytes", str(path))
    return path.read_bytes()


def read_json(path: Path) -> Any:
    """Return the content of a JSON file; OSError or ValueError where there is none."""
    try:
        return json.loads(read_bytes(path, MAX_DOCUMENT))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
