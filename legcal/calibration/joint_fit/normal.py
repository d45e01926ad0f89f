"""The covariance of what was found, and the directions that are known worst.

Poses and cameras are eliminated from the Gauss-Newton normal matrix; the inverse of what
remains is the covariance of the named unknowns with everything else unknown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.linalg import cho_factor, cho_solve, null_space

from legcal.calibration.joint_fit.constraints import Tangent, tangent
from legcal.calibration.joint_fit.problem import FitProblem, Linearization, named_jacobian
from legcal.calibration.joint_fit.residuals import Rows, Sums, summed
from legcal.calibration.joint_fit.state import State
from legcal.errors import NotIdentifiable
from legcal.estimation import efficiency
from legcal.geometry import Array, BoolArray

_RANGE = 1e-13  # eigenvalues below this part of the largest are rounding
_SAFE = 1e-9  # a scaled block with a pivot below may be singular


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """N x = -g with N = [[U, W], [W^T, V]]: kept unknowns first, then one block for each pose.

    Poses move inside their constraints: V, W and g_pose belong to coordinates y of
    :class:`legcal.calibration.joint_fit.constraints.Tangent`.

    Attributes
    ----------
    U : (n_kept, n_kept) array
    W : (n_kept, n_poses, f) array
    V : (n_poses, f, f) array
    g_kept, g_pose : (n_kept,) and (n_poses, f) array
        Gradient of the cost.
    tangent : Tangent or None
        What the constraints leave; None where poses are free.
    held : (w, n_kept) array
        Directions that stay.
    """

    U: Array
    W: Array
    V: Array
    g_kept: Array
    g_pose: Array
    tangent: Tangent | None
    held: Array

    @cached_property
    def V_inverse(self) -> Array:
        """The inverses of the poses' blocks on their range, (n_poses, f, f)."""
        return inverse_on_range(self.V)

    def reduced(self) -> Array:
        """Return the normal matrix (n_kept, n_kept) of the kept unknowns: U - W V^-1 W^T."""
        S = self.U - _coupled(_by_pose(self.W, self.V_inverse), self.W)
        return np.asarray(0.5 * (S + S.T))

    def kept_covariance(self) -> Array:
        """Return the inverse of the reduced matrix, held directions left out."""
        S = self.reduced()
        if len(self.held) == 0:
            return inverse_on_range(S)
        N = null_space(self.held)
        return np.asarray(N @ inverse_on_range(N.T @ S @ N) @ N.T)

    def step(self, damping: float) -> tuple[Array, float]:
        """Return a Levenberg-Marquardt step and the fall of the cost that it promises.

        Parameters
        ----------
        damping : float
            Part of the diagonal that is added to it.

        Returns
        -------
        x : (size,) array
            Changes of all unknowns.
        fall : float
        """
        V = _damped(self.V, damping)
        V_inverse = np.asarray(np.linalg.inv(V), dtype=np.float64)
        WV = _by_pose(self.W, V_inverse)
        U = _damped(self.U, damping)
        S = U - _coupled(WV, self.W)
        right = -self.g_kept + _flat(WV) @ self.g_pose.ravel()
        kept = self._solved(S, right)
        pull = self.g_pose + (kept @ _flat(self.W)).reshape(self.g_pose.shape)
        y = -(V_inverse @ pull[..., None])[..., 0]
        linear = float(self.g_kept @ kept + np.sum(self.g_pose * y))
        extra = float(
            np.sum(np.diagonal(U - self.U) * kept**2)
            + np.sum(np.einsum("kpp->kp", V - self.V) * y**2)
        )
        pose = y if self.tangent is None else _carried(self.tangent, kept, y)
        return np.concatenate([kept, pose.ravel()]), 0.5 * (extra - linear)

    def pose_step(self) -> Array:
        """Return the step (size,) of the poses alone, all else at rest."""
        y = -(self.V_inverse @ self.g_pose[..., None])[..., 0]
        kept = np.zeros(len(self.U))
        pose = y if self.tangent is None else _carried(self.tangent, kept, y)
        return np.concatenate([kept, pose.ravel()])

    def _solved(self, S: Array, right: Array) -> Array:
        """Return S^-1 right in the complement of what is held."""
        if len(self.held):
            N = null_space(self.held)
            return np.asarray(N @ _solve(N.T @ S @ N, N.T @ right))
        return _solve(S, right)


def normal_equations(
    problem: FitProblem, state: State, linear: Linearization, k: float
) -> NormalEquations:
    """Return the normal equations of the robust cost, with the loss's true curvature.

    Parameters
    ----------
    problem : FitProblem
    state : State
        Where *linear* was taken.
    linear : Linearization
    k : float
        Narrowness of the loss on all but readings, 0 for plain least squares.
    """
    return _of_rows(problem, state, linear, lambda rows, n_rows: rows.softened(k))


def information(
    problem: FitProblem, state: State, linear: Linearization, k: float
) -> NormalEquations:
    """Return the normal equations whose inverse is the covariance of the unknowns.

    Parameters
    ----------
    problem, state, linear
        As in :func:`normal_equations`.
    k : float
        Narrowness of the loss, which does not keep all information of what it is on
        (:func:`legcal.estimation.loss.efficiency`); 0 for what the data hold.
    """
    return _of_rows(
        problem, state, linear, lambda rows, n_rows: rows.scaled(np.sqrt(efficiency(k, n_rows)))
    )


def _of_rows(
    problem: FitProblem,
    state: State,
    linear: Linearization,
    weighted: Callable[[Rows, int], Rows],
) -> NormalEquations:
    """Return the normal equations of all kinds; *weighted* is done to those with a robust loss."""
    of = problem.couplings
    kinds = [
        (of.outlines, weighted(linear.outlines, 2)),
        (of.readings, linear.readings),
        (of.axes, weighted(linear.axes, 4)),
        (of.corners, weighted(linear.corners, 2)),
    ]
    sums = summed(kinds, problem.layout.n_kept, problem.layout.n_poses)
    return _constrained(problem, state, linear, sums)


def of_one_kind(
    problem: FitProblem, state: State, linear: Linearization, kind: Literal["outlines", "readings"]
) -> NormalEquations:
    """Return the normal equations of one kind of measurements and the priors, plain squares.

    Their poses are those that this kind alone tells: V and W are without the other kinds.
    """
    of_kind = {
        "outlines": (problem.couplings.outlines, linear.outlines),
        "readings": (problem.couplings.readings, linear.readings),
    }
    sums = summed([of_kind[kind]], problem.layout.n_kept, problem.layout.n_poses)
    return _constrained(problem, state, linear, sums)


def inverse_on_range(S: Array) -> Array:
    """Return the inverse of symmetric positive semidefinite matrices (..., n, n) on their range.

    The matrices are scaled to unit diagonal first, so that units do not matter.
    """
    flat = S.reshape(-1, *S.shape[-2:])
    scale = _scale(flat)
    scaled = scale[:, :, None] * flat * scale[:, None, :]
    inverse = np.empty_like(scaled)
    safe = _is_safe(scaled)
    inverse[safe] = np.linalg.inv(scaled[safe])
    value, vector = np.linalg.eigh(scaled[~safe])
    kept = value > _RANGE * value[..., -1:]
    reciprocal = np.where(kept, 1.0, 0.0) / np.where(kept, value, 1.0)
    inverse[~safe] = (vector * reciprocal[..., None, :]) @ np.swapaxes(vector, -1, -2)
    return np.asarray((scale[:, :, None] * inverse * scale[:, None, :]).reshape(S.shape))


def _is_safe(scaled: Array) -> BoolArray:
    """Say which matrices of unit diagonal are far from singular."""
    try:
        L = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return np.zeros(len(scaled), dtype=np.bool_)
    return np.asarray(np.einsum("kii->ki", L).min(axis=1, initial=1.0) ** 2 > _SAFE)


def _scale(S: Array) -> Array:
    """Return what scales diagonals (..., n) to one; one where they are zero."""
    diagonal = np.einsum("...ii->...i", S)
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)))


def _constrained(
    problem: FitProblem, state: State, linear: Linearization, sums: Sums
) -> NormalEquations:
    """Add the priors, and put motions inside the constraints in place of poses."""
    U = sums.U + linear.prior_J.T @ linear.prior_J
    g_kept = sums.g_kept + linear.prior_J.T @ linear.prior_r
    W, V, g_pose = sums.W, sums.V, sums.g_pose
    motion = tangent(state, problem.layout, problem.legs)
    if motion is not None:
        Z, Q = motion.Z, motion.Q
        coupled, QV = _coupled(W, Q), _by_pose(Q, V)
        U = U + coupled + coupled.T + _coupled(Q, QV)
        g_kept = g_kept + _flat(Q) @ g_pose.ravel()
        W = _by_pose(W + QV, Z)
        V = np.swapaxes(Z, 1, 2) @ V @ Z
        g_pose = np.einsum("kpf,kp->kf", Z, g_pose)
    return NormalEquations(U, W, V, g_kept, g_pose, motion, problem.held)


def _coupled(left: Array, right: Array) -> Array:
    """Return the sum over poses of left right^T, both (n_kept, n_poses, f)."""
    return np.asarray(_flat(left) @ _flat(right).T)


def _flat(W: Array) -> Array:
    """Return what couples unknowns to poses as one matrix (n_kept, n_poses f)."""
    return W.reshape(len(W), -1)


def _by_pose(W: Array, blocks: Array) -> Array:
    """Return W (n_kept, n_poses, f) times the block (n_poses, f, h) of each pose."""
    found = np.empty((*W.shape[:2], blocks.shape[2]))
    np.matmul(W.swapaxes(0, 1), blocks, out=found.swapaxes(0, 1))
    return found


def _damped(M: Array, damping: float) -> Array:
    """Return matrices with a part of their diagonal added to it; one where it is zero."""
    diagonal = np.einsum("...ii->...i", M)
    added = np.where(diagonal > 0.0, damping * diagonal, 1.0)
    return np.asarray(M + added[..., None] * np.eye(M.shape[-1]))


def _solve(S: Array, right: Array) -> Array:
    """Return S^-1 right for a positive definite S, scaled; least squares where it is not."""
    scale = _scale(S)
    scaled = scale[:, None] * S * scale
    try:
        found = cho_solve(cho_factor(scaled, check_finite=False), scale * right)
    except np.linalg.LinAlgError:
        found = inverse_on_range(scaled) @ (scale * right)
    return np.asarray(scale * found)


def _carried(motion: Tangent, kept: Array, y: Array) -> Array:
    """Return the motions of poses (n_poses, 6) for steps of kept unknowns and inside them."""
    return np.asarray(np.einsum("kpf,kf->kp", motion.Z, y) + np.einsum("akp,a->kp", motion.Q, kept))


_NAMED = 0.3  # components of a direction that are named, relative to the largest


@dataclass(frozen=True, eq=False)
class WeakDirection:
    """A combination of parameters that is known worst.

    Attributes
    ----------
    sigma : float
        Standard deviation along it; angles count at the mean length of the legs [m].
    parts : tuple of (str, float)
        Its largest components: parameter names and coefficients of a unit vector.
    """

    sigma: float
    parts: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        return " ".join(f"{value:+.2f} {name}" for name, value in self.parts)


def named_covariance(problem: FitProblem, state: State, covariance: Array) -> Array:
    """Return the covariance (n_named, n_named) of the values of the named unknowns.

    Parameters
    ----------
    problem : FitProblem
    state : State
    covariance : (n_kept, n_kept) array
        Of all unknowns but poses, as :func:`information` has them.
    """
    n = problem.layout.n_named
    by_x = named_jacobian(state, problem.layout, problem.legs)
    return np.asarray(by_x @ covariance[:n, :n] @ by_x.T)


def worst_directions(
    covariance: Array, names: tuple[str, ...], unit: Array, n_directions: int = 3
) -> tuple[WeakDirection, ...]:
    """Return the directions known worst, worst first.

    Parameters
    ----------
    covariance : (n, n) array
        Of parameters, each in its own unit.
    names : tuple of str
        Their names.
    unit : (n,) array
        A metre of each parameter in its unit.
    n_directions : int
        How many to name.
    """
    scaled = covariance / unit[:, None] / unit
    variance, vector = np.linalg.eigh(scaled)
    return tuple(
        direction(vector[:, -1 - i], names, float(np.sqrt(max(variance[-1 - i], 0.0))))
        for i in range(min(n_directions, len(names)))
    )


def direction(vector: Array, names: tuple[str, ...], sigma: float) -> WeakDirection:
    """Return the largest components of a direction, the largest one positive."""
    vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
    order = np.argsort(-np.abs(vector), kind="stable")
    named = [i for i in order if abs(vector[i]) >= _NAMED * abs(vector[order[0]])][:4]
    return WeakDirection(sigma, tuple((names[i], float(vector[i])) for i in named))


def check_counts(problem: FitProblem, n_images: int) -> None:
    """Refuse a fit with fewer equations than unknowns.

    Raises
    ------
    NotIdentifiable
        With both numbers.
    """
    equations = problem.n_equations + len(problem.priors)
    unknowns = problem.n_unknowns
    if equations < unknowns:
        seen = f"{len(problem.outlines)} outlines"
        if len(problem.axes):
            seen = f"{len(problem.axes)} axes" + f", {seen}" * bool(len(problem.outlines))
        raise NotIdentifiable(
            f"The fit is not determined: {n_images} images with {seen} "
            f"and {len(problem.readings)} readings give {equations} equations for "
            f"{unknowns} unknowns; add images."
        )
