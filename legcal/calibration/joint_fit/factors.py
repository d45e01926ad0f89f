"""Measurements and their factors: outlines, edges of bodies, readings, corners of boards.

Each kind is a class of arrays, one row per measurement, with its ``Factor``; :class:`Observed`
registers the kinds. A measurement in an image depends on both ends of a leg in the camera frame,
and these on joints, camera pose and platform pose; for the outline of an arm, on the ends of the
arm and its motor. Rotations are perturbed from the left by Cayley's map: a camera in its own frame,
a platform about the origin of R_e in the axes of R_b. Derivatives are computed in reverse mode,
from residuals to leg ends to variables. Arrays of many measurements (outlines, readings) have them
on the last axis, where NumPy is fastest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from legcal.calibration.joint_fit.parameter_choices import Choices, joints_of_length
from legcal.calibration.joint_fit.variables import FittedLegs, State
from legcal.data.corners import Corners
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines, no_outlines, polished_parts
from legcal.errors import Code, DatasetError, Problem
from legcal.estimation.problem import Factor, Residuals, Touch
from legcal.geometry.covariances import whitener
from legcal.geometry.lines import cross
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import ActuatorColumns, JointMotion
from legcal.machine.leg import LINKS, LegColumns, LegKind, Link
from legcal.machine.rods import actuator_index, first_rods
from legcal.vision.board import FixedBoard
from legcal.vision.camera import (
    Camera,
    intrinsic_names,
    pixel_derivatives,
    shared_cameras,
    undistort_near,
)
from legcal.vision.cylinder import EPSILON

_SAME_GAMMA = 1e-6  # relative difference of equal gammas
_PART_OF_DISTANCE = 1e-2  # step of differences along the distance of a measured point
_SIX, _ALL, _ONE = slice(0, 6), slice(None), slice(0, 1)
_OF_ACTUATOR = LegColumns.ACTUATOR


class Observed(NamedTuple):
    """All measurements of a fit, by kind; one factor each."""

    outlines: ObservedOutlines
    readings: Readings
    edges: ObservedEdges  # of bodies
    corners: ObservedCorners  # of the board on the base
    platform_corners: ObservedCorners

    def factors(self, keys: tuple[str, ...]) -> tuple[Factor[State], ...]:
        """Return the factor of each kind; *keys* are the estimated intrinsics."""
        return tuple(kind.factor(keys) for kind in self)

    @property
    def views(self) -> IntArray:
        """Indices of views with measurements."""
        seen = (self.outlines, self.edges, self.corners, self.platform_corners)
        return np.unique(np.concatenate([kind.view for kind in seen]))

    @property
    def boards(self) -> tuple[ObservedCorners, ...]:
        """Corners by board, in the order of ``LINKS``."""
        return self.corners, self.platform_corners

    def with_corners(self, corners: ObservedCorners) -> Observed:
        """Replace the corners of one board."""
        if corners.link == "base":
            return self._replace(corners=corners)
        return self._replace(platform_corners=corners)


def observed_arrays(
    measurements: Measurements,
    legs: FittedLegs,
    outlines: Outlines,
    board: BoardCorners | None = None,
    cameras: Sequence[Camera] | None = None,
    edges: Outlines | None = None,
) -> Observed:
    """Return measurements as arrays; *cameras* override the cameras of the views.

    Raises DatasetError if an outline cannot be used.
    """
    observed, given = observed_outlines(outlines, measurements, legs), measurements.cameras
    cameras = given if cameras is None else cameras
    if any(a is not b for a, b in zip(cameras, given, strict=True)):
        observed = observed.through(cameras)
    return Observed(
        observed,
        observed_readings(measurements, legs),
        observed_edges(edges, measurements, legs, cameras),
        *observed_corners(board, measurements, cameras),
    )


class Memory:
    """Cache of the last result of a function, keyed by the identity of its inputs."""

    def __init__(self) -> None:
        self._last: tuple[tuple[object, ...], Any] | None = None

    def __reduce__(self) -> tuple[type[Memory], tuple[()]]:
        return Memory, ()

    def of(self, compute: Callable[[], Any], *inputs: object) -> Any:
        """Return the cached result; compute it if any input is another object."""
        last = self._last
        if last is not None and all(a is b for a, b in zip(last[0], inputs, strict=True)):
            return last[1]
        result = compute()
        self._last = inputs, result
        return result


# ------------------------------------------------------------------------------------- outlines


@dataclass(frozen=True, eq=False)
class ObservedOutlines:
    """The n outlines of the fit."""

    index: IntArray  # (n,) rows of the table of outlines
    leg: IntArray  # (n,)
    view: IntArray  # (n,)
    pose: IntArray  # (n,)
    radius: IntArray  # (n,) in ``parts``
    # (n, 2, 2) points of the measured outline at both ends of its segment, on the sensor plane
    feet: Array
    pixels: Array  # (n, 2, 2) the same points in the image [px]
    lens: Array  # (n, 2, 2, 2) derivatives of pixels at these points [px]
    epsilon: Array  # (n,) +1 or -1 of eq (5)
    covariance: Array  # (n, 2, 2) claimed covariance of the offsets at both ends [px^2]
    # (n,) derivative of the outline's position by the logarithm of the camera's gamma, positive
    # inwards [px]; zero where the gamma is given or the derivative unknown
    by_gamma: Array
    bias_index: IntArray  # (n, c) the common-mode biases that act on each outline
    bias_shift: Array  # (n, c, 2) shift of both ends by one unit of each [px]
    parts: tuple[tuple[int, str], ...]  # leg index and part of each radius, sorted by leg and name
    views: tuple[str, ...]  # names of the views
    # (n_views,) representative of each view: the first of the one-image views of the same camera
    # (a hand-held one); else the view itself
    series: IntArray
    cameras: tuple[str, ...]  # representative view of the camera of each view
    on_actuators: bool = False  # some joints at A move
    arms: frozenset[tuple[int, str]] = frozenset()  # parts that are arms
    polished: frozenset[tuple[int, str]] = frozenset()  # parts with polished surfaces
    memory: Memory = field(default_factory=Memory, repr=False)  # of the predicted offsets

    @cached_property
    def width_px(self) -> float:
        """Median width of cylinders with both edges measured [px]; infinite without any."""
        direction = self.pixels[:, 1] - self.pixels[:, 0]
        normal = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        middle = self.pixels.mean(axis=1)
        image = np.stack([self.view, self.pose, self.radius], axis=1)
        _, image_of_outline = np.unique(image, axis=0, return_inverse=True)
        order = np.argsort(image_of_outline, kind="stable")
        first, second = order[:-1], order[1:]
        is_pair = (image_of_outline[first] == image_of_outline[second]) & (
            self.epsilon[first] != self.epsilon[second]
        )
        distance = np.sum(normal[first] * (middle[second] - middle[first]), axis=1)
        return float(np.median(np.abs(distance[is_pair]))) if is_pair.any() else np.inf

    @property
    def on_arm(self) -> BoolArray:
        """Mask of the outlines of arms, (n,)."""
        return np.array([part in self.arms for part in self.parts], dtype=np.bool_)[self.radius]

    def __len__(self) -> int:
        return len(self.index)

    def at(self, which: IntArray) -> ObservedOutlines:
        """Select outlines by index, without biases."""
        bare = vars(self.without_biases())
        chosen = {name: bare[name][which] for name in _BY_OUTLINE}
        return replace(self, **chosen, memory=Memory())

    def without_biases(self) -> ObservedOutlines:
        """Remove the common-mode biases."""
        return replace(self, bias_index=self.bias_index[:, :0], bias_shift=self.bias_shift[:, :0])

    def with_parts_first(self, parts: Sequence[tuple[int, str]]) -> ObservedOutlines:
        """Renumber radii: these parts first, then the others."""
        together = tuple(dict.fromkeys((*parts, *self.parts)))
        number = np.array([together.index(part) for part in self.parts], dtype=np.intp)
        return replace(self, radius=number[self.radius], parts=together)

    def through(self, cameras: Sequence[Camera]) -> ObservedOutlines:
        """Project the same pixels onto the sensor planes of other cameras."""
        feet, lens = _through_lenses(cameras, self.view, self.pixels)
        return replace(self, feet=feet, lens=lens)

    def offsets(self, keys: tuple[str, ...], state: State) -> Array:
        """Return the distance of both ends from the predicted outline, (n, 2) [px]."""
        return self._corrected(self._predicted(keys, state)[0], state)

    def rows(self, keys: tuple[str, ...], state: State) -> Residuals:
        """Return the offsets with their derivatives."""
        r, slope, ends = self._predicted(keys, state)
        if self.bias_index.shape[1]:
            by_bias = -self.bias_shift.transpose(1, 2, 0)
            slope = np.concatenate([slope[:7], by_bias, slope[7:]])
        return Residuals(self._corrected(r, state), slope.T, ends.chain)

    def _corrected(self, r: Array, state: State) -> Array:
        """Subtract the common-mode biases from offsets (2, n); return (n, 2)."""
        if not self.bias_index.shape[1]:
            return r.T
        biases = state.biases[self.bias_index]
        return np.asarray(r.T - np.einsum("nc,ncq->nq", biases, self.bias_shift))

    def _predicted(self, keys: tuple[str, ...], state: State) -> tuple[Array, Array, _EndsInCamera]:
        """Return offsets (2, n) with biases, derivatives (7 + n_keys, 2, n), and leg ends."""

        def predicted() -> tuple[Array, Array, _EndsInCamera]:
            ends = _ends_in_camera(state, self.leg, self.view, self.pose, self.on_arm)
            points, lens = (self.feet, self.lens), self._lens
            if keys:
                points = _on_sensor(self, state.cameras)
                lens = _transposed_inverses(points[1])
            radius, xy = state.radii[self.radius], np.ascontiguousarray(points[0].T)
            r, slope, by_xy = outline_offsets(ends.A, ends.B, radius, self.epsilon, xy, lens)
            if keys:
                off = r, by_xy
                by_key = _distances_by_intrinsics(self, keys, state.cameras, points, lens, *off)
                slope = np.concatenate([slope, by_key])
            return r, slope, ends

        inputs = self.radius, self.feet, self.lens, self.epsilon
        poses = state.camera_pose, state.platform_pose
        prediction: tuple[Array, Array, _EndsInCamera] = self.memory.of(
            predicted, keys, *inputs, state.legs, state.radii, state.cameras, *poses
        )
        return prediction

    @cached_property
    def _lens(self) -> Array:
        """Inverse transposed derivatives of pixels by row, column and end, (2, 2, 2, n)."""
        return _transposed_inverses(self.lens)

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor, whitened by the claimed covariances."""
        own = ("radii", self.radius, _ONE), ("biases", self.bias_index, _ONE)
        touches = _touches_of_legs(self, *own)
        rows, whitening = partial(self.rows, keys), whitener(self.covariance)
        return Factor("outlines", rows, touches, len(self), 2, self.pose, whitening, robust=True)


_NAMES = [one.name for one in fields(ObservedOutlines)]
_BY_OUTLINE = _NAMES[: _NAMES.index("parts")]  # fields with a row for each outline


def observed_outlines(
    outlines: Outlines, measurements: Measurements, legs: FittedLegs
) -> ObservedOutlines:
    """Return the used outlines as arrays.

    Raises DatasetError if the covariance of an outline is not positive definite, its part does not
    exist in the mechanism, or outlines of a camera were measured with several gammas.
    """
    index = np.flatnonzero(outlines.used)
    row, leg = outlines.row[index], outlines.leg[index]
    view = measurements.view[row]
    keys = [(j, outlines.part[i]) for i, j in zip(index.tolist(), leg.tolist(), strict=True)]
    parts = tuple(sorted(set(keys)))
    covariance = outlines.covariance[index]
    cameras, by_gamma = _cameras_of(measurements), _by_gamma(outlines, measurements)[index]
    problems: list[str | Problem] = [
        *_mixed_gammas(by_gamma, outlines.gamma[index], view, cameras),
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
    order = np.lexsort((measurements.pose[row], view, leg))  # by leg and view
    index, row, leg, view = index[order], row[order], leg[order], view[order]
    covariance, by_gamma = covariance[order], by_gamma[order]
    n, numbers = len(index), {part: i for i, part in enumerate(parts)}
    radius = np.array([numbers[key] for key in keys], dtype=np.intp)[order]
    feet, pixels, lens = np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2, 2, 2))
    for v in np.unique(view):
        camera, of_view = measurements.views[v].camera, view == v
        h, xy = outlines.h[index[of_view], None], camera.undistort(outlines.ends[index[of_view]])
        normal = h[..., :2]
        value = np.sum(normal * xy, axis=-1, keepdims=True) + h[..., 2:]
        feet[of_view] = xy - normal * value / np.sum(normal**2, axis=-1, keepdims=True)
        lens[of_view] = camera.pixels_per_unit(feet[of_view])
        pixels[of_view] = camera.distort(feet[of_view])
    return ObservedOutlines(
        index,
        leg,
        view,
        measurements.pose[row],
        radius,
        feet,
        pixels,
        lens,
        EPSILON[outlines.edge[index] - 1],
        covariance,
        by_gamma,
        np.zeros((n, 0), dtype=np.intp),
        np.zeros((n, 0, 2)),
        parts,
        measurements.view_names,
        _series(measurements),
        cameras,
        legs.n_actuators > 0,
        frozenset((j, leg.arm.link) for j, leg in enumerate(legs.nominal) if leg.arm is not None),
        polished_parts(outlines),
    )


def _bad_covariances(
    covariance: Array, row: IntArray, leg: IntArray, measurements: Measurements, legs: FittedLegs
) -> list[Problem]:
    """Describe each covariance that is not positive definite."""
    s00, s01, s11 = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    good = (s00 > 0.0) & (s11 > 0.0) & (s00 * s11 > s01**2)
    return [
        Problem(
            f"The outline of {legs.names[leg[i]]} in "
            f"{measurements.image[row[i]] or f'row {row[i]}'} could not be used",
            "a covariance that is not positive definite "
            f"(s00 = {s00[i]:g}, s01 = {s01[i]:g}, s11 = {s11[i]:g} px^2)",
            remedy="correct it in the observations",
            code=Code.BAD_ROW,
        )
        for i in np.flatnonzero(~good)
    ]


def _series(measurements: Measurements) -> IntArray:
    """Return the representative view of each view, (n_views,)."""
    owners = measurements.owners
    images = np.bincount(measurements.view, minlength=len(owners))
    first: dict[str, int] = {}
    representative = [
        first.setdefault(owner, v) if n == 1 else v
        for v, (owner, n) in enumerate(zip(owners, images.tolist(), strict=True))
    ]
    return np.array(representative, dtype=np.intp)


def _cameras_of(measurements: Measurements) -> tuple[str, ...]:
    """Name of the representative view of each view's camera.

    A view with a given gamma represents itself: no gamma is estimated for it.
    """
    views = measurements.views
    unknown = [view for view in views if not view.camera.gamma_is_given]
    shared = shared_cameras([view.name for view in unknown], [view.camera for view in unknown])
    stands_for = dict(zip((view.name for view in unknown), shared, strict=True))
    return tuple(stands_for.get(view.name, view.name) for view in views)


def _by_gamma(outlines: Outlines, measurements: Measurements) -> Array:
    """Return the inward shift (n,) of outlines by ln gamma [px]; zero where gamma is given."""
    given = np.array([view.camera.gamma_is_given for view in measurements.views], dtype=np.bool_)
    unknown = ~given[measurements.view[outlines.row]] & np.isfinite(outlines.by_gamma)
    return np.where(unknown, outlines.by_gamma, 0.0)


def _through_lenses(
    cameras: Sequence[Camera], view: IntArray, pixels: Array
) -> tuple[Array, Array]:
    """Return points (n, ..., 2) on the sensor plane at pixels, and derivatives of pixels there."""
    xy, by_xy = np.zeros(pixels.shape), np.zeros((*pixels.shape, 2))
    for v in np.unique(view).tolist():
        of_view = view == v
        xy[of_view] = cameras[v].undistort(pixels[of_view])
        by_xy[of_view] = cameras[v].pixels_per_unit(xy[of_view])
    return xy, by_xy


def _transposed_inverses(J: Array) -> Array:
    """Return J^-T of matrices (n, ..., 2, 2) by row and column, (2, 2, ..., n)."""
    (a, b), (c, d) = np.moveaxis(J, (-2, -1), (0, 1))
    adjoint = np.stack([np.stack([d, -c]), np.stack([-b, a])]) / (a * d - b * c)
    return np.ascontiguousarray(np.moveaxis(adjoint, 2, -1))


def _mixed_gammas(moved: Array, gamma: Array, view: IntArray, cameras: Sequence[str]) -> list[str]:
    """Describe each camera whose outlines were measured with several gammas."""
    gammas_of: dict[str, set[float]] = {}
    moving = np.flatnonzero(moved)
    for value, v in zip(gamma[moving].tolist(), view[moving].tolist(), strict=True):
        gammas_of.setdefault(cameras[v], set()).add(value)
    return [
        f"The outlines of the camera of view {name} could not be used: they were measured with "
        f"different gammas, {min(values):g} and {max(values):g}; measure the images again, or "
        "write gamma of the view in dataset.yaml."
        for name, values in sorted(gammas_of.items())
        if max(values) / min(values) > 1.0 + _SAME_GAMMA
    ]


def known_gammas(outlines: Outlines, measurements: Measurements) -> dict[str, float]:
    """Return the gamma that used outlines were measured with, by view without a given gamma."""
    moved = outlines.used & (_by_gamma(outlines, measurements) != 0.0)
    cameras = _cameras_of(measurements)
    view = measurements.view[outlines.row[moved]].tolist()
    gamma_of = {
        cameras[v]: gamma for v, gamma in zip(view, outlines.gamma[moved].tolist(), strict=True)
    }
    named = zip(measurements.view_names, cameras, strict=True)
    return {name: gamma_of[camera] for name, camera in named if camera in gamma_of}


# ---------------------------------------------------------------------------------------- edges


@dataclass(frozen=True, eq=False)
class ObservedEdges:
    """The n straight edges of the bodies of legs in the fit.

    An edge parallel to the axis of a leg is a line to its vanishing point, wherever it is about the
    axis and however the body has turned about itself. A body leans by a constant vector in R_b, of
    which the component along the leg has no effect.
    """

    index: IntArray  # (n,) rows of the table of edges
    leg: IntArray  # (n,)
    view: IntArray  # (n,)
    pose: IntArray  # (n,)
    body: IntArray  # (n,) in ``bodies``
    feet: Array  # (n, 2, 2) both ends on the sensor plane
    pixels: Array  # (n, 2, 2) the same in the image [px]
    lens: Array  # (n, 2, 2, 2) derivatives of pixels at these points [px]
    # (n,) standard deviation of the offset of the second end from a line through the first [px]
    sigma: Array
    line: IntArray  # (n,) numbers of the lines of bodies that they are
    bodies: tuple[tuple[int, str], ...]  # leg index and link of each
    on_actuators: bool = False  # some joints at A move

    def __len__(self) -> int:
        return len(self.index)

    def rows(self, keys: tuple[str, ...], state: State) -> Residuals:
        """Return the offsets (n, 1) [px] of second ends with their derivatives."""
        arm = np.zeros(len(self), dtype=np.bool_)
        ends = _ends_in_camera(state, self.leg, self.view, self.pose, arm)
        D, lean = ends.B - ends.A, state.leans[self.body]
        length = np.sqrt(np.einsum("in,in->n", D, D))
        u = D / length
        along = u + np.einsum("ijn,nj->in", ends.R_camera, lean)
        points = _on_sensor(self, state.cameras) if keys else (self.feet, self.lens)
        lens = _transposed_inverses(points[1])
        r, by_along, by_xy = edge_offsets(along, points[0].T, lens[:, :, 1])
        by_B = (by_along - np.einsum("in,in->n", by_along, u) * u) / length
        by_lean = np.einsum("ijn,in->jn", ends.R_camera, by_along)
        slope = np.concatenate([-by_B, by_B, by_lean])
        if keys:  # the line begins at the first end, as it was measured
            off = np.stack([np.zeros_like(r), r]), by_xy
            by_key = _distances_by_intrinsics(self, keys, state.cameras, points, lens, *off)
            slope = np.concatenate([slope, by_key.sum(axis=1)])

        def chain(slope: Array) -> tuple[Array, Array]:
            kept, by_pose = ends.chain(slope)
            # The lean is fixed in R_b: a rotation of the camera turns it as well.
            by_rotation = cross(lean[:, None], slope[..., 6:9])
            kept[..., 6:9] += np.einsum("ijn,nqj->nqi", ends.R_camera, by_rotation)
            return kept, by_pose

        return Residuals(r[:, None], slope[:, None].T, chain)

    def lines_in_views(self, used: BoolArray) -> Array:
        """Return the columns (n, 1, c) of the lines of bodies in each view, of some edges (n,)."""
        key = np.stack([self.view, self.body, self.line], axis=1)
        _, line = np.unique(key, axis=0, return_inverse=True)
        return np.array((line[:, None] == np.unique(line[used])) & used[:, None], float)[:, None]

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor."""
        touches = _touches_of_legs(self, ("leans", self.body, _ALL))
        rows, whitening = partial(self.rows, keys), 1.0 / self.sigma[:, None, None]
        return Factor("edges", rows, touches, len(self), 1, self.pose, whitening, robust=True)


def _touches_of_legs(seen: ObservedOutlines | ObservedEdges, *own: Touch) -> tuple[Touch, ...]:
    """Return what measurements of legs in images depend on; *own* stand before the intrinsics."""
    ends: tuple[Touch, ...] = ("legs", seen.leg, _SIX), ("camera_pose", seen.view, _ALL)
    touches = (*ends, *own, ("cameras", seen.view, _ALL))
    return (*touches, ("legs", seen.leg, _OF_ACTUATOR)) if seen.on_actuators else touches


def observed_edges(
    edges: Outlines | None,
    measurements: Measurements,
    legs: FittedLegs,
    cameras: Sequence[Camera],
) -> ObservedEdges:
    """Return the used edges of bodies as arrays.

    Raises DatasetError if the covariance of an edge is not positive definite.
    """
    edges = no_outlines() if edges is None else edges
    index = np.flatnonzero(edges.used)
    row, leg = edges.row[index], edges.leg[index]
    pixels, covariance = edges.ends[index], edges.covariance[index]
    problems = _bad_covariances(covariance, row, leg, measurements, legs)
    if problems:
        raise DatasetError(problems)
    keys = [(j, edges.part[i]) for i, j in zip(index.tolist(), leg.tolist(), strict=True)]
    bodies = tuple(sorted(set(keys)))
    body = np.array([bodies.index(key) for key in keys], dtype=np.intp)
    view = measurements.view[row]
    feet, lens = _through_lenses(cameras, view, pixels)
    difference = np.array([-1.0, 1.0])
    variance = np.einsum("i,nij,j->n", difference, covariance, difference)
    return ObservedEdges(
        index,
        leg,
        view,
        measurements.pose[row],
        body,
        feet,
        pixels,
        lens,
        np.sqrt(variance),
        edges.edge[index],
        bodies,
        legs.n_actuators > 0,
    )


# ------------------------------------------------------------------------------------- readings


@dataclass(frozen=True, eq=False)
class Readings:
    """The n encoder readings of the fit, of legs that change their length and of actuators."""

    leg: IntArray  # (n,) indices; for an actuator the first rod on it
    actuator: IntArray  # (n,) indices; -1 for a leg that changes its length
    pose: IntArray  # (n,) indices
    sign: Array  # (n,) sign of the reading in the length of the leg, 1 for actuators
    # (n,) sign * q: the leg length without its offset [m], or the actuator's reading [m or rad]
    length: Array
    sigma: Array  # (n,) standard deviations [m or rad]
    by_zero: Array  # (n, n_own_zeros) derivative of residuals by the zeros of some images
    n_legs: int  # of the mechanism
    memory: Memory = field(default_factory=Memory, repr=False)

    def __len__(self) -> int:
        return len(self.leg)

    @property
    def reading(self) -> Array:
        """The readings (n,) [m or rad]."""
        return self.sign * self.length

    def rows(self, state: State) -> Residuals:
        """Return predicted minus measured readings, (n, 1) [m or rad], with their derivatives.

        Of legs, |AB| - sign q - q0; of readings q less the zeros of some images.
        """
        inputs = state.legs, state.platform_pose, state.own_zeros
        rows: Residuals = self.memory.of(lambda: self._rows(state), *inputs)
        return rows

    def _rows(self, state: State) -> Residuals:
        arm, end = (table[:, self._end] for table in state.ends_at_poses)
        R_pose = _by_measurement(state.platform_pose.R, self.pose)
        along, of_leg = end - state.A.T[:, self.leg], self.actuator < 0
        length = np.sqrt(np.einsum("in,in->n", along, along))
        q, moving = state.platform_pose.q, np.flatnonzero(~of_leg)
        n_q, n_kept = q.shape[1], 7 + len(state.own_zeros)
        slope = np.zeros((n_kept + n_q, 1, len(self)))
        np.divide(along, length, out=slope[3:6, 0], where=of_leg)
        slope[:3], slope[6], slope[7:n_kept, 0] = -slope[3:6], -1.0 * of_leg, self.by_zero.T
        slope[n_kept + self.actuator[moving], 0, moving] = 1.0

        def chain(slope: Array) -> tuple[Array, Array]:
            by_length = slope.T
            b, J = by_length[3:6], np.zeros((n_kept + 6 + n_q, *by_length.shape[1:]))
            J[:3], J[6:n_kept], J[n_kept + 3 : n_kept + 6] = by_length[:3], by_length[6:n_kept], b
            np.einsum("jin,jqn->iqn", R_pose, b, out=J[3:6])
            J[n_kept : n_kept + 3] = _cross(arm[:, None], b)
            J[n_kept + 6 :] = by_length[n_kept:]
            return J[:n_kept].T, J[n_kept:].T

        predicted = length - state.lengths[self.leg]
        predicted[moving] = q[self.pose[moving], self.actuator[moving]]
        r = predicted - self.length + self.by_zero @ state.own_zeros
        return Residuals(r[:, None], slope.T, chain)

    @cached_property
    def _end(self) -> IntArray:
        return self.pose * self.n_legs + self.leg

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor; readings do not depend on intrinsics."""
        del keys
        zeros = np.tile(np.arange(self.by_zero.shape[1], dtype=np.intp), (len(self), 1))
        touches = (("legs", self.leg, slice(0, 7)), ("own_zeros", zeros, _ONE))
        whitening = 1.0 / self.sigma[:, None, None]
        return Factor("readings", self.rows, touches, len(self), 1, self.pose, whitening)


def observed_readings(measurements: Measurements, legs: FittedLegs) -> Readings:
    """Return the readings, one for each motor and platform pose.

    Images of a pose share the reading of the first row.
    """
    on, q = np.array(actuator_index(legs.nominal)), measurements.q_of_poses
    first = first_rods(legs.nominal)
    is_read = [leg.kind is LegKind.ACTUATED or j in first for j, leg in enumerate(legs.nominal)]
    leg, pose = np.nonzero((np.isfinite(q) & is_read).T)
    sign = np.where(on < 0, legs.sign, 1)[leg].astype(np.float64)
    sigma = measurements.sigma_q[leg]
    motors = np.array([nominal.motor_label for nominal in legs.nominal], dtype=object)
    own = measurements.own_zeros
    has = [(motors == one.motor)[leg] & one.rows[measurements.first_rows][pose] for one in own]
    by_zero = sign[:, None] * np.array(has, dtype=np.float64).reshape(len(own), len(leg)).T
    length = sign * q[pose, leg]
    return Readings(leg, on[leg], pose, sign, length, sigma, by_zero, legs.n_legs)


@dataclass(frozen=True, eq=False)
class MeasuredLengths:
    """The n hand-measured distances between joints."""

    leg: IntArray  # (n, 2) the legs of both joints
    is_base: BoolArray  # (n,) joints on the base, at reading 0; else on the platform
    length: Array  # (n,) [m]
    sigma: Array  # (n,) standard deviations [m]

    def __len__(self) -> int:
        return len(self.length)

    def rows(self, state: State) -> Residuals:
        """Return predicted minus measured distances (n, 1) [m] with their derivatives."""
        points = np.where(self.is_base[:, None, None], state.A[self.leg], state.B[self.leg])
        vector = points[:, 0] - points[:, 1]
        distance = np.linalg.norm(vector, axis=1)
        u, J = vector / distance[:, None], np.zeros((len(self), 1, 2, 2, 3))
        row = np.arange(len(self))
        side = np.where(self.is_base, 0, 1)
        J[row, 0, 0, side], J[row, 0, 1, side] = u, -u
        return Residuals.of((distance - self.length)[:, None], J.reshape(len(self), 1, 12))

    def factor(self) -> Factor[State]:
        """Return the factor."""
        touches = (("legs", self.leg[:, 0], _SIX), ("legs", self.leg[:, 1], _SIX))
        whitening = 1.0 / self.sigma[:, None, None]
        return Factor("lengths", self.rows, touches, len(self), 1, None, whitening)


def measured_lengths(names: Sequence[str], choices: Choices) -> MeasuredLengths:
    """Return the stated distances between joints; *names* are the legs."""
    stated = [
        (joints, prior)
        for name, prior in sorted(choices.priors.items())
        if (joints := joints_of_length(name)) is not None
    ]
    legs = [[names.index(leg) for leg, _ in joints] for joints, _ in stated]
    return MeasuredLengths(
        np.array(legs, dtype=np.intp).reshape(-1, 2),
        np.array([joints[0][1] == "base" for joints, _ in stated], dtype=np.bool_),
        np.array([prior.mean for _, prior in stated]),
        np.array([prior.sigma for _, prior in stated]),
    )


# -------------------------------------------------------------------------------------- corners


@dataclass(frozen=True, eq=False)
class BoardCorners:
    """Calibration boards on base and platform, and their corners in images."""

    boards: tuple[FixedBoard, ...]  # corner points in board frames
    corners: Corners  # measured corners; only the used ones enter


@dataclass(frozen=True, eq=False)
class ObservedCorners:
    """The n corners of a board in the fit."""

    link: Link  # that the board is fixed to
    view: IntArray  # (n,) index of the view
    pose: IntArray  # (n,) index of the platform pose; -1 for the board on the base
    corner: IntArray  # (n,) number of the corner
    point: Array  # (n, 3) the corners in the frame of the board [m]
    feet: Array  # (n, 2) measured corners on the sensor plane
    pixels: Array  # (n, 2) measured corners in the image [px]
    lens: Array  # (n, 2, 2) derivative of pixels at these points [px]
    sigma: Array  # (n,) standard deviation of both coordinates [px]

    def __len__(self) -> int:
        return len(self.view)

    def chosen(self, which: BoolArray, scale: float = 1.0) -> ObservedCorners:
        """Select corners, and scale their standard deviations."""
        shown = [f.name for f in fields(self) if f.name != "link"]
        chosen = replace(self, **{name: getattr(self, name)[which] for name in shown})
        return replace(chosen, sigma=scale * chosen.sigma)

    @property
    def name(self) -> str:
        """Name of the factor."""
        return "corners" if self.link == "base" else f"{self.link}_corners"

    def keys(self, which: BoolArray) -> list[tuple[int, int, int]]:
        """Return view, pose and number of selected corners."""
        columns = (column[which].tolist() for column in (self.view, self.pose, self.corner))
        return list(zip(*columns, strict=True))

    def rows(self, keys: tuple[str, ...], state: State) -> Residuals:
        """Return predicted minus measured corners (n, 2) [px] with their derivatives."""
        R_camera, board = state.camera_pose.R[self.view], LINKS.index(self.link)
        moves = self.link == "platform"
        arm = self.point @ state.board_pose.R[board].T
        scaled_arm = state.board_scale[board] * arm
        on_link = in_base_frame = scaled_arm + state.board_pose.t[board]
        if moves:
            R_link = state.platform_pose.R[self.pose]
            turned_on_link = _matvec(R_link, on_link)
            in_base_frame = turned_on_link + state.platform_pose.t[self.pose]
        turned = _matvec(R_camera, in_base_frame)
        xy, lens = _on_sensor(self, state.cameras) if keys else (self.feet, self.lens)
        in_camera = turned + state.camera_pose.t[self.view]
        depth = in_camera[:, 2:]
        projected = in_camera[:, :2] / depth
        by_projected = lens / depth[:, None]
        by_depth = -by_projected @ projected[..., None]
        r = (lens @ (projected - xy)[..., None])[..., 0]
        by_intrinsics = _pixels_by_intrinsics(self, keys, state.cameras, xy, lens, xy - projected)
        slope = np.concatenate([by_projected, by_depth, by_intrinsics], axis=-1)

        def chain(slope: Array) -> tuple[Array, Array]:
            in_camera = slope[..., :3]
            in_base = in_camera @ R_camera
            in_link, by_pose = in_base, np.zeros((*slope.shape[:2], 0))
            if moves:
                in_link = in_base @ R_link
                by_rotation = cross(turned_on_link[:, None], in_base)
                by_q = np.zeros((*slope.shape[:2], state.platform_pose.q.shape[1]))
                by_pose = np.concatenate([by_rotation, in_base, by_q], axis=-1)
            J = [
                cross(turned[:, None], in_camera),
                in_camera,
                cross(scaled_arm[:, None], in_link),
                in_link,
                in_link @ arm[..., None],
                slope[..., 3:],
            ]
            return np.concatenate(J, axis=-1), by_pose

        return Residuals(r, slope, chain)

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor; a board on the platform depends on its poses."""
        board = np.full(len(self), LINKS.index(self.link), dtype=np.intp)
        element = self.pose if self.link == "platform" else None
        touches = (
            ("camera_pose", self.view, _ALL),
            ("board_pose", board, _ALL),
            ("board_scale", board, _ALL),
            ("cameras", self.view, _ALL),
        )
        rows, whitening = partial(self.rows, keys), 1.0 / self.sigma[:, None, None]
        return Factor(self.name, rows, touches, len(self), 2, element, whitening, robust=True)


def observed_corners(
    seen: BoardCorners | None, measurements: Measurements, cameras: Sequence[Camera]
) -> tuple[ObservedCorners, ...]:
    """Return the used corners of the board on each link, as arrays.

    A corner is averaged over the images of a view; on the platform, over those of a view and pose.
    """
    boards = {} if seen is None else {fixed.link: fixed for fixed in seen.boards}
    return tuple(_corners_on(link, boards.get(link), seen, measurements, cameras) for link in LINKS)


def _corners_on(
    link: Link,
    fixed: FixedBoard | None,
    seen: BoardCorners | None,
    measurements: Measurements,
    cameras: Sequence[Camera],
) -> ObservedCorners:
    """Return the used corners of the board on a link."""
    if seen is None or fixed is None:
        none, index = np.zeros(0), np.zeros(0, dtype=np.intp)
        pair = none.reshape(0, 2)
        return ObservedCorners(
            link, index, index, index, none.reshape(0, 3), pair, pair, none.reshape(0, 2, 2), none
        )
    corners = seen.corners
    used = np.flatnonzero(corners.used & fixed.has(corners.corner))
    row = corners.row[used]
    moving = measurements.pose[row] if link == "platform" else np.full(len(row), -1)
    key = np.stack([measurements.view[row], moving, corners.corner[used]], axis=1)
    unique_keys, which = np.unique(key, axis=0, return_inverse=True)
    which = which.ravel()
    weight = corners.sigma_px[used] ** -2.0
    total = np.bincount(which, weights=weight)
    pixels = np.stack(
        [np.bincount(which, weights=weight * corners.px[used, i]) / total for i in range(2)], axis=1
    )
    view, pose, corner = unique_keys.T.astype(np.intp)
    feet, lens = _through_lenses(cameras, view, pixels)
    point, sigma = fixed.board.points[corner - fixed.first], 1.0 / np.sqrt(total)
    return ObservedCorners(link, view, pose, corner, point, feet, pixels, lens, sigma)


# ------------------------------------------------------------------------------------ residuals


def outline_offsets(
    A: Array, B: Array, radius: Array, epsilon: Array, xy: Array, lens: Array
) -> tuple[Array, Array, Array]:
    """Return the signed distances of points from predicted outlines of legs, and derivatives.

    With n = A x B and D = B - A, the outline of the cylinder about AB seen from the origin, eqs (1)
    and (3), is h = epsilon r (D x n) - n sqrt(|n|^2 - |D|^2 r^2) up to scale. The distance is
    h . (x, y, 1) / |J^-T (h1, h2)|, as in :meth:`legcal.vision.camera.Camera.line_offset` for a
    constant derivative J of the lens.

    Parameters
    ----------
    A, B : (3, n) array
        Both ends in the camera frame [m].
    radius, epsilon : (n,) array
        Radii [m], and +1 or -1 of eq (5).
    xy : (2, 2, n) array
        Both points on the sensor plane, by coordinate and point.
    lens : (2, 2, 2, n) array
        J^-T at these points [1/px], by row, column and point.

    Returns
    -------
    offset : (2, n) array
        Distance of both points [px]; NaN where the origin is inside the cylinder.
    by_leg : (7, 2, n) array
        Derivatives by A, B and radius.
    by_xy : (2, 2, n) array
        Derivatives by the coordinates of the point.
    """
    D, n = B - A, _cross(A, B)
    squared = np.einsum("in,in->n", D, D)
    across, signed = _cross(D, n), epsilon * radius
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = np.sqrt(np.einsum("in,in->n", n, n) - radius * radius * squared)
        h = signed * across - depth * n
        normal = np.einsum("ijen,jn->ien", lens, h[:2])
        size = np.sqrt(np.einsum("ien,ien->en", normal, normal))
        offset = (h[0] * xy[0] + h[1] * xy[1] + h[2]) / size
        by_h = np.empty((3, *offset.shape))
        np.divide(1.0, size, out=by_h[2])
        by_xy = h[:2, None] * by_h[2]
        turned = np.einsum("ijen,ien->jen", lens, normal)
        by_h[:2] = (xy - (offset * by_h[2]) * turned) * by_h[2]
        along = np.einsum("ien,in->en", by_h, n) / depth
    n, D = n[:, None], D[:, None]
    by_n = signed * _cross(by_h, D) - depth * by_h - along * n
    by_D = signed * _cross(n, by_h) + (along * (radius * radius)) * D
    by_leg = np.empty((7, *offset.shape))
    np.subtract(_cross(B[:, None], by_n), by_D, out=by_leg[:3])
    np.add(_cross(by_n, A[:, None]), by_D, out=by_leg[3:6])
    np.einsum("ien,in->en", by_h, epsilon * across, out=by_leg[6])
    by_leg[6] += along * (radius * squared)
    return offset, by_leg, by_xy


def edge_offsets(along: Array, xy: Array, lens: Array) -> tuple[Array, Array, Array]:
    """Return the distances of points from lines to vanishing points, and derivatives.

    The line through the first point and the vanishing point of a direction D is h = (x0, 1) x D;
    the distance of the second point is h . (x1, 1) / |J^-T (h1, h2)|.

    Parameters
    ----------
    along : (3, n) array
        D in the camera frame, of any length.
    xy : (2, 2, n) array
        Both points on the sensor plane, by coordinate and point.
    lens : (2, 2, n) array
        J^-T at the second point [1/px].

    Returns
    -------
    offset : (n,) array
        Distances [px].
    by_along : (3, n) array
        Derivatives by D.
    by_xy : (2, 2, n) array
        Derivatives by the coordinates of the points.
    """
    first, second = (np.concatenate([xy[:, k], np.ones((1, xy.shape[2]))]) for k in (0, 1))
    h = _cross(first, along)
    normal = np.einsum("ijn,jn->in", lens, h[:2])
    size = np.sqrt(np.einsum("in,in->n", normal, normal))
    offset = np.einsum("in,in->n", h, second) / size
    by_h = second / size
    by_h[:2] -= (offset / size**2) * np.einsum("ijn,in->jn", lens, normal)
    by_xy = np.stack([_cross(along, by_h)[:2], h[:2] / size], axis=1)
    return offset, _cross(by_h, first), by_xy


# ----------------------------------------------------------------------------------- chain rule


def _on_sensor(
    seen: ObservedOutlines | ObservedEdges | ObservedCorners, cameras: Sequence[Camera]
) -> tuple[Array, Array]:
    """Return measured points on the sensor planes of cameras, and derivatives of their pixels.

    These are at the points of the camera files, which do not move with the cameras.
    """
    xy, lens = seen.feet.copy(), seen.lens.copy()
    for v in np.unique(seen.view).tolist():
        of_view = seen.view == v
        xy[of_view] = undistort_near(cameras[v], seen.pixels[of_view], seen.feet[of_view])
        lens[of_view] = pixel_derivatives(cameras[v], seen.feet[of_view], ())[0]
    return xy, lens


def _pixels_by_intrinsics(
    seen: ObservedOutlines | ObservedEdges | ObservedCorners,
    keys: tuple[str, ...],
    cameras: Sequence[Camera],
    xy: Array,
    lens: Array,
    off: Array,
) -> Array:
    """Return derivatives (n, ..., 2, n_keys) of pixels where measured points should be.

    Measured points xy (n, ..., 2) are *off* from there; *lens* are the derivatives of their pixels
    (:func:`_on_sensor`). An intrinsic moves what is predicted by what it moves xy, less what it
    changes of the distance: a longer focal length would shrink distances otherwise, so that noise
    alone would lengthen it.
    """
    moved = np.zeros((*xy.shape, len(keys)))
    for v in np.unique(seen.view).tolist() if keys else ():
        of_view, camera = seen.view == v, cameras[v]
        present = [k for k, key in enumerate(keys) if key in intrinsic_names(camera)]
        names, step = [keys[k] for k in present], _PART_OF_DISTANCE * off[of_view]
        by_xy, by_intrinsics = pixel_derivatives(camera, xy[of_view], names)
        beyond, before = (
            pixel_derivatives(camera, seen.feet[of_view] + x, names)[1] for x in (step, -step)
        )
        of_distance = (beyond - before) / (2.0 * _PART_OF_DISTANCE)
        of_names = np.zeros((*xy[of_view].shape, len(keys)))
        of_names[..., present] = lens[of_view] @ np.linalg.solve(by_xy, by_intrinsics) - of_distance
        moved[of_view] = of_names
    return moved


def _distances_by_intrinsics(
    seen: ObservedOutlines | ObservedEdges,
    keys: tuple[str, ...],
    cameras: Sequence[Camera],
    points: tuple[Array, Array],
    inverse: Array,
    r: Array,
    by_xy: Array,
) -> Array:
    """Return derivatives (n_keys, 2, n) of distances of points from lines by intrinsics.

    *points* are those of :func:`_on_sensor`, *inverse* are J^-T there (2, 2, 2, n), *r* (2, n) the
    distances [px] of both, *by_xy* (2, 2, n) their derivatives by the coordinates of the points.
    """
    normal = np.einsum("ijen,jen->ien", inverse, by_xy)
    off = r * np.einsum("ijen,ien->jen", inverse, normal)
    moved = _pixels_by_intrinsics(seen, keys, cameras, *points, off.T)
    return np.asarray(-np.einsum("ien,neik->ken", normal, moved))


@dataclass(frozen=True, eq=False)
class _EndsInCamera:
    """Both ends of legs in the camera frame, with the terms of the chain rule."""

    A: Array  # (3, n) in the camera frame
    B: Array
    A_turned: Array  # (3, n) R_camera A, without the translation
    B_turned: Array
    arm: Array  # (3, n) from the origin of R_e to B, in R_b
    R_camera: Array  # (3, 3, n)
    R_pose: Array
    moved: _JointMotions | None  # None where no joint at A moves

    def chain(self, slope: Array) -> tuple[Array, Array]:
        """Chain slopes by both ends to derivatives by kept variables and by the pose.

        *slope* (n, q, l) has six columns for the ends, then radius, biases and intrinsics. The
        derivatives by kept variables are A, B, camera, these, and the numbers of actuators.
        """
        by_ends, moved = slope.T, self.moved
        n_numbers, n_q = (0, 0) if moved is None else (ActuatorColumns.COUNT, moved.by_q.shape[1])
        by_A, by_B, n_leg_columns = by_ends[:3], by_ends[3:6], 6 + len(by_ends)
        m = n_leg_columns + n_numbers
        J = np.empty((m + 6 + n_q, *by_ends.shape[1:]))
        b = J[m + 3 : m + 6]
        np.einsum("jin,jqn->iqn", self.R_camera, by_A, out=J[:3])
        if moved is not None:
            a = J[:3].copy()
            np.einsum("jin,jqn->iqn", moved.by_A, a, out=J[:3])
            np.einsum("jin,jqn->iqn", moved.by_numbers, a, out=J[n_leg_columns:m])
            np.einsum("jin,jqn->iqn", moved.by_q, a, out=J[m + 6 :])
        np.einsum("jin,jqn->iqn", self.R_camera, by_B, out=b)
        if moved is not None and len(moved.arms):
            of_arms = b[:, :, moved.arms]
            J[n_leg_columns:m, :, moved.arms] += np.einsum(
                "jin,jqn->iqn", moved.far_numbers, of_arms
            )
            J[m + 6 :, :, moved.arms] += np.einsum("jin,jqn->iqn", moved.far_q, of_arms)
            b[:, :, moved.arms] = 0.0  # arms do not depend on the platform
        np.einsum("jin,jqn->iqn", self.R_pose, b, out=J[3:6])
        J[6:9] = _cross(self.A_turned[:, None], by_A)
        J[6:9] += _cross(self.B_turned[:, None], by_B)
        np.add(by_A, by_B, out=J[9:12])
        J[12:n_leg_columns] = by_ends[6:]
        J[m : m + 3] = _cross(self.arm[:, None], b)
        return J[:m].T, J[m:].T


@dataclass(frozen=True, eq=False)
class _JointMotions:
    """Derivatives of the joints at A by numbers of actuators and by readings.

    For an arm, they are of its near end, and ``far_*`` of its far end.
    """

    by_A: Array  # (3, 3, n) by A at reading 0
    by_numbers: Array  # (3, 9, n) by the numbers of the actuator
    by_q: Array  # (3, n_actuators, n)
    arms: IntArray  # (m,) the measurements of arms
    far_numbers: Array  # (3, 9, m)
    far_q: Array  # (3, n_actuators, m)


def _joint_motion(
    state: State, leg: IntArray, pose: IntArray, arm: BoolArray
) -> _JointMotions | None:
    """Return derivatives of the joints at A of legs at poses; None without actuators.

    Where *arm* is true, they are of both ends of the arm instead.
    """
    n_poses, n_q = state.platform_pose.q.shape
    if not n_q:
        return None
    shape = len(state.legs), n_poses
    by_A = np.broadcast_to(np.eye(3), (*shape, 3, 3)).copy()
    ends = np.zeros((3, *shape, 3, ActuatorColumns.COUNT)), np.zeros((3, *shape, 3, n_q))
    on = actuator_index(state.legs)
    for j, motion in state.actuated.items():
        by_A[j] = motion.by_A
        _write_motion(motion, on[j], *(table[0, j] for table in ends))
    for j, motions in state.arm_ends.items():
        carried = state.legs[j].arm
        slopes = np.zeros((0, 3, 4)) if carried is None else carried.ends_slope()
        for end, (motion, slope) in enumerate(zip(motions, slopes, strict=True), start=1):
            _write_motion(motion, on[j], *(table[end, j] for table in ends))
            ends[0][end, j, :, :, 5:] = motion.by_A @ slope
    by_numbers, by_q = (table[arm.astype(np.intp), leg, pose] for table in ends)
    arms = np.flatnonzero(arm)
    far_numbers, far_q = (table[2, leg[arms], pose[arms]] for table in ends)
    return _JointMotions(
        _measurement_last(np.where(arm[:, None, None], 0.0, by_A[leg, pose])),
        _measurement_last(by_numbers),
        _measurement_last(by_q),
        arms,
        _measurement_last(far_numbers),
        _measurement_last(far_q),
    )


def _write_motion(motion: JointMotion, actuator: int, by_numbers: Array, by_q: Array) -> None:
    """Write the derivatives of a point into (n_poses, 3, 9) and (n_poses, 3, n_q)."""
    by_numbers[:, :, :2], by_numbers[:, :, 2:4] = motion.by_axis, motion.by_point
    by_numbers[:, :, 4], by_q[:, :, actuator] = motion.by_gain, motion.by_q


def _measurement_last(table: Array) -> Array:
    """Move the first axis of a table (n, ...) to the end."""
    return np.ascontiguousarray(np.moveaxis(table, 0, -1))


def _ends_in_camera(
    state: State, leg: IntArray, view: IntArray, pose: IntArray, arm: BoolArray
) -> _EndsInCamera:
    """Both ends of legs in the camera frames of views, at poses.

    Where *arm* is true, the ends of the arm take the place of A and B.
    """
    n_legs = len(state.A)
    R_camera, t = _by_measurement(state.camera_pose.R, view), state.camera_pose.t.T[:, view]
    moved = _joint_motion(state, leg, pose, arm)
    to_B, end = (table[:, pose * n_legs + leg] for table in state.ends_at_poses)
    if moved is None:
        of_views = (state.camera_pose.R.transpose(1, 0, 2) @ state.A.T).reshape(3, -1)
        A = of_views[:, view * n_legs + leg]
    else:
        near = state.A_at_poses[pose, leg]
        for j, motions in state.arm_ends.items():
            of_arm = np.flatnonzero(arm & (leg == j))
            near[of_arm], far = (motion.A[pose[of_arm]] for motion in motions)
            end[:, of_arm] = far.T
        A = np.einsum("ijn,nj->in", R_camera, near)
    B = np.einsum("ijn,jn->in", R_camera, end)
    R_pose = _by_measurement(state.platform_pose.R, pose)
    return _EndsInCamera(A + t, B + t, A, B, to_B, R_camera, R_pose, moved)


def _by_measurement(R: Array, which: IntArray) -> Array:
    """Gather matrices (k, 3, 3) by measurement, (3, 3, n)."""
    return np.ascontiguousarray(R.transpose(1, 2, 0))[..., which]


def _cross(a: Array, b: Array) -> Array:
    """Vector product along the first axis."""
    product = np.empty((3, *np.broadcast(a[0], b[0]).shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[j], b[k], out=product[i])
        product[i] -= a[k] * b[j]
    return product


def _matvec(R: Array, v: Array) -> Array:
    """Product R v of rows, (n, 3)."""
    return np.asarray((R @ v[..., None])[..., 0])
