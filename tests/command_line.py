"""The command line in the process of the tests."""

import sys
from pathlib import Path

import pytest

from legcal import cli


def run(monkeypatch: pytest.MonkeyPatch, *words: str | Path) -> int:
    """Run a command, its images in this process too, and return its exit code."""
    monkeypatch.setattr("legcal.cli.options.MAX_IMAGE_WORKERS", 1)
    monkeypatch.setattr(sys, "argv", ["legcal", *map(str, words)])
    return cli.run_command()
