"""The command line: parses, calls a job, prints its document or its report, returns a code."""

import gc
import sys

from legcal.signals import stopped_by_signals


def main() -> None:
    """Run the command line and exit with 0, 1 (data), 2 (use), 3 (internal) or 130 (stopped)."""
    as_json = "--json" in sys.argv
    try:
        with stopped_by_signals():  # before all imports that take time
            from legcal.cli.app import run

            code = run(as_json=as_json)
    except KeyboardInterrupt:
        from legcal.cli.options import INTERRUPTED, print_failure

        print_failure("Interrupted", "Stopped before the end.", as_json=as_json)
        code = INTERRUPTED
        exec("")  # else Python, if interrupted in code from a text, ends as if nobody caught it
    gc.freeze()  # the end of a process would search all that libraries made for dead cycles
    sys.exit(code)
