"""What is identifiable of every shipped model, how clear the ranks are, and how long it takes.

python benchmarks/identify.py [RUNS]

For three views of all legs: rank of the joint fit, and the standard
deviation of the worst direction that counts as determined and of the best that does not, in
leg lengths (the limit is 1). Then the time of the analysis alone and of the whole command.
"""

import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import legcal
from legcal.calibration.identify.identifiability import Analysis, identifiability
from legcal.calibration.identify.session import planned_session

ROOT = Path(__file__).parents[1]
WEAK = ["leg1,leg2,leg3,leg4,leg5", "leg1,leg2,leg3,leg4,leg5", "leg5,leg6"]


def main(runs: int = 5) -> None:
    """Print a line a model, then a line a command."""
    print(f"{'model':16} {'rank':>9} {'worst':>8} {'beyond':>8} {'seconds':>8}")
    for path in sorted((ROOT / "models").glob("*.yaml")):
        machine = legcal.load_mechanism(path)
        begin = time.perf_counter()
        report = identifiability(machine)
        seconds = time.perf_counter() - begin
        views = [[machine.leg_names.index(name) for name in view] for view in report.views]
        session = planned_session(machine, views)
        singular = np.linalg.svd(Analysis(session).information, compute_uv=False)
        sigma = 1.0 / np.maximum(singular, 1e-30) / session.mean_length
        beyond = f"{sigma[sigma >= 1.0].min():8.0f}" if np.any(sigma >= 1.0) else f"{'none':>8}"
        print(
            f"{path.stem:16} {report.full.rank:4}/{report.full.of:<4} "
            f"{sigma[sigma < 1.0].max():8.4f} {beyond} {seconds:8.2f}"
        )
    weak = [word for view in WEAK for word in ("--view", view)]
    for words in (["inspect"], ["identify"], ["identify", *weak]):
        command = [sys.executable, "-m", "legcal", words[0], "hexapod", *words[1:]]
        taken = []
        for _ in range(runs):
            begin = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            taken.append(time.perf_counter() - begin)
        views_given = " with views" if len(words) > 1 else ""
        print(f"legcal {words[0]} hexapod{views_given}: {statistics.median(taken):.2f} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
