"""Commands stopped at drawn moments: what is lost, left behind or falsified.

    python benchmarks/kills.py [--kills 500] [--seed 0]

SIGINT, SIGTERM and SIGKILL at moments drawn between start and end of calibrate, detect, simulate
and study, with and without a result that stands already, with one process and two, to the first
of them or to all. After each the command is run again to its end. Printed is every fault.
"""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fuzzing.kills import drawn_kills, faults_of, remove_finished


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    begin, faulty, signals = time.perf_counter(), 0, Counter[str]()
    try:
        for done, kill in enumerate(drawn_kills(asked.kills, asked.seed), 1):
            faults = list(faults_of(kill))
            faulty += bool(faults)
            signals[kill.number.name] += 1
            for fault in faults:
                print(f"{kill}: {fault}", flush=True)
            if done % 10 == 0:
                print(f"{done} kills, {faulty} with faults", file=sys.stderr, flush=True)
    finally:
        remove_finished()
    counts = ", ".join(f"{count} {name}" for name, count in sorted(signals.items()))
    print(
        f"{asked.kills} kills ({counts}) in {time.perf_counter() - begin:.0f} s, "
        f"{faulty} with faults"
    )


if __name__ == "__main__":
    main()
