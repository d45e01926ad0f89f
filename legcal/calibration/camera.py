"""From photographs of a board to a camera: corners searched, all of them adjusted, judged."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import f as f_distribution

from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable, NotVisible, UsageError
from legcal.estimation import (
    Factor,
    Frames,
    GaussianPrior,
    Huber,
    Problem,
    Rows,
    Variables,
    all_free,
    minimise,
    normal_equations,
)
from legcal.files import Document, OwnYaml, describe
from legcal.geometry import Array, BoolArray, IntArray
from legcal.perception import describe_image, find_corners, plane_poses
from legcal.progress import Report, no_progress
from legcal.vision import (
    CALIBRATED,
    DISTORTION_MODELS,
    Board,
    Camera,
    DistortionModel,
    ImageSize,
    board_of,
    camera_info,
    distort_derivatives,
    image_size,
    intrinsic_names,
    intrinsic_values,
    quiet_opencv,
    read_image,
    with_intrinsics,
)
from legcal.workers import Run, worker_pool


@dataclass(frozen=True)
class ImageResult:
    """What an image gave.

    Attributes
    ----------
    name : str
        Its file.
    corners : int
        Of the board, found in it.
    used : int
        Those that were used.
    rms_px : float or None
        Of their residuals, both coordinates together [px]; None if the image was left out.
    tilt : float or None
        Of the board out of the image plane [rad].
    reason : str
        Why it was left out, "" if it was not.
    """

    name: str
    corners: int
    used: int
    rms_px: float | None
    tilt: float | None
    reason: str


class Intrinsic(Document):
    """A number of the camera [px, or without unit]."""

    name: str
    value: float
    sigma: float


class BoardImage(Document):
    """What an image gave."""

    image: str
    corners: int
    used: int
    rms_px: float | None
    tilt_rad: float | None
    reason: str | None


class CameraDocument(Document):
    """What ``legcal camera --json`` prints."""

    legcal_camera: int
    model: str
    width: int
    height: int
    intrinsics: list[Intrinsic]
    covariance: list[list[float]]
    rms_px: float
    noise_px: float
    coverage: float
    images: list[BoardImage]
    warnings: list[str]


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """The result of :func:`legcal.calibrate_camera`.

    Attributes
    ----------
    camera : Camera
        The camera.
    covariance : (k, k) array
        Of its numbers, in the order of ``names`` [px, and without unit].
    board : Board
        The board that it was calibrated with.
    images : tuple of ImageResult
        All images, in their order.
    rms_px : float
        Of the residuals, both coordinates together [px].
    noise_px : float
        Scatter of either coordinate of a corner, one standard deviation [px].
    coverage : float
        Share of the image inside the convex hull of all corners.
    warnings : tuple of str
        What is wrong with it, one sentence each.
    """

    camera: Camera
    covariance: Array
    board: Board
    images: tuple[ImageResult, ...]
    rms_px: float
    noise_px: float
    coverage: float
    warnings: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers: ``fx fy cx cy``, then the distortion in OpenCV's order."""
        return intrinsic_names(self.camera)

    @property
    def values(self) -> Array:
        """The numbers, (k,) [px, and without unit]."""
        return intrinsic_values(self.camera)

    @property
    def sigma(self) -> Array:
        """Their standard deviations, (k,) [px, and without unit]."""
        return np.sqrt(np.diag(self.covariance))

    def document(self) -> dict[str, Any]:
        """Return what ``--json`` prints."""
        numbers = zip(self.names, self.values.tolist(), self.sigma.tolist(), strict=True)
        return CameraDocument(
            legcal_camera=1,
            model=self.camera.model,
            width=self.camera.width,
            height=self.camera.height,
            intrinsics=[Intrinsic(name=name, value=v, sigma=sigma) for name, v, sigma in numbers],
            covariance=self.covariance.tolist(),
            rms_px=self.rms_px,
            noise_px=self.noise_px,
            coverage=self.coverage,
            images=[
                BoardImage(
                    image=image.name,
                    corners=image.corners,
                    used=image.used,
                    rms_px=image.rms_px,
                    tilt_rad=image.tilt,
                    reason=image.reason or None,
                )
                for image in self.images
            ],
            warnings=list(self.warnings),
        ).document()


CAMERA_FILE = OwnYaml(
    "the camera", "camera file", CALIBRATED, "a new file or one that this command wrote"
)
_DIGITS = 6  # of figures that describe the calibration


def write_camera(calibration: CameraCalibration, path: Path) -> None:
    """Write a camera; an earlier one of this command is replaced, any other file is not.

    Raises
    ------
    UsageError
        If another file stands there, or none can be written.
    OutOfResources
        If the file cannot be written.
    """
    names, sigma = calibration.names, calibration.sigma.tolist()
    block = {
        "version": 1,
        "rms_px": _short(calibration.rms_px),
        "coverage": _short(calibration.coverage),
        "sigma": {name: _short(s) for name, s in zip(names, sigma, strict=True)},
        "images": [
            {"image": i.name, "corners": i.used, "rms_px": _short(i.rms_px)}
            for i in calibration.images
            if i.rms_px is not None
        ],
        "warnings": list(calibration.warnings),
    }
    text = camera_info(calibration.camera, path.stem, {CALIBRATED: block})
    CAMERA_FILE.write(path, text)


def _short(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
_MOST_NAMED = 5


def listed_images(named: Sequence[str | Path]) -> list[Path]:
    """Return the image files that are named, each once, those of a folder or pattern by name.

    Parameters
    ----------
    named : sequence of str or Path
        Files, folders (what is in them, not below) or patterns of the shell's kind.

    Raises
    ------
    DatasetError
        With one sentence for each that names no image.
    """
    found: dict[Path, None] = {}
    problems = []
    for name in named:
        paths = _matching(str(name))
        if not paths:
            problems.append(
                f"The images {describe(str(name))} could not be read: found no such file, folder "
                f"with images or pattern that matches one, needed {', '.join(SUFFIXES)}; check the "
                "path."
            )
        found |= dict.fromkeys(paths)
    if problems or not found:
        raise DatasetError(problems or "The images could not be read: found none, needed some.")
    return list(found)


def _matching(name: str) -> list[Path]:
    """Return the images that one name stands for."""
    if not name:
        return []
    path = Path(name)
    if path.is_dir():
        return [p for p in sorted(path.iterdir()) if p.suffix.lower() in SUFFIXES and p.is_file()]
    if os.path.lexists(path):
        return [path]
    hits = [Path(hit) for hit in sorted(glob.glob(name, recursive=True))]
    return [hit for hit in hits if hit.suffix.lower() in SUFFIXES and hit.is_file()]


def common_size(paths: Sequence[Path]) -> ImageSize:
    """Return the size that all images have.

    Raises
    ------
    DatasetError
        With one sentence for each that is no complete image, or if they differ in size.
    """
    sizes: dict[ImageSize, list[Path]] = {}
    problems = []
    for path in paths:
        found = ""
        try:
            sizes.setdefault(image_size(path.read_bytes()), []).append(path)
        except OSError as error:
            found = f"'{error.strerror}'"
        except ValueError as error:
            found = str(error)
        if found:
            problems.append(
                f"{path}: the image could not be read: found {found}, needed a complete PNG, JPEG "
                "or TIFF file; copy it again or leave it out."
            )
    if problems:
        raise DatasetError(problems)
    if len(sizes) > 1:
        by_count = sorted(sizes.items(), key=lambda item: -len(item[1]))
        told = "; ".join(
            f"{size.width} x {size.height} px in {_named(some)}" for size, some in by_count
        )
        raise DatasetError(
            f"The camera could not be calibrated: found images of different sizes, {told}, needed "
            "one size; leave out those that another camera took, or that were scaled, cropped or "
            "turned."
        )
    return next(iter(sizes))


def _named(paths: Sequence[Path]) -> str:
    """Return some of the names of files."""
    if len(paths) <= _MOST_NAMED:
        return ", ".join(path.name for path in paths)
    return f"{len(paths)} images ({paths[0].name}, ...)"


N_STEPS = 60
HUBER = Huber(3.0)  # standard deviations from which a corner counts less and less
WEAK_PIXELS = 10.0  # image widths: prior of focal lengths and principal point


@dataclass(frozen=True, eq=False)
class SeenCorners:
    """The corners of the board in some images, n of them."""

    image: IntArray  # (n,) of each corner, rising, from 0 to n_images - 1
    points: Array  # (n, 3) where it is on the board [m]
    px: Array  # (n, 2) where it is seen [px]
    sigma_px: Array  # (n,) standard deviation of either coordinate [px]


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A camera and the board in every image."""

    camera: Camera
    T_camera_board: tuple[RigidTransform, ...]  # of every image
    residual: Array  # (n, 2) corners less where they should be seen [px]
    cost: float  # half the sum of squares, in standard deviations, large ones by Huber's loss
    covariance: Array  # (k, k) of intrinsic_names, by the standard deviations of corners


@dataclass(frozen=True, eq=False)
class _State:
    """What the adjustment moves."""

    camera: Camera
    board_pose: Frames  # T_camera_board of every image


def adjust(
    camera: Camera,
    poses: Sequence[RigidTransform],
    seen: SeenCorners,
    free: Sequence[str] = (),
    *,
    n_steps: int = N_STEPS,
) -> Adjusted | None:
    """Return the camera and poses of least cost near a start.

    The intrinsics *free*, all of them without it, are held by priors that tell next to nothing.
    None if no place near the start has all corners before the camera.
    """
    names = tuple(free) or intrinsic_names(camera)
    where = np.array([intrinsic_names(camera).index(name) for name in names])
    pixel = np.array([name[0] in "fc" for name in names])
    known = GaussianPrior(
        np.arange(len(names), dtype=np.intp),
        np.where(pixel, intrinsic_values(camera)[where], 0.0),
        np.where(
            pixel,
            WEAK_PIXELS * max(camera.width, camera.height),
            DISTORTION_MODELS[camera.model].prior_sigma,
        ),
    )

    def moved(camera: Camera, change: Array) -> Camera:
        values = intrinsic_values(camera)[where] + change[0]
        return with_intrinsics(camera, dict(zip(names, values.tolist(), strict=True)))

    n = len(seen.image)
    problem = Problem[_State](
        variables=(
            Variables(
                "camera",
                all_free(1, len(names)),
                moved,
                names,
                ("",) * len(names),
                lambda camera: intrinsic_values(camera)[where],
                prior=known,
            ),
        ),
        eliminated=Variables("board_pose", all_free(len(poses), 6), Frames.moved),
        factors=(
            Factor(
                "corners",
                lambda state: _corner_rows(state, seen, names),
                (("camera", np.zeros(n, dtype=np.intp), slice(None)),),
                n,
                2,
                seen.image,
                1.0 / seen.sigma_px[:, None, None],
                robust=True,
            ),
        ),
        name="calibration of the camera",
    )
    state = _State(camera, Frames.of(poses))
    if not np.all(np.isfinite(problem.factor("corners").rows(state).r)):
        return None
    found = minimise(problem, state, HUBER, max_iterations=n_steps, must_converge=False)
    normal = normal_equations(problem, found.state, found.linear, HUBER)
    return Adjusted(
        found.state.camera,
        found.state.board_pose.motions,
        -found.linear["corners"].r * seen.sigma_px[:, None],
        found.cost,
        normal.kept_covariance(),
    )


def _corner_rows(state: _State, seen: SeenCorners, names: Sequence[str]) -> Rows:
    """Return predicted less measured corners [px]; not finite where one is behind the camera."""
    camera, R = state.camera, state.board_pose.R[seen.image]
    arm = (R @ seen.points[:, :, None])[:, :, 0]
    P = arm + state.board_pose.t[seen.image]
    if P[:, 2].min() <= 1e-9 or not (camera.K[0, 0] > 1.0 and camera.K[1, 1] > 1.0):
        nothing = np.full(seen.px.shape, np.nan)
        shape = *seen.px.shape, len(names)
        return Rows.of(nothing, np.zeros(shape), np.zeros((*seen.px.shape, 6)))
    xy = P[:, :2] / P[:, 2:]
    predicted, by_point = camera.project_with_derivative(P)
    by_turn = np.cross(arm[:, None, :], by_point)  # d(pixel) = by_point . (w x arm)
    by_pose = np.concatenate([by_turn, by_point], axis=-1)
    return Rows.of(predicted - seen.px, distort_derivatives(camera, xy, names), by_pose)


FOCAL_LENGTHS = (0.25, 4.0, 13)  # least to greatest, how many: parts of the longer side
_WIDEST = 1.45  # of an angle to the axis before a fisheye lens [rad]
_ROUGH, _ROUGH_STEPS = ("fx", "fy", "k1"), 12  # looked for first


def adjusted_anyhow(seen: SeenCorners, size: ImageSize, model: DistortionModel) -> Adjusted | None:
    """Return the adjustment from where a camera is roughly right, None if none succeeds.

    Parameters
    ----------
    seen : SeenCorners
        The corners.
    size : ImageSize
        Of the images [px].
    model : {"plumb_bob", "rational_polynomial", "equidistant"}
        How the lens distorts.
    """
    start = None if DISTORTION_MODELS[model].is_fisheye else _by_opencv(seen, size, model)
    start = start or _by_straight_lines(seen, size, model)
    if start is None:
        return None
    rough = adjust(*start, seen, _ROUGH, n_steps=_ROUGH_STEPS)
    return None if rough is None else adjust(rough.camera, rough.T_camera_board, seen)


def _by_straight_lines(
    seen: SeenCorners, size: ImageSize, model: DistortionModel
) -> tuple[Camera, list[RigidTransform]] | None:
    """Return the camera without distortion before which boards are flattest, of several."""
    centre = 0.5 * (size.width - 1.0), 0.5 * (size.height - 1.0)
    no_distortion = np.zeros(len(DISTORTION_MODELS[model].coefficients))
    cameras = []
    for part in np.geomspace(*FOCAL_LENGTHS).tolist():
        f = part * max(size.width, size.height)
        K = np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])
        cameras.append(Camera(K, size.width, size.height, no_distortion, model))
    best = min(cameras, key=lambda camera: _bend(camera, seen))
    poses = []
    for a, b in pairwise(_bounds(seen)):
        found = plane_poses(best, seen.points[a:b], seen.px[a:b], np.ones(b - a))
        if not found:
            return None
        poses.append(found[0].T_camera_plane)
    return best, poses


def _bend(camera: Camera, seen: SeenCorners) -> float:
    """Return how far the corners of boards are from any plane before a camera (rms) [px]."""
    angle = np.linalg.norm(seen.px - camera.K[:2, 2], axis=1) / camera.K[0, 0]
    if DISTORTION_MODELS[camera.model].is_fisheye and angle.max() > _WIDEST:
        return np.inf
    xy = camera.undistort(seen.px)
    off = []
    for a, b in pairwise(_bounds(seen)):
        board = seen.points[a:b, :2]
        H, _ = cv2.findHomography(board, xy[a:b])
        if H is None:
            return np.inf
        flat = np.column_stack([board, np.ones(b - a)]) @ np.asarray(H, dtype=np.float64).T
        off.append(camera.distort(flat[:, :2] / flat[:, 2:]) - seen.px[a:b])
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))


def _bounds(seen: SeenCorners) -> IntArray:
    """Return where the corners of each image begin, and where those of the last one end."""
    return np.searchsorted(seen.image, np.arange(seen.image[-1] + 2))


def _by_opencv(
    seen: SeenCorners, size: ImageSize, model: DistortionModel
) -> tuple[Camera, list[RigidTransform]] | None:
    """Return the camera that OpenCV calibrates, with two coefficients of distortion."""
    pieces = list(pairwise(_bounds(seen)))
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    try:
        with quiet_opencv():
            _, K, distortion, turns, shifts = cv2.calibrateCamera(
                [seen.points[a:b].astype(np.float32) for a, b in pieces],
                [seen.px[a:b].astype(np.float32) for a, b in pieces],
                (size.width, size.height),
                np.eye(3),
                np.zeros(5),
                flags=flags,
            )
    except cv2.error:
        return None
    numbers = np.concatenate([np.ravel(K), np.ravel(distortion), np.ravel(turns), np.ravel(shifts)])
    if not np.all(np.isfinite(numbers)) or min(K[0, 0], K[1, 1]) < 1.0:
        return None
    coefficients = np.zeros(len(DISTORTION_MODELS[model].coefficients))
    coefficients[:2] = np.ravel(distortion)[:2]
    poses = [
        RigidTransform.from_components(np.ravel(t), Rotation.from_rotvec(np.ravel(w)))
        for w, t in zip(turns, shifts, strict=True)
    ]
    return Camera(np.asarray(K), size.width, size.height, coefficients, model), poses


N_ROUNDS = 6
OUTLYING = 6.0  # standard deviations of a corner that is left out
ODD_IMAGE = 4.0  # times the scatter of the median image, from which an image is left out
LEAST_ODD_PX = 0.5  # scatter of an image that may be left out [px]
FEWEST = 6  # corners of an image that is used
LEAST_NOISE_PX = 0.015  # of a corner: what neighbours share does not show in residuals
LEAST_KEPT = 0.6  # of the corners of an image that is used


@dataclass(frozen=True, eq=False)
class Agreed:
    """A camera, and the corners that agree with it.

    Attributes
    ----------
    adjusted : Adjusted
        By the corners that were kept.
    seen : SeenCorners
        Those corners, their images numbered anew.
    images : tuple of int
        The number that each of these images had.
    left_out : dict of int to str
        Images that disagree, and how.
    n_left_out : int
        Single corners that were left out of the other images.
    extra_px : float
        Scatter of the corners beyond what they claim, one standard deviation [px].
    scale : float
        Factor on the covariance, by the residuals.
    """

    adjusted: Adjusted
    seen: SeenCorners
    images: tuple[int, ...]
    left_out: dict[int, str]
    n_left_out: int
    extra_px: float
    scale: float


def agreed(seen: SeenCorners, size: ImageSize, model: DistortionModel) -> Agreed | None:
    """Return the camera on which corners agree; None if no adjustment succeeds.

    Parameters
    ----------
    seen : SeenCorners
        All corners of all images.
    size : ImageSize
        Of the images [px].
    model : {"plumb_bob", "rational_polynomial", "equidistant"}
        How the lens distorts.
    """
    n_images = int(seen.image[-1]) + 1
    claimed = seen.sigma_px
    seen = replace(seen, sigma_px=np.hypot(claimed, float(np.median(claimed))))
    first = adjusted_anyhow(seen, size, model)
    if first is None:
        return None
    camera, poses = first.camera, list(first.T_camera_board)
    kept = np.ones(len(seen.image), dtype=np.bool_)
    left_out: dict[int, str] = {}
    adjusted, extra = first, 0.0
    for _ in range(N_ROUNDS):
        part, images = _part(seen, kept, n_images)
        found = adjust(camera, [poses[k] for k in images], part)
        if found is None:
            break
        adjusted, camera = found, found.camera
        for k, T in zip(images, found.T_camera_board, strict=True):
            poses[k] = T
        extra = _extra(found.residual, claimed[kept])
        sigma = np.hypot(claimed, extra)
        judged = kept.copy()
        judged[kept] = np.linalg.norm(found.residual, axis=1) < OUTLYING * sigma[kept]
        left_out |= _odd_images(found.residual, part, images)
        judged &= ~np.isin(seen.image, list(left_out))
        counts = np.bincount(seen.image, minlength=n_images)
        for k in set(images) - set(left_out):
            n_kept = int(np.count_nonzero(judged & (seen.image == k)))
            if n_kept < max(FEWEST, LEAST_KEPT * counts[k]):
                left_out[k] = f"{counts[k] - n_kept} of its {counts[k]} corners disagree"
        judged &= ~np.isin(seen.image, list(left_out))
        settled = bool(np.array_equal(judged, kept)) and np.allclose(
            sigma, seen.sigma_px, rtol=0.02
        )
        if len(set(seen.image[judged].tolist())) == 0:
            break
        kept, seen = judged, replace(seen, sigma_px=sigma)
        if settled:
            break
    part, images = _part(seen, kept, n_images)
    last = adjust(camera, [poses[k] for k in images], part)
    adjusted = last if last is not None else adjusted
    others = ~np.isin(seen.image, list(left_out))
    return Agreed(
        adjusted,
        part,
        images,
        left_out,
        int(np.count_nonzero(~kept & others)),
        extra,
        _scale(adjusted, part, len(images)),
    )


def _part(seen: SeenCorners, kept: BoolArray, n_images: int) -> tuple[SeenCorners, tuple[int, ...]]:
    """Return some of the corners, and the numbers that their images had."""
    images = sorted(set(seen.image[kept].tolist()))
    new = np.full(n_images, -1, dtype=np.intp)
    new[images] = np.arange(len(images))
    part = SeenCorners(new[seen.image[kept]], seen.points[kept], seen.px[kept], seen.sigma_px[kept])
    return part, tuple(images)


def _extra(residual: Array, claimed: Array) -> float:
    """Return how far corners scatter beyond what they claim, robustly [px]."""
    seen = 1.4826 * float(np.median(np.abs(residual)))
    return float(np.sqrt(max(seen**2 - float(np.median(claimed)) ** 2, 0.0)))


def _odd_images(residual: Array, seen: SeenCorners, images: Sequence[int]) -> dict[int, str]:
    """Return the images whose corners scatter far more than those of the others."""
    scatter = [float(np.sqrt(np.mean(residual[seen.image == i] ** 2))) for i in range(len(images))]
    usual = float(np.median(scatter))
    return {
        k: f"its corners are {s:.2f} px off (rms), those of the others {usual:.2f} px"
        for k, s in zip(images, scatter, strict=True)
        if s > max(ODD_IMAGE * usual, LEAST_ODD_PX)
    }


def _scale(adjusted: Adjusted, seen: SeenCorners, n_images: int) -> float:
    """Return chi^2 of the corners by its degrees of freedom, for no less than the least noise."""
    chi2 = float(np.sum((adjusted.residual / seen.sigma_px[:, None]) ** 2))
    unknowns = len(adjusted.covariance) + 6 * n_images
    dof = max(2 * len(seen.px) - unknowns, 1)
    noise = float(np.sqrt(np.sum(adjusted.residual**2) / dof))
    return chi2 / dof * max(1.0, LEAST_NOISE_PX / max(noise, 1e-9)) ** 2


FEWEST_IMAGES, FEW_IMAGES = 3, 10
LARGEST_FOCAL_SIGMA, WEAK_FOCAL_SIGMA = 0.05, 0.003  # as parts of the focal length
LEAST_TILT, LEAST_SPREAD = np.radians(15.0), np.radians(20.0)
LEAST_COVERAGE = 0.5
LARGE_RESIDUAL_PX = 1.0
MANY_LEFT_OUT = 0.05  # of all corners
_OVERFIT = 0.01  # probability from which on the gain of more coefficients may be chance
_FOLDED_PX = 0.1


def tilts(found: Agreed) -> Array:
    """Return the angle of each board out of the image plane, (n_images,) [rad]."""
    normal = np.array([T.rotation.as_matrix()[:, 2] for T in found.adjusted.T_camera_board])
    return np.asarray(np.arccos(np.clip(np.abs(normal[:, 2]), 0.0, 1.0)))


def spread(found: Agreed) -> float:
    """Return the largest angle between two boards' planes [rad]."""
    normal = np.array([T.rotation.as_matrix()[:, 2] for T in found.adjusted.T_camera_board])
    return float(np.arccos(np.clip(np.abs(normal @ normal.T), 0.0, 1.0).min()))


def coverage(found: Agreed) -> float:
    """Return the share of the image inside the convex hull of all corners."""
    hull = cv2.convexHull(found.seen.px.astype(np.float32))
    camera = found.adjusted.camera
    return float(cv2.contourArea(hull)) / (camera.width * camera.height)


def refuse_undetermined(found: Agreed, names: Sequence[str], left_out: Sequence[str] = ()) -> None:
    """Raise NotIdentifiable if the images do not determine the camera.

    Parameters
    ----------
    found : Agreed
        What the images gave.
    names : sequence of str
        The images that were used.
    left_out : sequence of str, optional
        Others that show the board, each with the reason why it was not used.
    """
    n = len(found.images)
    if n < FEWEST_IMAGES:
        raise too_few_images(n, names, left_out)
    camera = found.adjusted.camera
    f = float(camera.K[0, 0])
    sigma = float(np.sqrt(found.adjusted.covariance[0, 0] * found.scale))
    if not sigma <= LARGEST_FOCAL_SIGMA * f:
        raise NotIdentifiable(
            f"The camera could not be calibrated: found boards tilted by at most "
            f"{np.degrees(tilts(found).max()):.0f} deg out of the image plane and at most "
            f"{np.degrees(spread(found)):.0f} deg to each other, which leave the focal length open "
            f"(fx {f:.0f} px, known to {sigma:.2g} px), needed views from several sides; tilt the "
            "board by 30 deg and more to the left, the right, up and down."
        )
    centre = camera.K[:2, 2]
    if not np.all((centre > 0.0) & (centre < [camera.width - 1.0, camera.height - 1.0])):
        raise NotIdentifiable(
            f"The camera could not be calibrated: found the principal point at ({centre[0]:.0f}, "
            f"{centre[1]:.0f}) px, outside the image, needed one inside; see that the images are "
            "not cropped, that the model fits the lens, and tilt the board more."
        )


def too_few_images(n: int, names: Sequence[str], left_out: Sequence[str] = ()) -> NotIdentifiable:
    """Return the refusal of so few images with the board, saying why others were left out."""
    found = f"{n} images" if n != 1 else "1 image"
    which = f" ({', '.join(names)})" if names else ""
    others, mend = "", ""
    if left_out:
        told = "; ".join(left_out)
        others = f" that agree{which}, and {len(left_out)} more that had to be left out ({told})"
        mend = "see that the board is flat and does not move while it is photographed, and "
    return NotIdentifiable(
        f"The camera could not be calibrated: found {found} with the board{others or which}, "
        f"needed {FEWEST_IMAGES} at least and better {FEW_IMAGES}; {mend}take more, with the "
        "board tilted to all sides."
    )


def warnings(found: Agreed) -> list[str]:
    """Return what is wrong with a camera that can be used, one sentence each."""
    n, camera = len(found.images), found.adjusted.camera
    sigma = np.sqrt(np.diag(found.adjusted.covariance) * found.scale)
    told = []
    if n < FEW_IMAGES:
        told.append(
            f"{n} images are few: the standard deviations themselves are uncertain; take "
            f"{FEW_IMAGES} or more."
        )
    tilt, apart = float(tilts(found).max()), spread(found)
    focal = float(sigma[0] / camera.K[0, 0])
    if tilt < LEAST_TILT or apart < LEAST_SPREAD or focal > WEAK_FOCAL_SIGMA:
        told.append(
            f"The focal length is weakly determined, to {100.0 * focal:.2g} % ({sigma[0]:.2g} px): "
            f"the boards are tilted by at most {np.degrees(tilt):.0f} deg out of the image plane "
            f"and {np.degrees(apart):.0f} deg to each other; tilt them by 30 deg and more."
        )
    covered = coverage(found)
    if covered < LEAST_COVERAGE:
        told.append(
            f"Corners cover {100.0 * covered:.0f} % of the image: what the lens does outside is "
            "extrapolated; bring the board near every edge and corner of the image."
        )
    told += _folding(camera)
    told += _overfit(found)
    rms = float(np.sqrt(np.mean(np.sum(found.adjusted.residual**2, axis=1))))
    if rms > LARGE_RESIDUAL_PX:
        told.append(
            f"The residuals are large, {rms:.2f} px (rms): the board is bent, its dimensions are "
            "wrong, or the model of the lens does not fit."
        )
    n_all = found.n_left_out + len(found.seen.px)
    if found.n_left_out > MANY_LEFT_OUT * n_all:
        told.append(
            f"{found.n_left_out} of {n_all} corners disagree with the others and were left out; "
            "see that the board is flat, sharp and evenly lit."
        )
    return told


def _folding(camera: Camera) -> list[str]:
    """Return a warning if the lens model maps two directions to one pixel inside the image."""
    w, h = camera.width - 1.0, camera.height - 1.0
    corners = np.array([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]])
    back = camera.distort(camera.undistort(corners))
    off = float(np.nan_to_num(np.abs(back - corners), nan=np.inf).max())
    if off < _FOLDED_PX:
        return []
    return [
        "The lens model folds back before the corners of the image, where no board was seen: "
        "pixels there cannot be used; bring the board into the corners, or take a simpler --model."
    ]


def _overfit(found: Agreed) -> list[str]:
    """Return a warning if the three more coefficients of the rational model gain nothing."""
    full = found.adjusted
    if full.camera.model != "rational_polynomial":
        return []
    simple = [name for name in intrinsic_names(full.camera) if name not in ("k4", "k5", "k6")]
    zeroed = full.camera.distortion.copy()
    zeroed[5:] = 0.0
    start = Camera(full.camera.K, full.camera.width, full.camera.height, zeroed, full.camera.model)
    plain = adjust(start, full.T_camera_board, found.seen, simple)
    if plain is None:
        return []
    dof = 2 * len(found.seen.px) - len(full.covariance) - 6 * len(found.images)
    gain = (plain.cost - full.cost) / 3.0 / max(full.cost / max(dof, 1), 1e-30)
    if gain > 0.0 and f_distribution.sf(gain, 3, max(dof, 1)) < _OVERFIT:
        return []
    rms = [float(np.sqrt(np.mean(np.sum(a.residual**2, axis=1)))) for a in (full, plain)]
    return [
        f"The model overfits: with rational_polynomial corners are {rms[0]:.4f} px off (rms), "
        f"with plumb_bob {rms[1]:.4f} px, which is no better than chance; take --model plumb_bob."
    ]


STAGE = "Searching the board"
_ASKED = 2  # images that are asked what they show instead
_Corners = tuple[IntArray, Array, Array]


def calibrate_camera(
    images: str | Path | Sequence[str | Path],
    board: str | Path | Board,
    *,
    model: DistortionModel = "plumb_bob",
    output: str | Path | None = None,
    progress: Report = no_progress,
    workers: int = 1,
) -> CameraCalibration:
    """Calibrate a camera from photographs of a flat board.

    Parameters
    ----------
    images : str, Path or sequence of these
        Files, folders or patterns.
    board : str, Path or Board
        Such as ``chessboard:9x6:25mm`` (squares), or a YAML file with the block ``board`` of a
        dataset. Its size does not matter here, its proportions do.
    model : {"plumb_bob", "rational_polynomial", "equidistant"}
        How the lens distorts.
    output : path, optional
        Write a ROS camera_info file there, with the standard deviations of all numbers.
    progress : callable
        Called as ``progress(stage, done, total)``.
    workers : int
        Search the images in that many processes, as :func:`legcal.calibrate` does.

    Returns
    -------
    CameraCalibration
        Look at its ``warnings`` before you use it.

    Raises
    ------
    DatasetError
        If images cannot be read, or are not of one size.
    UsageError
        If the board, the model or the output cannot be meant.
    NotVisible
        If no image shows the board.
    NotIdentifiable
        If fewer than three images show it, or all from one side.
    DidNotConverge
        If no camera explains the corners.
    """
    if model not in get_args(DistortionModel):
        raise UsageError(
            f"The camera could not be calibrated: found the model {model!r}, needed "
            f"{', '.join(get_args(DistortionModel))}; correct it."
        )
    if output is not None:
        CAMERA_FILE.check_place(Path(output))
    wanted = board_of(board)
    paths = listed_images([images] if isinstance(images, str | Path) else images)
    size = common_size(paths)
    with worker_pool(workers) as run:
        found = _search(wanted, paths, size, run, progress)
    shown = [k for k, (numbers, _, _) in enumerate(found) if len(numbers) >= FEWEST]
    if not shown:
        raise _nowhere(wanted, paths, size)
    if len(shown) < FEWEST_IMAGES:
        raise too_few_images(len(shown), [paths[k].name for k in shown])
    progress("Adjusting the camera", 0, 1)
    fitted = agreed(_seen(wanted, [found[k] for k in shown]), size, model)
    progress("Adjusting the camera", 1, 1)
    if fitted is None:
        raise DidNotConverge(
            f"The camera could not be calibrated: found no {model} camera that explains the "
            "corners, needed one; check the board and the model of the lens."
        )
    left_out = [f"{paths[shown[k]].name}: {why}" for k, why in fitted.left_out.items()]
    refuse_undetermined(fitted, [paths[shown[k]].name for k in fitted.images], left_out)
    result = _result(wanted, paths, found, shown, fitted)
    if output is not None:
        write_camera(result, Path(output))
    return result


@dataclass(frozen=True, eq=False)
class _Search:
    """The search of an image, for any process."""

    board: Board
    paths: tuple[Path, ...]
    size: ImageSize

    def __call__(self, k: int) -> _Corners:
        return find_corners(self.board, _read(self.paths[k], self.size))


def _read(path: Path, size: ImageSize) -> Array:
    """Return the grey levels of an image whose size is known."""
    return np.asarray(read_image(path, Camera(np.eye(3), size.width, size.height)))


def _search(
    board: Board, paths: Sequence[Path], size: ImageSize, run: Run, progress: Report
) -> list[_Corners]:
    """Return the corners in every image."""
    progress(STAGE, 0, len(paths))
    found = []
    for corners in run(_Search(board, tuple(paths), size), range(len(paths))):
        found.append(corners)
        progress(STAGE, len(found), len(paths))
    return found


def _seen(board: Board, found: Sequence[_Corners]) -> SeenCorners:
    """Return the corners of some images in one table."""
    counts = [len(numbers) for numbers, _, _ in found]
    return SeenCorners(
        np.repeat(np.arange(len(found)), counts),
        np.concatenate([board.points[numbers] for numbers, _, _ in found]),
        np.concatenate([px for _, px, _ in found]),
        np.concatenate([sigma for _, _, sigma in found]),
    )


def _nowhere(board: Board, paths: Sequence[Path], size: ImageSize) -> NotVisible:
    """Return the refusal of images without the board, and say what they show instead."""
    what = next((w for p in paths[:_ASKED] if (w := describe_image(board, _read(p, size)))), None)
    thing = "tags" if board.kind == "aprilgrid" else "squares"
    hint = ""
    if what is None and board.kind == "chessboard":
        hint = f" (squares are counted: {board.columns - 1} x {board.rows - 1} inner corners)"
    return NotVisible(
        f"The camera could not be calibrated: found {what or 'nothing like the board'} in its "
        f"{len(paths)} image{'s' * (len(paths) != 1)}, needed a {board.kind} of {board.columns} x "
        f"{board.rows} {thing}{hint}; correct --board, or take sharper images of the whole board."
    )


def _result(
    board: Board,
    paths: Sequence[Path],
    found: Sequence[_Corners],
    shown: Sequence[int],
    fitted: Agreed,
) -> CameraCalibration:
    """Return the camera with what it rests on."""
    adjusted, seen = fitted.adjusted, fitted.seen
    used = {shown[k]: i for i, k in enumerate(fitted.images)}
    left_out = {shown[k]: why for k, why in fitted.left_out.items()}
    square = np.sum(adjusted.residual**2, axis=1)
    tilt = tilts(fitted)
    images = []
    for k, path in enumerate(paths):
        i = used.get(k)
        n = len(found[k][0])
        why = left_out.get(k, "" if k in shown else "the board was not found")
        if i is None:
            images.append(ImageResult(path.name, n, 0, None, None, why))
            continue
        here = seen.image == i
        rms = float(np.sqrt(np.mean(square[here])))
        n_used = int(np.count_nonzero(here))
        images.append(ImageResult(path.name, n, n_used, rms, float(tilt[i]), ""))
    n_dof = max(2 * len(square) - len(adjusted.covariance) - 6 * len(fitted.images), 1)
    return CameraCalibration(
        camera=adjusted.camera,
        covariance=adjusted.covariance * fitted.scale,
        board=board,
        images=tuple(images),
        rms_px=float(np.sqrt(np.mean(square))),
        noise_px=float(np.sqrt(square.sum() / n_dof)),
        coverage=coverage(fitted),
        warnings=(*_lost(images), *warnings(fitted)),
    )


def _lost(images: Sequence[ImageResult]) -> list[str]:
    """Return a sentence for each reason for which images were left out."""
    by_reason: dict[str, list[str]] = {}
    for image in images:
        if image.reason:
            by_reason.setdefault(image.reason, []).append(image.name)
    return [f"{', '.join(names)} left out: {why}." for why, names in by_reason.items()]
