"""One command line of legcal, run in this process."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
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

_SCHEMAS = {"calibrate": "result", "camera": "camera-calibration", "detect": "doctor"}

# Typer reads the signatures of all commands anew for every run: as long as a refusal takes.
_get_command = cache(typer.main.get_command)


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


def words_of(command: str, places: dict[str, Path | str]) -> list[str]:
    """Split a command line and put paths in the place of their names in braces."""
    return [word.format(**places) for word in shlex.split(command)]


def run(words: Sequence[str], *, inside: Path | None = None) -> Outcome:
    """Run ``legcal WORDS``, in a folder if one is given.

    Images are searched in this process: for the few of a test, starting others takes longer than
    the work.
    """
    out, err = io.StringIO(), io.StringIO()
    folder = contextlib.chdir(inside) if inside is not None else contextlib.nullcontext()
    code: object = None
    with (
        patch.object(sys, "argv", ["legcal", *words]),
        patch.object(typer.main, "get_command", _get_command),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        folder,
        _one_processor(),
    ):
        try:
            cli.main()
        except SystemExit as stop:
            code = stop.code
    assert isinstance(code, int), f"{' '.join(words)} did not exit"
    outcome = Outcome(code, out.getvalue(), err.getvalue())
    if "--json" in words and outcome.out:
        fits_schema(words, outcome.document)
    return outcome


def fits_schema(words: Sequence[str], document: dict[str, Any]) -> None:
    """Hold what a command printed against its schema, where it has one."""
    name = "check" if "--check" in words else _SCHEMAS.get(words[0], words[0])
    name = "error" if "error" in document else name
    path = ROOT / f"legcal/files/schemas/{name}.json"
    if find_spec("jsonschema") is None:
        return
    from jsonschema import Draft202012Validator

    schema = json.loads(path.read_text(encoding="utf-8"))
    problems = Draft202012Validator(schema).iter_errors(document)
    assert [error.message for error in problems] == [], name


@contextlib.contextmanager
def _one_processor() -> Iterator[None]:
    """Let this process have one processor, another one in every process that runs tests."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    chosen = sorted(before)[int(worker) % len(before)]
    os.sched_setaffinity(0, {chosen})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
