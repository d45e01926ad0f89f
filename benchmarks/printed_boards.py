"""Whether ``legcal camera`` states honest uncertainties from boards as they are printed.

    OMP_NUM_THREADS=1 python benchmarks/printed_boards.py [--sets 200] [--images 20] [--wrong zoom]
    OMP_NUM_THREADS=1 python benchmarks/printed_boards.py --photographs [--kind phone]

Each set has a sheet of its own: bent by --warp mm, uneven beyond that, printed --ratio wider than
high. Corners have errors of their own and errors that neighbours in an image share (sharpening,
compression), and the lens is a little outside its model. Printed are the normalised squared error
of all intrinsics e' C^-1 e / k, 1 where sigmas are honest, that of the difference of random halves
of a set, pulls of single intrinsics, and with --wrong what a third of the images does to them. With
--photographs boards are rendered, developed by a camera with sharpening and JPEG, and searched.
"""

import argparse
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from board_photographs import PrintedBoard, photograph_boards
from camera_sessions import together

from legcal.calibration.camera_calibration.consensus import RobustFit, robust_fit
from legcal.calibration.camera_calibration.starts import from_scratch, part_of
from legcal.geometry.types import Array
from legcal.perception.board_adjustment import BoardImages, Sheet
from legcal.perception.board_corners import certain_corners, search_board
from legcal.simulation.cameras import mild_lens
from legcal.simulation.rendering.appearance import CAMERAS, Appearance
from legcal.vision.board import Board
from legcal.vision.camera import Camera, intrinsic_names, intrinsic_values
from legcal.vision.image_file import ImageSize, read_image

BOARD = Board("chessboard", 10, 7, 0.025)
CAMERA = Camera(
    np.array([[1150.0, 0.0, 648.3], [0.0, 1153.0, 471.2], [0.0, 0.0, 1.0]]),
    1280,
    960,
    np.array([-0.25, 0.1, 1e-3, -5e-4, -0.02]),
)
WRONG = ("zoom", "rolling", "bent", "noise", "shift")
_UNEVEN, _SHARED = 0.7, 0.4  # lengths over which sheets and errors of corners vary, in half boards
_FEWEST = 8  # images of a half


@dataclass(frozen=True)
class Look:
    """How corners are made."""

    warp: float = 5e-4  # [m] one standard deviation of each number
    ratio: float = 2e-3
    uneven: float = 3e-5  # [m]
    noise: float = 0.03  # [px]
    shared: float = 0.03  # [px]
    lens: float = 0.02  # [px] near the corners of the image


def corners(
    look: Look, n_images: int, rng: np.random.Generator, camera: Camera, sheet: Array
) -> BoardImages:
    """Return the corners of a board, whole in every image."""
    points = BOARD.points
    shape = replace(Sheet.flat(points), numbers=sheet)
    at = (points[:, :2] - shape.middle) / shape.half
    apart = np.sum((at[:, None] - at) ** 2, axis=-1)
    rough, shared = (
        np.linalg.cholesky(np.exp(-0.5 * apart / length**2) + 1e-8 * np.eye(len(points)))
        for length in (_UNEVEN, _SHARED)
    )
    real = shape.placed(points)[0]
    real[:, 2] += look.uneven * (rough @ rng.standard_normal(len(points)))
    middle = RigidTransform.from_translation(-points.mean(axis=0))
    size = np.array([camera.width, camera.height])
    seen: list[Array] = []
    while len(seen) < n_images:
        xy = camera.undistort(rng.uniform(0.2 * size, 0.8 * size))
        quarter = 0.5 * np.pi * (rng.uniform() < 0.25)
        angles = [*rng.uniform(-0.5, 0.5, 2), rng.uniform(-0.3, 0.3) + quarter]
        turn = Rotation.from_euler("xyz", angles)
        T = RigidTransform.from_components(rng.uniform(0.3, 0.6) * np.array([*xy, 1.0]), turn)
        px = camera.project((T * middle).apply(real))
        q = (px - 0.5 * size) / (0.5 * float(np.linalg.norm(size)))
        px = px + look.lens * (q * np.sum(q**2, axis=1, keepdims=True) ** 3)
        if np.all((px > 5.0) & (px < size - 6.0)):
            error = look.noise * rng.standard_normal(px.shape)
            seen.append(px + error + look.shared * (shared @ rng.standard_normal(px.shape)))
    n = len(points)
    image = np.repeat(np.arange(n_images), n)
    every = np.full(n * n_images, look.noise)
    return BoardImages(image, np.tile(points, (n_images, 1)), np.concatenate(seen), every)


def with_wrong(
    kind: str | None, look: Look, n_images: int, rng: np.random.Generator
) -> BoardImages:
    """Return a set of which a third of the images is wrong."""
    sheet = np.array([1.0, 1.0, 0.5, 1.0]) * [*[look.warp] * 3, look.ratio]
    sheet = sheet * rng.standard_normal(4)
    n_wrong = n_images // 3 if kind else 0
    good = corners(look, n_images - n_wrong, rng, CAMERA, sheet)
    if not kind:
        return good
    if kind == "zoom":
        K = CAMERA.K * np.array([[1.05, 1.0, 1.0], [1.0, 1.05, 1.0], [1.0, 1.0, 1.0]])
        return together(good, corners(look, n_wrong, rng, replace(CAMERA, K=K), sheet))
    if kind == "bent":
        sheet = sheet + np.array([2e-3, 0.0, 1e-3, 0.0])
    if kind == "noise":
        look = replace(look, noise=1.0)
    other = corners(look, n_wrong, rng, CAMERA, sheet)
    if kind == "shift":
        other = replace(other, px=other.px + np.array([12.0, 5.0]))
    if kind == "rolling":
        row = other.px[:, 1:] / CAMERA.height - 0.5
        drift = rng.normal(0.0, 6.0, (n_wrong, 2))[other.image]
        other = replace(other, px=other.px + row * drift)
    return together(good, other)


def photographs(args: argparse.Namespace, seed: int, folder: Path) -> tuple[BoardImages, Camera]:
    """Return the corners that are found in rendered photographs, and the camera."""
    rng = np.random.default_rng(seed)
    scale = 1.0 + args.ratio * rng.standard_normal()
    printed = PrintedBoard(BOARD, 1e-3 * args.warp * rng.standard_normal(), (scale, 1.0))
    camera, pipeline = mild_lens(), CAMERAS[args.kind]
    look = Appearance(camera=args.kind, colour=pipeline.colour, gamma=2.2)
    paths = photograph_boards(folder, printed, camera, look, args.images, seed, pipeline)
    found = [
        certain_corners(BOARD, search_board(BOARD, np.asarray(read_image(path, camera))))
        for path in paths
    ]
    found = [one for one in found if len(one[0]) == BOARD.n_corners]
    return (
        BoardImages(
            np.repeat(np.arange(len(found)), BOARD.n_corners),
            np.concatenate([BOARD.points[numbers] for numbers, _, _ in found]),
            np.concatenate([px for _, px, _ in found]),
            np.concatenate([sigma for _, _, sigma in found]),
        ),
        camera,
    )


def squares(e: Array, C: Array) -> float:
    """Return e' C^-1 e / k."""
    scale = 1.0 / np.sqrt(np.diag(C))
    return float((scale * e) @ np.linalg.solve(scale[:, None] * C * scale, scale * e)) / len(e)


def halves(seen: BoardImages, found: RobustFit, rng: np.random.Generator) -> float | None:
    """Return the squared difference of halves of the images that were used, None if few."""
    order = rng.permutation(np.array(found.images))
    if len(order) < 2 * _FEWEST:
        return None
    size = ImageSize(found.adjusted.camera.width, found.adjusted.camera.height)
    n = int(seen.image[-1]) + 1
    fits = [
        robust_fit(
            part_of(seen, np.isin(seen.image, some), n)[0], size, found.adjusted.camera.model
        )
        for some in np.array_split(order, 2)
    ]
    if any(fit is None for fit in fits):
        return None
    one, other = (fit for fit in fits if fit is not None)
    e = intrinsic_values(one.adjusted.camera) - intrinsic_values(other.adjusted.camera)
    return squares(e, one.covariance + other.covariance)


def sets(args: argparse.Namespace) -> Iterator[tuple[BoardImages, Camera]]:
    """Yield the corners of all sets with the camera that took them."""
    look = Look(warp=1e-3 * args.warp, ratio=args.ratio)
    truth = CAMERA
    if not args.photographs and look.lens:  # the camera of the model that is nearest to the lens
        ideal = replace(look, uneven=0.0, noise=1e-6, shared=0.0)
        many = corners(ideal, 60, np.random.default_rng(10**6), CAMERA, np.zeros(4))
        nearest = from_scratch(many, ImageSize(CAMERA.width, CAMERA.height), CAMERA.model)
        assert nearest is not None
        truth = nearest.camera
    for seed in range(args.first, args.first + args.sets):
        if not args.photographs:
            yield with_wrong(args.wrong, look, args.images, np.random.default_rng(seed)), truth
            continue
        kept = nullcontext(args.keep / f"{seed}") if args.keep else TemporaryDirectory()
        with kept as folder:
            yield photographs(args, seed, Path(folder))


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sets", type=int, default=200, help="sets of images; 200")
    parser.add_argument("--images", type=int, default=20, help="images of each; 20")
    parser.add_argument("--first", type=int, default=0, help="the first seed; 0")
    parser.add_argument("--warp", type=float, default=0.5, help="bend of the board [mm]; 0.5")
    parser.add_argument("--ratio", type=float, default=0.002, help="of print scales; 0.002")
    parser.add_argument("--wrong", choices=WRONG, help="what is wrong with a third of the images")
    parser.add_argument("--photographs", action="store_true", help="render, develop and search")
    parser.add_argument(
        "--kind", choices=CAMERAS, default="phone", help="the camera of photographs; phone"
    )
    parser.add_argument("--keep", type=Path, help="keep the photographs in this folder")
    args = parser.parse_args()
    errors, pulls, apart, left_out, failed = [], [], [], 0, 0
    for k, (seen, truth) in enumerate(sets(args)):
        found = robust_fit(seen, ImageSize(truth.width, truth.height), "plumb_bob")
        if found is None:
            failed += 1
            continue
        e = intrinsic_values(found.adjusted.camera) - intrinsic_values(truth)
        errors.append(squares(e, found.covariance))
        pulls.append(e / np.sqrt(np.diag(found.covariance)))
        half = halves(seen, found, np.random.default_rng(k))
        apart += [] if half is None else [half]
        left_out += len(found.left_out)
    rms = np.sqrt(np.mean(np.square(pulls), axis=0))
    print(f"{len(errors)} sets of {args.images} images, {failed} failed, {left_out} left out")
    print(f"squared error of all intrinsics / k: mean {np.mean(errors):.2f}, "
          f"median {np.median(errors):.2f}, largest {np.max(errors):.1f}")  # fmt: skip
    if apart:
        print(f"squared difference of halves / k:    mean {np.mean(apart):.2f}, "
              f"median {np.median(apart):.2f}, largest {np.max(apart):.1f}")  # fmt: skip
    names = intrinsic_names(CAMERA)
    print("pulls (rms): " + ", ".join(f"{n} {p:.2f}" for n, p in zip(names, rms, strict=True)))
    print(f"largest pull of any intrinsic: {np.abs(pulls).max():.1f}")


if __name__ == "__main__":
    main()
