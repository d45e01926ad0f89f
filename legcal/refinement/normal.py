"""The normal equations in NumPy, with the platform poses eliminated (Schur complement).

Every measurement depends on one pose at most, so the poses' 6 x 6 blocks are eliminated all at
once, and what is left is as small as the mechanism and its cameras. Blocks that are singular
(a pose or a camera that too little was measured of) are inverted on their range only: they
then neither move nor carry information.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.refinement.inputs import evaluate_jacobian, inputs_of
from legcal.refinement.loss import curvature, efficiency, weights
from legcal.refinement.problem import FitProblem
from legcal.refinement.residuals import axis_residual, encoder_residual, outline_residual
from legcal.refinement.state import State

_RANGE = 1e-13  # eigenvalues below this part of the largest are rounding


@dataclass(frozen=True, eq=False)
class Linearization:
    """Whitened residuals and their Jacobians at a state; unknowns in mm and mrad.

    Attributes
    ----------
    outline_r, outline_J : (n, 2) and (n, 2, 19) array
    encoder_r, encoder_J : (n, 1) and (n, 1, 13) array
    prior_r, prior_J : (n,) array
        Residuals of the prior, and their derivatives by their own unknown.
    axis_r, axis_J : (n, 4) and (n, 4, 18) array
    """

    outline_r: Array
    outline_J: Array
    encoder_r: Array
    encoder_J: Array
    prior_r: Array
    prior_J: Array
    axis_r: Array
    axis_J: Array


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """N x = -g with N = [[U, W], [W^T, V]]: kept unknowns first, then one block for each pose.

    Attributes
    ----------
    U : (n_kept, n_kept) array
    W : (n_poses, n_kept, 6) array
    V_inverse : (n_poses, 6, 6) array
    g_kept, g_pose : (n_kept,) and (n_poses, 6) array
        Gradient of the cost.
    """

    U: Array
    W: Array
    V_inverse: Array
    g_kept: Array
    g_pose: Array

    def reduced(self) -> Array:
        """Return the normal matrix (n_kept, n_kept) of the kept unknowns: U - W V^-1 W^T."""
        S = self.U - np.einsum("kap,kpq,kbq->ab", self.W, self.V_inverse, self.W, optimize=True)
        return np.asarray(0.5 * (S + S.T))

    def step(self) -> Array:
        """Return the Gauss-Newton step x; directions that nothing determines stay."""
        eliminated = np.einsum("kpq,kq->kp", self.V_inverse, self.g_pose)
        right = -self.g_kept + np.einsum("kap,kp->a", self.W, eliminated)
        kept = inverse_on_range(self.reduced()) @ right
        pose = -eliminated - np.einsum("kpq,kaq,a->kp", self.V_inverse, self.W, kept, optimize=True)
        return np.concatenate([kept, pose.ravel()])


def linearize(problem: FitProblem, state: State, whitening: Array) -> Linearization:
    """Return residuals and Jacobians of all measurements at a state."""
    of_outlines, of_readings, _, of_axes = inputs_of(problem, state, whitening, 0.0)
    prior = problem.radius_prior
    return Linearization(
        *evaluate_jacobian(outline_residual(), of_outlines),
        *evaluate_jacobian(encoder_residual(), of_readings),
        (state.radii - prior.mean) / prior.sigma,
        1e-3 / prior.sigma,
        *evaluate_jacobian(axis_residual(), of_axes),
    )


def normal_equations(problem: FitProblem, linear: Linearization, k: float) -> NormalEquations:
    """Return the normal equations of the robust cost, with the loss's true curvature.

    Parameters
    ----------
    problem : FitProblem
    linear : Linearization
    k : float
        Narrowness of the loss on outlines and axes, 0 for plain least squares.

    Returns
    -------
    NormalEquations
    """
    outlines, axes = (
        _robust_blocks(r, J, k)
        for r, J in ((linear.outline_r, linear.outline_J), (linear.axis_r, linear.axis_J))
    )
    return _assembled(problem, linear, outlines, axes)


def information(problem: FitProblem, linear: Linearization, k: float) -> NormalEquations:
    """Return the normal equations whose inverse is the covariance of the unknowns.

    Parameters
    ----------
    problem : FitProblem
    linear : Linearization
    k : float
        Narrowness of the loss, which does not keep all information of outlines and axes
        (:func:`legcal.refinement.loss.efficiency`); 0 for what the data hold.

    Returns
    -------
    NormalEquations
    """
    outlines, axes = (
        (efficiency(k, J.shape[1]) * (np.swapaxes(J, -1, -2) @ J), np.zeros(J.shape[::2]))
        for J in (linear.outline_J, linear.axis_J)
    )
    return _assembled(problem, linear, outlines, axes)


def inverse_on_range(S: Array) -> Array:
    """Return the inverse of symmetric positive semidefinite matrices (..., n, n) on their range.

    The matrices are scaled to unit diagonal first, so that units do not matter.
    """
    diagonal = np.einsum("...ii->...i", S)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    value, vector = np.linalg.eigh(scale[..., :, None] * S * scale[..., None, :])
    kept = value > _RANGE * value[..., -1:]
    inverse = np.where(kept, 1.0, 0.0) / np.where(kept, value, 1.0)
    scaled = scale[..., :, None] * vector
    return np.asarray((scaled * inverse[..., None, :]) @ np.swapaxes(scaled, -1, -2))


def _robust_blocks(r: Array, J: Array, k: float) -> tuple[Array, Array]:
    """Return each measurement's share in the normal matrix and in the gradient."""
    w = weights(np.sum(r**2, axis=-1), k)
    MJ = curvature(r, k) @ J
    return np.swapaxes(J, -1, -2) @ MJ, np.einsum("nri,nr,n->ni", J, r, w)


def _assembled(
    problem: FitProblem,
    linear: Linearization,
    outlines: tuple[Array, Array],
    axes: tuple[Array, Array],
) -> NormalEquations:
    """Sum the blocks of all measurements into the blocks of the normal equations."""
    layout, n_poses = problem.layout, len(problem.layout.pose)
    n_kept = layout.n_kept
    U = np.zeros((n_kept + 1) ** 2)
    W = np.zeros(n_poses * (n_kept + 1) * 6)
    V = np.zeros((n_poses, 36))
    g_kept, g_pose = np.zeros(n_kept + 1), np.zeros((n_poses, 6))
    J = linear.encoder_J
    kinds = [
        (problem.outline_index, problem.outlines.pose, *outlines),
        (
            problem.encoder_index,
            problem.readings.pose,
            np.swapaxes(J, -1, -2) @ J,
            np.einsum("nri,nr->ni", J, linear.encoder_r),
        ),
        (problem.axis_index, problem.axes.pose, *axes),
    ]
    for index, pose, blocks, gradients in kinds:
        m = index.shape[1] - 6
        at = np.minimum(index[:, :m], n_kept)  # what is fixed collects in the last row
        U += _summed((at[:, :, None] * (n_kept + 1) + at[:, None, :]), blocks[:, :m, :m], len(U))
        place = (pose[:, None] * (n_kept + 1) + at)[:, :, None] * 6 + np.arange(6)
        W += _summed(place, blocks[:, :m, m:], len(W))
        np.add.at(V, pose, blocks[:, m:, m:].reshape(-1, 36))
        g_kept += _summed(at, gradients[:, :m], n_kept + 1)
        np.add.at(g_pose, pose, gradients[:, m:])
    U_matrix = U.reshape(n_kept + 1, n_kept + 1)[:n_kept, :n_kept].copy()
    position = problem.radius_prior.position
    U_matrix[position, position] += linear.prior_J**2
    g_kept[position] += linear.prior_J * linear.prior_r
    return NormalEquations(
        U_matrix,
        W.reshape(n_poses, n_kept + 1, 6)[:, :n_kept],
        inverse_on_range(V.reshape(n_poses, 6, 6)),
        g_kept[:n_kept],
        g_pose,
    )


def _summed(place: IntArray, value: Array, size: int) -> Array:
    """Sum values into a vector at their places."""
    sums = np.bincount(place.ravel(), weights=value.ravel(), minlength=size)
    return np.asarray(sums, dtype=np.float64)
