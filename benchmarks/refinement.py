"""Build time, solve time and memory of the joint fit, beside what SciPy needs for it.

Run from the project's folder: ``python benchmarks/refinement.py [--scipy-images 45 450]``. The
session is that of the tests: a hexapod, three views, four legs seen in each image, outlines with
0.1 px noise. The start is wrong by 2 mm in every parameter, 5 mm and 0.6 degrees in every camera
and pose.

``solve`` is one minimum of plain least squares from that start; ``refine`` is all of it, with the
robust loss, rejections, noise and covariance. Every size runs in a process of its own, whose
largest memory is that of building and solving. SciPy gets the same residuals, written in NumPy in
``plain_fit.py``, and must end in the same minimum.
"""

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from fit_sessions import irregular_hexapod
from plain_fit import PlainFit

from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.outline_errors import NoiseModel
from legcal.calibration.joint_fit.problem import build_fit
from legcal.estimation.solver import minimise

SIZES = (45, 450, 4500)
REPEATS = 5
SAME = 1e-9  # [m]


def shortest_ms(call: Callable[[], object], repeats: int = REPEATS) -> float:
    """Return the shortest of several durations of a call [ms]."""
    durations = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        durations.append(time.perf_counter() - begin)
    return 1e3 * min(durations)


def measure(n_images: int, with_scipy: bool) -> None:
    """Print one row: sizes and times of a session; then what SciPy needs."""
    session = irregular_hexapod(n_images // 3)
    noisy, start = session.noisy(0), session.start
    measurements, outlines = noisy.measurements, noisy.outlines
    building = shortest_ms(lambda: build_fit(session.legs, measurements, outlines))
    problem = build_fit(session.legs, measurements, outlines)
    begin = problem.begin(start)
    found = minimise(problem, begin)
    solving = shortest_ms(lambda: minimise(problem, begin))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    whole = shortest_ms(lambda: refine(session.legs, measurements, outlines, start), 2)
    print(
        f"{n_images:6d} {problem.n_unknowns:9d} {problem.n_equations:10d} {building:9.1f} "
        f"{solving:9.1f} {found.iterations:6d} {solving / n_images:13.3f} {whole:10.0f} "
        f"{memory:8.0f}",
        flush=True,
    )
    if not with_scipy:
        return
    plain = PlainFit(problem, begin, NoiseModel().whitening(problem.outlines.covariance))
    ours = np.concatenate([found.state.A.ravel(), found.state.B.ravel(), found.state.lengths])
    kinds = {"2-point, sparse": True} | ({"2-point": False} if n_images < 100 else {})
    for kind, sparse in kinds.items():
        begin_s = time.perf_counter()
        theirs = plain.solve(sparse=sparse)
        took = 1e3 * (time.perf_counter() - begin_s)
        apart = float(np.abs(plain.joints_and_offsets(theirs.x) - ours).max())
        verdict = "the same minimum" if apart < SAME else "ANOTHER MINIMUM"
        print(
            f"       SciPy {kind}: {took:.0f} ms, {took / solving:.0f} times ours; {verdict}: "
            f"{apart:.1e} m apart, cost {theirs.cost:.9g} and {found.cost:.9g}",
            flush=True,
        )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, help="only this size, in this process")
    parser.add_argument("--scipy-images", type=int, nargs="*", default=[45, 450])
    chosen = parser.parse_args()
    if chosen.images:
        measure(chosen.images, chosen.images in chosen.scipy_images)
        return
    print(
        "images  unknowns  equations  build/ms  solve/ms  steps  solve/image/ms  refine/ms  peak/MB"
    )
    for size in SIZES:
        also = [str(n) for n in chosen.scipy_images]
        subprocess.run(
            [sys.executable, __file__, "--images", str(size), "--scipy-images", *also], check=True
        )


if __name__ == "__main__":
    main()
