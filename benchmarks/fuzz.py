"""Damaged inputs of every reader: what other than an answer or a refusal they lead to.

    OMP_NUM_THREADS=1 python benchmarks/fuzz.py [--inputs 100000] [--seed 0] [--workers N]
                                                [--keep FOLDER] [--deep SHARE] [--only NAME]
                                                [--claims 4]

Every input is a valid file with one to three changes (bytes, tokens, lines, structure), which a
command reads in a child process with limits. Printed are the exit codes, the slowest and the
largest, and every fault; FOLDER gets the damaged files of the faults. A few more are valid tables
of outlines whose covariances are most unequal: they must not be refused.
"""

import argparse
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fuzzing.running import DEEP_SHARE, Count, cases_of_unequal_claims, count_cases, drawn_cases

from legcal.workers import worker_pool


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--keep", type=Path, help="folder for the damaged files of the faults")
    parser.add_argument("--deep", type=float, default=DEEP_SHARE, help="share of slow commands")
    parser.add_argument("--only", default="", help="subjects whose name holds this")
    parser.add_argument("--claims", type=int, default=4, help="tables of most unequal outlines")
    asked = parser.parse_args()
    begin = time.perf_counter()
    cases = drawn_cases(asked.inputs, asked.seed, asked.deep)
    cases += cases_of_unequal_claims(asked.claims, asked.seed)
    cases = [case for case in cases if asked.only in case.subject.name]
    parts = [cases[k :: asked.workers] for k in range(asked.workers)]
    total = Count()
    with worker_pool(asked.workers, "The inputs could not be read") as run:
        for count in run(count_cases, parts):
            total.include(count)
    seconds = time.perf_counter() - begin
    print(f"{total.n_cases} inputs in {seconds:.0f} s: exit codes {dict(total.codes)}")
    for word, ended in (("slowest", total.slowest), ("largest", total.largest)):
        if ended is not None:
            what = f"{ended.seconds:.2f} s, {ended.megabytes:.0f} MB"
            print(f"{word}: {ended.case.name}: {what}")
    print(f"{len(total.faults)} faults")
    for ended in total.faults:
        print(f"  {ended.case.name}: {ended.fault[:300]}")
        if asked.keep:
            asked.keep.mkdir(parents=True, exist_ok=True)
            name = ended.case.name.replace("/", "_").replace(":", "_").replace(" ", "_")
            (asked.keep / name).write_bytes(ended.case.content())
    sys.exit(bool(total.faults))


if __name__ == "__main__":
    main()
