"""EXIF: the directories of a TIFF that cameras write into photographs, read within bounds.

Only tags that are asked for are read, of the first directory and of the one that EXIF adds to it.
Sources: TIFF 6.0; CIPA DC-008, "Exif 2.32".
"""

import math
import struct
from collections.abc import Collection

Value = tuple[float, ...] | bytes

_MAGIC = {b"II*\0": "<", b"MM\0*": ">"}
_EXIF_DIRECTORY = 0x8769
_NUMBERS = {3: "H", 4: "I", 11: "f", 12: "d"}  # struct's letters by the type numbers of TIFF
_TEXTS, _RATIONAL = (1, 2, 7), 5
_MOST_ENTRIES = 1000  # of a directory
_MOST_BYTES = 65_536  # of a value
_MOST_NUMBERS = 64


def read_tags(block: bytes, wanted: Collection[int]) -> dict[int, Value]:
    """Return the values of some tags: numbers, or the bytes of a text; nothing of a damaged block.

    Rationals without a value (a denominator of zero) are left out.
    """
    order = _MAGIC.get(block[:4])
    if order is None:
        return {}
    try:
        (first,) = struct.unpack_from(order + "I", block, 4)
        found = _directory(block, order, first, {*wanted, _EXIF_DIRECTORY})
        pointer = found.pop(_EXIF_DIRECTORY, ())
        if pointer and not isinstance(pointer, bytes):
            found |= _directory(block, order, int(pointer[0]), wanted)
    except struct.error:  # a pointer beyond the end
        return {}
    return found


def _directory(block: bytes, order: str, at: int, wanted: Collection[int]) -> dict[int, Value]:
    """Return the values of some tags of a directory."""
    (n_entries,) = struct.unpack_from(order + "H", block, at)
    if n_entries > _MOST_ENTRIES:
        raise struct.error
    found: dict[int, Value] = {}
    for entry in range(at + 2, at + 2 + 12 * n_entries, 12):
        tag, kind, count = struct.unpack_from(order + "HHI", block, entry)
        if tag not in wanted:
            continue
        value = _value(block, order, entry + 8, kind, count)
        if value:
            found[tag] = value
    return found


def _value(block: bytes, order: str, at: int, kind: int, count: int) -> Value | None:
    """Return the value of an entry, which stands at a place or where that points to."""
    if kind in _TEXTS:
        letters, n_bytes = f"{min(count, _MOST_BYTES)}s", count
    elif kind in _NUMBERS or kind == _RATIONAL:
        count = min(count, _MOST_NUMBERS)
        letters = f"{2 * count}I" if kind == _RATIONAL else f"{count}{_NUMBERS[kind]}"
        n_bytes = struct.calcsize("=" + letters)
    else:
        return None
    if n_bytes > 4:
        (at,) = struct.unpack_from(order + "I", block, at)
    unpacked = struct.unpack_from(order + letters, block, at)
    if kind in _TEXTS:
        return bytes(unpacked[0])
    if kind == _RATIONAL:
        pairs = zip(unpacked[::2], unpacked[1::2], strict=True)
        numbers = tuple(a / b for a, b in pairs if b)
        return numbers if len(numbers) == count and all(map(math.isfinite, numbers)) else None
    numbers = tuple(float(x) for x in unpacked)
    return numbers if all(map(math.isfinite, numbers)) else None
