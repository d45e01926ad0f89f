"""What was observed, as arrays that the residuals take: outlines, readings, axes, corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.joint_fit.state import FittedLegs
from legcal.data import Corners, LegAxes, Measurements, Outlines, join_axes
from legcal.errors import DatasetError
from legcal.geometry import Array, BoolArray, IntArray
from legcal.machine import LegKind
from legcal.vision import EPSILON, Board, Camera, shared_cameras

_ALIKE = 1e-6  # gammas that differ by less, relatively, are one


def cameras_of(measurements: Measurements) -> tuple[str, ...]:
    """Return the name of the view that stands for the camera of each view.

    A view whose gamma is told stands for itself: nothing is to be found of its camera's.
    """
    views = measurements.views
    unknown = [view for view in views if not view.camera.gamma_is_given]
    shared = shared_cameras([view.name for view in unknown], [view.camera for view in unknown])
    stands_for = dict(zip((view.name for view in unknown), shared, strict=True))
    return tuple(stands_for.get(view.name, view.name) for view in views)


def movements_by_gamma(outlines: Outlines, measurements: Measurements) -> Array:
    """Return how far outlines move towards the inside with ln gamma, zero where that is told [px].

    (n,)
    """
    told = np.array([view.camera.gamma_is_given for view in measurements.views], dtype=np.bool_)
    unknown = ~told[measurements.view[outlines.row]] & np.isfinite(outlines.by_gamma)
    return np.where(unknown, outlines.by_gamma, 0.0)


def mixed_gammas(moved: Array, gamma: Array, camera: Sequence[str]) -> list[str]:
    """Return one sentence for each camera whose outlines were measured with several gammas."""
    found: dict[str, set[float]] = {}
    for by_gamma, one, name in zip(moved.tolist(), gamma.tolist(), camera, strict=True):
        if by_gamma != 0.0:
            found.setdefault(name, set()).add(one)
    return [
        f"The outlines of the camera of view {name} could not be used: found that they were "
        f"measured with the gammas {min(values):g} and {max(values):g}, needed one; search the "
        "images again, or write gamma of the view in dataset.yaml."
        for name, values in sorted(found.items())
        if max(values) / min(values) > 1.0 + _ALIKE
    ]


def known_gammas(outlines: Outlines, measurements: Measurements) -> dict[str, float]:
    """Return with which gamma used outlines of cameras were measured that nobody told, by view."""
    moved = outlines.used & (movements_by_gamma(outlines, measurements) != 0.0)
    cameras = cameras_of(measurements)
    view = measurements.view[outlines.row[moved]].tolist()
    known = {
        cameras[v]: gamma for v, gamma in zip(view, outlines.gamma[moved].tolist(), strict=True)
    }
    names = [view.name for view in measurements.views]
    return {n: known[c] for n, c in zip(names, cameras, strict=True) if c in known}


@dataclass(frozen=True, eq=False)
class ObservedOutlines:
    """The outlines that enter the fit, n of them."""

    index: IntArray  # (n,) rows of the table of outlines
    leg: IntArray  # (n,)
    view: IntArray  # (n,)
    pose: IntArray  # (n,)
    radius: IntArray  # (n,) in ``parts``
    # (n, 2, 2) points of the measured outline at both ends of the used piece, on the sensor plane
    feet: Array
    pixels: Array  # (n, 2, 2) the same points in the image [px]
    # (n, 9) what the residual needs besides: the inverse transposed derivative of pixels at these
    # points [1/px], column by column, and epsilon of eq (5)
    constants: Array
    covariance: Array  # (n, 2, 2) claimed covariance of the offsets at both ends [px^2]
    parts: tuple[tuple[int, str], ...]  # leg index and part of each radius, sorted by leg and name
    views: tuple[str, ...]  # names of the views
    # (n_views,) the view that stands for each: the first of those that show one image each with the
    # same camera, as one that is held in the hand does; else itself
    series: IntArray
    cameras: tuple[str, ...]  # the view that stands for the camera of each view
    # (n,) how far each moves towards the inside with the logarithm of the gamma of its camera [px];
    # zero where that gamma is told, or nothing is known of it
    by_gamma: Array
    bias_index: IntArray  # (n, c) the shared shifts that each outline has a part in
    bias_shift: Array  # (n, c, 2) how far one pixel of each shifts both ends [px]

    @property
    def epsilon(self) -> Array:
        """+1 or -1 of eq (5), (n,)."""
        return np.asarray(self.constants[:, 8])

    def __len__(self) -> int:
        return len(self.index)


@dataclass(frozen=True, eq=False)
class Readings:
    """The encoder readings that enter the fit, n of them."""

    leg: IntArray  # (n,) indices
    pose: IntArray  # (n,) indices
    length: Array  # (n,) sign * q: the leg length without its offset [m]
    sigma: float  # standard deviation [m]

    def __len__(self) -> int:
        return len(self.leg)


def observed_outlines(
    outlines: Outlines, measurements: Measurements, legs: FittedLegs
) -> ObservedOutlines:
    """Return the used outlines in the form that the residuals take.

    Raises
    ------
    DatasetError
        If an outline has a covariance that is not positive definite, or shows a part that the
        mechanism does not have, or outlines of a camera were measured with several gammas.
    """
    index = np.flatnonzero(outlines.used)
    row, leg = outlines.row[index], outlines.leg[index]
    view = measurements.view[row]
    keys = [(int(j), outlines.part[i]) for i, j in zip(index, leg, strict=True)]
    parts = tuple(sorted(set(keys)))
    covariance = outlines.covariance[index]
    cameras, by_gamma = cameras_of(measurements), movements_by_gamma(outlines, measurements)[index]
    problems = [
        *mixed_gammas(by_gamma, outlines.gamma[index], [cameras[v] for v in view.tolist()]),
        *_bad_covariances(covariance, row, leg, measurements, legs),
        *(
            f"The outlines of {legs.names[j]}.{part} could not be used: the mechanism has no such "
            "cylinder; correct the part in the observations."
            for j, part in parts
            if (j, part) not in legs.radii
        ),
    ]
    if problems:
        raise DatasetError(problems)
    feet, pixels = np.zeros((len(index), 2, 2)), np.zeros((len(index), 2, 2))
    constants = np.empty((len(index), 9))
    constants[:, 8] = EPSILON[outlines.edge[index] - 1]
    for v in np.unique(view):
        camera, of_view = measurements.views[v].camera, np.flatnonzero(view == v)
        at = index[of_view]
        feet[of_view], lens = feet_of_ends(camera, outlines.h[at], outlines.ends[at])
        constants[of_view, :8] = np.swapaxes(lens, -1, -2).reshape(-1, 8)
        pixels[of_view] = camera.distort(feet[of_view])
    numbers = {part: i for i, part in enumerate(parts)}
    return ObservedOutlines(
        index,
        leg,
        view,
        measurements.pose[row],
        np.array([numbers[key] for key in keys], dtype=np.intp),
        feet,
        pixels,
        constants,
        covariance,
        parts,
        tuple(view.name for view in measurements.views),
        _series(measurements),
        cameras,
        by_gamma,
        np.zeros((len(index), 0), dtype=np.intp),
        np.zeros((len(index), 0, 2)),
    )


def _series(measurements: Measurements) -> IntArray:
    """Return the view that stands for each, (n_views,)."""
    views = measurements.views
    owners = shared_cameras([view.name for view in views], [view.camera for view in views])
    images = np.bincount(measurements.view, minlength=len(views))
    first: dict[str, int] = {}
    found = [
        first.setdefault(owner, v) if n == 1 else v
        for v, (owner, n) in enumerate(zip(owners, images.tolist(), strict=True))
    ]
    return np.array(found, dtype=np.intp)


def of_parts(outlines: ObservedOutlines, parts: Sequence[tuple[int, str]]) -> ObservedOutlines:
    """Return the same outlines, radii counted in given parts, then in those of no other."""
    together = tuple(dict.fromkeys((*parts, *outlines.parts)))
    number = np.array([together.index(part) for part in outlines.parts], dtype=np.intp)
    return replace(outlines, radius=number[outlines.radius], parts=together)


def seen_by(outlines: ObservedOutlines, cameras: Sequence[Camera]) -> ObservedOutlines:
    """Return the same outlines in the image, on the sensor planes of other cameras."""
    feet, constants = outlines.feet.copy(), outlines.constants.copy()
    for v in np.unique(outlines.view):
        of_view = outlines.view == v
        feet[of_view] = cameras[v].undistort(outlines.pixels[of_view])
        lens = np.linalg.inv(cameras[v].pixels_per_unit(feet[of_view]))
        constants[of_view, :8] = lens.reshape(-1, 8)
    return replace(outlines, feet=feet, constants=constants)


def feet_of_ends(camera: Camera, h: Array, ends: Array) -> tuple[Array, Array]:
    """Return the points of measured lines nearest to their ends, and the lens there."""
    xy = camera.undistort(ends)
    normal = h[:, None, :2]
    value = np.sum(normal * xy, axis=-1, keepdims=True) + h[:, None, 2:]
    feet = xy - normal * value / np.sum(normal**2, axis=-1, keepdims=True)
    J = camera.pixels_per_unit(feet)
    return feet, np.swapaxes(np.linalg.inv(J), -1, -2)


def readings(measurements: Measurements, legs: FittedLegs) -> Readings:
    """Return the encoder readings, one row of them for each platform pose.

    Images of one pose share one reading: that of the first row. Legs without a motor have none.
    """
    length = legs.sign * measurements.q[measurements.first_rows]
    actuated = np.array([leg.kind is LegKind.ACTUATED for leg in legs.nominal], dtype=np.bool_)
    pose, leg = np.nonzero(np.isfinite(length) & actuated)
    return Readings(leg, pose, length[pose, leg], measurements.sigma_q)


def _bad_covariances(
    covariance: Array, row: IntArray, leg: IntArray, measurements: Measurements, legs: FittedLegs
) -> list[str]:
    """Return one sentence for each covariance that is not positive definite."""
    s00, s01, s11 = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    good = (s00 > 0.0) & (s11 > 0.0) & (s00 * s11 > s01**2)
    return [
        f"The outline of {legs.names[leg[i]]} in {measurements.image[row[i]] or f'row {row[i]}'} "
        f"could not be used: its covariance s00 = {s00[i]:g}, s01 = {s01[i]:g}, s11 = {s11[i]:g} "
        "px^2 is not positive definite; correct it in the observations."
        for i in np.flatnonzero(~good)
    ]


@dataclass(frozen=True, eq=False)
class ObservedAxes:
    """The axes that enter the fit, n of them."""

    leg: IntArray  # (n,) indices
    view: IntArray  # (n,) indices
    pose: IntArray  # (n,) indices
    M: Array  # (n, 3) a point of each axis in the camera frame [m]
    basis: Array  # (n, 2, 3) unit vectors e1, e2 normal to the axis; its direction is e1 x e2
    # (n, 4, 4) Lower triangular T with T C T^T = 1, C being the claimed covariance of (alpha1,
    # alpha2, beta1, beta2) [1/rad, 1/m]
    whitening: Array

    def __len__(self) -> int:
        return len(self.leg)


def observed_axes(
    axes: LegAxes | None, measurements: Measurements, legs: FittedLegs
) -> ObservedAxes:
    """Return axes in the form that the residual takes.

    Raises
    ------
    DatasetError
        If an axis has a covariance that is not positive definite.
    """
    if axes is None or len(axes) == 0:
        none = np.zeros(0, dtype=np.intp)
        return ObservedAxes(
            none, none, none, np.zeros((0, 3)), np.zeros((0, 2, 3)), np.zeros((0, 4, 4))
        )
    scale = np.sqrt(np.abs(np.einsum("nii->ni", axes.covariance)))
    scale = np.where(scale > 0.0, scale, 1.0)  # rad and m side by side
    correlation = axes.covariance / (scale[:, :, None] * scale[:, None, :])
    least = np.linalg.eigvalsh(correlation)[:, 0]
    problems = [
        f"The axis of {legs.names[axes.leg[i]]} in "
        f"{measurements.image[axes.row[i]] or f'row {axes.row[i] + 1}'} could not be used: its "
        "covariance is not positive definite, needed four positive variances; correct its "
        "standard deviations."
        for i in np.flatnonzero(~(least > 0.0))
    ]
    if problems:
        raise DatasetError(problems)
    whitening = np.linalg.inv(np.linalg.cholesky(correlation)) / scale[:, None, :]
    return ObservedAxes(
        axes.leg,
        measurements.view[axes.row],
        measurements.pose[axes.row],
        axes.M,
        axes.basis,
        whitening,
    )


@dataclass(frozen=True, eq=False)
class ObservedBoard:
    """The corners of a board that enter the fit, n of them."""

    view: IntArray  # (n,) index of the view
    corner: IntArray  # (n,) number of the corner
    point: Array  # (n, 3) the corners in the frame of the board [m]
    feet: Array  # (n, 2) where they were measured, on the sensor plane
    pixels: Array  # (n, 2) the same in the image [px]
    # (n, 4) what the residual needs besides: the derivative of pixels at these points [px], column
    # by column
    constants: Array
    sigma: Array  # (n,) standard deviation of both coordinates [px]

    @property
    def pixels_per_unit(self) -> Array:
        """Derivative of pixels by the sensor plane at the measured corners, (n, 2, 2) [px]."""
        return np.swapaxes(self.constants.reshape(-1, 2, 2), -1, -2)

    def __len__(self) -> int:
        return len(self.view)

    def chosen(self, which: BoolArray, scale: float = 1.0) -> ObservedBoard:
        """Return some of the corners, with standard deviations larger by a factor."""
        return ObservedBoard(
            self.view[which],
            self.corner[which],
            self.point[which],
            self.feet[which],
            self.pixels[which],
            self.constants[which],
            scale * self.sigma[which],
        )


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """A calibration board that stands still on the base, and what images show of it."""

    board: Board  # where its corners are, in its own frame
    corners: Corners  # where images show them; only the used ones count


def no_board() -> ObservedBoard:
    """Return what is seen where there is no board."""
    none, index = np.zeros(0), np.zeros(0, dtype=np.intp)
    pair = none.reshape(0, 2)
    return ObservedBoard(index, index, none.reshape(0, 3), pair, pair, none.reshape(0, 4), none)


def observed_board(
    seen: SeenBoard | None, measurements: Measurements, cameras: Sequence[Camera]
) -> ObservedBoard:
    """Return the used corners in the form that the residual takes."""
    if seen is None or not seen.corners.used.any():
        return no_board()
    corners = seen.corners
    used = np.flatnonzero(corners.used)
    key = np.stack([measurements.view[corners.row[used]], corners.corner[used]], axis=1)
    distinct, which = np.unique(key, axis=0, return_inverse=True)
    which = which.ravel()
    weight = corners.sigma_px[used] ** -2.0
    total = np.bincount(which, weights=weight)
    pixels = np.stack(
        [np.bincount(which, weights=weight * corners.px[used, i]) / total for i in range(2)], axis=1
    )
    view, corner = distinct.T
    found = ObservedBoard(
        view=view,
        corner=corner,
        point=seen.board.points[corner],
        feet=np.zeros((len(view), 2)),
        pixels=pixels,
        constants=np.zeros((len(view), 4)),
        sigma=1.0 / np.sqrt(total),
    )
    return board_seen_by(found, cameras)


def board_seen_by(board: ObservedBoard, cameras: Sequence[Camera]) -> ObservedBoard:
    """Return the same corners in the image, on the sensor planes of other cameras."""
    feet, constants = board.feet.copy(), board.constants.copy()
    for v in np.unique(board.view).tolist():
        of_view = board.view == v
        feet[of_view] = cameras[v].undistort(board.pixels[of_view])
        lens = cameras[v].pixels_per_unit(feet[of_view])
        constants[of_view] = np.swapaxes(lens, -1, -2).reshape(-1, 4)
    return replace(board, feet=feet, constants=constants)


def average_images(axes: LegAxes, measurements: Measurements) -> LegAxes:
    """Return one axis for each leg at each pose in each view, weighted by the covariances.

    Nothing is lost by it, and a fit is smaller by the number of images.
    """
    view, pose = measurements.view[axes.row], measurements.pose[axes.row]
    return join_axes(axes, view * measurements.n_poses + pose)
