"""Poses of the platform by what images show alone, without the readings.

Everything else stays as the fit has it. Where legs have R or U joints or constant lengths, the
poses keep what these demand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.refinement.constraints import on_constraints
from legcal.refinement.foretold import Foretold
from legcal.refinement.linearize import Linearization, linearize, offsets_of
from legcal.refinement.normal import NormalEquations, of_one_kind
from legcal.refinement.state import State, turned

_ROBUST_STEPS, _MOST_STEPS = 10, 30
_WIDTH = 3.0  # whitened distance at which an outline starts to count less
_KNOWN = 0.03  # [rad], or of a leg's length: a pose known worse is none
_FURTHEST = 0.1  # [rad], or of a leg's length, in one step
_LOST = 0.3  # the same from where the search began
_SETTLED = 1e-4  # squared length of the last step, in standard deviations
_RANK = 1.0  # [1/rad^2, 1/m^2]: better than a metre or radian


@dataclass(frozen=True, eq=False)
class ShownPoses:
    """Poses by outlines alone.

    Attributes
    ----------
    T_Rb_Re : tuple of RigidTransform
        All poses; those that are not known mean nothing.
    known : (n_known,) array of int
        Which poses the outlines determine.
    covariance : (n_known, 6, 6) array
        Of the motion between each of these by the readings and by the outlines: rotation vector in
        R_b and displacement of R_e [rad^2, rad m, m^2].
    """

    T_Rb_Re: tuple[RigidTransform, ...]
    known: IntArray
    covariance: Array


def poses_by_outlines(foretold: Foretold, whitening: Array, rejection: float) -> ShownPoses:
    """Return the poses that fit the outlines best.

    Outlines count less the farther off they are, then those near enough count alike. Poses that
    still move after that are not known.

    Parameters
    ----------
    foretold : Foretold
        The images at poses nearby, those by the readings.
    whitening : (n, 2, 2) array
        Whitens the noise of the outlines [1/px].
    rejection : float
        Whitened distance beyond which an outline does not count.
    """
    problem, begin = foretold.problem, foretold.state
    linear = linearize(problem, begin, whitening)
    length = _mean_length(begin)
    state, known = begin, _is_known(of_one_kind(problem, begin, linear, "outlines"), length)
    settled = np.zeros(len(known), dtype=np.bool_)
    weight = np.ones(len(problem.outlines))
    for step in range(_ROBUST_STEPS + _MOST_STEPS):
        s = linear.outlines.squared_norms
        if step < _ROBUST_STEPS:
            weight = 1.0 / (1.0 + s / _WIDTH**2)
        elif step == _ROBUST_STEPS:
            weight = np.where(s < rejection**2, 1.0, 0.0)
        normal = of_one_kind(problem, state, _weighted(linear, weight), "outlines")
        change, squared = _step(normal)
        settled = (squared < _SETTLED) & (step >= _ROBUST_STEPS)
        moving = known & ~settled
        if not moving.any():
            break
        state, is_near = _moved(foretold, state, np.where(moving[:, None], change, 0.0), length)
        known &= is_near
        linear = linearize(problem, state, whitening)
    outlines = of_one_kind(problem, state, _weighted(linear, weight), "outlines")
    readings = of_one_kind(problem, state, linear, "readings")
    which = np.flatnonzero(known & settled & _is_known(outlines, length))
    covariance = _covariance(outlines, readings, foretold.covariance)[which]
    return ShownPoses(state.T_Rb_Re, which, covariance)


def _weighted(linear: Linearization, weight: Array) -> Linearization:
    """Return the same with weights of the squares of outlines."""
    factor = np.sqrt(weight)[:, None, None] * np.eye(2)
    return replace(linear, outlines=linear.outlines.whitened(factor))


def _step(normal: NormalEquations) -> tuple[Array, Array]:
    """Return Gauss-Newton's steps (n_poses, 6) and their squared lengths in sigmas (n_poses,)."""
    y = -(normal.V_inverse @ normal.g_pose[..., None])[..., 0]
    squared = np.einsum("kf,kfh,kh->k", y, normal.V, y)
    return (_motions(normal) @ y[..., None])[..., 0], np.asarray(squared)


def _moved(
    foretold: Foretold, state: State, change: Array, length: float
) -> tuple[State, BoolArray]:
    """Return poses after a change [rad, m] that is not too large, and which are near the first.

    Those that are not are back at the first ones, and so are those that put a camera into a leg.
    """
    begin, unit = foretold.state, np.repeat([1.0, length], 3)
    reach = np.linalg.norm(change / unit, axis=1, keepdims=True)
    change = change * np.minimum(1.0, _FURTHEST / np.maximum(reach, 1e-300))
    R, t = turned(state.R_pose, change[:, :3]), state.t_pose + change[:, 3:]
    cosine = 0.5 * (np.einsum("kij,kij->k", R, begin.R_pose) - 1.0)
    shift = np.linalg.norm(t - begin.t_pose, axis=1)
    is_near = (cosine > np.cos(_LOST)) & (shift < _LOST * length)
    trial = _with_poses(state, begin, is_near, R, t)
    trial = on_constraints(trial, foretold.problem.legs.frame_legs)
    seen = np.isfinite(offsets_of(foretold.problem, trial)).all(axis=1)
    is_near[foretold.problem.outlines.pose[~seen]] = False
    return _with_poses(trial, begin, is_near, trial.R_pose, trial.t_pose), is_near


def _with_poses(state: State, begin: State, chosen: BoolArray, R: Array, t: Array) -> State:
    """Return a state with some new poses, the others those of the beginning."""
    return replace(
        state,
        R_pose=np.where(chosen[:, None, None], R, begin.R_pose),
        t_pose=np.where(chosen[:, None], t, begin.t_pose),
    )


def _mean_length(state: State) -> float:
    """Return the mean length of the legs [m]."""
    B = state.B @ np.swapaxes(state.R_pose, 1, 2) + state.t_pose[:, None]
    return float(np.mean(np.linalg.norm(B - state.A, axis=2)))


def _is_known(normal: NormalEquations, length: float) -> BoolArray:
    """Return which poses are determined well enough to mean anything."""
    Z = _motions(normal)
    covariance = Z @ normal.V_inverse @ np.swapaxes(Z, 1, 2)
    has_rank = np.linalg.eigvalsh(normal.V)[:, 0] > _RANK
    turn, shift = (
        np.sqrt(np.trace(covariance[:, part, part], axis1=1, axis2=2))
        for part in (slice(0, 3), slice(3, 6))
    )
    return np.asarray(has_rank & (shift < _KNOWN * length) & (turn < _KNOWN))


def _covariance(outlines: NormalEquations, readings: NormalEquations, of_fit: Array) -> Array:
    """Return the covariance of the motions between poses by readings and by outlines.

    Each has its own noise, and both follow the errors of the fit.
    """
    apart = _following(outlines) - _following(readings)
    inside = outlines.V_inverse + readings.V_inverse + apart @ of_fit @ np.swapaxes(apart, 1, 2)
    Z = _motions(outlines)
    return np.asarray(Z @ inside @ np.swapaxes(Z, 1, 2))


def _following(normal: NormalEquations) -> Array:
    """Return how poses follow the kept unknowns inside the constraints, (n_poses, f, n_kept)."""
    return np.asarray(-normal.V_inverse @ np.moveaxis(normal.W, 0, 2))


def _motions(normal: NormalEquations) -> Array:
    """Return the basis of the motions of poses, (n_poses, 6, f)."""
    if normal.tangent is None:
        return np.broadcast_to(np.eye(6), (len(normal.V), 6, 6))
    return normal.tangent.Z
