"""``python -m legcal`` is the command line."""

from legcal.cli import main

main()
