"""Small image files that say what cameras and programs write into theirs."""

import struct
import zlib
from collections.abc import Mapping
from fractions import Fraction

import cv2
import numpy as np

from legcal.geometry.types import Image

Said = str | int | float | bytes

TAGS = {
    "make": 0x010F, "model": 0x0110, "orientation": 0x0112, "software": 0x0131,
    "exposure": 0x829A, "focus": 0x9206, "focal": 0x920A, "width": 0xA002,
    "height": 0xA003, "zoom": 0xA404, "focal35": 0xA405, "serial": 0xA431,
    "lens": 0xA434, "taken": 0x9003,
}  # fmt: skip
_OF_CAMERA = ("make", "model", "orientation", "software")  # in the first directory


def exif(order: str = "<", **said: Said) -> bytes:
    """Return an EXIF block: texts, whole numbers as shorts, others as rationals, NumPy doubles."""
    first = {TAGS[name]: x for name, x in said.items() if name in _OF_CAMERA}
    second = {TAGS[name]: x for name, x in said.items() if name not in _OF_CAMERA}
    head = {"<": b"II*\0", ">": b"MM\0*"}[order] + struct.pack(order + "I", 8)
    directory = _directory(order, 8, {**first, 0x8769: 0})
    at = len(head) + len(directory)
    directory = _directory(order, 8, {**first, 0x8769: at})
    return head + directory + _directory(order, at, second)


def _directory(order: str, at: int, values: Mapping[int, Said]) -> bytes:
    entries, after = b"", b""
    start = at + 2 + 12 * len(values) + 4
    for tag, value in sorted(values.items()):
        if isinstance(value, str):
            kind, count, data = 2, len(value.encode()) + 1, value.encode() + b"\0"
        elif isinstance(value, bytes):
            kind, count, data = 7, len(value), value
        elif isinstance(value, int):
            kind, count = (4, 1) if tag == 0x8769 else (3, 1)
            data = struct.pack(order + ("I" if kind == 4 else "H"), value)
        elif isinstance(value, np.float64):
            kind, count, data = 12, 1, struct.pack(order + "d", value)
        else:
            ratio = Fraction(value).limit_denominator(10_000)
            kind, count, data = 5, 1, struct.pack(order + "II", *ratio.as_integer_ratio())
        if len(data) > 4:
            stored, after = struct.pack(order + "I", start + len(after)), after + data
        else:
            stored = data.ljust(4, b"\0")
        entries += struct.pack(order + "HHI", tag, kind, count) + stored
    return struct.pack(order + "H", len(values)) + entries + bytes(4) + after


def jpeg(image: Image, quality: int = 95, block: bytes = b"") -> bytes:
    """Return a JPEG with EXIF."""
    content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
    body = block and b"Exif\0\0" + block
    segment = body and b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body
    return bytes(content[:2] + segment + content[2:])


def png(image: Image, block: bytes = b"", **texts: str) -> bytes:
    """Return a PNG with EXIF and texts."""
    content = cv2.imencode(".png", image)[1].tobytes()
    chunks = [(b"tEXt", f"{key}\0{text}".encode()) for key, text in texts.items()]
    chunks += [(b"eXIf", block)] * bool(block)
    added = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
    return content[:33] + added + content[33:]


def undecodable_png(image: Image) -> bytes:
    """Return a PNG whose checksums are right and whose data are no picture."""
    content = cv2.imencode(".png", image)[1].tobytes()
    body = zlib.compress(b"junk")
    chunk = b"IDAT" + body
    checksum = struct.pack(">I", zlib.crc32(chunk))
    return content[:33] + struct.pack(">I", len(body)) + chunk + checksum + content[-12:]


def tiff(image: Image, compression: int = 1) -> bytes:
    """Return a TIFF: 1 as it is, 7 with a JPEG inside."""
    options = [cv2.IMWRITE_TIFF_COMPRESSION, compression, cv2.IMWRITE_TIFF_ROWSPERSTRIP, 16]
    return np.asarray(cv2.imencode(".tiff", image, options)[1]).tobytes()
