"""Changing attribute values of a URDF in place: every other byte of the file stays as it was."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from xml.parsers import expat

import numpy as np

from legcal.errors import ModelError
from legcal.geometry.types import Array

_XYZ = re.compile(rb"""(?<=\s)xyz\s*=\s*(?:"([^"]*)"|'([^']*)')""")


@dataclass(frozen=True)
class OriginSpan:
    """Where the origin of a joint stands in the file, as byte offsets.

    Attributes
    ----------
    start, end : int
        What a new value replaces: the value of ``xyz``, or nothing where it is not written.
    before, after : bytes
        What goes around the value.
    """

    start: int
    end: int
    before: bytes = b""
    after: bytes = b""


def patch_origins(content: bytes, origins: Mapping[str, Array]) -> bytes:
    """Return a URDF with the ``xyz`` of some joint origins changed.

    Values are written with 17 significant digits where they need them. The tags, quotes, comments,
    white space and line ends of the file are not touched.

    Parameters
    ----------
    content : bytes
        A checked URDF.
    origins : mapping of str to (3,) array
        New origins by joint name, in the parent link [m].

    Raises
    ------
    ModelError
        If the file has no such joint.
    """
    spans = origin_spans(content)
    missing = sorted(set(origins) - set(spans))
    if missing:
        raise ModelError(
            f"The URDF could not be changed: found no joint '{missing[0]}', needed the joints of "
            "the mechanism; give the URDF that was loaded."
        )
    changes = sorted(
        ((spans[joint], xyz) for joint, xyz in origins.items()), key=lambda c: c[0].start
    )
    pieces, at = [], 0
    for span, xyz in changes:
        value = " ".join(repr(float(x)) for x in xyz).encode()
        pieces += [content[at : span.start], span.before, value, span.after]
        at = span.end
    return b"".join([*pieces, content[at:]])


def origin_spans(content: bytes) -> dict[str, OriginSpan]:
    """Return where the origin of every joint of a URDF is, or would be, written."""
    spans: dict[str, OriginSpan] = {}
    path: list[str] = []
    joint: list[str] = []
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if path == ["robot"] and tag == "joint":
            joint[:] = [attributes["name"]]
            at = _tag_end(content, parser.CurrentByteIndex)
            if content[at - 2 : at] != b"/>":
                spans[joint[0]] = OriginSpan(at, at, b'<origin xyz="', b'"/>')
        elif path == ["robot", "joint"] and tag == "origin":
            spans[joint[0]] = _span_in_tag(content, parser.CurrentByteIndex)
        path.append(tag)

    def end(_tag: str) -> None:
        path.pop()

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.Parse(content, True)
    return spans


def same_point(one: Array, two: Array) -> bool:
    """Say whether two points differ by no more than the rounding of their computation."""
    return bool(np.abs(one - two).max() < 4e-16)


def _tag_end(content: bytes, start: int) -> int:
    """Return the offset after the ``>`` of a start tag; quoted values may hold one."""
    quote = b""
    for at in range(start, len(content)):
        byte = content[at : at + 1]
        if quote:
            quote = b"" if byte == quote else quote
        elif byte in (b'"', b"'"):
            quote = byte
        elif byte == b">":
            return at + 1
    return len(content)


def _span_in_tag(content: bytes, start: int) -> OriginSpan:
    """Return the span of ``xyz`` in an origin tag, or where to write it."""
    tag = content[start : _tag_end(content, start)]
    found = _XYZ.search(tag)
    if found is None:
        at = start + len(b"<origin")
        return OriginSpan(at, at, b' xyz="', b'"')
    group = 1 if found.group(1) is not None else 2
    return OriginSpan(start + found.start(group), start + found.end(group))
