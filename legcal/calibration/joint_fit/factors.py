"""Measurements and their factors: outlines, readings, axes, and corners of a calibration board.

Each kind is a class of arrays, one row a measurement, with the :class:`legcal.estimation.Factor`
that it is in the fit; :class:`Observed` registers the kinds. A measurement in an image depends on
both ends of a leg in the camera frame; these depend on joints, camera and platform pose. Rotations
change by Cayley's map from the left: a camera turns in its own frame, a platform about the origin
of R_e in the directions of R_b. The residuals are CasADi functions; the chain rule around them is
written out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from legcal.calibration.joint_fit.variables import FittedLegs, State
from legcal.data import Corners, LegAxes, Measurements, Outlines, join_axes
from legcal.errors import DatasetError
from legcal.estimation import Factor, Residuals
from legcal.geometry import Array, BoolArray, IntArray, cross, whitener
from legcal.machine import LegKind
from legcal.vision import (
    EPSILON,
    Board,
    Camera,
    intrinsic_names,
    shared_cameras,
    undistort_derivatives,
)

_SAME_GAMMA = 1e-6  # relative difference of gammas that count as one
_SIX, _ALL, _ONE = slice(0, 6), slice(None), slice(0, 1)


class Observed(NamedTuple):
    """All measurements of a fit, by kind; each kind is one factor."""

    outlines: ObservedOutlines
    readings: Readings
    axes: ObservedAxes
    corners: ObservedCorners

    def factors(self, keys: tuple[str, ...]) -> tuple[Factor[State], ...]:
        """Return the factor of each kind; *keys* are the intrinsics that may be unknown."""
        return tuple(kind.factor(keys) for kind in self)

    @property
    def views(self) -> IntArray:
        """The views that show anything."""
        return np.unique(np.concatenate([self.outlines.view, self.axes.view, self.corners.view]))


def observed_arrays(
    measurements: Measurements,
    legs: FittedLegs,
    outlines: Outlines,
    axes: LegAxes | None = None,
    board: BoardCorners | None = None,
    cameras: Sequence[Camera] | None = None,
) -> Observed:
    """Return measurements as arrays; of *cameras* in place of those of the views, where given.

    Raises
    ------
    DatasetError
        If an outline or an axis cannot be used.
    """
    given = [view.camera for view in measurements.views]
    found = observed_outlines(outlines, measurements, legs)
    if cameras is not None and any(a is not b for a, b in zip(cameras, given, strict=True)):
        found = found.through(cameras)
    return Observed(
        found,
        observed_readings(measurements, legs),
        observed_axes(axes, measurements, legs),
        observed_corners(board, measurements, given if cameras is None else cameras),
    )


# ------------------------------------------------------------------------------------- outlines


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
    # (n, 9) data of the residual: the inverse transposed derivative of pixels at these points
    # [1/px], column by column, and epsilon of eq (5)
    constants: Array
    covariance: Array  # (n, 2, 2) claimed covariance of the offsets at both ends [px^2]
    # (n,) derivative of their place by the logarithm of the gamma of the camera, positive inwards
    # [px]; zero where that gamma is given, or the derivative is not known
    by_gamma: Array
    bias_index: IntArray  # (n, c) the common-mode biases that act on each outline
    bias_shift: Array  # (n, c, 2) how far one unit of each shifts both ends [px]
    parts: tuple[tuple[int, str], ...]  # leg index and part of each radius, sorted by leg and name
    views: tuple[str, ...]  # names of the views
    # (n_views,) the view that stands for each: the first of those that show one image each with the
    # same camera, as one that is held in the hand does; else itself
    series: IntArray
    cameras: tuple[str, ...]  # the view that stands for the camera of each view

    @property
    def epsilon(self) -> Array:
        """+1 or -1 of eq (5), (n,)."""
        return np.asarray(self.constants[:, 8])

    def __len__(self) -> int:
        return len(self.index)

    def at(self, which: IntArray) -> ObservedOutlines:
        """Return some of the outlines, by index, without biases."""
        bare = self.without_biases()
        shared = ("parts", "views", "series", "cameras")
        chosen = {
            f.name: getattr(bare, f.name)[which] for f in fields(self) if f.name not in shared
        }
        return replace(self, **chosen)

    def without_biases(self) -> ObservedOutlines:
        """Return the same outlines without common-mode biases."""
        return replace(self, bias_index=self.bias_index[:, :0], bias_shift=self.bias_shift[:, :0])

    def with_parts_first(self, parts: Sequence[tuple[int, str]]) -> ObservedOutlines:
        """Return the same outlines, radii numbered by these parts, then by those of no other."""
        together = tuple(dict.fromkeys((*parts, *self.parts)))
        number = np.array([together.index(part) for part in self.parts], dtype=np.intp)
        return replace(self, radius=number[self.radius], parts=together)

    def through(self, cameras: Sequence[Camera]) -> ObservedOutlines:
        """Return the same outlines in the image, on the sensor planes of other cameras."""
        feet, constants = self.feet.copy(), self.constants.copy()
        for v in np.unique(self.view):
            of_view = self.view == v
            feet[of_view] = cameras[v].undistort(self.pixels[of_view])
            lens = np.linalg.inv(cameras[v].pixels_per_unit(feet[of_view]))
            constants[of_view, :8] = lens.reshape(-1, 8)
        return replace(self, feet=feet, constants=constants)

    def offsets(self, keys: tuple[str, ...], state: State) -> Array:
        """Return how far both ends are from the predicted outline, (n, 2) [px]."""
        local, *_ = self._local(keys, state)
        return self._corrected(outline_residual().values(local, self.constants), state)

    def rows(self, keys: tuple[str, ...], state: State) -> Residuals:
        """Return these offsets with their derivatives."""
        local, ends, by_intrinsics = self._local(keys, state)
        r, slope = outline_residual().evaluate(local, self.constants)
        if not self.bias_index.shape[1] and not keys:
            return Residuals(r, slope[..., :7], ends.with_others)
        along = slope[..., 7:].reshape(len(self), 2, 2, 2)  # by (end, coordinate)
        others = [
            -np.swapaxes(self.bias_shift, 1, 2),
            np.einsum("nqec,neck->nqk", along, by_intrinsics),
        ]
        slope = np.concatenate([slope[..., :7], *others], axis=-1)
        return Residuals(self._corrected(r, state), slope, ends.with_others)

    def _corrected(self, r: Array, state: State) -> Array:
        """Return offsets (n, 2) without common-mode biases."""
        r = r - np.einsum("nc,ncq->nq", state.biases[self.bias_index], self.bias_shift)
        return np.asarray(r)

    def _local(self, keys: tuple[str, ...], state: State) -> tuple[Array, _EndsInCamera, Array]:
        ends = _ends_in_camera(state, self.leg, self.view, self.pose)
        xy, by_intrinsics = _on_sensor(state.cameras, keys, self.view, self.feet, self.pixels)
        parts = [ends.A, ends.B, state.radii[self.radius, None], xy.reshape(len(self), 4)]
        return np.concatenate(parts, axis=1), ends, by_intrinsics

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor of outlines, whitened with their claimed covariances."""
        touches = (
            ("legs", self.leg, _SIX),
            ("camera_pose", self.view, _ALL),
            ("radii", self.radius, _ONE),
            ("biases", self.bias_index, _ONE),
            ("cameras", self.view, _ALL),
        )
        whitening = whitener(self.covariance)

        def rows(state: State) -> Residuals:
            return self.rows(keys, state)

        return Factor("outlines", rows, touches, len(self), 2, self.pose, whitening, robust=True)


def observed_outlines(
    outlines: Outlines, measurements: Measurements, legs: FittedLegs
) -> ObservedOutlines:
    """Return the used outlines.

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
    cameras, by_gamma = _cameras_of(measurements), _by_gamma(outlines, measurements)[index]
    problems = [
        *_mixed_gammas(by_gamma, outlines.gamma[index], [cameras[v] for v in view.tolist()]),
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
    n, numbers = len(index), {part: i for i, part in enumerate(parts)}
    feet, pixels, constants = np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.empty((n, 9))
    constants[:, 8] = EPSILON[outlines.edge[index] - 1]
    for v in np.unique(view):
        camera, of_view = measurements.views[v].camera, view == v
        at = index[of_view]
        normal, xy = outlines.h[at, None, :2], camera.undistort(outlines.ends[at])
        value = np.sum(normal * xy, axis=-1, keepdims=True) + outlines.h[at, None, 2:]
        feet[of_view] = xy - normal * value / np.sum(normal**2, axis=-1, keepdims=True)
        lens = np.linalg.inv(camera.pixels_per_unit(feet[of_view]))
        constants[of_view, :8] = lens.reshape(-1, 8)
        pixels[of_view] = camera.distort(feet[of_view])
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
        by_gamma,
        np.zeros((n, 0), dtype=np.intp),
        np.zeros((n, 0, 2)),
        parts,
        tuple(v.name for v in measurements.views),
        _series(measurements),
        cameras,
    )


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


def _cameras_of(measurements: Measurements) -> tuple[str, ...]:
    """Return the name of the view that stands for the camera of each view.

    A view whose gamma is given stands for itself: no gamma is estimated for it.
    """
    views = measurements.views
    unknown = [view for view in views if not view.camera.gamma_is_given]
    shared = shared_cameras([view.name for view in unknown], [view.camera for view in unknown])
    stands_for = dict(zip((view.name for view in unknown), shared, strict=True))
    return tuple(stands_for.get(view.name, view.name) for view in views)


def _by_gamma(outlines: Outlines, measurements: Measurements) -> Array:
    """Return how far outlines (n,) move inwards by ln gamma, zero where that is given [px]."""
    given = np.array([view.camera.gamma_is_given for view in measurements.views], dtype=np.bool_)
    unknown = ~given[measurements.view[outlines.row]] & np.isfinite(outlines.by_gamma)
    return np.where(unknown, outlines.by_gamma, 0.0)


def _mixed_gammas(moved: Array, gamma: Array, camera: Sequence[str]) -> list[str]:
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
        if max(values) / min(values) > 1.0 + _SAME_GAMMA
    ]


def known_gammas(outlines: Outlines, measurements: Measurements) -> dict[str, float]:
    """Return the gamma with which used outlines were measured, by view, where none is given."""
    moved = outlines.used & (_by_gamma(outlines, measurements) != 0.0)
    cameras = _cameras_of(measurements)
    view = measurements.view[outlines.row[moved]].tolist()
    known = {
        cameras[v]: gamma for v, gamma in zip(view, outlines.gamma[moved].tolist(), strict=True)
    }
    names = [view.name for view in measurements.views]
    return {n: known[c] for n, c in zip(names, cameras, strict=True) if c in known}


# ------------------------------------------------------------------------------------- readings


@dataclass(frozen=True, eq=False)
class Readings:
    """The encoder readings that enter the fit, n of them."""

    leg: IntArray  # (n,) indices
    pose: IntArray  # (n,) indices
    length: Array  # (n,) sign * q: the leg length without its offset [m]
    sigma: float  # standard deviation [m]

    def __len__(self) -> int:
        return len(self.leg)

    def rows(self, state: State) -> Residuals:
        """Return the closures of legs (n, 1) [m] with their derivatives."""
        arm, R_pose = state.arms[self.pose, self.leg], state.platform_pose.R[self.pose]
        B = state.platform_pose.t[self.pose] + arm
        local = np.column_stack([state.A[self.leg], B, state.lengths[self.leg]])
        r, slope = encoder_residual().evaluate(local, self.length[:, None])

        def chain(slope: Array) -> tuple[Array, Array]:
            b = slope[..., 3:6]
            J = np.concatenate([slope[..., :3], b @ R_pose, slope[..., 6:]], axis=-1)
            return J, np.concatenate([cross(arm[:, None], b), b], axis=-1)

        return Residuals(r, slope, chain)

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor of readings; no camera matters to them."""
        del keys
        touches = (("legs", self.leg, slice(0, 7)),)
        return Factor("readings", self.rows, touches, len(self), 1, self.pose, 1.0 / self.sigma)


def observed_readings(measurements: Measurements, legs: FittedLegs) -> Readings:
    """Return the encoder readings, one row of them for each platform pose.

    Images of one pose share one reading: that of the first row. Legs without a motor have none.
    """
    length = legs.sign * measurements.q[measurements.first_rows]
    actuated = np.array([leg.kind is LegKind.ACTUATED for leg in legs.nominal], dtype=np.bool_)
    pose, leg = np.nonzero(np.isfinite(length) & actuated)
    return Readings(leg, pose, length[pose, leg], measurements.sigma_q)


# ----------------------------------------------------------------------------------------- axes


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

    def rows(self, state: State) -> Residuals:
        """Return alpha and beta (n, 4) with their derivatives."""
        data = np.concatenate([self.M, self.basis.reshape(-1, 6)], axis=1)
        ends = _ends_in_camera(state, self.leg, self.view, self.pose)
        r, slope = axis_residual().evaluate(np.concatenate([ends.A, ends.B], axis=1), data)
        return Residuals(r, slope, ends.by_unknowns)

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor of measured axes, which contain cameras already."""
        del keys
        touches = (("legs", self.leg, _SIX), ("camera_pose", self.view, _ALL))
        n, whitening = len(self), self.whitening
        return Factor("axes", self.rows, touches, n, 4, self.pose, whitening, robust=True)


def observed_axes(
    axes: LegAxes | None, measurements: Measurements, legs: FittedLegs
) -> ObservedAxes:
    """Return axes as arrays.

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
    whitening = whitener(correlation) / scale[:, None, :]
    view, pose = measurements.view[axes.row], measurements.pose[axes.row]
    return ObservedAxes(axes.leg, view, pose, axes.M, axes.basis, whitening)


def average_images(axes: LegAxes, measurements: Measurements) -> LegAxes:
    """Return one axis for each leg at each pose in each view, weighted by the covariances.

    No information is lost, and a fit is smaller by the number of images.
    """
    view, pose = measurements.view[axes.row], measurements.pose[axes.row]
    return join_axes(axes, view * measurements.n_poses + pose)


# -------------------------------------------------------------------------------------- corners


@dataclass(frozen=True, eq=False)
class BoardCorners:
    """A calibration board that stands still on the base, and its corners in images."""

    board: Board  # where its corners are, in its own frame
    corners: Corners  # where images show them; only the used ones count


@dataclass(frozen=True, eq=False)
class ObservedCorners:
    """The corners of a board that enter the fit, n of them."""

    view: IntArray  # (n,) index of the view
    corner: IntArray  # (n,) number of the corner
    point: Array  # (n, 3) the corners in the frame of the board [m]
    feet: Array  # (n, 2) where they were measured, on the sensor plane
    pixels: Array  # (n, 2) the same in the image [px]
    # (n, 4) data of the residual: the derivative of pixels at these points [px], column by column
    constants: Array
    sigma: Array  # (n,) standard deviation of both coordinates [px]

    def __len__(self) -> int:
        return len(self.view)

    def chosen(self, which: BoolArray, scale: float = 1.0) -> ObservedCorners:
        """Return some of the corners, with standard deviations larger by a factor."""
        chosen = ObservedCorners(*(getattr(self, f.name)[which] for f in fields(self)))
        return replace(chosen, sigma=scale * chosen.sigma)

    def rows(self, keys: tuple[str, ...], state: State) -> Residuals:
        """Return predicted minus measured corners (n, 2) [px] with their derivatives."""
        R_camera = state.camera_pose.R[self.view]
        arm = self.point @ state.board_pose.R[0].T
        grown = state.board_scale[0] * arm
        turned = _times(R_camera, grown + state.board_pose.t)
        xy, by_intrinsics = _on_sensor(state.cameras, keys, self.view, self.feet, self.pixels)
        local = np.concatenate([turned + state.camera_pose.t[self.view], xy], axis=1)
        r, slope = corner_residual().evaluate(local, self.constants)

        def chain(slope: Array) -> tuple[Array, Array]:
            in_camera = slope[..., :3]
            in_base = in_camera @ R_camera
            J = [
                cross(turned[:, None], in_camera),
                in_camera,
                cross(grown[:, None], in_base),
                in_base,
                in_base @ arm[..., None],
                slope[..., 3:] @ by_intrinsics,
            ]
            return np.concatenate(J, axis=-1), np.zeros((*slope.shape[:2], 6))

        return Residuals(r, slope, chain)

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor of corners; no platform pose moves them."""
        one = np.zeros(len(self), dtype=np.intp)
        touches = (
            ("camera_pose", self.view, _ALL),
            ("board_pose", one, _ALL),
            ("board_scale", one, _ALL),
            ("cameras", self.view, _ALL),
        )
        whitening = 1.0 / self.sigma[:, None, None]

        def rows(state: State) -> Residuals:
            return self.rows(keys, state)

        return Factor("corners", rows, touches, len(self), 2, None, whitening, robust=True)


def observed_corners(
    seen: BoardCorners | None, measurements: Measurements, cameras: Sequence[Camera]
) -> ObservedCorners:
    """Return the used corners, those of all images of a view as one weighted mean."""
    corners = None if seen is None else seen.corners
    if seen is None or corners is None or not corners.used.any():
        none, index = np.zeros(0), np.zeros(0, dtype=np.intp)
        pair = none.reshape(0, 2)
        return ObservedCorners(
            index, index, none.reshape(0, 3), pair, pair, none.reshape(0, 4), none
        )
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
    feet, constants = np.zeros((len(view), 2)), np.zeros((len(view), 4))
    for v in np.unique(view).tolist():
        of_view = view == v
        feet[of_view] = cameras[v].undistort(pixels[of_view])
        lens = cameras[v].pixels_per_unit(feet[of_view])
        constants[of_view] = np.swapaxes(lens, -1, -2).reshape(-1, 4)
    sigma = 1.0 / np.sqrt(total)
    return ObservedCorners(view, corner, seen.board.points[corner], feet, pixels, constants, sigma)


# ------------------------------------------------------------------------------------ residuals


@dataclass(frozen=True, eq=False)
class Residual:
    """A CasADi residual of one measurement, evaluated for many at once."""

    n_local: int  # numbers that it depends on
    n_rows: int
    value: ca.Function  # (local, data) -> residual
    jacobian: ca.Function  # (local, data) -> residual and its dense Jacobian by local

    def values(self, local: Array, data: Array) -> Array:
        """Return residuals (n, n_rows) of n measurements."""
        r = np.zeros((len(local), self.n_rows))
        _call(self.value, (local, data), (r,))
        return r

    def evaluate(self, local: Array, data: Array) -> tuple[Array, Array]:
        """Return residuals (n, n_rows) and Jacobians (n, n_rows, n_local) of n measurements."""
        n = len(local)
        r = np.zeros((n, self.n_rows))
        by_local = np.zeros((n, self.n_local, self.n_rows))  # CasADi stores column by column
        _call(self.jacobian, (local, data), (r, by_local))
        return r, np.swapaxes(by_local, 1, 2)


def _call(function: ca.Function, inputs: Sequence[Array], results: Sequence[Array]) -> None:
    """Evaluate a function for all measurements, on NumPy's memory and without copies."""
    n = len(inputs[0])
    if n == 0:
        return
    buffer: Any
    buffer, evaluate = _mapped(function, n).buffer()
    kept = [np.ascontiguousarray(array, dtype=np.float64) for array in inputs]
    for i, array in enumerate(kept):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(results):
        buffer.set_res(i, array.data)
    evaluate()


@lru_cache(maxsize=64)
def _mapped(function: ca.Function, n: int) -> ca.Function:
    """Return the function over n measurements."""
    return function.map(n)


def _residual(name: str, local: ca.SX, data: ca.SX, r: ca.SX) -> Residual:
    by_local = ca.densify(ca.jacobian(r, local))
    options = {"cse": True}
    return Residual(
        local.size1(),
        r.size1(),
        ca.Function(name, [local, data], [r], options),
        ca.Function(f"{name}_jacobian", [local, data], [r, by_local], options),
    )


def outline_of_leg(A: ca.SX, B: ca.SX, radius: ca.SX, epsilon: ca.SX) -> ca.SX:
    """Return the outline h of the cylinder about AB seen from the origin, eqs (1) and (3).

    Its length is that of A x B squared, of no matter for a line. With n = A x B and D = B - A
    eq (3) is h = epsilon r (D x n) - n sqrt(|n|^2 - |D|^2 r^2) up to that, without a division.
    """
    n, D = ca.cross(A, B), B - A
    depth = ca.sqrt(ca.dot(n, n) - radius**2 * ca.dot(D, D))
    return epsilon * radius * ca.cross(D, n) - depth * n


def offset_in_image(h: ca.SX, xy: ca.SX, J_inverse_transposed: ca.SX) -> ca.SX:
    """Return the signed distance [px] of a point of the sensor plane from the line h.

    The same as :meth:`legcal.vision.camera.Camera.line_offset`, with the derivative of the
    lens at the point given as a constant.
    """
    normal = J_inverse_transposed @ h[:2]
    return (h[0] * xy[0] + h[1] * xy[1] + h[2]) / ca.norm_2(normal)


@cache
def outline_residual() -> Residual:
    """Return the distances [px] of the predicted outline from both ends of the measured one.

    local (11): A and B in the camera frame, radius [m], both ends on the sensor plane. data (9):
    J^-T at the ends (2 x 4, column by column), epsilon.
    """
    local, data = ca.SX.sym("local", 11), ca.SX.sym("data", 9)
    h = outline_of_leg(local[0:3], local[3:6], local[6], data[8])
    offsets = [
        offset_in_image(
            h, local[7 + 2 * end : 9 + 2 * end], ca.reshape(data[4 * end : 4 + 4 * end], 2, 2)
        )
        for end in range(2)
    ]
    return _residual("outline", local, data, ca.vertcat(*offsets))


@cache
def axis_residual() -> Residual:
    """Return how far a leg's predicted axis is from a measured one: alpha1, alpha2, beta1, beta2.

    The measured axis passes through M along e1 x e2. alpha is the predicted direction in e1 and
    e2, over its part along the axis; beta is where the predicted axis meets the plane through
    M with these directions, from M [m].

    local (6): A and B in the camera frame [m]. data (9): M, e1, e2.
    """
    local, data = ca.SX.sym("local", 6), ca.SX.sym("data", 9)
    A, leg = local[0:3], local[3:6] - local[0:3]
    M, e1, e2 = data[0:3], data[3:6], data[6:9]
    basis, along = ca.horzcat(e1, e2).T, ca.cross(e1, e2)
    slope = leg / ca.dot(along, leg)
    to_A = A - M
    beta = basis @ (to_A - slope * ca.dot(along, to_A))
    return _residual("axis", local, data, ca.vertcat(basis @ slope, beta))


@cache
def corner_residual() -> Residual:
    """Return how far a predicted corner of the calibration board is from the measured one [px].

    local (5): the corner in the camera frame [m], the measured one on the sensor plane. data (4):
    the derivative of pixels by the sensor plane there (2 x 2, column by column).
    """
    local, data = ca.SX.sym("local", 5), ca.SX.sym("data", 4)
    away = local[:2] / local[2] - local[3:]
    return _residual("corner", local, data, ca.reshape(data, 2, 2) @ away)


@cache
def encoder_residual() -> Residual:
    """Return the closure of a leg, |AB| - sign q - q0 [m].

    local (7): A and B in R_b, q0 [m]. data (1): sign * q [m].
    """
    local, data = ca.SX.sym("local", 7), ca.SX.sym("data", 1)
    closure = ca.norm_2(local[3:6] - local[0:3]) - data - local[6]
    return _residual("encoder", local, data, closure)


# ----------------------------------------------------------------------------------- chain rule


def _on_sensor(
    cameras: Sequence[Camera], keys: tuple[str, ...], view: IntArray, feet: Array, pixels: Array
) -> tuple[Array, Array]:
    """Return points of images (n, ..., 2) on the sensor plane, and (n, ..., 2, n_keys).

    The latter is how they move with intrinsics; without any unknown these are at *feet*.
    """
    if not keys:
        return feet, np.zeros((*feet.shape, 0))
    xy, slopes = feet.copy(), np.zeros((*feet.shape, len(keys)))
    for v in np.unique(view):
        camera, of_view = cameras[v], view == v
        known = [k for k, key in enumerate(keys) if key in intrinsic_names(camera)]
        seen = pixels[of_view]
        xy[of_view] = camera.undistort(seen)
        some = np.zeros((*seen.shape, len(keys)))
        some[..., known] = undistort_derivatives(camera, seen, [keys[k] for k in known])
        slopes[of_view] = some
    return xy, slopes


@dataclass(frozen=True, eq=False)
class _EndsInCamera:
    """Both ends of legs in the camera frame, and what their derivatives are made of."""

    A: Array  # (n, 3) from the camera, in its directions, and B likewise
    B: Array
    A_turned: Array  # without the camera's place
    B_turned: Array
    arm: Array  # (n, 3) from the origin of R_e to B, in R_b
    R_camera: Array  # (n, 3, 3)
    R_pose: Array

    def with_others(self, slope: Array) -> tuple[Array, Array]:
        """Return the same with what comes after the ends: radius, biases, intrinsics."""
        J, J_pose = self.by_unknowns(slope[..., :6])
        return np.concatenate([J, slope[..., 6:]], axis=-1), J_pose

    def by_unknowns(self, slope: Array) -> tuple[Array, Array]:
        """Return derivatives by A, B, camera and by the pose from those by both ends."""
        by_A, by_B = slope[..., :3], slope[..., 3:6]
        a, b = by_A @ self.R_camera, by_B @ self.R_camera
        turn = cross(self.A_turned[:, None], by_A) + cross(self.B_turned[:, None], by_B)
        J = np.concatenate([a, b @ self.R_pose, turn, by_A + by_B], axis=-1)
        return J, np.concatenate([cross(self.arm[:, None], b), b], axis=-1)


def _ends_in_camera(state: State, leg: IntArray, view: IntArray, pose: IntArray) -> _EndsInCamera:
    """Return both ends of legs in the camera frames of views at poses."""
    R_camera, t = state.camera_pose.R[view], state.camera_pose.t[view]
    arm = state.arms[pose, leg]
    A = (state.A @ np.swapaxes(state.camera_pose.R, 1, 2))[view, leg]
    B = _times(R_camera, state.platform_pose.t[pose] + arm)
    return _EndsInCamera(A + t, B + t, A, B, arm, R_camera, state.platform_pose.R[pose])


def _times(R: Array, v: Array) -> Array:
    """Return R v of rows, (n, 3)."""
    return np.asarray((R @ v[..., None])[..., 0])
