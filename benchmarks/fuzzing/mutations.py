"""Damage to a valid file: bytes, lines, tokens and whole structures, drawn from a seed."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

Chance = np.random.Generator
Mutation = Callable[[bytes, Chance], bytes]

TOKEN = re.compile(rb"[-+]?\d[\w.+-]*|[A-Za-z_][\w./-]*")
NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
LINE = re.compile(rb"[^\n]*\n|[^\n]+")
MOST = 2_000_000  # bytes of a mutated file: larger ones are in the table of bombs

NUMBERS = (
    "nan", "NaN", ".nan", "inf", "-inf", ".inf", "Infinity", "1e400", "-1e400", "1e-400", "-0", "0",
    "-1", "1", "1e308", "-1e308", "1e150", "1e20", "2147483648", "-2147483649", "4294967296",
    "9223372036854775808", "18446744073709551616", "1" * 400, "0." + "3" * 400, "1_000", "0x10",
    "0o17", "1,5", "1.5.5", "--1", "+1", "1e", "e5", "\u0661\u0662", "\u00bd", "1mm", "90deg",
    "1 m",
)  # fmt: skip
WORDS = (
    "", " ", "null", "~", "true", "no", "[]", "{}", "''", '""', "None", "\u00e4\u00f6\u20ac",
    "\U0001f916", "\u202e", "\ufeff", "a" * 5000, "../../..", "/", "/dev/null", ".", "..", "~/x",
    "C:\\x", "=1+1", "@x", "+x", "-x", "%s%n", "{0}", "{x}", "$(x)", "`x`", "&amp;", "<x>",
    "\x1b[31m", "\x07", "\x00", "\t", "\x85", "\u2028", "!!python/object:x {}", "!!binary x",
    "&a", "*a", "<<", "? ", "- ", ": ", "|", ">", "#", "%", "2020-01-01", "12:30:45", "0b1",
    "leg1", "base", "platform",
)  # fmt: skip


def mutate(content: bytes, kind: str, chance: Chance) -> bytes:
    """Return the content of a file of a kind (a suffix) with one to three changes."""
    mutations = [*BYTES]
    if kind not in BINARY:
        mutations = [*BYTES[:2], *TEXT, *TEXT, *STRUCTURE.get(kind, ())]
    for _ in range(int(chance.choice([1, 1, 1, 2, 3]))):
        content = mutations[chance.integers(len(mutations))](content, chance)[:MOST]
    return content


def _place(content: bytes, chance: Chance) -> int:
    return int(chance.integers(len(content) + 1))


def flip_bytes(content: bytes, chance: Chance) -> bytes:
    """Change a few bytes, most often near the beginning, where headers are."""
    changed = bytearray(content)
    for _ in range(int(chance.integers(1, 6))):
        if changed:
            end = len(changed) if chance.random() < 0.5 else min(len(changed), 64)
            changed[int(chance.integers(end))] = int(chance.integers(256))
    return bytes(changed)


def cut(content: bytes, chance: Chance) -> bytes:
    """Keep the beginning, or leave a part out."""
    start = _place(content, chance)
    if chance.random() < 0.5:
        return content[:start]
    return content[:start] + content[start + int(chance.integers(1, 200)) :]


def repeat_part(content: bytes, chance: Chance) -> bytes:
    """Write a part twice or many times."""
    start = _place(content, chance)
    part = content[start : start + int(chance.integers(1, 400))]
    return content[:start] + part * int(chance.choice([2, 2, 3, 50])) + content[start:]


def foreign_bytes(content: bytes, chance: Chance) -> bytes:
    """Insert random bytes."""
    start = _place(content, chance)
    return content[:start] + chance.bytes(int(chance.integers(1, 40))) + content[start:]


def _tokens(content: bytes, chance: Chance, pattern: re.Pattern[bytes]) -> re.Match[bytes] | None:
    found = list(pattern.finditer(content))
    return found[chance.integers(len(found))] if found else None


def change_number(content: bytes, chance: Chance) -> bytes:
    """Put something else, or a number of another size, in the place of a number."""
    match = _tokens(content, chance, NUMBER)
    if match is None:
        return content
    if chance.random() < 0.6:
        new = NUMBERS[chance.integers(len(NUMBERS))].encode()
    else:
        value = float(match[0]) * float(chance.choice([-1.0, 1e-3, 0.5, 2.0, 10.0, 1e3, 1e6, 57.3]))
        new = repr(value).encode()
    return content[: match.start()] + new + content[match.end() :]


def change_word(content: bytes, chance: Chance) -> bytes:
    """Put another word in the place of one, also one of the same file."""
    match = _tokens(content, chance, TOKEN)
    if match is None:
        return content
    other = _tokens(content, chance, TOKEN)
    new = WORDS[chance.integers(len(WORDS))].encode()
    if other is not None and chance.random() < 0.4:
        new = other[0]
    return content[: match.start()] + new + content[match.end() :]


def swap_tokens(content: bytes, chance: Chance) -> bytes:
    """Exchange two words or numbers."""
    found = [_tokens(content, chance, TOKEN) for _ in range(2)]
    if found[0] is None or found[1] is None:
        return content
    one, two = sorted((m for m in found if m is not None), key=lambda m: m.start())
    if one.end() > two.start():
        return content
    return b"".join(
        [content[: one.start()], two[0], content[one.end() : two.start()], one[0],
         content[two.end() :]]
    )  # fmt: skip


def change_lines(content: bytes, chance: Chance) -> bytes:
    """Leave a line out, write it twice, empty it, move it, or turn its indentation."""
    lines = LINE.findall(content)
    if not lines:
        return content
    k = int(chance.integers(len(lines)))
    way = chance.integers(6)
    if way == 0:
        del lines[k]
    elif way == 1:
        lines.insert(k, lines[k])
    elif way == 2:
        lines[k] = b"\n"
    elif way == 3:
        lines.insert(int(chance.integers(len(lines))), lines.pop(k))
    elif way == 4:
        lines[k] = bytes(chance.choice([b"  ", b"\t", b"    ", b""])) + lines[k].lstrip()
    else:
        lines = lines[: k + 1] * 2
    return b"".join(lines)


def encode_otherwise(content: bytes, chance: Chance) -> bytes:
    """Write the text with another encoding or other ends of lines."""
    way = chance.integers(6)
    if way == 0:
        return b"\xef\xbb\xbf" + content
    if way == 1:
        return content.replace(b"\n", b"\r\n")
    if way == 2:
        return content.replace(b"\n", b"\r")
    if way == 3:
        return content.decode("utf-8", "replace").encode("utf-16")
    if way == 4:
        start = _place(content, chance)
        return content[:start] + b"\xe9\xff" + content[start:]
    return content + b"\x00" * 3


def nest_deeply(content: bytes, chance: Chance) -> bytes:
    """Insert many opening brackets or tags."""
    start = _place(content, chance)
    depth = int(chance.choice([20, 500, 20_000]))
    opening = bytes(chance.choice([b"[", b"{", b"{a: ", b'{"a":', b"<a>", b"- ", b"("]))
    return content[:start] + opening * depth + content[start:]


def yaml_structure(content: bytes, chance: Chance) -> bytes:
    """Write anchors, merge keys, tags, other documents or a key twice."""
    added = (
        b"a: &a [1, 2]\nb: *a\n",
        b"a: &a [*a]\n",
        b"x: &x {a: 1}\n<<: [*x, *x, *x]\n",
        b"<<: 3\n",
        b"---\n",
        b"...\nmore: 1\n",
        b"!!python/object/apply:os.system ['true']\n",
        b"? [1, 2]\n: 3\n",
        b"1: 2\n",
        b"null: 1\n",
        b"'': 1\n",
        b"\xe2\x80\x8b: 1\n",
        b"legcal: {}\n",
        b"views: []\n",
        b"type: [6d]\n",
    )
    lines = LINE.findall(content)
    lines.insert(int(chance.integers(len(lines) + 1)), added[chance.integers(len(added))])
    return b"".join(lines)


def xml_structure(content: bytes, chance: Chance) -> bytes:
    """Take an element or an attribute out, write it twice, or add what no URDF has."""
    way = chance.integers(5)
    if way == 0:
        match = _tokens(content, chance, re.compile(rb'\s[\w:]+="[^"]*"'))
    else:
        match = _tokens(content, chance, re.compile(rb"<[^<>]*/?>"))
    if match is None:
        return content
    if way < 2:
        return content[: match.start()] + content[match.end() :]
    if way == 2:
        return content[: match.end()] + match[0] + content[match.end() :]
    added = (
        b'<!DOCTYPE robot [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]>&b;',
        b"<!-- ",
        b"<![CDATA[",
        b"<?xml version='1.1'?>",
        b"<axis/>",
        b'<joint name="x" type="floating"><parent link="base"/><child link="base"/></joint>',
        b'<mimic joint="leg1_prismatic" multiplier="nan"/>',
        b'<origin xyz="1 2" rpy="a b c"/>',
        b"<limit/>",
        b'<a xmlns:b="c" b:d="e"/>',
        b'<xi:include href="/dev/zero" xmlns:xi="http://www.w3.org/2001/XInclude"/>',
    )
    return content[: match.end()] + added[chance.integers(len(added))] + content[match.end() :]


def csv_structure(content: bytes, chance: Chance) -> bytes:
    """Take a column out, write one twice, change a header, a row's length or a separator."""
    lines = content.split(b"\n")
    rows = [line.split(b",") for line in lines]
    width = len(rows[0])
    j, way = int(chance.integers(width)), chance.integers(6)
    k = int(chance.integers(len(rows)))
    if way == 0:
        rows = [row[:j] + row[j + 1 :] for row in rows]
    elif way == 1:
        rows = [row[: j + 1] + row[j:] for row in rows]
    elif way == 2:
        other = int(chance.integers(width))
        for row in rows:
            if len(row) == width:
                row[j], row[other] = row[other], row[j]
    elif way == 3:
        rows[k] = rows[k][:j]
    elif way == 4:
        rows[k] = [b'"' + cell.replace(b'"', b'""') for cell in rows[k]]
    else:
        separator = bytes(chance.choice([b";", b"\t", b" ", b",,"]))
        return b"\n".join(separator.join(row) for row in rows)
    return b"\n".join(b",".join(row) for row in rows)


BYTES: tuple[Mutation, ...] = (flip_bytes, cut, repeat_part, foreign_bytes)
TEXT: tuple[Mutation, ...] = (
    change_number,
    change_number,
    change_word,
    swap_tokens,
    change_lines,
    encode_otherwise,
    nest_deeply,
)
STRUCTURE: dict[str, tuple[Mutation, ...]] = {
    "yaml": (yaml_structure, yaml_structure),
    "urdf": (xml_structure, xml_structure, xml_structure),
    "xml": (xml_structure, xml_structure, xml_structure),
    "csv": (csv_structure, csv_structure),
}
BINARY = ("png", "jpg", "tiff")
