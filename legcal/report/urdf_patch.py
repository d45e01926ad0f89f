"""Changing attribute values of a URDF in place: every other byte of the file stays as it was."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.parsers import expat

import numpy as np

from legcal.errors import ModelError
from legcal.geometry.types import Array

_ATTRIBUTES = {
    name: re.compile(rb"""(?<=\s)%s\s*=\s*(?:"([^"]*)"|'([^']*)')""" % name.encode())
    for name in ("xyz", "rpy", "radius")
}


@dataclass(frozen=True, eq=False)
class Origin:
    """What is written into the origin of a joint.

    Attributes
    ----------
    xyz : (3,) array or None
        Position in the parent link [m]; None where it stays as it is.
    rpy : (3,) array or None
        Angles about fixed x, y, z [rad]; None where they stay as they are.
    """

    xyz: Array | None = None
    rpy: Array | None = None


@dataclass(frozen=True)
class _Span:
    """Where a value stands in the file, or is to stand, as byte offsets."""

    start: int
    end: int
    before: bytes = b""
    after: bytes = b""


def patch_origins(content: bytes, origins: Mapping[str, Origin]) -> bytes:
    """Return a URDF with some joint origins changed.

    Values are written with 17 significant digits where they need them. The tags, quotes, comments,
    white space and line ends of the file are not touched.

    Parameters
    ----------
    content : bytes
        A checked URDF.
    origins : mapping of str to Origin
        New origins by joint name.

    Raises
    ------
    ModelError
        If the file has no such joint.
    """
    tags = _origin_tags(content)
    missing = sorted(set(origins) - set(tags))
    if missing:
        raise ModelError(
            f"The URDF could not be changed: found no joint '{missing[0]}', needed the joints of "
            "the mechanism; give the URDF that was loaded."
        )
    changes = [
        change
        for joint, origin in origins.items()
        for change in _changes(content, tags[joint], origin)
    ]
    return _changed(content, changes)


def patch_radii(content: bytes, radii: Mapping[tuple[str, int], float]) -> bytes:
    """Return a URDF with other radii of some visual cylinders, otherwise as it was.

    Parameters
    ----------
    content : bytes
        A checked URDF.
    radii : mapping of (str, int) to float
        New radii [m] by link and number of the cylinder among the visual cylinders of that link.
    """
    tags = _cylinder_tags(content)
    return _changed(
        content,
        [
            (_span_in_tag(content, tags[place], "radius"), repr(float(R)).encode())
            for place, R in radii.items()
        ],
    )


def _changed(content: bytes, changes: Sequence[tuple[_Span, bytes]]) -> bytes:
    """Return a file with values at the places of some spans."""
    pieces, at = [], 0
    for span, value in sorted(changes, key=lambda change: change[0].start):
        pieces += [content[at : span.start], span.before, value, span.after]
        at = span.end
    return b"".join([*pieces, content[at:]])


def _cylinder_tags(content: bytes) -> dict[tuple[str, int], int]:
    """Return where the tag of every visual cylinder stands, by link and number in it."""
    tags: dict[tuple[str, int], int] = {}
    path: list[str] = []
    link, count, is_first = "", 0, True
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal link, count, is_first
        if path == ["robot"] and tag == "link":
            link, count = attributes["name"], 0
        elif path == ["robot", "link", "visual"] and tag == "geometry":
            is_first = True
        elif path == ["robot", "link", "visual", "geometry"]:
            if tag == "cylinder" and is_first:
                tags[link, count] = parser.CurrentByteIndex
                count += 1
            is_first = False
        path.append(tag)

    def end(_tag: str) -> None:
        path.pop()

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.Parse(content, True)
    return tags


def _origin_tags(content: bytes) -> dict[str, tuple[int, bool]]:
    """Return where the origin of every joint of a URDF stands, or would, and whether it does."""
    tags: dict[str, tuple[int, bool]] = {}
    path: list[str] = []
    joint: list[str] = []
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if path == ["robot"] and tag == "joint":
            joint[:] = [attributes["name"]]
            at = _tag_end(content, parser.CurrentByteIndex)
            if content[at - 2 : at] != b"/>":
                tags[joint[0]] = at, False
        elif path == ["robot", "joint"] and tag == "origin":
            tags[joint[0]] = parser.CurrentByteIndex, True
        path.append(tag)

    def end(_tag: str) -> None:
        path.pop()

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.Parse(content, True)
    return tags


def _changes(content: bytes, tag: tuple[int, bool], origin: Origin) -> list[tuple[_Span, bytes]]:
    """Return the values that change in an origin, in the order in which they are written."""
    at, is_written = tag
    values = [
        (name, " ".join(repr(float(x)) for x in value).encode())
        for name, value in (("xyz", origin.xyz), ("rpy", origin.rpy))
        if value is not None
    ]
    if is_written:
        return [(_span_in_tag(content, at, name), value) for name, value in values]
    if not values:
        return []
    written = b" ".join(b'%s="%s"' % (name.encode(), value) for name, value in values)
    return [(_Span(at, at, b"<origin ", b"/>"), written)]


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


def _span_in_tag(content: bytes, start: int, name: str) -> _Span:
    """Return the span of an attribute's value in a tag, or where an origin is to have it."""
    tag = content[start : _tag_end(content, start)]
    found = _ATTRIBUTES[name].search(tag)
    if found is None:
        at = start + len(b"<origin")
        return _Span(at, at, b' %s="' % name.encode(), b'"')
    group = 1 if found.group(1) is not None else 2
    return _Span(start + found.start(group), start + found.end(group))
