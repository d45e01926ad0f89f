"""The command line: parses, calls a job, prints its document or its report, returns a code."""

import os
import sys

from legcal.signals import INTERRUPTED, stopped_by_signals


def main() -> None:
    """Run the command line and exit with 0, 1 (data), 2 (use), 3 (internal) or 130 (stopped)."""
    code = run_command()
    if code == INTERRUPTED:
        os._exit(code)  # Python would end by the signal where that met the making of a dataclass
    sys.exit(code)


def run_command() -> int:
    """Run the command line and return its exit code."""
    as_json = "--json" in sys.argv  # also where the words cannot be parsed
    try:
        with stopped_by_signals():  # before all imports that take time
            from legcal.cli.app import run

            return run(as_json=as_json)
    except KeyboardInterrupt:
        from legcal.cli.options import print_failure

        print_failure("Interrupted", "Stopped before the end.", as_json=as_json)
        return INTERRUPTED
