"""The command line."""

from legcal.cli.app import main

__all__ = ["main"]
