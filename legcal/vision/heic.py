"""HEIC photographs, read by the package pi-heif where it is installed (``legcal[heic]``).

Its wheels hold the decoders libheif and libde265 (LGPL-3); the wheels of pillow-heif, of which it
is a part, hold the encoder x265 too (GPL-2). Pixels are rotated according to the file.
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

HEIC_SUFFIXES = (".heic", ".heif", ".hif")
_BRANDS = (b"heic", b"heix", b"hevc", b"hevx", b"mif1", b"msf1")
_REFUSALS = (ValueError, RuntimeError, EOFError, OSError, SyntaxError)  # errors of the package


class UnreadableError(ValueError):
    """A HEIC file that is damaged, or that the package cannot read."""


def is_heic(content: bytes) -> bool:
    """Return whether the bytes of a file look like HEIC."""
    return content[4:8] == b"ftyp" and content[8:12] in _BRANDS


def can_read_heic() -> bool:
    """Return whether the package is installed."""
    return _package() is not None


def heic_size(content: bytes) -> tuple[int, int]:
    """Return width and height of the picture [px]."""
    width, height = _opened(content).size
    return int(width), int(height)


def heic_pixels(content: bytes) -> NDArray[np.generic]:
    """Return the pixels (height, width, 3) of 8 or 16 bits, blue first, or grey (height, width)."""
    try:
        pixels = np.asarray(_opened(content))
    except _REFUSALS as error:
        raise UnreadableError(str(error)) from error
    return pixels[..., :3] if pixels.ndim == 3 else pixels  # without the alpha channel


def heic_exif(content: bytes) -> bytes:
    """Return the block of EXIF, b"" where there is none, or no package."""
    try:
        return bytes(_opened(content).info.get("exif") or b"")
    except UnreadableError:
        return b""


def _package() -> ModuleType | None:
    try:
        import pi_heif
    except ImportError:
        return None
    module: ModuleType = pi_heif
    return module


def _opened(content: bytes) -> Any:
    """Return the picture of a file, its pixels not yet decoded."""
    package = _package()
    if package is None:
        raise UnreadableError("no package that reads it")
    try:
        return package.open_heif(content, convert_hdr_to_8bit=False, bgr_mode=True)
    except _REFUSALS as error:
        raise UnreadableError(str(error)) from error
