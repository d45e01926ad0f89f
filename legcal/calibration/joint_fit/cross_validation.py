"""Images that did not take part: predicted by a fit without them, and by the nominal model.

No fit is repeated: from the normal equations at the minimum the information of a block of poses is
removed, with all images of these, and one Gauss-Newton step taken. Blocks are of neighbouring
poses, so that a fit has to extrapolate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from legcal.calibration.joint_fit.problem import FitProblem
from legcal.calibration.joint_fit.variables import State
from legcal.errors import DidNotConverge
from legcal.estimation.problem import linearize
from legcal.estimation.solver import minimise, normal_equations
from legcal.estimation.uncertainty import left_out_blocks, marginal
from legcal.geometry.types import Array, IntArray

_N_BLOCKS = 5
_MAX_STEPS = 6  # from the calibrated to the nominal model
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
            held, begin, max_iterations=_MAX_STEPS, tolerance=_NEARLY, must_converge=False
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
