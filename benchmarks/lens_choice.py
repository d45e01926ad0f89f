"""The lens model that ``legcal camera`` chooses where few images reach the edge of the field.

    OMP_NUM_THREADS=1 python benchmarks/lens_choice.py [--sets 25] [--lens NAME] [--images 35]
                                                       [--first 0] [--table]

Corners of a board of 9 x 7 squares are simulated before lenses of every model: most boards near the
middle of the image, 1 to 10 of them (by turns) near its corners. A line for each lens: sets with
the true model; images left out, though none is wrong; error of the projection over the whole
image, in stated standard deviations (share within 3, median, and the largest of a set at the 95th
percentile); processor seconds of a choice. ``--table`` prints every set.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from camera_sessions import (
    WIDE_LENSES,
    WIDE_SIZE,
    corners_at_the_edge,
    projection_errors,
    wide_camera,
)

from legcal.calibration.camera_calibration.lens import chosen_lens
from legcal.geometry.types import Array
from legcal.vision.distortion import DistortionModel


@dataclass(frozen=True)
class Outcome:
    """The choice for a set."""

    model: str
    n_left_out: int
    errors: Array
    seconds: float
    reason: str


def outcome(model: DistortionModel, n_images: int, number: int) -> Outcome:
    """Return the choice for a set of a lens."""
    truth = wide_camera(model)
    rng = np.random.default_rng([49, list(WIDE_LENSES).index(model), number])
    seen = corners_at_the_edge(truth, n_images, 1 + number % 10, rng)
    begin = time.process_time()
    chosen = chosen_lens(seen, WIDE_SIZE)
    seconds = time.process_time() - begin
    if chosen is None:
        return Outcome("none", n_images, np.full(1, np.inf), seconds, "")
    fit = chosen.fit
    return Outcome(
        fit.adjusted.camera.model,
        len(fit.left_out),
        projection_errors(truth, fit.adjusted.camera, fit.covariance),
        seconds,
        chosen.reason,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sets", type=int, default=25)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--images", type=int, default=35)
    parser.add_argument("--lens", choices=WIDE_LENSES, action="append")
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    print("lens                 right  left out   within 3  median  p95 of max  seconds")
    for model in options.lens or WIDE_LENSES:
        outcomes = []
        for number in range(options.first, options.first + options.sets):
            outcomes.append(result := outcome(model, options.images, number))
            if options.table:
                print(
                    f"  {number:3d} {1 + number % 10:2d} at the edge: {result.model:19s} "
                    f"{result.n_left_out:2d} out {result.errors.max():6.1f} sigma "
                    f"{result.seconds:5.1f} s  {result.reason}",
                    flush=True,
                )
        right = sum(result.model == model for result in outcomes)
        n_left_out = sum(result.n_left_out for result in outcomes)
        errors = np.concatenate([result.errors for result in outcomes])
        largest = [result.errors.max() for result in outcomes]
        print(
            f"{model:19s} {right:3d}/{len(outcomes):<3d} {n_left_out:3d}/"
            f"{options.images * len(outcomes):<5d} {100.0 * np.mean(errors < 3.0):8.1f} % "
            f"{np.median(errors):6.2f} {np.quantile(largest, 0.95):10.1f} "
            f"{np.mean([result.seconds for result in outcomes]):9.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
