"""Build and solve time of the fit of everything, for 45 and 450 images, and of one of axes.

Run from the project's folder: ``python benchmarks/refinement.py``. The session is that of
the tests: a hexapod, three views, four legs seen in each image, outlines with 0.1 px noise. The
start is wrong by 2 mm in every parameter, 5 mm and 0.6 degrees in every camera and pose.

The fit of axes is that of section 4.3: 45 poses, three images each, the noise of Table 1; built
once and solved for other data, as Monte Carlo studies do.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from axes_session import axes_session
from hexapod_session import disturbed_start, noisy_outlines, noisy_readings, simulate
from legcal.refinement.repeated import average_images, bound, build_axes_fit, solve_again
from legcal.refinement.solve import polish, solve

from legcal.refinement import build_fit, refine
from legcal.refinement.noise import NoiseModel

REPEATS = 5


def shortest_ms(call: Callable[[], object]) -> float:
    """Return the shortest of several durations of a call [ms]."""
    durations = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        call()
        durations.append(time.perf_counter() - begin)
    return 1e3 * min(durations)


def measure(n_poses_per_view: int) -> None:
    """Print one row: sizes and times of a session."""
    session = simulate(n_poses_per_view)
    rng = np.random.default_rng(0)
    measurements, outlines = noisy_readings(session, rng), noisy_outlines(session, rng)
    start = disturbed_start(session)
    begin = time.perf_counter()
    problem = build_fit(session.legs, measurements, outlines)
    first_build = 1e3 * (time.perf_counter() - begin)
    again = shortest_ms(lambda: build_fit(session.legs, measurements, outlines))
    state = start.state(problem.radius_prior.mean)
    whitening = NoiseModel().whitening(problem.outlines.covariance)
    found, iterations = solve(problem, state, whitening, 0.0)
    once = shortest_ms(lambda: solve(problem, state, whitening, 0.0))
    rounding = shortest_ms(lambda: polish(problem, found, whitening, 0.0))
    whole = shortest_ms(lambda: refine(session.legs, measurements, outlines, start))
    print(
        f"{measurements.n_rows:6d} {problem.layout.size:9d} {problem.n_equations:10d} "
        f"{first_build:12.0f} {again:12.0f} {once:9.0f} {iterations:11d} {rounding:10.0f} "
        f"{whole:10.0f}"
    )


def measure_axes() -> None:
    """Print the times of a fit of axes, of all images and of the mean of each pose's images."""
    session = axes_session(15, 3)
    measurements, every = session.noisy(0)
    start, truth = session.start(), session.truth
    print("axes  average/ms  build/ms  solve again/ms  bound/ms")
    for axes in (every, average_images(every, measurements)):
        fit = build_axes_fit(session.legs, measurements, axes)
        times = [
            shortest_ms(call)
            for call in (
                lambda: average_images(every, measurements),
                lambda axes=axes: build_axes_fit(session.legs, measurements, axes),
                lambda fit=fit, axes=axes: solve_again(fit, measurements, axes, start),
                lambda fit=fit, axes=axes: bound(fit, measurements, axes, truth),
            )
        ]
        print("{:4d} {:11.1f} {:9.0f} {:15.0f} {:9.0f}".format(len(axes), *times))


def main() -> None:
    """Print the tables."""
    print(
        "images  unknowns  equations  build 1st/ms  build 2nd/ms  solve/ms  iterations  polish/ms  "
        "refine/ms"
    )
    for n_poses_per_view in (15, 150):
        measure(n_poses_per_view)
    measure_axes()


if __name__ == "__main__":
    main()
