"""The version of legcal, defined here only."""

__version__ = "0.2.0"
