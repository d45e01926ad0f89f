"""How long the commands take as whole processes, and how much memory: medians of some runs.

python benchmarks/commands.py [RUNS]
"""

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
LEGCAL = [sys.executable, "-m", "legcal"]


def measure(words: list[str], runs: int, before: Path | None = None) -> str:
    """Run a command some times; remove the cache of a dataset before each run if one is given."""
    seconds, megabytes = [], []
    for _ in range(runs):
        if before is not None:
            for name in ("observations.csv", ".legcal-cache.json"):
                (before / name).unlink(missing_ok=True)
        begin = time.perf_counter()
        process = subprocess.Popen(
            [*LEGCAL, *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        _, status, usage = os.wait4(process.pid, 0)
        seconds.append(time.perf_counter() - begin)
        megabytes.append(usage.ru_maxrss / 1024.0)
        if status:
            sys.exit(f"legcal {' '.join(words)} failed")
    return (
        f"{statistics.median(seconds):6.2f} s (min {min(seconds):.2f}, max {max(seconds):.2f})"
        f"  {max(megabytes):6.0f} MB"
    )


def main(runs: int = 5) -> None:
    """Print a line a command."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(shutil.copytree(ROOT / "examples/hexapod", Path(temporary) / "hexapod"))
        calibrate = ["calibrate", str(folder), "-o", str(Path(temporary) / "out")]
        print("--help            ", measure(["--help"], runs))
        print("inspect           ", measure(["inspect", "hexapod"], runs))
        print("calibrate, first  ", measure(calibrate, runs, before=folder))
        print("calibrate, cached ", measure(calibrate, runs))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
