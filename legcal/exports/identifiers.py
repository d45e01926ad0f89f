"""Names of a machine as identifiers and literals of other languages."""

from __future__ import annotations

import re
from collections.abc import Iterable

MAX_IDENTIFIER = 40  # letters: MATLAB names have at most 63, with prefixes
# Reserved in Python, C or MATLAB, so that a machine has the same name in all of them.
_RESERVED = frozenset(
    {
        "false", "none", "true", "and", "as", "assert", "async", "await", "auto", "bool",
        "break", "case", "catch", "char", "class", "classdef", "const", "continue", "def",
        "default", "del", "do", "double", "elif", "else", "elseif", "end", "enum", "except",
        "extern", "finally", "float", "for", "from", "function", "global", "goto", "if",
        "import", "in", "inline", "int", "is", "lambda", "long", "nonlocal", "not", "or",
        "otherwise", "parfor", "pass", "persistent", "raise", "register", "restrict",
        "return", "short", "signed", "sizeof", "spmd", "static", "struct", "switch", "try",
        "typedef", "union", "unsigned", "void", "volatile", "while", "with", "yield"
    }
)  # fmt: skip


def identifier(name: str) -> str:
    """Return a name as an identifier of ASCII letters, digits and underscores."""
    text = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")[:MAX_IDENTIFIER].lower()
    if not text or text[0].isdigit() or text in _RESERVED:
        text = f"m_{text}".rstrip("_")
    return text


def is_identifier(name: str) -> bool:
    """Return whether a name is an identifier in all languages."""
    return re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,62}", name) is not None and name not in _RESERVED


def identifiers(names: Iterable[str]) -> list[str]:
    """Return names as distinct identifiers."""
    unique_names: list[str] = []
    for name in names:
        plain, number = identifier(name), 1
        unique = plain
        while unique in unique_names:
            number += 1
            unique = f"{plain}_{number}"
        unique_names.append(unique)
    return unique_names


def c_string(text: str) -> str:
    """Return text as a C literal, in UTF-8."""
    return '"' + "".join(_c_byte(byte) for byte in text.encode()) + '"'


def _c_byte(byte: int) -> str:
    letter = chr(byte)
    is_plain = 0x20 <= byte < 0x7F and letter not in '"\\?'
    return letter if is_plain else f"\\{byte:03o}"


def matlab_string(text: str) -> str:
    """Return text as a character vector of MATLAB."""
    return "'" + text.replace("'", "''") + "'"


def comment(text: str) -> str:
    """Return text for a comment of any language: one line of ASCII without comment ends."""
    return re.sub(r"[^A-Za-z0-9 ._,;:()+=-]", "_", text)
