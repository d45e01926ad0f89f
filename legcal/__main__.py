"""``python -m legcal`` is the command line."""

from legcal.cli import main

if __name__ == "__main__":
    main()
