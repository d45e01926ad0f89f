"""The lens model that ``legcal camera`` chooses where few images reach the edge of the field.

    OMP_NUM_THREADS=1 python benchmarks/lens_choice.py [--sets 25] [--lens NAME] [--images 35]
                                                       [--first 0] [--table]

Corners of a board of 9 x 7 squares are simulated before lenses of every model: most boards near the
middle of the image, 1 to 10 of them (by turns) near its corners. A line for each lens: sets with
the true model; images left out, though none is wrong; error of the projection against the map of
its uncertainty that ``legcal camera`` states over the whole image (share of places within 3
standard deviations, median, and the largest of a set at the 95th percentile; share of places that
the map leaves open); processor seconds of a choice. ``--table`` prints every set.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from camera_sessions import NOISE_PX, with_noise
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.camera_calibration.lens import chosen_lens
from legcal.calibration.camera_calibration.projection import compare_cameras, projection_sigma
from legcal.geometry.types import Array
from legcal.perception.board_adjustment import BoardImages
from legcal.vision.board import Board
from legcal.vision.camera import Camera
from legcal.vision.distortion import DistortionModel
from legcal.vision.image_file import ImageSize

WIDE_SIZE = ImageSize(1280, 960)
_BOARD = Board("chessboard", 9, 7, 1.0)
_MIDDLE, _EDGE = (0.0, 0.55), (0.85, 1.05)  # distance from the centre, in half diagonals of 600 px
WIDE_LENSES: dict[DistortionModel, tuple[float, list[float]]] = {
    "plumb_bob": (1100.0, [-0.28, 0.11, 4e-4, -3e-4, -0.02]),
    "rational_polynomial": (850.0, [0.55, -0.08, 4e-4, -3e-4, 0.01, 0.9, 0.02, 0.01]),
    "thin_prism": (
        850.0,
        [0.55, -0.08, 4e-4, -3e-4, 0.01, 0.9, 0.02, 0.01, 2e-3, -4e-4, -1.5e-3, 3e-4],
    ),
    "equidistant": (564.0, [0.0705, -0.0234, 0.0164, -0.0014]),
    # rectilinear in the middle and compressed at the edge, as of phones and action cameras
    "splined_radial": (560.0, [0.022, 0.096, 0.19, 0.21, 0.12, 0.02]),
}


@dataclass(frozen=True)
class Outcome:
    """The choice for a set."""

    model: str
    n_left_out: int
    errors: Array
    seconds: float
    reason: str


def wide_camera(model: DistortionModel) -> Camera:
    """Return a camera with a lens of a model."""
    f, coefficients = WIDE_LENSES[model]
    K = np.array([[f, 0.0, 651.0], [0.0, 0.999 * f, 497.0], [0.0, 0.0, 1.0]])
    return Camera(K, WIDE_SIZE.width, WIDE_SIZE.height, np.array(coefficients), model)


def corners_at_the_edge(
    camera: Camera, n_images: int, n_edge: int, rng: np.random.Generator
) -> BoardImages:
    """Return the corners of boards of which the last *n_edge* are near corners of the image."""
    size = np.array([camera.width, camera.height])
    centre = _BOARD.points.mean(axis=0)
    image: list[Array] = []
    points, px = [], []
    while len(image) < n_images:
        is_edge = len(image) >= n_images - n_edge
        turn = rng.choice([0.6, 2.5, 3.8, 5.6]) if is_edge else rng.uniform(0.0, 2.0 * np.pi)
        away = 600.0 * rng.uniform(*(_EDGE if is_edge else _MIDDLE))
        at = 0.5 * size + away * np.array([np.cos(turn), np.sin(turn)])
        if not np.all((at > 30.0) & (at < size - 30.0)):
            continue
        ray = np.array([*camera.undistort(at), 1.0])
        ray /= np.linalg.norm(ray)
        lean, slope = rng.uniform(0.0, 2.0 * np.pi), np.radians(rng.uniform(5.0, 40.0))
        R = Rotation.from_rotvec(0.6 * np.cross([0.0, 0.0, 1.0], ray))
        R = R * Rotation.from_rotvec(slope * np.array([np.cos(lean), np.sin(lean), 0.0]))
        R = R * Rotation.from_rotvec([0.0, 0.0, rng.uniform(-0.4, 0.4)])
        distance = rng.uniform(9.0, 15.0) * camera.K[0, 0] / 564.0
        T = RigidTransform.from_components(distance * ray - R.apply(centre), R)
        P = T.apply(_BOARD.points)
        ahead = P[:, 2] > 0.05 * distance
        seen = camera.project(np.where(ahead[:, None], P, [0.0, 0.0, 1.0]))
        back = camera.undistort(seen)  # polynomials fold far points back into the image
        is_true = np.linalg.norm(back - P[:, :2] / P[:, 2:], axis=1) < 1e-3
        inside = ahead & is_true & np.all((seen > 4.0) & (seen < size - 5.0), axis=1)
        if np.count_nonzero(inside) < 16:
            continue
        image.append(np.full(np.count_nonzero(inside), len(image)))
        points.append(_BOARD.points[inside])
        px.append(seen[inside])
    return with_noise(image, points, px, NOISE_PX, rng)


def projection_errors(truth: Camera, camera: Camera, covariance: Array) -> Array:
    """Return errors at the places of the map of uncertainty, in its standard deviations (n,).

    Zero where the map states that the lens model does not reach the place.
    """
    sigma = projection_sigma(camera, covariance)
    off = np.zeros_like(sigma)
    off[np.isfinite(sigma)] = compare_cameras(camera, truth).px
    return np.asarray(off / sigma)


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
    print("lens                 right  left out   within 3  median  p95 of max    open  seconds")
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
            f"{100.0 * np.mean(errors == 0.0):7.1f} % "
            f"{np.mean([result.seconds for result in outcomes]):9.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
