"""How well a fit predicts held-out images: in pixels, and at the platform.

In pixels: where the calibrated model, its readings and its cameras put the outlines, against where
they are. At the platform: its pose by the readings, against its pose by the outlines alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.joint_fit.factors import observed_outlines
from legcal.calibration.joint_fit.outline_errors import EdgeBiases, NoiseModel, possible_biases
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import Postures, State
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.errors import NotIdentifiable, NotVisible
from legcal.estimation.problem import Linearization, linearize
from legcal.estimation.solver import NormalEquations, information
from legcal.estimation.uncertainty import explained_share
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.kinematics import pose_differences


@dataclass(frozen=True, eq=False)
class Predicted:
    """Held-out images, and what a fit predicts of them."""

    problem: FitProblem  # their outlines and readings; the unknowns of the fit, their own biases
    state: State  # where the fit ended, at the poses of these images
    covariance: Array  # (n_kept, n_kept) by the fit; biases of other groups have their prior


@dataclass(frozen=True, eq=False)
class Posterior:
    """Where a fit ended, with the covariance of everything that is no pose."""

    problem: FitProblem  # with the biases that outlines share
    state: State
    edge_biases: EdgeBiases
    noise: NoiseModel
    covariance: Array  # (n_kept, n_kept)

    @property
    def biases(self) -> dict[str, float]:
        """Common-mode edge biases by name [px], and logarithms of gammas over the assumed ones."""
        labels = self.problem.block("biases").labels
        return dict(zip(labels, self.state.biases.tolist(), strict=True))

    def of_images(
        self,
        measurements: Measurements,
        outlines: Outlines,
        T_Rb_Re: Sequence[RigidTransform],
    ) -> Predicted:
        """Return what the fit predicts of other images of the same views, at given poses."""
        fitted, legs, state = self.problem, self.problem.legs, self.state
        found = observed_outlines(outlines, measurements, legs)
        found = found.with_parts_first(fitted.outlines.parts).through(state.cameras)
        possible = possible_biases(found, legs.names, fitted.outlines)
        shifts = possible.of_sizes(self.edge_biases.sigma)
        problem = fitted.with_measurements(measurements, found, shifts)
        values = self.biases
        others = [legs.radii[part] for part in found.parts[len(state.radii) :]]
        return Predicted(
            problem,
            replace(
                state,
                radii=np.append(state.radii, others),
                biases=np.array([values.get(name, 0.0) for name in shifts.names]),
                platform_pose=problem.postures(state.legs, T_Rb_Re),
            ),
            self._covariance_of(problem, shifts),
        )

    def _covariance_of(self, problem: FitProblem, shifts: EdgeBiases) -> Array:
        """Return the covariance of the unknowns of a problem with other biases."""
        old = self.problem
        place = {name: i for i, name in enumerate(old.named)}
        cameras = range(old.n_named, old.n_kept)
        where = np.array([*(place.get(name, -1) for name in problem.named), *cameras], np.intp)
        is_known = where >= 0
        covariance = np.zeros((problem.n_kept, problem.n_kept))
        biases = problem.where("biases")
        covariance[biases, biases] = shifts.sigmas**2
        kept = where[is_known]
        covariance[np.ix_(is_known, is_known)] = self.covariance[np.ix_(kept, kept)]
        return covariance


_READINGS = "readings", "actuator_readings"  # factors of them
_ROBUST_STEPS, _MAX_STEPS = 10, 30
_WIDTH = 3.0  # whitened distance at which an outline starts to count less
_MAX_SIGMA = 0.03  # [rad], or of a leg's length: a pose known worse is none
_MAX_STEP = 0.1  # [rad], or of a leg's length, in one step
_MAX_DISTANCE = 0.3  # the same from where the search began
_STEP_TOLERANCE = 1e-4  # squared length of the last step, in standard deviations
_MIN_INFORMATION = 1.0  # [1/rad^2], 1 / squared leg lengths: better than a radian or a leg


@dataclass(frozen=True, eq=False)
class PosesByOutlines:
    """Poses by outlines alone."""

    T_Rb_Re: tuple[RigidTransform, ...]  # all of them; those that are not known mean nothing
    known: IntArray  # (n_known,) which poses the outlines determine
    # (n_known, 6, 6) of the motion between each by the readings and by the outlines: rotation
    # vector in R_b and displacement of R_e [rad, m].
    covariance: Array


def poses_by_outlines(predicted: Predicted, rejection: float) -> PosesByOutlines:
    """Return the poses that fit the outlines best, from those by the readings.

    Outlines count less the farther off they are, then those nearer than *rejection* (whitened)
    count alike. Poses that still move after that are not known.
    """
    problem, begin = predicted.problem, predicted.state
    linear = linearize(problem, begin)
    length = begin.mean_length
    state, known = begin, _is_known(_by_outlines(problem, begin, linear), begin)
    converged = np.zeros(len(known), dtype=np.bool_)
    weight = np.ones(len(problem.outlines))
    for step in range(_ROBUST_STEPS + _MAX_STEPS):
        s = linear["outlines"].squared_norms
        if step < _ROBUST_STEPS:
            weight = 1.0 / (1.0 + s / _WIDTH**2)
        elif step == _ROBUST_STEPS:
            weight = np.where(s < rejection**2, 1.0, 0.0)
        normal = _by_outlines(problem, state, linear, weight)
        change, squared = _step(normal)
        converged = (squared < _STEP_TOLERANCE) & (step >= _ROBUST_STEPS)
        moving = known & ~converged
        if not moving.any():
            break
        state, is_near = _moved(predicted, state, np.where(moving[:, None], change, 0.0), length)
        known &= is_near
        linear = linearize(problem, state)
    outlines = _by_outlines(problem, state, linear, weight)
    readings = information(problem, state, linear, only=_READINGS)
    which = np.flatnonzero(known & converged & _is_known(outlines, state))
    covariance = _covariance(outlines, readings, predicted.covariance)[which]
    return PosesByOutlines(state.platform_pose.motions, which, covariance)


def _by_outlines(
    problem: FitProblem, state: State, linear: Linearization, weight: Array | None = None
) -> NormalEquations:
    """Return the information of outlines alone, their squares weighted (n,)."""
    if weight is not None:
        rows = linear["outlines"].whitened(np.sqrt(weight)[:, None, None])
        linear = replace(linear, rows={**linear.rows, "outlines": rows})
    return information(problem, state, linear, only=("outlines",))


def _step(normal: NormalEquations) -> tuple[Array, Array]:
    """Return Gauss-Newton's steps (n_poses, d) and their squared lengths in sigmas (n_poses,)."""
    y = -(normal.V_inverse @ normal.g_elements[..., None])[..., 0]
    squared = np.einsum("kf,kfh,kh->k", y, normal.V, y)
    return (_motions(normal) @ y[..., None])[..., 0], np.asarray(squared)


def _moved(
    predicted: Predicted, state: State, change: Array, length: float
) -> tuple[State, BoolArray]:
    """Return poses after a change (n_poses, d) that is not too large, and which are near the first.

    Those that are not are back at the first ones, and so are those that put a camera into a leg.
    """
    problem, begin = predicted.problem, predicted.state
    first = begin.platform_pose
    reach = np.linalg.norm(change / begin.posture_scale, axis=1, keepdims=True)
    change = change * np.minimum(1.0, _MAX_STEP / np.maximum(reach, 1e-300))
    moved = state.platform_pose.moved(change)
    cosine = 0.5 * (np.einsum("kij,kij->k", moved.R, first.R) - 1.0)
    shift = np.linalg.norm(moved.t - first.t, axis=1)
    is_near = (cosine > np.cos(_MAX_DISTANCE)) & (shift < _MAX_DISTANCE * length)
    trial = problem.projected(_with_poses(state, first, is_near, moved))
    seen = np.isfinite(problem.offsets(trial)).all(axis=1)
    is_near[problem.outlines.pose[~seen]] = False
    return _with_poses(trial, first, is_near, trial.platform_pose), is_near


def _with_poses(state: State, first: Postures, chosen: BoolArray, poses: Postures) -> State:
    """Return a state with some new poses, the others the first ones."""
    return replace(state, platform_pose=first.where(chosen, poses))


def _is_known(normal: NormalEquations, state: State) -> BoolArray:
    """Return which poses are determined well enough to mean anything."""
    Z, length = _motions(normal), state.mean_length
    covariance = Z @ normal.V_inverse @ np.swapaxes(Z, 1, 2)
    scale = state.posture_scale if normal.tangent is None else np.ones(normal.V.shape[1])
    has_rank = np.linalg.eigvalsh(scale[:, None] * normal.V * scale)[:, 0] > _MIN_INFORMATION
    turn, shift = (
        np.sqrt(np.trace(covariance[:, part, part], axis1=1, axis2=2))
        for part in (slice(0, 3), slice(3, 6))
    )
    return np.asarray(has_rank & (shift < _MAX_SIGMA * length) & (turn < _MAX_SIGMA))


def _covariance(outlines: NormalEquations, readings: NormalEquations, of_fit: Array) -> Array:
    """Return the covariance (n_poses, 6, 6) of motions between poses by readings and by outlines.

    Each has its own noise, and both follow the errors of the fit.
    """
    apart = outlines.elements_by_kept - readings.elements_by_kept
    inside = outlines.V_inverse + readings.V_inverse + apart @ of_fit @ np.swapaxes(apart, 1, 2)
    Z = _motions(outlines)[:, :6]
    return np.asarray(Z @ inside @ np.swapaxes(Z, 1, 2))


def _motions(normal: NormalEquations) -> Array:
    """Return the basis of the motions of postures, (n_poses, d, f)."""
    if normal.tangent is None:
        return np.broadcast_to(np.eye(6), (len(normal.V), 6, 6))
    return normal.tangent.Z


_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))  # of the norm of two unit Gaussians
_RANK_TOLERANCE = 1e-18  # of the largest eigenvalue of what readings say of a pose


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Held-out images compared with the predictions of a fit.

    Offsets are without the biases that outlines share with fitted ones. What is expected is one
    standard deviation, by the noise of outlines and readings and the covariance of all that the fit
    knows.
    """

    n_images: int  # held out
    n_poses: int
    outlines: int  # in them
    wrong: int  # far from where they should be for their noise; left out of what follows
    rms_px: float | None  # of the offsets [px]; None without outlines
    expected_px: float | None
    rms_px_of_view: dict[str, float]  # the same for each view that has some, by its name
    displacement: Array  # (n_known,) platform by readings and by outlines alone [m]
    rotation: Array  # (n_known,) [rad]
    expected_displacement: Array
    expected_rotation: Array

    @property
    def at_platform(self) -> PlatformPair | None:
        """What was found at the platform and what was expected there; None without any pose.

        Poses count by how well their outlines determine them.
        """
        if len(self.displacement) == 0:
            return None
        return PlatformPair(
            *_weighted_rms(self.displacement, self.expected_displacement),
            *_weighted_rms(self.rotation, self.expected_rotation),
        )


@dataclass(frozen=True)
class PlatformPair:
    """Root mean squares over poses: found, and expected as one standard deviation."""

    displacement: float  # [m]
    expected_displacement: float
    rotation: float  # [rad]
    expected_rotation: float


def compare_held_out(
    posterior: Posterior,
    measurements: Measurements,
    outlines: Outlines,
    T_Rb_Re: Sequence[RigidTransform],
) -> HeldOut:
    """Compare held-out images with the predictions of a fit of others.

    Common-mode biases that the outlines share with those of the fit are subtracted. The expected
    errors have the noise of the outlines, that of the readings, and the covariance of the fit.

    Of held-out *measurements* the used *outlines* are compared, at the poses *T_Rb_Re* by the
    fit and the readings.

    Raises
    ------
    NotIdentifiable
        If the readings do not determine the poses.
    NotVisible
        If a camera stands inside a leg.
    """
    predicted = posterior.of_images(measurements, outlines, T_Rb_Re)
    problem, state = predicted.problem.weighted(posterior.noise), predicted.state
    predicted = replace(predicted, problem=problem)
    L = np.linalg.cholesky(posterior.noise.covariance(problem.outlines.covariance))
    linear = linearize(problem, state)
    _refuse_unseen(linear)
    readings = information(problem, state, linear, only=_READINGS)
    _refuse_undetermined(readings)
    expected = np.eye(2) + explained_share(
        problem, linear, readings, "outlines", predicted.covariance
    )
    offsets = (L @ linear["outlines"].r[..., None])[..., 0]
    norm = _norms(linear["outlines"].r, expected)
    limit = problem.settings.rejection * _usual(norm)
    right = norm < limit
    pixels = np.einsum("nij,njk,nik->ni", L, expected, L)
    shown = poses_by_outlines(predicted, limit)
    known = shown.known.tolist()
    displacement, rotation = pose_differences(
        [shown.T_Rb_Re[k] for k in known], [T_Rb_Re[k] for k in known]
    )
    variance = np.einsum("kii->ki", shown.covariance)
    return HeldOut(
        n_images=measurements.n_rows,
        n_poses=measurements.n_poses,
        outlines=len(problem.outlines),
        wrong=int(np.sum(~right)),
        rms_px=_rms(offsets[right]),
        expected_px=_rms(np.sqrt(pixels[right])),
        rms_px_of_view=_of_views(measurements, problem.outlines.view[right], offsets[right]),
        displacement=displacement,
        rotation=rotation,
        expected_displacement=np.sqrt(variance[:, 3:].sum(axis=1)),
        expected_rotation=np.sqrt(variance[:, :3].sum(axis=1)),
    )


def _refuse_undetermined(readings: NormalEquations) -> None:
    """Raise NotIdentifiable where readings do not determine a pose."""
    value = np.linalg.eigvalsh(readings.V)
    bad = np.flatnonzero(value[:, 0] <= _RANK_TOLERANCE * value[:, -1])
    if len(bad):
        raise NotIdentifiable(
            "The images that were kept aside could not be compared with what the fit predicts: "
            f"found readings that leave platform pose {bad[0] + 1} of them open, needed readings "
            "that determine every pose; leave out --holdout."
        )


def _refuse_unseen(linear: Linearization) -> None:
    """Raise NotVisible where a camera stands inside a leg."""
    bad = int(np.sum(~np.isfinite(linear["outlines"].r).all(axis=1)))
    if bad:
        raise NotVisible(
            "The images that were kept aside could not be compared with what the fit predicts: "
            f"found {bad} outlines of legs that a camera stands inside by their readings, needed "
            "cameras outside the legs; check the readings."
        )


def _norms(r: Array, covariance: Array) -> Array:
    """Return how many standard deviations residuals (n, 2) are off, (n,)."""
    inverse = np.linalg.inv(covariance)
    return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", r, inverse, r)))


def _usual(norm: Array) -> float:
    """Return the median distance of outlines in sigmas of their noise, at least one."""
    return max(float(np.median(norm)) / _MEDIAN, 1.0) if len(norm) else 1.0


def _of_views(measurements: Measurements, view: IntArray, offsets: Array) -> dict[str, float]:
    """Return the root mean square of offsets for each view that has some [px]."""
    return {
        measurements.views[v].name: float(np.sqrt(np.mean(offsets[view == v] ** 2)))
        for v in np.unique(view).tolist()
    }


def _rms(offsets: Array) -> float | None:
    """Return the root mean square of offsets, None without any."""
    return float(np.sqrt(np.mean(offsets**2))) if len(offsets) else None


def _weighted_rms(found: Array, expected: Array) -> tuple[float, float]:
    """Return the root mean squares of both, weighted by what was expected."""
    weight = expected**-2
    total = float(np.sum(weight))
    return float(np.sqrt(np.sum(weight * found**2) / total)), float(np.sqrt(len(found) / total))
