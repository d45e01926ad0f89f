"""A camera fitted to the images of a board that agree on it, and the faults of the others.

A single image hardly determines a camera. It contradicts a group of images by its score and
information (``Clusters``): along all parameters of camera and sheet together, along the focal
length, the principal point, and the sheet. The group starts as the half of the images with the
least total cost (least trimmed squares from many random starts, on quadratic costs), grows by all
images that do not contradict it, and is fitted again until it is stable. Images with a common
fault, such as a third of them at another zoom, cannot move it. Single corners that disagree are
left out afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.special import chdtri

from legcal.calibration.camera_calibration.starts import from_scratch, part_of, readjust
from legcal.estimation.clusters import Clusters
from legcal.estimation.solver import COST_TOLERANCE
from legcal.geometry.types import Array, BoolArray
from legcal.perception.board_adjustment import (
    SHEET,
    AdjustedBoard,
    BoardImages,
    Sheet,
    adjust_board,
)
from legcal.vision.camera import intrinsic_names, intrinsic_values
from legcal.vision.distortion import DistortionModel
from legcal.vision.image_file import ImageSize

_SIGNIFICANCE = 1e-5  # significance level of a contradiction
_FEW = 5  # smallest number of images with a majority
_STARTS, _OF_START = 100, 4  # number of random groups, images of each
_ROUNDS = 8
_FIRST_RATIO = 3.0  # scatter of all images, relative to that of the half with the least cost
_CLEAR = 0.6  # share of the images in a group that ends the search
_MORE_STARTS = 4  # fits of random images if the first fit has no clear group
_EXPLAINED = 0.9  # smallest share of the excess cost that a fault has to explain
_NEGLIGIBLE = 1e-3  # tolerance of the fits, relative to the excess cost
_ALIKE = 0.2  # largest relative difference of the changes of both focal lengths by a zoom
_TWO = 0.85  # smallest share of scatter between two clusters (0.64 for a normal distribution)
_RIVAL = 4  # smallest size of another group
_MOST_ROUNDS = 6
OUTLIER_SIGMAS = 6.0  # smallest residual of an outlier corner, in standard deviations
_OUTLIER_IMAGE = 4.0  # smallest scatter of an outlier image, relative to the median image
_MIN_OUTLIER_PX = 0.5  # smallest scatter of an outlier image [px]
MIN_CORNERS = 6  # smallest number of corners of a used image
# smallest noise of a corner [px]: errors that neighbours share do not show in residuals
_MIN_NOISE_PX = 0.015
_TO_SIGMA = 1.4826  # standard deviation over median absolute deviation of a normal distribution
_LEAST_SCATTER_PX = 1e-4  # standard deviation of exact corners
_MIN_INLIERS = 0.6  # smallest share of inlier corners in a used image


def _agreeing_images(
    corners: BoardImages,
    size: ImageSize,
    model: DistortionModel,
    first: AdjustedBoard | None = None,  # adjustment to all images, if there is one
) -> tuple[AdjustedBoard, dict[int, str], tuple[int, ...]] | None:
    """Return the largest group of images that agree on a camera; None if no fit succeeds.

    The camera fitted to these, with poses and residuals of all images; the other images with their
    faults; those of them that agree among themselves.
    """
    n = int(corners.image[-1]) + 1
    largest = _largest(corners, size, model, first)
    if largest is None:
        return None
    adjusted, group = largest
    others = np.flatnonzero(~group)
    if not len(others):
        return adjusted, {}, ()
    rival: tuple[int, ...] = ()
    if len(others) >= _RIVAL:
        part, numbers = part_of(corners, np.isin(corners.image, others), n)
        second = _largest(part, size, model)
        if second is not None and np.count_nonzero(second[1]) >= _RIVAL:
            rival = tuple(np.array(numbers)[second[1]].tolist())
    return adjusted, _reasons(adjusted, corners, group), rival


def _largest(
    corners: BoardImages,
    size: ImageSize,
    model: DistortionModel,
    first: AdjustedBoard | None = None,
) -> tuple[AdjustedBoard, BoolArray] | None:
    """Return the adjustment to the largest group of agreeing images, and the group."""
    n = int(corners.image[-1]) + 1
    rng = np.random.default_rng(0)
    best: tuple[AdjustedBoard, BoolArray] | None = None
    first = first or from_scratch(corners, size, model)
    if first is not None:
        all_images = np.ones(n, dtype=np.bool_)
        if n < _FEW:
            return first, all_images
        group = _grown(first, _cheapest(first, corners, rng))
        if group.all():
            return first, group
        if np.count_nonzero(group) >= _OF_START:
            best = _settled(first, first, group, corners)
    for _ in range(_MORE_STARTS if n >= _FEW else 0):
        if best is not None and np.count_nonzero(best[1]) >= _CLEAR * n:
            break
        chosen = rng.choice(n, _OF_START, replace=False)
        part, _ = part_of(corners, np.isin(corners.image, chosen), n)
        rough = from_scratch(part, size, model)
        if rough is None:
            continue
        start = first or rough
        candidate = _settled(rough, start, None, corners)
        if candidate is not None and (
            best is None or np.count_nonzero(candidate[1]) > np.count_nonzero(best[1])
        ):
            best = candidate
    return best


def _settled(
    near: AdjustedBoard, start: AdjustedBoard, group: BoolArray | None, corners: BoardImages
) -> tuple[AdjustedBoard, BoolArray] | None:
    """Return the adjustment to a group that fitting it does not change, and the group."""
    n = int(corners.image[-1]) + 1
    poses = list(start.T_camera_board)
    settled: tuple[AdjustedBoard, BoolArray] | None = None
    for _ in range(_ROUNDS):
        if group is not None:
            part, images = part_of(corners, group[corners.image], n)
            fitted = readjust(near, [poses[k] for k in images], part)
            if fitted is None:
                return None
            near = fitted
            for k, T in zip(images, fitted.T_camera_board, strict=True):
                poses[k] = T
        names = intrinsic_names(near.camera)
        adjusted = adjust_board(near.camera, poses, corners, names, near.sheet, held=True)
        if adjusted is None:
            return None
        poses = list(adjusted.T_camera_board)
        before = group
        if group is None:
            cost = _costs(adjusted, corners)
            group = cost <= np.sort(cost)[n // 2]
        group = _grown(adjusted, group)
        if np.count_nonzero(group) < _OF_START:
            return None
        settled = adjusted, group
        if before is not None and np.array_equal(before, group):
            break
    return settled


def _costs(adjusted: AdjustedBoard, corners: BoardImages) -> Array:
    """Return the squared residuals of images over their degrees of freedom, (n_images,)."""
    square = np.sum((adjusted.residual / corners.sigma_px[:, None]) ** 2, axis=1)
    n = len(adjusted.T_camera_board)
    n_corners = np.bincount(corners.image, minlength=n)
    return np.bincount(corners.image, square, n) / np.maximum(2 * n_corners - 6, 1)


def _cheapest(adjusted: AdjustedBoard, corners: BoardImages, rng: np.random.Generator) -> BoolArray:
    """Return the half of the images with the least total quadratic cost."""
    clusters = adjusted.clusters
    n = len(clusters.score)
    dof = np.maximum(2 * np.bincount(corners.image, minlength=n) - 6, 1)
    base = _costs(adjusted, corners) * dof
    half = n // 2 + 1
    best, least_total = np.ones(n, dtype=np.bool_), np.inf
    for _ in range(_STARTS):
        group = np.isin(np.arange(n), rng.choice(n, _OF_START, replace=False))
        for _ in range(_ROUNDS):
            step = clusters.choose(group).best()
            added = 2.0 * clusters.score @ step + clusters.information @ step @ step
            cost = np.maximum(base + added, 0.0) / dof
            before, group = group, np.isin(np.arange(n), np.argsort(cost)[:half])
            if np.array_equal(before, group):
                break
        total = float(cost[group].sum())
        if total < least_total:
            best, least_total = group, total
    return best


def _grown(adjusted: AdjustedBoard, group: BoolArray) -> BoolArray:
    """Return the group grown by all images that do not contradict it, to first order."""
    clusters, first = adjusted.clusters, _FIRST_RATIO
    for _ in range(_ROUNDS):
        before = group
        moved = clusters.moved(clusters.choose(group).best())
        for direction in _whole_picture(adjusted).T:
            group = group & ~_of_two_kinds(direction, moved, group)
        moved = clusters.moved(clusters.choose(group).best())
        ratio = max(first * moved.choose(group).ratio(), 1.0)
        group, first = ~_contradicting(adjusted, moved, group, ratio), 1.0
        if np.array_equal(before, group) or np.count_nonzero(group) < _OF_START:
            break
    return group


def _contradicting(
    adjusted: AdjustedBoard, clusters: Clusters, group: BoolArray, ratio: float
) -> BoolArray:
    """Return a mask of the images that contradict a group at its minimum."""
    k = clusters.score.shape[1]
    whole = _whole_picture(adjusted)
    limits = [
        (None, k),
        (whole[:, :1], 1),
        (whole[:, 1:], 2),
        (np.eye(k)[:, k - len(SHEET) :], len(SHEET)),
    ]
    contradicts = np.zeros(len(group), dtype=np.bool_)
    for directions, dof in limits:
        limit = float(chdtri(dof, _SIGNIFICANCE))
        contradicts |= clusters.contradiction(group, ratio, directions) > limit
    return contradicts


def _of_two_kinds(direction: Array, clusters: Clusters, group: BoolArray) -> BoolArray:
    """Return a mask of the smaller of two clusters of a group along a change (k,).

    The scatter is estimated with the change free in each image, so that the clusters do not
    inflate it.
    """
    minority, n = np.zeros(len(group), dtype=np.bool_), int(np.count_nonzero(group))
    if n < _FEW:
        return minority
    freed, change, information = clusters.choose(group).freed(direction)
    weight = information / max(freed.ratio(), 1.0)
    order = np.argsort(change)
    w, z = weight[order], change[order]
    mean = float(w @ z) / float(w.sum())
    spread = float(w @ (z - mean) ** 2)
    if spread < chdtri(n - 1, _SIGNIFICANCE):
        return minority
    low = np.cumsum(w)[:-1]
    between = np.cumsum(w * (z - mean))[:-1] ** 2 * (1.0 / low + 1.0 / (w.sum() - low))
    if between.max() < _TWO * spread:
        return minority
    cut = int(np.argmax(between)) + 1
    fewer = order[:cut] if cut <= n - cut else order[cut:]
    minority[np.flatnonzero(group)[fewer]] = True
    return minority


def _whole_picture(adjusted: AdjustedBoard) -> Array:
    """Return changes (k, 3) of the shared unknowns: scaling, and shifts along x and along y."""
    k = adjusted.clusters.score.shape[1]
    zoom = np.concatenate([intrinsic_values(adjusted.camera)[:2], np.zeros(k - 2)])
    return np.column_stack([zoom, np.eye(k)[:, 2:4]])


@dataclass(frozen=True, eq=False)
class _Fault:
    gain: float  # share of the excess cost of the image that it explains
    # (2,): relative change of both focal lengths, or shift of the principal point [px]
    change: Array


def _reasons(adjusted: AdjustedBoard, corners: BoardImages, group: BoolArray) -> dict[int, str]:
    """Return the likeliest fault of each image outside of a group, in words."""
    usual = float(np.median(_costs(adjusted, corners)[group]))
    faults = {i: _faults(adjusted, corners, i, usual) for i in np.flatnonzero(~group).tolist()}
    candidates = {
        i: [name for name, fault in of_image.items() if fault.gain > _EXPLAINED]
        for i, of_image in faults.items()
    }
    every = [name for names in candidates.values() for name in names]
    likeliest = {i: max(names, key=every.count, default="") for i, names in candidates.items()}
    reasons = {}
    in_group = corners.px[group[corners.image]]
    for i, name in likeliest.items():
        if name in _LIKE_A_LENS and _is_outside(corners.px[corners.image == i], in_group):
            reasons[i] = (
                "it reaches a part of the image that the others do not, where the lens model may "
                "not hold; bring the board there in more images"
            )
            continue
        equal = [faults[k][name].change for k, other in likeliest.items() if other == name != ""]
        if name == "zoom":
            longer = faults[i][name].change.mean() > 0.0
            zooms = [change.mean() for change in equal if (change.mean() > 0.0) == longer]
            reasons[i] = (
                f"another zoom or focus, with a focal length about "
                f"{100.0 * abs(np.median(zooms)):.2g} % {'longer' if longer else 'shorter'} than "
                "in the others"
            )
        elif name == "shift":
            x, y = np.rint(np.median(equal, axis=0)).astype(np.intp)
            reasons[i] = (
                f"its picture lies about ({x}, {y}) px beside that of the others, as with "
                "stabilisation or another crop"
            )
        elif name:
            reasons[i] = (
                "another distortion of the lens than in the others, as where a program corrects it"
            )
        else:
            rms = [adjusted.rms_px(mask) for mask in (corners.image == i, group[corners.image])]
            reasons[i] = (
                f"its corners are {rms[0]:.2f} px off (rms) before the camera of the others, whose "
                f"own are {rms[1]:.2f} px off: the board is bent differently, camera or board "
                "moved, or the picture was changed"
            )
    return reasons


def _is_outside(px: Array, others: Array) -> bool:
    """Return whether most corners of an image lie outside the hull of others."""
    hull = cv2.convexHull(others.astype(np.float32))
    inside = [cv2.pointPolygonTest(hull, point, False) >= 0.0 for point in px.tolist()]
    return 2 * sum(inside) < len(inside)


_FREE = {"zoom": slice(0, 2), "shift": slice(2, 4), "lens": slice(4, 6)}  # of intrinsics
_LIKE_A_LENS = ("", "zoom", "lens")  # faults like those of a wrong lens model


def _faults(
    adjusted: AdjustedBoard, corners: BoardImages, i: int, usual: float
) -> dict[str, _Fault]:
    """Return the possible faults of an image, given the usual cost of a degree of freedom."""
    camera, T, of_image = adjusted.camera, adjusted.T_camera_board[i], corners.image == i
    points, sheet = corners.points[of_image], adjusted.sheet or Sheet.flat(corners.points)
    only = np.zeros(len(points), dtype=np.intp)
    image = replace(corners.choose(of_image), image=only, points=sheet.placed(points)[0])
    plain = adjust_board(camera, [T], image)
    if plain is None:
        return {}
    excess = max(plain.cost - 0.5 * usual * max(2 * len(points) - 6, 1), 1e-300)
    tolerance = max(_NEGLIGIBLE * excess, COST_TOLERANCE)
    faults = {}

    def add(name: str, variant: AdjustedBoard | None) -> None:
        if variant is None:
            return
        change = variant.camera.K[:2, 2] - camera.K[:2, 2]
        if name == "zoom":
            change = np.diag(variant.camera.K)[:2] / np.diag(camera.K)[:2] - 1.0
            if abs(change[0] - change[1]) > _ALIKE * abs(change.sum()):
                return
        faults[name] = _Fault((plain.cost - variant.cost) / excess, change)

    for name, free in _FREE.items():
        names = intrinsic_names(camera)[free]
        add(name, adjust_board(camera, [T], image, names, tolerance=tolerance))
    return faults


# Corners


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A camera fitted to the corners that agree with it."""

    adjusted: AdjustedBoard  # fit to the inlier corners
    corners: BoardImages  # inlier corners, with their images renumbered
    images: tuple[int, ...]  # original numbers of these images
    left_out: dict[int, str]  # outlier images and their disagreement
    rival: tuple[int, ...]  # outlier images that agree among themselves
    n_left_out: int  # number of outlier corners in the other images
    # squared errors over their claims, the larger one of residuals and disagreement of images
    ratio: float
    all_covariance: Array  # (k + 4, k + 4): covariance of the intrinsics, then of the sheet

    @property
    def covariance(self) -> Array:
        """Covariance (k, k) of the intrinsics."""
        k = len(intrinsic_names(self.adjusted.camera))
        return self.all_covariance[:k, :k]

    @property
    def sheet(self) -> Array:
        """Numbers of the sheet, (4,)."""
        return np.zeros(len(SHEET)) if self.adjusted.sheet is None else self.adjusted.sheet.numbers


def robust_fit(
    corners: BoardImages,
    size: ImageSize,
    model: DistortionModel,
    first: AdjustedBoard | None = None,  # adjustment to all images, if there is one
) -> RobustFit | None:
    """Return the fit of the camera without outliers; None if no adjustment succeeds."""
    n_images = int(corners.image[-1]) + 1
    claimed, corners = corners.sigma_px, evened(corners)
    agreed = _agreeing_images(corners, size, model, first)
    if agreed is None:
        return None
    adjusted, left_out, rival = agreed
    poses = list(adjusted.T_camera_board)
    is_kept = ~np.isin(corners.image, list(left_out))
    for _ in range(_MOST_ROUNDS):
        part, images = part_of(corners, is_kept, n_images)
        readjusted = readjust(adjusted, [poses[k] for k in images], part)
        if readjusted is None:
            break
        adjusted = readjusted
        for k, T in zip(images, readjusted.T_camera_board, strict=True):
            poses[k] = T
        sigma = _scattered(claimed, is_kept, readjusted.residual)
        judged = is_kept.copy()
        judged[is_kept] = (
            np.linalg.norm(readjusted.residual, axis=1) < OUTLIER_SIGMAS * sigma[is_kept]
        )
        left_out |= _outlier_images(readjusted.residual, part, images)
        judged &= ~np.isin(corners.image, list(left_out))
        counts = np.bincount(corners.image, minlength=n_images)
        for k in set(images) - set(left_out):
            n_kept = int(np.count_nonzero(judged & (corners.image == k)))
            if n_kept < max(MIN_CORNERS, _MIN_INLIERS * counts[k]):
                left_out[k] = f"{counts[k] - n_kept} of its {counts[k]} corners disagree"
        judged &= ~np.isin(corners.image, list(left_out))
        converged = bool(np.array_equal(judged, is_kept)) and np.allclose(
            sigma, corners.sigma_px, rtol=0.02
        )
        if len(set(corners.image[judged].tolist())) == 0:
            break
        is_kept, corners = judged, replace(corners, sigma_px=sigma)
        if converged:
            break
    part, images = part_of(corners, is_kept, n_images)
    adjusted = readjust(adjusted, [poses[k] for k in images], part) or adjusted
    others = ~np.isin(corners.image, list(left_out))
    ratio = max(_scale(adjusted, part, len(images)), adjusted.clusters.ratio())
    return RobustFit(
        adjusted,
        part,
        images,
        left_out,
        rival,
        int(np.count_nonzero(~is_kept & others)),
        ratio,
        adjusted.clusters.covariance(ratio),
    )


def evened(corners: BoardImages) -> BoardImages:
    """Return corners of which none claims to be far better than the others."""
    claimed = corners.sigma_px
    return replace(corners, sigma_px=np.hypot(claimed, float(np.median(claimed))))


def _scattered(claimed: Array, is_kept: BoolArray, residual: Array) -> Array:
    """Return standard deviations of corners (n,), updated by the robust scatter of residuals [px].

    Excess scatter is added to all in quadrature; claims that are too large are scaled.
    """
    share = _TO_SIGMA * float(np.median(np.abs(residual) / claimed[is_kept, None]))
    if share < 1.0:
        return np.maximum(share * claimed, _LEAST_SCATTER_PX)
    scatter, usual = _TO_SIGMA * np.median(np.abs(residual)), np.median(claimed[is_kept])
    return np.asarray(np.hypot(claimed, np.sqrt(max(scatter**2 - usual**2, 0.0))))


def _outlier_images(residual: Array, corners: BoardImages, images: Sequence[int]) -> dict[int, str]:
    """Return the images with far more scatter than the median image, and a description of it."""
    scatter = [
        float(np.sqrt(np.mean(residual[corners.image == i] ** 2))) for i in range(len(images))
    ]
    usual = float(np.median(scatter))
    return {
        k: f"its corners are {s:.2f} px off (rms), those of the others {usual:.2f} px"
        for k, s in zip(images, scatter, strict=True)
        if s > max(_OUTLIER_IMAGE * usual, _MIN_OUTLIER_PX)
    }


def _scale(adjusted: AdjustedBoard, corners: BoardImages, n_images: int) -> float:
    """Return chi^2 of the corners over its degrees of freedom, with at least the minimum noise."""
    chi2 = float(np.sum((adjusted.residual / corners.sigma_px[:, None]) ** 2))
    unknowns = len(adjusted.covariance) + 6 * n_images
    dof = max(2 * len(corners.px) - unknowns, 1)
    noise = float(np.sqrt(np.sum(adjusted.residual**2) / dof))
    return chi2 / dof * max(1.0, _MIN_NOISE_PX / max(noise, 1e-9)) ** 2
