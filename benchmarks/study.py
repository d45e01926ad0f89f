"""Time and memory of the paper's evaluation, for a hundred runs and for many more.

Run from the project's folder: ``python benchmarks/study.py [--runs 100 2000] [--workers 2]``.
Every study is a process of its own, as on the command line, figures included. Memory is the largest
resident set of that process and of its workers; it is to stay the same however many runs there are.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

_PROGRAM = """
import json, resource, sys
from pathlib import Path
from legcal.simulation import PaperStudy
from legcal.simulation import run_study

if __name__ == "__main__":
    n_runs, workers, folder = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
    result = run_study(PaperStudy(), n_runs, workers=workers, output=folder)
    who = resource.RUSAGE_SELF
    print(json.dumps({"own": resource.getrusage(who).ru_maxrss / 1024.0}))
"""


def measure(n_runs: int, workers: int) -> None:
    """Print one row: time and memory of a study."""
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "program.py"
        program.write_text(_PROGRAM)
        words = [sys.executable, str(program), str(n_runs), str(workers), f"{folder}/out"]
        begin = time.perf_counter()
        process = subprocess.Popen(
            words, stdout=subprocess.PIPE, env={**os.environ, "OMP_NUM_THREADS": "1"}
        )
        largest = 0.0
        while process.poll() is None:
            largest = max(largest, _largest_worker(process.pid))
            time.sleep(0.5)
        seconds = time.perf_counter() - begin
        assert process.stdout is not None
        own = json.loads(process.stdout.read())["own"]
        size = (Path(folder) / "out" / "runs.jsonl").stat().st_size / 1024.0**2
    print(f"{n_runs:6d} {workers:8d} {seconds:9.1f} {own:10.0f} {largest:11.0f} {size:14.1f}")


def _largest_worker(parent: int) -> float:
    """Return the resident memory of the largest child of a process [MB]."""
    sizes = [0.0]
    for path in Path("/proc").glob("[0-9]*/status"):
        try:
            fields = dict(line.split(":", 1) for line in path.read_text().splitlines())
        except OSError:  # it ended meanwhile
            continue
        if int(fields["PPid"]) == parent and "VmRSS" in fields:
            sizes.append(int(fields["VmRSS"].split()[0]) / 1024.0)
    return max(sizes)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, nargs="+", default=[100, 2000])
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    print("  runs  workers    time/s  memory/MB  worker/MB  checkpoint/MB")
    for n_runs in arguments.runs:
        measure(n_runs, arguments.workers)


if __name__ == "__main__":
    main()
