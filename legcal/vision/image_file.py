"""Image files: checked without decoding, read as grey levels, made larger for searches."""

import os
import re
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from legcal.errors import DatasetError
from legcal.files.reading import MAX_IMAGE, read_bytes
from legcal.geometry.types import Array
from legcal.vision.camera import Camera
from legcal.vision.heic import (
    HEIC_SUFFIXES,
    UnreadableError,
    can_read_heic,
    heic_pixels,
    heic_size,
    is_heic,
)
from legcal.vision.image_facts import (
    JPEG_SIGNATURE,
    PNG_SIGNATURE,
    TIFF_SIGNATURES,
    ImageFacts,
    read_facts,
)

_Level = TypeVar("_Level", np.uint8, np.float32)
Grey = NDArray[np.float32]  # (height, width) grey levels, 0 to 255

_lock = threading.Lock()
_state = {"depth": 0, "level": 0}


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV's log inside the block; the last thread to leave restores its level."""
    with _lock:
        if _state["depth"] == 0:
            _state["level"] = cv2.utils.logging.getLogLevel()
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        _state["depth"] += 1
    try:
        yield
    finally:
        with _lock:
            _state["depth"] -= 1
            if _state["depth"] == 0:
                cv2.utils.logging.setLogLevel(_state["level"])


_FLAGS = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
_JPEG_MARKER = re.compile(rb"\xff[\x01-\xcf\xd8-\xfe]")
_DEEP, _FULL = 12, 16  # bits that the data in files of 16 bits may have
_TIFF_INTEGERS = {1: "B", 3: "H", 4: "I"}  # struct's letters by the type numbers of TIFF
_TIFF_TAGS = (256, 257, 258, 273, 279, 322, 323, 324, 325, 339)  # that are looked at
_TIFF_FORMATS = {2: "signed", 3: "floating-point"}  # of samples, others than unsigned
_TIFF_BYTES = {3: 2, 4: 4, 5: 8, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}  # others have one


MAX_SIDE, MAX_AREA = 30_000, 100_000_000  # [px] of an image or a camera; the largest sensors
_MOST_SCANS = 200  # of a JPEG: each is another pass over all pixels
_MOST_TAGS, _MOST_STRIPS = 200, 100_000  # of a TIFF
_SIDEWAYS = 5  # EXIF orientation, from which on width and height are exchanged for looking
_STRIP = 256  # rows of an image that become grey levels at once

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
FOREIGN_SUFFIXES = (".heic", ".heif", ".hif", ".avif", ".webp", ".gif", ".bmp", ".jp2", ".jxl",
                    ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")  # fmt: skip
CONVERT = (
    "write them as JPEG of quality 95 or more, or PNG, without turning or scaling them "
    "(magick mogrify -format jpg -quality 98 *.HEIC), or set the phone to the most compatible "
    "format"
)
CONVERT_HEIC = f"install what reads HEIC (pip install 'legcal[heic]'), or {CONVERT}"
_BRANDS = {b"avif": "AVIF", b"avis": "AVIF", b"crx ": "CR3"}

_COMPLETE = "a complete PNG, JPEG or TIFF file"
_AGAIN = "copy it again or remove the row"
_LEVELS = "8 or 16 bit grey levels or colours"


class BadImage(ValueError):
    """What is wrong with the bytes of an image file: found and needed, as parts of a sentence."""

    def __init__(self, found: str, needed: str = _COMPLETE, remedy: str = _AGAIN) -> None:
        super().__init__(found)
        self.needed = needed
        self.remedy = remedy


@dataclass(frozen=True)
class ImageSize:
    """Size of an image [px]."""

    width: int
    height: int


def read_image(path: Path, camera: Camera, where: str = "") -> Grey:
    """Read an image of 8 or 16 bits, grey or in colour, as grey levels."""
    return np.asarray(decode_image(path, camera, where), dtype=np.float32)


def decode_image(path: Path, camera: Camera, where: str = "") -> NDArray[np.uint8] | Grey:
    """Read an image as grey levels: those of 8 bits as they are, which takes the least memory."""
    content, problem = _complete_content(path, camera, where)
    if problem:
        raise DatasetError(problem)
    pixels: NDArray[np.generic] | None
    try:
        if is_heic(content):
            pixels = heic_pixels(content)
        else:
            with quiet_opencv():
                pixels = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), _FLAGS)
    except (cv2.error, UnreadableError):
        pixels = None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        found = "data that cannot be decoded" if pixels is None else f"{pixels.dtype} pixels"
        raise DatasetError(_problem(path, where, found, _LEVELS))
    if pixels.dtype == np.uint8 and pixels.ndim == 2:
        return np.asarray(pixels, dtype=np.uint8)
    scale = 255.0 / (2 ** _depth(pixels) - 1) if pixels.dtype == np.uint16 else 1.0
    grey = np.empty(pixels.shape[:2], dtype=np.float32)
    for top in range(0, len(grey), _STRIP):  # colours in 32 bits take more than there may be
        levels = pixels[top : top + _STRIP].astype(np.float32)
        if pixels.dtype == np.uint16:
            levels *= np.float32(scale)
        if levels.ndim == 3:
            levels = np.asarray(cv2.cvtColor(levels, cv2.COLOR_BGR2GRAY))
        grey[top : top + _STRIP] = levels
    return grey


def _depth(pixels: NDArray[np.generic]) -> int:
    """Return how many bits the data of a file of 16 bits have.

    Data that are moved to the upper bits leave the lower ones empty and have all 16. An image of 16
    bits that needs no more than 12 is nearly black.
    """
    used = int(np.bitwise_or.reduce(pixels, axis=None))
    is_moved = used % 2 ** (_FULL - _DEEP) == 0
    return _FULL if is_moved or used >= 2**_DEEP else _DEEP


def inspect_image(path: Path, camera: Camera, where: str = "") -> tuple[ImageFacts, str | None]:
    """Return what an image file says of itself, and what keeps it from being used, if anything.

    The pixels are not decoded.
    """
    content, problem = _complete_content(path, camera, where)
    return read_facts(content), problem


def image_size(content: bytes) -> ImageSize:
    """Return the size of an image from the bytes of its file."""
    if not content:
        raise BadImage("an empty file")
    readers = {JPEG_SIGNATURE: _jpeg_size, PNG_SIGNATURE: _png_size}
    readers |= dict.fromkeys(TIFF_SIGNATURES, _tiff_size)
    try:
        for signature, read in readers.items():
            if content.startswith(signature):
                size = read(content)
                if problem := size_problem(size.width, size.height):
                    raise BadImage(*problem)
                return size
    except (struct.error, IndexError) as error:
        raise BadImage(f"a file cut off after {len(content)} bytes") from error
    if is_heic(content):
        return _heic_size(content)
    if content[4:8] == b"ftyp" and content[8:12] in _BRANDS:
        raise BadImage(
            f"a {_BRANDS[content[8:12]]} file, which cannot be read here", remedy=CONVERT
        )
    raise BadImage("a file that is none of these")


def _heic_size(content: bytes) -> ImageSize:
    """Return the size of a HEIC photograph, if its package is there."""
    if not can_read_heic():
        raise BadImage("a HEIC file, which cannot be read here", remedy=CONVERT_HEIC)
    try:
        size = ImageSize(*heic_size(content))
    except UnreadableError as error:
        raise BadImage(f"a HEIC file that cannot be read ({error})") from error
    if problem := size_problem(size.width, size.height):
        raise BadImage(*problem)
    return size


def image_suffixes() -> tuple[str, ...]:
    """Return the endings of image files that can be read here."""
    return SUFFIXES + HEIC_SUFFIXES if can_read_heic() else SUFFIXES


def size_problem(width: int, height: int) -> tuple[str, str] | None:
    """Return found and needed of a size that no image and no camera can have, else None."""
    if min(width, height) > 0 and max(width, height) <= MAX_SIDE and width * height <= MAX_AREA:
        return None
    needed = f"at most {MAX_SIDE} px a side and {MAX_AREA} px in all"
    return f"{width} x {height} px", needed


def likely_cause(size: ImageSize, needed: ImageSize, facts: ImageFacts) -> str:
    """Return in brackets why an image has another size than its camera, "" if nothing shows."""
    causes = []
    if facts.is_screenshot:
        causes.append("a screenshot, as its file says")
    elif size == ImageSize(needed.height, needed.width) and (facts.orientation or 1) >= _SIDEWAYS:
        causes.append(
            f"turned by a quarter turn, as programs show it by its EXIF orientation "
            f"{facts.orientation}; pixels are taken as they are stored"
        )
    elif size == ImageSize(needed.height, needed.width):
        causes.append("turned by a quarter turn")
    else:
        for turned, word in ((size, ""), (ImageSize(size.height, size.width), "turned and ")):
            factor = turned.width / needed.width
            if abs(turned.height - factor * needed.height) <= max(1.0, factor):
                causes.append(f"{word}rescaled by {factor:.4g}")
                break
        else:
            if size.width <= needed.width and size.height <= needed.height:
                causes.append("cropped, or taken in another mode of the camera")
    if facts.taken_size not in (None, (size.width, size.height)):
        width, height = facts.taken_size
        causes.append(f"taken with {width} x {height} px, as its EXIF data say")
    return f" ({', '.join(causes)})" if causes else ""


def _complete_content(path: Path, camera: Camera, where: str) -> tuple[bytes, str | None]:
    """Return the bytes of an image file, and what is wrong with them if anything."""
    if not os.path.isfile(path):
        found = "something that is not a file" if os.path.exists(path) else "no such file"
        return b"", _problem(path, where, found, _COMPLETE, "correct the path or remove the row")
    try:
        content = read_bytes(path, MAX_IMAGE)
        size = image_size(content)
    except OSError as error:
        return b"", _problem(path, where, f"'{error.strerror}'", "a readable file")
    except BadImage as error:
        return b"", _problem(path, where, str(error), error.needed, error.remedy)
    needed = ImageSize(camera.width, camera.height)
    if size != needed:
        return b"", _problem(
            path,
            where,
            f"{size.width} x {size.height} px{likely_cause(size, needed, read_facts(content))}",
            f"{camera.width} x {camera.height} px as in its camera file",
            "use the original image, neither scaled, cropped nor rotated, or the calibration of "
            "its size",
        )
    return content, None


def _problem(path: Path, where: str, found: str, needed: str, remedy: str = _AGAIN) -> str:
    """Return the sentence for an image that cannot be used."""
    prefix = f"{where}: " if where else ""
    return f"{prefix}image {path} could not be read: found {found}, needed {needed}; {remedy}."


def _jpeg_size(content: bytes) -> ImageSize:
    """Walk the segments of a JPEG to its end-of-image marker."""
    size, at, n_scans = None, 2, 0
    while True:
        match = _JPEG_MARKER.search(content, at)
        if match is None:
            raise BadImage(f"a JPEG cut off after {len(content)} bytes, without its end marker")
        marker, at = content[match.start() + 1], match.end()
        if marker == 0xD9:
            break
        if marker in (0x01, 0xD8):
            continue
        n_scans += marker == 0xDA
        if n_scans > _MOST_SCANS:
            raise BadImage(f"a JPEG of more than {_MOST_SCANS} scans", "fewer")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", content, at + 3)
            size = ImageSize(width, height)
        at += struct.unpack_from(">H", content, at)[0]
    if size is None:
        raise BadImage("a JPEG without a picture")
    return size


def _png_size(content: bytes) -> ImageSize:
    """Walk the chunks of a PNG to IEND, checking their checksums."""
    width, height = struct.unpack_from(">II", content, 16)
    at, kind = len(PNG_SIGNATURE), b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", content, at)
        if at + 12 + length > len(content):
            raise BadImage(f"a PNG cut off after {len(content)} bytes")
        (checksum,) = struct.unpack_from(">I", content, at + 8 + length)
        if zlib.crc32(memoryview(content)[at + 4 : at + 8 + length]) != checksum:
            raise BadImage(f"a PNG whose {kind.decode('latin-1')} chunk has a wrong checksum")
        at += 12 + length
    return ImageSize(width, height)


def _tiff_size(content: bytes) -> ImageSize:
    """Read the first directory of a TIFF and see that all it points to is there."""
    order = "<" if content.startswith(b"II") else ">"
    (at,) = struct.unpack_from(order + "I", content, 4)
    (n_tags,) = struct.unpack_from(order + "H", content, at)
    if n_tags > _MOST_TAGS:
        raise BadImage(f"a TIFF of {n_tags} tags", f"at most {_MOST_TAGS}")
    ends = [at + 2 + 12 * n_tags + 4]  # the directory, and the pointer to the next one
    tags: dict[int, tuple[int, ...]] = {}
    n_all = 0
    for entry in range(at + 2, at + 2 + 12 * n_tags, 12):
        tag, kind, count = struct.unpack_from(order + "HHI", content, entry)
        n_bytes = count * _TIFF_BYTES.get(kind, 1)
        (pointer,) = struct.unpack_from(order + "I", content, entry + 8)
        start = pointer if n_bytes > 4 else entry + 8
        ends.append(start + n_bytes)
        n_all += n_bytes
        if n_all > len(content):  # tags may point to the same bytes, which are read many times
            raise BadImage(f"a TIFF cut off after {len(content)} bytes")
        if count > _MOST_STRIPS and tag in _TIFF_TAGS:
            raise BadImage(f"a TIFF of {count} strips", f"at most {_MOST_STRIPS}")
        if count and tag in _TIFF_TAGS and kind in _TIFF_INTEGERS and ends[-1] <= len(content):
            tags[tag] = struct.unpack_from(f"{order}{count}{_TIFF_INTEGERS[kind]}", content, start)
    if max(tags.get(322, (0,))) * max(tags.get(323, (0,))) > MAX_AREA:
        raise BadImage("a TIFF of tiles that are larger than any image")
    starts, lengths = tags.get(273, tags.get(324, ())), tags.get(279, tags.get(325, ()))
    ends += [start + length for start, length in zip(starts, lengths, strict=False)]
    if max(ends) > len(content):
        raise BadImage(f"a TIFF cut off after {len(content)} bytes")
    if not (starts and lengths and tags.get(256) and tags.get(257)):
        raise BadImage("a TIFF without a picture")
    bits, form = max(tags.get(258, (1,))), max(tags.get(339, (1,)))
    if bits > _FULL or form in _TIFF_FORMATS:
        kind = _TIFF_FORMATS.get(form, "integer")
        raise BadImage(f"a TIFF of {bits} bit {kind} pixels", _LEVELS)
    return ImageSize(tags[256][0], tags[257][0])


def possible_scale(image: NDArray[np.generic], wanted: float, max_pixels: int) -> float:
    """Return the scale at which an image has at most so many pixels, and no more than wanted."""
    return min(wanted, float(np.sqrt(max_pixels / image.size)))


def rescaled(image: NDArray[_Level], scale: float) -> NDArray[_Level]:
    """Return an image made larger or smaller by a factor, for a search."""
    if scale == 1:
        return image
    height, width = image.shape
    size = (max(round(scale * width), 1), max(round(scale * height), 1))
    method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    return np.asarray(cv2.resize(image, size, interpolation=method), dtype=image.dtype)


def reduced(px: Array, scale: float) -> Array:
    """Return pixels of a rescaled image as those of the image; middles of pixels are whole."""
    return np.asarray((px + 0.5) / scale - 0.5)
