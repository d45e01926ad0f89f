"""Calibrate parallel robots from photographs of their legs."""

from legcal.version import __version__

__all__ = ["__version__"]
