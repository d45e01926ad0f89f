"""Prediction errors of a fit: in held-out images, and in images left out block by block.

**Held out**, in pixels: outlines predicted from the calibrated model, the readings and the cameras,
against the measured ones.

**Left out**: images that did not take part, predicted by a fit without them and by the nominal
model. No fit is repeated: from the normal equations at the minimum the information of a block of
poses is removed, with all images of these, and one Gauss-Newton step taken. Blocks are of
neighbouring poses, so that a fit has to extrapolate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.documents import Holdout
from legcal.calibration.joint_fit.factors import observed_outlines
from legcal.calibration.joint_fit.outline_errors import EdgeBiases, NoiseModel, possible_biases
from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import State
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.errors import DidNotConverge, NotIdentifiable, NotVisible
from legcal.estimation.problem import Residuals, linearize
from legcal.estimation.solver import information, minimise
from legcal.estimation.uncertainty import left_out_blocks, leverage
from legcal.geometry.types import Array, IntArray


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
    ) -> Posterior:
        """Return the same of other images of the views, at given poses; new biases have a prior."""
        problem_of_fit, legs, state = self.problem, self.problem.legs, self.state
        observed = observed_outlines(outlines, measurements, legs)
        observed = observed.with_parts_first(problem_of_fit.outlines.parts).through(state.cameras)
        possible = possible_biases(observed, legs.names, problem_of_fit.outlines)
        shifts = possible.of_sizes(self.edge_biases.sigma)
        problem = problem_of_fit.with_measurements(measurements, observed, shifts)
        biases = self.biases
        other_radii = [legs.radii[part] for part in observed.parts[len(state.radii) :]]
        predicted = replace(
            state,
            radii=np.append(state.radii, other_radii),
            biases=np.array([biases.get(name, 0.0) for name in shifts.names]),
            platform_pose=problem.postures(state.legs, T_Rb_Re),
        )
        covariance = self._covariance_of(problem, shifts)
        return replace(self, problem=problem, state=predicted, covariance=covariance)

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
_MEDIAN = float(np.sqrt(2.0 * np.log(2.0)))  # median norm of two unit Gaussians
_RANK_TOLERANCE = 1e-18  # relative to the largest eigenvalue of a pose's information


def compare_held_out(
    posterior: Posterior,
    measurements: Measurements,
    outlines: Outlines,
    T_Rb_Re: Sequence[RigidTransform],
) -> Holdout:
    """Compare held-out images with the predictions of a fit to other images.

    Common-mode biases known from the fit are subtracted. Expected errors include the noise of
    outlines and readings, and the covariance of the fit.

    The used *outlines* of the held-out *measurements* are compared, at the poses *T_Rb_Re*
    computed from the fit and the readings.

    Raises NotIdentifiable if the readings do not determine the poses; NotVisible if a camera is
    inside a leg.
    """
    predicted = posterior.of_images(measurements, outlines, T_Rb_Re)
    problem, state = predicted.problem.weighted(posterior.noise), predicted.state
    L = np.linalg.cholesky(posterior.noise.covariance(problem.outlines.covariance))
    linear = linearize(problem, state)
    n_inside = int(np.sum(~np.isfinite(linear["outlines"].r).all(axis=1)))
    if n_inside:
        raise NotVisible(
            f"The held-out images could not be compared with the fit: for {n_inside} outlines, the "
            "readings put a camera inside the leg; check the readings."
        )
    readings = information(linear, only=_READINGS)
    eigenvalues = np.linalg.eigvalsh(readings.V)
    undetermined = np.flatnonzero(eigenvalues[:, 0] <= _RANK_TOLERANCE * eigenvalues[:, -1])
    if len(undetermined):
        raise NotIdentifiable(
            "The held-out images could not be compared with the fit: their readings do not "
            f"determine platform pose {undetermined[0] + 1}; leave out --holdout."
        )
    expected = np.eye(2) + leverage(readings, "outlines", predicted.covariance)
    offsets = (L @ linear["outlines"].r[..., None])[..., 0]
    r = linear["outlines"].r
    norm = np.sqrt(np.einsum("ni,nij,nj->n", r, np.linalg.inv(expected), r))  # Mahalanobis
    scatter = max(float(np.median(norm)) / _MEDIAN, 1.0) if len(norm) else 1.0
    inliers = norm < problem.settings.rejection * scatter
    view = problem.outlines.view[inliers]
    pixels = np.einsum("nij,njk,nik->ni", L, expected, L)
    return Holdout(
        images=measurements.n_rows,
        poses=measurements.n_poses,
        outlines=len(problem.outlines),
        wrong=int(np.sum(~inliers)),
        rms_px=rms(offsets[inliers]),
        expected_px=rms(np.sqrt(pixels[inliers])),
        views={
            measurements.views[v].name: float(np.sqrt(np.mean(offsets[inliers][view == v] ** 2)))
            for v in np.unique(view).tolist()
        },
    )


def rms(values: Array) -> float | None:
    """Root mean square of values; None without any."""
    return float(np.sqrt(np.mean(values**2))) if values.size else None


_N_BLOCKS = 5
_STEPS_TO_NOMINAL = 6  # from the calibrated to the nominal model
_NEARLY = 1.0  # decrease of the cost, in squared sigmas, at which these end


@dataclass(frozen=True)
class CrossValidation:
    """How well blocks of images are predicted that did not take part."""

    squares: Array  # (n_blocks,) squared Mahalanobis distances of the innovations
    dof: IntArray  # (n_blocks,) their expectations
    # by how much the squares of the nominal model are larger, cameras and poses fitted again, over
    # what they would be with the measurements that the fit predicts; None where that could not be
    # fitted
    gain: float | None
    gain_sigma: float = 0.0  # its standard deviation about one, if the claim is right

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
    block = _blocks(state)
    left_out = left_out_blocks(linearize(problem, state), block)
    held = replace(problem, held_directions=np.eye(problem.n_kinematic))
    begin = replace(state, legs=problem.parameters.at_fixed(problem.legs.nominal))
    gain, gain_sigma = None, 0.0
    try:
        of_nominal, claimed = (
            _squares_near(measured, begin, block) for measured in (held, _as_if_true(held, state))
        )
        if claimed > 0.0:
            gain = (of_nominal - float(left_out.squares.sum())) / claimed
            gain_sigma = 2.0 / float(np.sqrt(claimed))
    except DidNotConverge:  # the nominal model does not close at these readings
        pass
    return CrossValidation(left_out.squares, left_out.dof, gain, gain_sigma)


def _squares_near(problem: FitProblem, begin: State, block: IntArray) -> float:
    """Return the squares of blocks that are left out, near the minimum from a state."""
    minimum = minimise(
        problem, begin, max_iterations=_STEPS_TO_NOMINAL, tolerance=_NEARLY, must_converge=False
    )
    return float(left_out_blocks(minimum.linear, block).squares.sum())


def _as_if_true(problem: FitProblem, state: State) -> FitProblem:
    """Return the problem with the measurements that a state predicts, without noise."""

    def less(rows: Callable[[State], Residuals], off: Array, at: State) -> Residuals:
        found = rows(at)
        return replace(found, r=found.r - off)

    return problem.with_factors(
        *(
            replace(factor, rows=partial(less, factor.rows, factor.rows(state).r))
            for factor in problem.factors
        )
    )


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
