"""The lines of a checkpoint: what the first one says, and what one of a run holds."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from legcal.errors import UsageError
from legcal.version import __version__

_KEY = "legcal_study"
_VERSION = 1

IsRecord = Callable[[Any], bool]
"""Tells what a study records from anything else."""


def header(name: str, settings: dict[str, Any], seed: int) -> dict[str, Any]:
    """Return the first line of the checkpoint of a study."""
    found: dict[str, Any] = json.loads(
        encoded(
            {
                _KEY: _VERSION,
                "study": name,
                "version": __version__,
                "seed": seed,
                "settings": settings,
            }
        )
    )
    return found


def encoded(document: dict[str, Any]) -> bytes:
    """Return a document as one line."""
    return json.dumps(document, allow_nan=False, separators=(",", ":")).encode() + b"\n"


def parsed(line: bytes) -> Any:
    """Return the document on a line, None if there is none."""
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def is_run(found: Any, is_record: IsRecord) -> bool:
    """Return whether a document says what a run found, or how it failed."""
    if not isinstance(found, dict) or type(found.get("run")) is not int or found["run"] < 0:
        return False
    if found.keys() == {"run", "record"}:
        return is_record(found["record"])
    return found.keys() == {"run", "failure"} and is_failure(found["failure"])


def is_failure(found: Any) -> bool:
    """Return whether a document describes a failure: its kind and its message."""
    return (
        isinstance(found, dict)
        and found.keys() == {"kind", "message"}
        and all(isinstance(text, str) for text in found.values())
    )


def check_header(path: Path, line: bytes, expected: dict[str, Any]) -> None:
    """Refuse a first line that is not the expected one."""
    start = f"{path}: the study could not be continued: found"
    end = "give another output folder, or this one the command that began it."
    found = parsed(line)
    if not isinstance(found, dict) or found.get(_KEY) != _VERSION:
        raise UsageError(
            f"{start} a file that is no checkpoint of legcal, needed one or none; "
            "give another output folder."
        )
    if found.get("study") != expected["study"]:
        raise UsageError(
            f"{start} the checkpoint of the study '{found.get('study')}', needed one of "
            f"'{expected['study']}'; {end}"
        )
    if found != expected:
        different = "; ".join(_differences(found, expected))
        raise UsageError(f"{start} a checkpoint of other settings ({different}); {end}")


def _differences(found: Any, expected: Any, name: str = "") -> Iterator[str]:
    """Name what two documents differ in."""
    if isinstance(found, dict) and isinstance(expected, dict):
        for key in dict.fromkeys([*expected, *found]):
            if found.get(key) != expected.get(key):
                inner = key if name in ("", "settings") else f"{name}.{key}"
                yield from _differences(found.get(key), expected.get(key), inner)
    else:
        yield f"{name} {json.dumps(found)} instead of {json.dumps(expected)}"
