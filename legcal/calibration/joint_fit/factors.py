"""Measurements and their factors: outlines, readings, axes, and corners of calibration boards.

Each kind is a class of arrays, one row a measurement, with the ``Factor``
that it is in the fit; :class:`Observed` registers the kinds. A measurement in an image depends on
both ends of a leg in the camera frame; these depend on joints, camera and platform pose. Ends of an
arm stand in their place where that is seen, and depend on its motor. Rotations change by Cayley's
map from the left: a camera turns in its own frame, a platform about the origin of R_e in the
directions of R_b. Residuals are written with their derivatives, which go backwards
from each to the ends of the leg and on to the variables. Where there are many measurements, as of
outlines and readings, arrays have these last: NumPy then works along them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from legcal.calibration.joint_fit.parameter_choices import Choices, joints_of_length
from legcal.calibration.joint_fit.variables import FittedLegs, State
from legcal.data.axes import LegAxes, join_axes
from legcal.data.corners import Corners
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.errors import DatasetError
from legcal.estimation.problem import Factor, Residuals, Touch
from legcal.geometry.covariances import whitener
from legcal.geometry.lines import cross
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import ActuatorColumns, JointMotion
from legcal.machine.leg import LegColumns, LegKind
from legcal.machine.rods import actuator_index
from legcal.vision.board import LINKS, FixedBoard, Link
from legcal.vision.camera import Camera, intrinsic_names, shared_cameras, undistort_with_derivatives
from legcal.vision.cylinder import EPSILON

_SAME_GAMMA = 1e-6  # relative difference of gammas that count as one
_SIX, _ALL, _ONE = slice(0, 6), slice(None), slice(0, 1)
_OF_ACTUATOR = LegColumns.ACTUATOR


class Observed(NamedTuple):
    """All measurements of a fit, by kind; each kind is one factor."""

    outlines: ObservedOutlines
    readings: Readings
    actuator_readings: ActuatorReadings
    axes: ObservedAxes
    corners: ObservedCorners  # of the board on the base
    platform_corners: ObservedCorners

    def factors(self, keys: tuple[str, ...]) -> tuple[Factor[State], ...]:
        """Return the factor of each kind; *keys* are the intrinsics that may be unknown."""
        return tuple(kind.factor(keys) for kind in self)

    @property
    def views(self) -> IntArray:
        """The views that show anything."""
        seen = (self.outlines, self.axes, self.corners, self.platform_corners)
        return np.unique(np.concatenate([kind.view for kind in seen]))

    @property
    def boards(self) -> tuple[ObservedCorners, ...]:
        """The corners of each board, in the order of the links."""
        return self.corners, self.platform_corners

    def with_corners(self, corners: ObservedCorners) -> Observed:
        """Return the same with other corners of the board on their link."""
        if corners.link == "base":
            return self._replace(corners=corners)
        return self._replace(platform_corners=corners)


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
        observed_actuator_readings(measurements, legs),
        observed_axes(axes, measurements, legs),
        *observed_corners(board, measurements, given if cameras is None else cameras),
    )


class Memory:
    """The last result of a function, as long as the same objects go into it."""

    def __init__(self) -> None:
        self._last: tuple[tuple[object, ...], Any] | None = None

    def __reduce__(self) -> tuple[type[Memory], tuple[()]]:
        return Memory, ()

    def of(self, compute: Callable[[], Any], *inputs: object) -> Any:
        """Return what a function of these objects returns; it is called if one is another."""
        last = self._last
        if last is not None and all(a is b for a, b in zip(last[0], inputs, strict=True)):
            return last[1]
        found = compute()
        self._last = inputs, found
        return found


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
    on_actuators: bool = False  # whether some joints at A move
    arms: frozenset[tuple[int, str]] = frozenset()  # which parts of the machine are arms
    memory: Memory = field(default_factory=Memory, repr=False)  # of the predicted offsets

    @property
    def width_px(self) -> float:
        """Median width of the cylinders both of whose edges are seen; infinite without any [px]."""
        across = self.pixels[:, 1] - self.pixels[:, 0]
        normal = np.stack([-across[:, 1], across[:, 0]], axis=1)
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        middle = self.pixels.mean(axis=1)
        image = np.stack([self.view, self.pose, self.radius], axis=1)
        _, of = np.unique(image, axis=0, return_inverse=True)
        order = np.argsort(of, kind="stable")
        first, second = order[:-1], order[1:]
        is_pair = (of[first] == of[second]) & (self.epsilon[first] != self.epsilon[second])
        away = np.sum(normal[first] * (middle[second] - middle[first]), axis=1)
        return float(np.median(np.abs(away[is_pair]))) if is_pair.any() else np.inf

    @property
    def on_arm(self) -> BoolArray:
        """Whether each is of an arm, and not along its leg, (n,)."""
        return np.array([part in self.arms for part in self.parts], dtype=np.bool_)[self.radius]

    @property
    def epsilon(self) -> Array:
        """+1 or -1 of eq (5), (n,)."""
        return np.asarray(self.constants[:, 8])

    def __len__(self) -> int:
        return len(self.index)

    def at(self, which: IntArray) -> ObservedOutlines:
        """Return some of the outlines, by index, without biases."""
        bare = self.without_biases()
        shared = ("parts", "views", "series", "cameras", "on_actuators", "arms", "memory")
        chosen = {
            f.name: getattr(bare, f.name)[which] for f in fields(self) if f.name not in shared
        }
        return replace(self, **chosen, memory=Memory())

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
            lens = _inverses(cameras[v].pixels_per_unit(feet[of_view]))
            constants[of_view, :8] = lens.reshape(-1, 8)
        return replace(self, feet=feet, constants=constants)

    def offsets(self, keys: tuple[str, ...], state: State) -> Array:
        """Return how far both ends are from the predicted outline, (n, 2) [px]."""
        return self._corrected(self._predicted(keys, state)[0], state)

    def rows(self, keys: tuple[str, ...], state: State) -> Residuals:
        """Return these offsets with their derivatives."""
        r, slope, ends, _ = self._predicted(keys, state)
        if self.bias_index.shape[1]:
            by_bias = -self.bias_shift.transpose(1, 2, 0)
            slope = np.concatenate([slope[:7], by_bias, slope[7:]])
        return Residuals(self._corrected(r, state), slope.T, ends.chain)

    def by_intrinsics(self, wanted: tuple[str, ...], keys: tuple[str, ...], state: State) -> Array:
        """Return derivatives (n, 2, n_wanted) of the offsets by intrinsics of the views."""
        by_xy = self._predicted(keys, state)[3]
        slopes = _on_sensor(state.cameras, wanted, self.view, self.feet, self.pixels)[1]
        return np.asarray(np.einsum("nqck,cqn->nqk", slopes, by_xy))

    def _corrected(self, r: Array, state: State) -> Array:
        """Return offsets (n, 2) without common-mode biases, from (2, n) with them."""
        if not self.bias_index.shape[1]:
            return r.T
        biases = state.biases[self.bias_index]
        return np.asarray(r.T - np.einsum("nc,ncq->nq", biases, self.bias_shift))

    def _predicted(
        self, keys: tuple[str, ...], state: State
    ) -> tuple[Array, Array, _EndsInCamera, Array]:
        """Return offsets (2, n) with biases, derivatives (7 + n_keys, 2, n), and ends of legs.

        The last are the derivatives (2, 2, n) by the points on the sensor plane.
        """

        def predicted() -> tuple[Array, Array, _EndsInCamera, Array]:
            ends = _ends_in_camera(state, self.leg, self.view, self.pose, self.on_arm)
            xy, by_key = self._feet, None
            if keys:
                moved, slopes = _on_sensor(state.cameras, keys, self.view, self.feet, self.pixels)
                xy, by_key = np.ascontiguousarray(moved.T), slopes.transpose(3, 2, 1, 0)
            radius = state.radii[self.radius]
            r, slope, by_xy = outline_offsets(ends.A, ends.B, radius, self.epsilon, xy, self._lens)
            if by_key is not None:
                slope = np.concatenate([slope, np.einsum("kcqn,cqn->kqn", by_key, by_xy)])
            return r, slope, ends, by_xy

        own = self.radius, self.feet, self.constants
        poses = state.camera_pose, state.platform_pose
        found: tuple[Array, Array, _EndsInCamera, Array] = self.memory.of(
            predicted, keys, *own, state.legs, state.radii, state.cameras, *poses
        )
        return found

    @cached_property
    def _feet(self) -> Array:
        """The feet by coordinate and end, (2, 2, n)."""
        return np.ascontiguousarray(self.feet.T)

    @cached_property
    def _lens(self) -> Array:
        """The inverse transposed derivatives of pixels by row, column and end, (2, 2, 2, n)."""
        by_end = self.constants[:, :8].reshape(-1, 2, 2, 2)  # column by column
        return np.ascontiguousarray(by_end.transpose(3, 2, 1, 0))

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor of outlines, whitened with their claimed covariances."""
        touches: tuple[Touch, ...] = (
            ("legs", self.leg, _SIX),
            ("camera_pose", self.view, _ALL),
            ("radii", self.radius, _ONE),
            ("biases", self.bias_index, _ONE),
            ("cameras", self.view, _ALL),
        )
        if self.on_actuators:
            touches = (*touches, ("legs", self.leg, _OF_ACTUATOR))
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
    keys = [(j, outlines.part[i]) for i, j in zip(index.tolist(), leg.tolist(), strict=True)]
    parts = tuple(sorted(set(keys)))
    covariance = outlines.covariance[index]
    cameras, by_gamma = _cameras_of(measurements), _by_gamma(outlines, measurements)[index]
    problems = [
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
    order = np.lexsort((measurements.pose[row], view, leg))  # those of a leg in a view together
    index, row, leg, view = index[order], row[order], leg[order], view[order]
    covariance, by_gamma = covariance[order], by_gamma[order]
    n, numbers = len(index), {part: i for i, part in enumerate(parts)}
    radius = np.array([numbers[key] for key in keys], dtype=np.intp)[order]
    feet, pixels, constants = np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.empty((n, 9))
    constants[:, 8] = EPSILON[outlines.edge[index] - 1]
    for v in np.unique(view):
        camera, of_view = measurements.views[v].camera, view == v
        at = index[of_view]
        normal, xy = outlines.h[at, None, :2], camera.undistort(outlines.ends[at])
        value = np.sum(normal * xy, axis=-1, keepdims=True) + outlines.h[at, None, 2:]
        feet[of_view] = xy - normal * value / np.sum(normal**2, axis=-1, keepdims=True)
        constants[of_view, :8] = _inverses(camera.pixels_per_unit(feet[of_view])).reshape(-1, 8)
        pixels[of_view] = camera.distort(feet[of_view])
    return ObservedOutlines(
        index,
        leg,
        view,
        measurements.pose[row],
        radius,
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
        legs.n_actuators > 0,
        frozenset((j, leg.arm.link) for j, leg in enumerate(legs.nominal) if leg.arm is not None),
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


def _inverses(M: Array) -> Array:
    """Return the inverses of matrices (..., 2, 2)."""
    (a, b), (c, d) = np.moveaxis(M, (-2, -1), (0, 1))
    adjoint = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    return np.asarray(adjoint / (a * d - b * c)[..., None, None])


def _mixed_gammas(moved: Array, gamma: Array, view: IntArray, cameras: Sequence[str]) -> list[str]:
    """Return one sentence for each camera whose outlines were measured with several gammas."""
    found: dict[str, set[float]] = {}
    some = np.flatnonzero(moved)
    for one, v in zip(gamma[some].tolist(), view[some].tolist(), strict=True):
        found.setdefault(cameras[v], set()).add(one)
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
    sign: Array  # (n,) of the reading in the length
    length: Array  # (n,) sign * q: the leg length without its offset [m]
    sigma: Array  # (n,) standard deviations [m]
    n_legs: int  # of the mechanism
    memory: Memory = field(default_factory=Memory, repr=False)

    def __len__(self) -> int:
        return len(self.leg)

    @property
    def by_scale(self) -> Array:
        """How residuals (n,) change with the scale of the readings [m]."""
        return -self.length

    def wrong_by(self, rows: Residuals) -> Array:
        """Return how far readings are above those of a state, (n,) [m]."""
        return -self.sign * rows.r[:, 0]

    def rows(self, state: State) -> Residuals:
        """Return the closures of legs (n, 1) [m], |AB| - sign q - q0, with their derivatives."""
        found: Residuals = self.memory.of(
            lambda: self._rows(state), state.legs, state.platform_pose
        )
        return found

    def _rows(self, state: State) -> Residuals:
        arm, end = (table[:, self._end] for table in state.ends_at_poses)
        R_pose = _by_measurement(state.platform_pose.R, self.pose)
        along = end - state.A.T[:, self.leg]
        length = np.sqrt(np.einsum("in,in->n", along, along))
        slope, n_q = np.empty((7, 1, len(self))), state.platform_pose.q.shape[1]
        np.divide(along, length, out=slope[3:6, 0])
        slope[:3], slope[6] = -slope[3:6], -1.0

        def chain(slope: Array) -> tuple[Array, Array]:
            by_length = slope.T
            b, J = by_length[3:6], np.zeros((13 + n_q, *by_length.shape[1:]))
            J[:3], J[6], J[10:13] = by_length[:3], by_length[6], b
            np.einsum("jin,jqn->iqn", R_pose, b, out=J[3:6])
            J[7:10] = _cross(arm[:, None], b)
            return J[:7].T, J[7:].T

        return Residuals((length - self.length - state.lengths[self.leg])[:, None], slope.T, chain)

    @cached_property
    def _end(self) -> IntArray:
        return self.pose * self.n_legs + self.leg

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor of readings; no camera matters to them."""
        del keys
        touches = (("legs", self.leg, slice(0, 7)),)
        whitening = 1.0 / self.sigma[:, None, None]
        return Factor("readings", self.rows, touches, len(self), 1, self.pose, whitening)


def observed_readings(measurements: Measurements, legs: FittedLegs) -> Readings:
    """Return the encoder readings, one row of them for each platform pose.

    Images of one pose share one reading: that of the first row. Legs without a motor have none.
    """
    length = legs.sign * measurements.q_of_poses
    actuated = np.array([leg.kind is LegKind.ACTUATED for leg in legs.nominal], dtype=np.bool_)
    leg, pose = np.nonzero((np.isfinite(length) & actuated).T)
    sigma = measurements.sigma_of(legs.nominal)[leg]
    sign = legs.sign[leg].astype(np.float64)
    return Readings(leg, pose, sign, length[pose, leg], sigma, legs.n_legs)


@dataclass(frozen=True, eq=False)
class ActuatorReadings:
    """The readings of actuators that enter the fit, n of them."""

    actuator: IntArray  # (n,) indices
    pose: IntArray  # (n,) indices
    reading: Array  # (n,) [m or rad]
    sigma: Array  # (n,) standard deviations in the same unit
    leg: IntArray  # (n,) indices of the first rod on each actuator

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def by_scale(self) -> Array:
        """How residuals (n,) change with the scale of the readings [m or rad]."""
        return -self.reading

    def wrong_by(self, rows: Residuals) -> Array:
        """Return how far readings are above those of a state, (n,) [m or rad]."""
        return -rows.r[:, 0]

    def rows(self, state: State) -> Residuals:
        """Return how far readings are from those of the state, (n, 1), with their derivatives."""
        q = state.platform_pose.q
        by_posture = np.zeros((len(self), 1, 6 + q.shape[1]))
        by_posture[np.arange(len(self)), 0, 6 + self.actuator] = 1.0
        r = q[self.pose, self.actuator] - self.reading
        return Residuals.of(r[:, None], np.zeros((len(self), 1, 0)), by_posture)

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor of these readings; nothing but a posture matters to them."""
        del keys
        whitening = 1.0 / self.sigma[:, None, None]
        return Factor("actuator_readings", self.rows, (), len(self), 1, self.pose, whitening)


def observed_actuator_readings(measurements: Measurements, legs: FittedLegs) -> ActuatorReadings:
    """Return the readings of actuators, one row of them for each platform pose."""
    on = actuator_index(legs.nominal)
    first = [on.index(a) for a in range(legs.n_actuators)]
    q = measurements.q_of_poses[:, first]
    actuator, pose = np.nonzero(np.isfinite(q).T)
    sigma = measurements.sigma_of(legs.nominal)[first]
    leg = np.array(first, dtype=np.intp)[actuator]
    return ActuatorReadings(actuator, pose, q[pose, actuator], sigma[actuator], leg)


@dataclass(frozen=True, eq=False)
class MeasuredLengths:
    """Distances of joints that were measured by hand, n of them."""

    leg: IntArray  # (n, 2) the legs of both joints
    is_base: BoolArray  # (n,) whether they are on the base, at reading 0, or on the platform
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
        """Return the factor of these distances."""
        touches = (("legs", self.leg[:, 0], _SIX), ("legs", self.leg[:, 1], _SIX))
        whitening = 1.0 / self.sigma[:, None, None]
        return Factor("lengths", self.rows, touches, len(self), 1, None, whitening)


def measured_lengths(names: Sequence[str], choices: Choices) -> MeasuredLengths:
    """Return the distances of joints that are stated, of legs with these names."""
    found = [
        (joints, prior)
        for name, prior in sorted(choices.priors.items())
        if (joints := joints_of_length(name)) is not None
    ]
    legs = [[names.index(leg) for leg, _ in joints] for joints, _ in found]
    return MeasuredLengths(
        np.array(legs, dtype=np.intp).reshape(-1, 2),
        np.array([joints[0][1] == "base" for joints, _ in found], dtype=np.bool_),
        np.array([prior.mean for _, prior in found]),
        np.array([prior.sigma for _, prior in found]),
    )


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
    on_actuators: bool = False  # whether some joints at A move

    def __len__(self) -> int:
        return len(self.leg)

    def rows(self, state: State) -> Residuals:
        """Return alpha and beta (n, 4) with their derivatives."""
        arm = np.zeros(len(self), dtype=np.bool_)
        ends = _ends_in_camera(state, self.leg, self.view, self.pose, arm)
        r, slope = axis_offsets(ends.A, ends.B, self.M.T, self.basis.T)
        return Residuals(r.T, slope.T, ends.chain)

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor of measured axes, which contain cameras already."""
        del keys
        touches: tuple[Touch, ...] = (("legs", self.leg, _SIX), ("camera_pose", self.view, _ALL))
        if self.on_actuators:
            touches = (*touches, ("legs", self.leg, _OF_ACTUATOR))
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
            none,
            none,
            none,
            np.zeros((0, 3)),
            np.zeros((0, 2, 3)),
            np.zeros((0, 4, 4)),
            legs.n_actuators > 0,
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
    moves = legs.n_actuators > 0
    return ObservedAxes(axes.leg, view, pose, axes.M, axes.basis, whitening, moves)


def average_images(axes: LegAxes, measurements: Measurements) -> LegAxes:
    """Return one axis for each leg at each pose in each view, weighted by the covariances.

    No information is lost, and a fit is smaller by the number of images.
    """
    view, pose = measurements.view[axes.row], measurements.pose[axes.row]
    return join_axes(axes, view * measurements.n_poses + pose)


# -------------------------------------------------------------------------------------- corners


@dataclass(frozen=True, eq=False)
class BoardCorners:
    """Calibration boards that are fixed to base and platform, and their corners in images."""

    boards: tuple[FixedBoard, ...]  # where corners are, in the frames of their boards
    corners: Corners  # where images show them; only the used ones count


@dataclass(frozen=True, eq=False)
class ObservedCorners:
    """The corners of a board that enter the fit, n of them."""

    link: Link  # what the board is fixed to
    view: IntArray  # (n,) index of the view
    pose: IntArray  # (n,) index of the platform pose; -1 on the base, which no pose moves
    corner: IntArray  # (n,) number of the corner, as the boards count them
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
        shown = [f.name for f in fields(self) if f.name != "link"]
        chosen = replace(self, **{name: getattr(self, name)[which] for name in shown})
        return replace(chosen, sigma=scale * chosen.sigma)

    @property
    def name(self) -> str:
        """The name of its factor."""
        return "corners" if self.link == "base" else f"{self.link}_corners"

    def keys(self, which: BoolArray) -> list[tuple[int, int, int]]:
        """Return view, pose and number of some corners."""
        columns = (column[which].tolist() for column in (self.view, self.pose, self.corner))
        return list(zip(*columns, strict=True))

    def rows(self, keys: tuple[str, ...], state: State) -> Residuals:
        """Return predicted minus measured corners (n, 2) [px] with their derivatives."""
        R_camera, board = state.camera_pose.R[self.view], LINKS.index(self.link)
        moves = self.link == "platform"
        arm = self.point @ state.board_pose.R[board].T
        grown = state.board_scale[board] * arm
        on_link = in_base_frame = grown + state.board_pose.t[board]
        if moves:
            R_link = state.platform_pose.R[self.pose]
            carried = _times(R_link, on_link)
            in_base_frame = carried + state.platform_pose.t[self.pose]
        turned = _times(R_camera, in_base_frame)
        xy, by_intrinsics = _on_sensor(state.cameras, keys, self.view, self.feet, self.pixels)
        in_camera = turned + state.camera_pose.t[self.view]
        depth = in_camera[:, 2:]
        seen = in_camera[:, :2] / depth
        lens = np.swapaxes(self.constants.reshape(-1, 2, 2), 1, 2)
        by_seen = lens / depth[:, None]
        by_depth = -by_seen @ seen[..., None]
        r = (lens @ (seen - xy)[..., None])[..., 0]
        slope = np.concatenate([by_seen, by_depth, -lens], axis=-1)

        def chain(slope: Array) -> tuple[Array, Array]:
            in_camera = slope[..., :3]
            in_base = in_camera @ R_camera
            in_link, by_pose = in_base, np.zeros((*slope.shape[:2], 0))
            if moves:
                in_link = in_base @ R_link
                turn = cross(carried[:, None], in_base)
                none = np.zeros((*slope.shape[:2], state.platform_pose.q.shape[1]))
                by_pose = np.concatenate([turn, in_base, none], axis=-1)
            J = [
                cross(turned[:, None], in_camera),
                in_camera,
                cross(grown[:, None], in_link),
                in_link,
                in_link @ arm[..., None],
                slope[..., 3:] @ by_intrinsics,
            ]
            return np.concatenate(J, axis=-1), by_pose

        return Residuals(r, slope, chain)

    def by_intrinsics(self, wanted: tuple[str, ...], state: State) -> Array:
        """Return derivatives (n, 2, n_wanted) of these by intrinsics of the views."""
        lens = np.swapaxes(self.constants.reshape(-1, 2, 2), 1, 2)
        slopes = _on_sensor(state.cameras, wanted, self.view, self.feet, self.pixels)[1]
        return np.asarray(-lens @ slopes)

    def factor(self, keys: tuple[str, ...]) -> Factor[State]:
        """Return the factor of corners; platform poses move those of a board on the platform."""
        one = np.full(len(self), LINKS.index(self.link), dtype=np.intp)
        element = self.pose if self.link == "platform" else None
        touches = (
            ("camera_pose", self.view, _ALL),
            ("board_pose", one, _ALL),
            ("board_scale", one, _ALL),
            ("cameras", self.view, _ALL),
        )
        whitening = 1.0 / self.sigma[:, None, None]

        def rows(state: State) -> Residuals:
            return self.rows(keys, state)

        return Factor(self.name, rows, touches, len(self), 2, element, whitening, robust=True)


def observed_corners(
    seen: BoardCorners | None, measurements: Measurements, cameras: Sequence[Camera]
) -> tuple[ObservedCorners, ...]:
    """Return the used corners of the board on each link.

    Those of all images of a view, or on the platform of all images of a view and a pose, are one
    weighted mean.
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
            link, index, index, index, none.reshape(0, 3), pair, pair, none.reshape(0, 4), none
        )
    corners = seen.corners
    used = np.flatnonzero(corners.used & fixed.has(corners.corner))
    row = corners.row[used]
    moving = measurements.pose[row] if link == "platform" else np.full(len(row), -1)
    key = np.stack([measurements.view[row], moving, corners.corner[used]], axis=1)
    distinct, which = np.unique(key, axis=0, return_inverse=True)
    which = which.ravel()
    weight = corners.sigma_px[used] ** -2.0
    total = np.bincount(which, weights=weight)
    pixels = np.stack(
        [np.bincount(which, weights=weight * corners.px[used, i]) / total for i in range(2)], axis=1
    )
    view, pose, corner = distinct.T.astype(np.intp)
    feet, constants = np.zeros((len(view), 2)), np.zeros((len(view), 4))
    for v in np.unique(view).tolist():
        of_view = view == v
        feet[of_view] = cameras[v].undistort(pixels[of_view])
        lens = cameras[v].pixels_per_unit(feet[of_view])
        constants[of_view] = np.swapaxes(lens, -1, -2).reshape(-1, 4)
    point, sigma = fixed.board.points[corner - fixed.first], 1.0 / np.sqrt(total)
    return ObservedCorners(link, view, pose, corner, point, feet, pixels, constants, sigma)


# ------------------------------------------------------------------------------------ residuals


def outline_offsets(
    A: Array, B: Array, radius: Array, epsilon: Array, xy: Array, lens: Array
) -> tuple[Array, Array, Array]:
    """Return the distances of predicted outlines of legs from points, and their derivatives.

    The outline h of the cylinder about AB seen from the origin, eqs (1) and (3), is up to its
    length, with n = A x B and D = B - A, epsilon r (D x n) - n sqrt(|n|^2 - |D|^2 r^2). The
    distance is h . (x, y, 1) / |J^-T (h1, h2)|, that of
    :meth:`legcal.vision.camera.Camera.line_offset` with the derivative J of the lens constant.

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
        Of both points [px]; NaN where the origin is inside the cylinder.
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


def axis_offsets(A: Array, B: Array, M: Array, basis: Array) -> tuple[Array, Array]:
    """Return how far predicted axes of legs are from measured ones, and the derivatives.

    A measured axis passes through M along e1 x e2. alpha is the predicted direction in e1 and
    e2, over its part along the axis; beta is where the predicted axis meets the plane through
    M with these directions, from M [m].

    Parameters
    ----------
    A, B, M : (3, n) array
        Both ends and M in the camera frame [m].
    basis : (3, 2, n) array
        e1 and e2.

    Returns
    -------
    r : (4, n) array
        alpha1, alpha2, beta1, beta2.
    by_ends : (6, 4, n) array
        Derivatives by A and B.
    """
    leg, to_A, axis = B - A, A - M, _cross(basis[:, 0], basis[:, 1])
    length, height = np.einsum("in,in->n", axis, leg), np.einsum("in,in->n", axis, to_A)
    alpha = np.einsum("ien,in->en", basis, leg) / length
    by_leg = (basis - alpha * axis[:, None]) / length
    beta = np.einsum("ien,in->en", basis, to_A) - alpha * height
    by_A = np.concatenate([-by_leg, (length + height) * by_leg], axis=1)
    by_B = np.concatenate([by_leg, -height * by_leg], axis=1)
    return np.concatenate([alpha, beta]), np.concatenate([by_A, by_B])


# ----------------------------------------------------------------------------------- chain rule


def _on_sensor(
    cameras: Sequence[Camera], keys: tuple[str, ...], view: IntArray, feet: Array, pixels: Array
) -> tuple[Array, Array]:
    """Return points of images (n, ..., 2) on the sensor plane, and (n, ..., 2, n_keys).

    The latter is how they move with intrinsics; without any unknown these are at *feet*.
    """
    xy, slopes = feet.copy(), np.zeros((*pixels.shape, len(keys)))
    for v in np.unique(view) if keys else ():
        camera, of_view = cameras[v], view == v
        known = [k for k, key in enumerate(keys) if key in intrinsic_names(camera)]
        some = np.zeros((*pixels[of_view].shape, len(keys)))
        names = [keys[k] for k in known]
        xy[of_view], some[..., known] = undistort_with_derivatives(
            camera, pixels[of_view], names, feet[of_view]
        )
        slopes[of_view] = some
    return xy, slopes


@dataclass(frozen=True, eq=False)
class _EndsInCamera:
    """Both ends of legs in the camera frame, and what their derivatives are made of."""

    A: Array  # (3, n) from the camera, in its directions, and B likewise
    B: Array
    A_turned: Array  # without the camera's place
    B_turned: Array
    arm: Array  # (3, n) from the origin of R_e to B, in R_b
    R_camera: Array  # (3, 3, n)
    R_pose: Array
    moved: _Moved | None  # where joints at A move

    def chain(self, slope: Array) -> tuple[Array, Array]:
        """Return derivatives by A, B, camera and others, and by the pose, from those by both ends.

        *slope* (n, q, l) has after these six numbers those of the others: radius, biases and
        intrinsics. Those by the numbers of actuators come after them.
        """
        by_ends, moved = slope.T, self.moved
        n_own, n_q = (0, 0) if moved is None else (ActuatorColumns.COUNT, moved.n_q)
        by_A, by_B, others = by_ends[:3], by_ends[3:6], 6 + len(by_ends)
        m = others + n_own
        J = np.empty((m + 6 + n_q, *by_ends.shape[1:]))
        b = J[m + 3 : m + 6]
        np.einsum("jin,jqn->iqn", self.R_camera, by_A, out=J[:3])
        if moved is not None:
            a = J[:3].copy()
            np.einsum("jin,jqn->iqn", moved.by_A, a, out=J[:3])
            np.einsum("jin,jqn->iqn", moved.by_numbers, a, out=J[others:m])
            np.einsum("jin,jqn->iqn", moved.by_q, a, out=J[m + 6 :])
        np.einsum("jin,jqn->iqn", self.R_camera, by_B, out=b)
        if moved is not None and len(moved.arms):
            of_arms = b[:, :, moved.arms]
            J[others:m, :, moved.arms] += np.einsum("jin,jqn->iqn", moved.far_numbers, of_arms)
            J[m + 6 :, :, moved.arms] += np.einsum("jin,jqn->iqn", moved.far_q, of_arms)
            b[:, :, moved.arms] = 0.0  # nothing of them is on the platform
        np.einsum("jin,jqn->iqn", self.R_pose, b, out=J[3:6])
        J[6:9] = _cross(self.A_turned[:, None], by_A)
        J[6:9] += _cross(self.B_turned[:, None], by_B)
        np.add(by_A, by_B, out=J[9:12])
        J[12:others] = by_ends[6:]
        J[m : m + 3] = _cross(self.arm[:, None], b)
        return J[:m].T, J[m:].T


@dataclass(frozen=True, eq=False)
class _Moved:
    """How the joints at A of measurements move with numbers of actuators and with readings.

    Of an arm it is its near end that does, and its far end as well.
    """

    by_A: Array  # (3, 3, n) by A at reading 0
    by_numbers: Array  # (3, 9, n) by the numbers of the actuator
    by_q: Array  # (3, n_actuators, n)
    arms: IntArray  # (m,) the measurements of arms
    far_numbers: Array  # (3, 9, m)
    far_q: Array  # (3, n_actuators, m)

    @property
    def n_q(self) -> int:
        """Number of readings in a posture."""
        return int(self.by_q.shape[1])


def _moved(state: State, leg: IntArray, pose: IntArray, arm: BoolArray) -> _Moved | None:
    """Return how the joints at A of legs at poses move, None where no actuator carries any.

    Where *arm* says so it is the ends of the arm of the leg that do.
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
    return _Moved(
        _last(np.where(arm[:, None, None], 0.0, by_A[leg, pose])),
        _last(by_numbers),
        _last(by_q),
        arms,
        _last(far_numbers),
        _last(far_q),
    )


def _write_motion(motion: JointMotion, actuator: int, by_numbers: Array, by_q: Array) -> None:
    """Write how a point moves with its actuator into (n_poses, 3, 9) and (n_poses, 3, n_q)."""
    by_numbers[:, :, :2], by_numbers[:, :, 2:4] = motion.by_axis, motion.by_point
    by_numbers[:, :, 4], by_q[:, :, actuator] = motion.by_gain, motion.by_q


def _last(table: Array) -> Array:
    """Return a table (n, ...) with its first axis last."""
    return np.ascontiguousarray(np.moveaxis(table, 0, -1))


def _ends_in_camera(
    state: State, leg: IntArray, view: IntArray, pose: IntArray, arm: BoolArray
) -> _EndsInCamera:
    """Return both ends of legs in the camera frames of views at poses; of their arms where *arm*.

    Ends of arms stand in place of A and B.
    """
    n_legs = len(state.A)
    R_camera, t = _by_measurement(state.camera_pose.R, view), state.camera_pose.t.T[:, view]
    moved = _moved(state, leg, pose, arm)
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
    """Return the matrix of each measurement, (3, 3, n), of some (k, 3, 3)."""
    return np.ascontiguousarray(R.transpose(1, 2, 0))[..., which]


def _cross(a: Array, b: Array) -> Array:
    """Return vector products along the first axis."""
    product = np.empty((3, *np.broadcast(a[0], b[0]).shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[j], b[k], out=product[i])
        product[i] -= a[k] * b[j]
    return product


def _times(R: Array, v: Array) -> Array:
    """Return R v of rows, (n, 3)."""
    return np.asarray((R @ v[..., None])[..., 0])
