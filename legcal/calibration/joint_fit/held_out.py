"""Prediction errors of a fit: in held-out images, and in images left out block by block.

**Held out**, in pixels: outlines predicted from the calibrated model, the readings and the cameras,
against the measured ones. At the platform: its pose from the readings, against its pose from
outlines alone.

**Left out**: images that did not take part, predicted by a fit without them and by the nominal
model. No fit is repeated: from the normal equations at the minimum the information of a block of
poses is removed, with all images of these, and one Gauss-Newton step taken. Blocks are of
neighbouring poses, so that a fit has to extrapolate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.documents import HoldoutPlatform
from legcal.calibration.joint_fit.factors import observed_outlines
from legcal.calibration.joint_fit.outline_errors import EdgeBiases, NoiseModel, possible_biases
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import Postures, State
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.errors import DidNotConverge, NotIdentifiable, NotVisible
from legcal.estimation.problem import Linearization, linearize
from legcal.estimation.solver import NormalEquations, information, minimise, normal_equations
from legcal.estimation.uncertainty import left_out_blocks, leverage, marginal
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.kinematics import pose_differences


@dataclass(frozen=True, eq=False)
class Predicted:
    """Prediction of a fit for held-out images."""

    problem: FitProblem  # held-out outlines and readings, with the unknowns of the fit
    state: State  # of the fit, at the poses of the held-out images
    covariance: Array  # (n_kept, n_kept) of the fit; new biases have their prior


@dataclass(frozen=True, eq=False)
class Posterior:
    """The minimum of a fit, with the covariance of all unknowns but platform poses."""

    problem: FitProblem  # with the common-mode biases
    state: State
    edge_biases: EdgeBiases
    noise: NoiseModel
    covariance: Array  # (n_kept, n_kept)

    @property
    def biases(self) -> dict[str, float]:
        """Common-mode edge biases by name [px], and ln gamma over the assumed gamma."""
        labels = self.problem.block("biases").labels
        return dict(zip(labels, self.state.biases.tolist(), strict=True))

    def of_images(
        self,
        measurements: Measurements,
        outlines: Outlines,
        T_Rb_Re: Sequence[RigidTransform],
    ) -> Predicted:
        """Predict other images of the same views, at given poses."""
        problem_of_fit, legs, state = self.problem, self.problem.legs, self.state
        observed = observed_outlines(outlines, measurements, legs)
        observed = observed.with_parts_first(problem_of_fit.outlines.parts).through(state.cameras)
        possible = possible_biases(observed, legs.names, problem_of_fit.outlines)
        shifts = possible.of_sizes(self.edge_biases.sigma)
        problem = problem_of_fit.with_measurements(measurements, observed, shifts)
        biases = self.biases
        other_radii = [legs.radii[part] for part in observed.parts[len(state.radii) :]]
        return Predicted(
            problem,
            replace(
                state,
                radii=np.append(state.radii, other_radii),
                biases=np.array([biases.get(name, 0.0) for name in shifts.names]),
                platform_pose=problem.postures(state.legs, T_Rb_Re),
            ),
            self._covariance_of(problem, shifts),
        )

    def _covariance_of(self, problem: FitProblem, shifts: EdgeBiases) -> Array:
        """Covariance of the unknowns of a problem with other biases."""
        problem_of_fit = self.problem
        column_of = {name: i for i, name in enumerate(problem_of_fit.named)}
        poses_and_boards = range(problem_of_fit.n_named, problem_of_fit.n_kept)
        columns = np.array(
            [*(column_of.get(name, -1) for name in problem.named), *poses_and_boards], np.intp
        )
        is_fitted = columns >= 0
        covariance = np.zeros((problem.n_kept, problem.n_kept))
        biases = problem.where("biases")
        covariance[biases, biases] = shifts.sigmas**2
        kept = columns[is_fitted]
        covariance[np.ix_(is_fitted, is_fitted)] = self.covariance[np.ix_(kept, kept)]
        return covariance


_READINGS = ("readings",)  # factors
_ROBUST_STEPS, _MAX_STEPS = 10, 30
_WIDTH = 3.0  # width of the robust loss, whitened
_MAX_SIGMA = 0.03  # [rad, mean leg lengths]: largest uncertainty of a usable pose
_MAX_STEP = 0.1  # [rad, mean leg lengths] in one step
_MAX_DISTANCE = 0.3  # [rad, mean leg lengths] from the start
_STEP_TOLERANCE = 1e-4  # squared length of the last step, in standard deviations
_MIN_INFORMATION = 1.0  # [1/rad^2, 1 / squared leg lengths]


@dataclass(frozen=True, eq=False)
class PosesByOutlines:
    """Platform poses estimated from outlines alone."""

    T_Rb_Re: tuple[RigidTransform, ...]  # all poses; valid only for ``known``
    known: IntArray  # (n_known,) indices of poses determined by outlines
    # (n_known, 6, 6) of the motion between the poses by readings and by outlines: rotation
    # vector in R_b and displacement of R_e [rad, m]
    covariance: Array


def poses_by_outlines(predicted: Predicted, rejection: float) -> PosesByOutlines:
    """Fit poses to outlines alone, starting from the poses by readings.

    First with a robust loss, then with equal weights of the inliers, whose whitened distance is
    below *rejection*. Poses that do not converge are not known.
    """
    problem, start = predicted.problem, predicted.state
    linear = linearize(problem, start)
    length = start.mean_length
    state, is_known = start, _are_determined(_outline_information(problem, start, linear), start)
    converged = np.zeros(len(is_known), dtype=np.bool_)
    weight = np.ones(len(problem.outlines))
    for step in range(_ROBUST_STEPS + _MAX_STEPS):
        s = linear["outlines"].squared_norms
        if step < _ROBUST_STEPS:
            weight = 1.0 / (1.0 + s / _WIDTH**2)
        elif step == _ROBUST_STEPS:
            weight = np.where(s < rejection**2, 1.0, 0.0)
        normal = _outline_information(problem, state, linear, weight)
        change, squared = _step(normal)
        converged = (squared < _STEP_TOLERANCE) & (step >= _ROBUST_STEPS)
        moving = is_known & ~converged
        if not moving.any():
            break
        state, is_near = _take_step(
            predicted, state, np.where(moving[:, None], change, 0.0), length
        )
        is_known &= is_near
        linear = linearize(problem, state)
    outlines = _outline_information(problem, state, linear, weight)
    readings = information(problem, state, linear, only=_READINGS)
    determined = np.flatnonzero(is_known & converged & _are_determined(outlines, state))
    covariance = _covariance(outlines, readings, predicted.covariance)[determined]
    return PosesByOutlines(state.platform_pose.motions, determined, covariance)


def _outline_information(
    problem: FitProblem, state: State, linear: Linearization, weight: Array | None = None
) -> NormalEquations:
    """Return the normal equations of outlines alone, with weights (n,) of their squares."""
    if weight is not None:
        rows = linear["outlines"].whitened(np.sqrt(weight)[:, None, None])
        linear = replace(linear, rows={**linear.rows, "outlines": rows})
    return information(problem, state, linear, only=("outlines",))


def _step(normal: NormalEquations) -> tuple[Array, Array]:
    """Gauss-Newton steps (n_poses, d) and their squared lengths in sigmas (n_poses,)."""
    y = -(normal.V_inverse @ normal.g_elements[..., None])[..., 0]
    squared = np.einsum("kf,kfh,kh->k", y, normal.V, y)
    return (_motions(normal) @ y[..., None])[..., 0], np.asarray(squared)


def _take_step(
    predicted: Predicted, state: State, change: Array, length: float
) -> tuple[State, BoolArray]:
    """Take bounded steps (n_poses, d); also return which poses are still near the start.

    Poses far from the start, or with a camera inside a leg, are reset to the start.
    """
    problem, start = predicted.problem, predicted.state
    first = start.platform_pose
    step_size = np.linalg.norm(change / start.posture_scale, axis=1, keepdims=True)
    change = change * np.minimum(1.0, _MAX_STEP / np.maximum(step_size, 1e-300))
    moved = state.platform_pose.moved(change)
    cosine = 0.5 * (np.einsum("kij,kij->k", moved.R, first.R) - 1.0)
    shift = np.linalg.norm(moved.t - first.t, axis=1)
    is_near = (cosine > np.cos(_MAX_DISTANCE)) & (shift < _MAX_DISTANCE * length)
    trial = problem.projected(_with_poses(state, first, is_near, moved))
    is_visible = np.isfinite(problem.offsets(trial)).all(axis=1)
    is_near[problem.outlines.pose[~is_visible]] = False
    return _with_poses(trial, first, is_near, trial.platform_pose), is_near


def _with_poses(state: State, first: Postures, chosen: BoolArray, poses: Postures) -> State:
    """Set the chosen poses, and the others to the first ones."""
    return replace(state, platform_pose=first.where(chosen, poses))


def _are_determined(normal: NormalEquations, state: State) -> BoolArray:
    """Mask of poses determined well enough to compare, (n_poses,)."""
    Z, length = _motions(normal), state.mean_length
    covariance = Z @ normal.V_inverse @ np.swapaxes(Z, 1, 2)
    scale = state.posture_scale if normal.tangent is None else np.ones(normal.V.shape[1])
    has_rank = np.linalg.eigvalsh(scale[:, None] * normal.V * scale)[:, 0] > _MIN_INFORMATION
    turn, shift = (
        np.sqrt(np.trace(covariance[:, part, part], axis1=1, axis2=2))
        for part in (slice(0, 3), slice(3, 6))
    )
    return np.asarray(has_rank & (shift < _MAX_SIGMA * length) & (turn < _MAX_SIGMA))


def _covariance(
    outlines: NormalEquations, readings: NormalEquations, fit_covariance: Array
) -> Array:
    """Covariance (n_poses, 6, 6) of motions between poses by readings and by outlines.

    Both have independent noise and share the errors of the fit.
    """
    difference = outlines.elements_by_kept - readings.elements_by_kept
    tangent_covariance = (
        outlines.V_inverse
        + readings.V_inverse
        + difference @ fit_covariance @ np.swapaxes(difference, 1, 2)
    )
    Z = _motions(outlines)[:, :6]
    return np.asarray(Z @ tangent_covariance @ np.swapaxes(Z, 1, 2))


def _motions(normal: NormalEquations) -> Array:
    """Tangent basis of postures, (n_poses, d, f)."""
    if normal.tangent is None:
        return np.broadcast_to(np.eye(6), (len(normal.V), 6, 6))
    return normal.tangent.Z


_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))  # median norm of two unit Gaussians
_RANK_TOLERANCE = 1e-18  # relative to the largest eigenvalue of a pose's information


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Held-out images compared with the predictions of a fit.

    Offsets are corrected for the common-mode biases of the fit. Expected errors are one standard
    deviation, from the noise of outlines and readings and the covariance of the fit.
    """

    images: int  # held-out images
    poses: int
    outlines: int  # in these images
    wrong: int  # outliers, excluded below
    rms_px: float | None  # of the offsets [px]; None without outlines
    expected_px: float | None
    views: dict[str, float]  # rms by name of the view [px]
    displacement: Array  # (n_known,) between poses by readings and by outlines [m]
    rotation: Array  # (n_known,) [rad]
    expected_displacement: Array
    expected_rotation: Array

    @property
    def platform(self) -> HoldoutPlatform | None:
        """Measured and expected errors at the platform; None without poses.

        Poses are weighted by their expected errors.
        """
        if len(self.displacement) == 0:
            return None
        dX, expected_dX = _weighted_rms(self.displacement, self.expected_displacement)
        dE, expected_dE = _weighted_rms(self.rotation, self.expected_rotation)
        return HoldoutPlatform(
            poses=len(self.displacement),
            dX_m=dX,
            expected_dX_m=expected_dX,
            dE_rad=dE,
            expected_dE_rad=expected_dE,
        )


def compare_held_out(
    posterior: Posterior,
    measurements: Measurements,
    outlines: Outlines,
    T_Rb_Re: Sequence[RigidTransform],
) -> HeldOut:
    """Compare held-out images with the predictions of a fit to other images.

    Common-mode biases known from the fit are subtracted. Expected errors include the noise of
    outlines and readings, and the covariance of the fit.

    The used *outlines* of the held-out *measurements* are compared, at the poses *T_Rb_Re*
    computed from the fit and the readings.

    Raises
    ------
    NotIdentifiable
        If the readings do not determine the poses.
    NotVisible
        If a camera is inside a leg.
    """
    predicted = posterior.of_images(measurements, outlines, T_Rb_Re)
    problem, state = predicted.problem.weighted(posterior.noise), predicted.state
    predicted = replace(predicted, problem=problem)
    L = np.linalg.cholesky(posterior.noise.covariance(problem.outlines.covariance))
    linear = linearize(problem, state)
    _refuse_unseen(linear)
    readings = information(problem, state, linear, only=_READINGS)
    _refuse_undetermined(readings)
    expected = np.eye(2) + leverage(problem, linear, readings, "outlines", predicted.covariance)
    offsets = (L @ linear["outlines"].r[..., None])[..., 0]
    norm = _norms(linear["outlines"].r, expected)
    limit = problem.settings.rejection * _median_distance(norm)
    inliers = norm < limit
    pixels = np.einsum("nij,njk,nik->ni", L, expected, L)
    by_outlines = poses_by_outlines(predicted, limit)
    poses = by_outlines.known.tolist()
    displacement, rotation = pose_differences(
        [by_outlines.T_Rb_Re[k] for k in poses], [T_Rb_Re[k] for k in poses]
    )
    variance = np.einsum("kii->ki", by_outlines.covariance)
    return HeldOut(
        images=measurements.n_rows,
        poses=measurements.n_poses,
        outlines=len(problem.outlines),
        wrong=int(np.sum(~inliers)),
        rms_px=_rms(offsets[inliers]),
        expected_px=_rms(np.sqrt(pixels[inliers])),
        views=_rms_by_view(measurements, problem.outlines.view[inliers], offsets[inliers]),
        displacement=displacement,
        rotation=rotation,
        expected_displacement=np.sqrt(variance[:, 3:].sum(axis=1)),
        expected_rotation=np.sqrt(variance[:, :3].sum(axis=1)),
    )


def _refuse_undetermined(readings: NormalEquations) -> None:
    """Raise NotIdentifiable if readings do not determine a pose."""
    eigenvalues = np.linalg.eigvalsh(readings.V)
    undetermined = np.flatnonzero(eigenvalues[:, 0] <= _RANK_TOLERANCE * eigenvalues[:, -1])
    if len(undetermined):
        raise NotIdentifiable(
            "The held-out images could not be compared with the fit: their readings do not "
            f"determine platform pose {undetermined[0] + 1}; leave out --holdout."
        )


def _refuse_unseen(linear: Linearization) -> None:
    """Raise NotVisible if a camera is inside a leg."""
    n_inside = int(np.sum(~np.isfinite(linear["outlines"].r).all(axis=1)))
    if n_inside:
        raise NotVisible(
            f"The held-out images could not be compared with the fit: for {n_inside} outlines, the "
            "readings put a camera inside the leg; check the readings."
        )


def _norms(r: Array, covariance: Array) -> Array:
    """Mahalanobis distances (n,) of residuals (n, 2)."""
    inverse = np.linalg.inv(covariance)
    return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", r, inverse, r)))


def _median_distance(norm: Array) -> float:
    """Median distance of outlines in standard deviations, at least one."""
    return max(float(np.median(norm)) / _MEDIAN, 1.0) if len(norm) else 1.0


def _rms_by_view(measurements: Measurements, view: IntArray, offsets: Array) -> dict[str, float]:
    """Root mean square of offsets by view [px]."""
    return {
        measurements.views[v].name: float(np.sqrt(np.mean(offsets[view == v] ** 2)))
        for v in np.unique(view).tolist()
    }


def _rms(offsets: Array) -> float | None:
    """Root mean square of offsets; None without any."""
    return float(np.sqrt(np.mean(offsets**2))) if len(offsets) else None


def _weighted_rms(measured: Array, expected: Array) -> tuple[float, float]:
    """Root mean squares of both, weighted by the expected variances."""
    weight = expected**-2
    total = float(np.sum(weight))
    return float(np.sqrt(np.sum(weight * measured**2) / total)), float(
        np.sqrt(len(measured) / total)
    )


_N_BLOCKS = 5
_STEPS_TO_NOMINAL = 6  # from the calibrated to the nominal model
_NEARLY = 1.0  # decrease of the cost, in squared sigmas, at which these end


@dataclass(frozen=True)
class CrossValidation:
    """How well blocks of images are predicted that did not take part.

    Attributes
    ----------
    squares : Array
        (n_blocks,) squared Mahalanobis distances of the innovations.
    dof : IntArray
        (n_blocks,) their expectations.
    gain : float or None
        By how much the squares of the nominal model are larger, cameras and poses fitted again,
        over what the change of the model claims; None where that could not be fitted.
    gain_sigma : float
        Its standard deviation about one, if the claim is right.
    """

    squares: Array
    dof: IntArray
    gain: float | None
    gain_sigma: float = 0.0

    @property
    def ratio(self) -> float:
        """Squares over their expectation, of all blocks."""
        return float(self.squares.sum() / max(int(self.dof.sum()), 1))


def cross_validate(problem: FitProblem, state: State) -> CrossValidation | None:
    """Compare the predictions of blocks of poses at a minimum; None for a single pose.

    Robust factors keep the weights of the minimum, so that all compare the same measurements.
    """
    if problem.n_elements < 2:
        return None
    problem = with_weights(problem, state)
    linear, block = linearize(problem, state), _blocks(state)
    left_out = left_out_blocks(problem, state, linear, block)
    squares = np.array([one.squares for one in left_out])
    dof = np.array([one.dof for one in left_out], dtype=np.intp)
    n = problem.n_kinematic
    nominal = problem.legs.vector(problem.legs.nominal)[problem.free]
    change = problem.coordinates(state)[:n] - nominal
    everything = normal_equations(problem, state, linear).reduced()
    # What blocks add to the information of all else, cameras unknown.
    of_all, *of_rest = (
        float(change @ marginal(information, np.arange(n)) @ change)
        for information in (everything, *(one.information for one in left_out))
    )
    claimed = len(of_rest) * of_all - sum(of_rest)
    held = problem.changed(held_directions=np.eye(n))
    begin = replace(state, legs=problem.parameters.at_fixed(problem.legs.nominal))
    gain, gain_sigma = None, 2.0 / float(np.sqrt(claimed)) if claimed > 0.0 else 0.0
    try:
        minimum = minimise(
            held, begin, max_iterations=_STEPS_TO_NOMINAL, tolerance=_NEARLY, must_converge=False
        )
        by_nominal = left_out_blocks(held, minimum.state, minimum.linear, block)
        if claimed > 0.0:
            gain = float(sum(one.squares for one in by_nominal) - squares.sum()) / claimed
    except DidNotConverge:  # the nominal model does not close at these readings
        pass
    return CrossValidation(squares, dof, gain, gain_sigma)


def with_weights(problem: FitProblem, state: State) -> FitProblem:
    """Replace the robust loss by the weights that it gives measurements at a state."""
    weighted = []
    for factor in problem.factors:
        if factor.robust:
            weight = problem.loss.weights(factor.linearize(state).squared_norms)
            root = np.sqrt(weight)[:, None, None]
            whitening = root * np.asarray(factor.whitening)
            weighted.append(replace(factor, whitening=whitening, robust=False))
    return problem.with_factors(*weighted)


def _blocks(state: State) -> IntArray:
    """Return the block of each pose: neighbours along the line on which poses are spread most."""
    poses = state.platform_pose
    n = len(poses.t)
    places = np.concatenate([poses.t / state.mean_length, poses.R.reshape(n, 9)], axis=1)
    along = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)[0][:, 0]
    block = np.empty(n, dtype=np.intp)
    block[np.argsort(along, kind="stable")] = np.arange(n) * min(_N_BLOCKS, n) // n
    return block
