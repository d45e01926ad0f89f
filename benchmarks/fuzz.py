"""Damaged inputs of every reader: what other than an answer or a refusal they lead to.

    OMP_NUM_THREADS=1 python benchmarks/fuzz.py [--inputs 100000] [--seed 0] [--workers N]
                                                [--keep FOLDER] [--deep SHARE] [--only NAME]

Every input is a valid file with one to three changes (bytes, tokens, lines, structure), which a
command reads in a child process with limits. Printed are the exit codes, the slowest and the
largest, and every fault; FOLDER gets the damaged files of the faults.
"""

import argparse
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fuzzing.running import DEEP_SHARE, Count, count_cases, drawn_cases
from fuzzing.subjects import SUBJECTS


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--deep", type=float, default=DEEP_SHARE)
    parser.add_argument("--only", default="", help="subjects whose name holds this")
    asked = parser.parse_args()
    begin = time.perf_counter()
    cases = drawn_cases(asked.inputs, asked.seed, asked.deep)
    cases = [case for case in cases if asked.only in SUBJECTS[case.subject].name]
    parts = [cases[k :: asked.workers] for k in range(asked.workers)]
    total = Count()
    with ProcessPoolExecutor(asked.workers) as pool:
        for count in pool.map(count_cases, parts):
            total.codes += count.codes
            for ended in (*count.faults, count.slowest, count.largest):
                if ended is not None and (ended.fault or not total.faults):
                    pass
            total.faults += count.faults
            for name in ("slowest", "largest"):
                one, other = getattr(total, name), getattr(count, name)
                value = "seconds" if name == "slowest" else "megabytes"
                if one is None or (other and getattr(other, value) > getattr(one, value)):
                    setattr(total, name, other)
    print(
        f"{len(cases)} inputs in {time.perf_counter() - begin:.0f} s: exit codes {dict(total.codes)}"
    )
    for word, ended in (("slowest", total.slowest), ("largest", total.largest)):
        if ended is not None:
            name = SUBJECTS[ended.case.subject].name
            print(
                f"{word}: {name} seed {ended.case.seed}: {ended.seconds:.2f} s, {ended.megabytes:.0f} MB"
            )
    print(f"{len(total.faults)} faults")
    for ended in total.faults:
        subject = SUBJECTS[ended.case.subject]
        print(f"  {subject.name} seed {ended.case.seed}: {ended.fault[:300]}")
        if asked.keep:
            asked.keep.mkdir(parents=True, exist_ok=True)
            name = f"{ended.case.seed}-{subject.name}".replace("/", "_").replace(":", "_")
            (asked.keep / name).write_bytes(ended.case.content())


if __name__ == "__main__":
    main()
