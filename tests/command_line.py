"""One command line of legcal, run in this process."""

from __future__ import annotations

import contextlib
import io
import json
import shlex
import sys
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import process_settings  # noqa: F401
import typer.main

from legcal import cli

ROOT = Path(__file__).parents[1]

# Typer reads the signatures of all commands anew for every run: as long as a refusal takes.
_get_command = cache(typer.main.get_command)

_SCHEMAS = {"calibrate": "result", "camera": "camera-calibration", "detect": "doctor"}


@dataclass(frozen=True)
class Outcome:
    """How a command ended and what it printed."""

    code: int
    out: str
    err: str

    @cached_property
    def document(self) -> Any:
        """The JSON document on stdout: all that there is, in one line."""
        return json.loads(self.out)

    @property
    def said(self) -> str:
        """All that was printed, in one line."""
        return " ".join((self.out + self.err).split())


def words_of(command: str, places: dict[str, Path | str]) -> list[str]:
    """Split a command line and put paths in the place of their names in braces."""
    return [word.format(**places) for word in shlex.split(command)]


def run(*words: str | Path, inside: Path | None = None) -> Outcome:
    """Run ``legcal WORDS``, in a folder if one is given.

    Images are searched in this process: for the few of a test, starting others takes longer than
    the work. A document that is printed is held against its schema.
    """
    out, err = io.StringIO(), io.StringIO()
    folder = contextlib.chdir(inside) if inside is not None else contextlib.nullcontext()
    with (
        patch.object(sys, "argv", ["legcal", *map(str, words)]),
        patch.object(typer.main, "get_command", _get_command),
        patch("legcal.cli.options.MAX_IMAGE_WORKERS", 1),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        folder,
    ):
        code = cli.run_command()
    outcome = Outcome(code, out.getvalue(), err.getvalue())
    if "--json" in words and outcome.out:
        _check_schema(words, outcome.document)
    return outcome


def _check_schema(words: tuple[str | Path, ...], document: dict[str, Any]) -> None:
    name = "check" if "--check" in words else _SCHEMAS.get(str(words[0]), str(words[0]))
    name = "camera-comparison" if "--compare" in words else name
    name = "error" if "error" in document else name
    path = ROOT / f"legcal/files/schemas/{name}.json"
    if find_spec("jsonschema") is None:
        return
    from jsonschema import Draft202012Validator

    schema = json.loads(path.read_text(encoding="utf-8"))
    problems = Draft202012Validator(schema).iter_errors(document)
    assert [error.message for error in problems] == [], name
