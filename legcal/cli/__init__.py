"""The command line: parses, calls a job, prints its document or its report, returns a code."""

from legcal.cli.app import main

__all__ = ["main"]
