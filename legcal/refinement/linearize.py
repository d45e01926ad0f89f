"""From a state to residuals and derivatives: the chain rule around the residuals.

A measurement in the image depends on both ends of a leg in the camera frame; these depend on
joints, camera and platform pose. Rotations change by Cayley's map from the left: a camera turns in
its own frame, a platform about the origin of R_e in the directions of R_b.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.refinement.problem import FitProblem
from legcal.refinement.residuals import (
    axis_residual,
    corner_residual,
    encoder_residual,
    outline_residual,
)
from legcal.refinement.rows import Rows
from legcal.refinement.state import State


@dataclass(frozen=True, eq=False)
class Linearization:
    """Whitened residuals of all kinds at a state.

    Attributes
    ----------
    outlines, readings, axes, corners : Rows
        Two, one, four and two rows a measurement.
    prior_r, prior_J : (n,) and (n, n_kept) array
    """

    outlines: Rows
    readings: Rows
    axes: Rows
    corners: Rows
    prior_r: Array
    prior_J: Array


@dataclass(frozen=True, eq=False)
class _Ends:
    """Both ends of legs in the camera frame, and what their derivatives are made of."""

    A: Array  # (n, 3) from the camera, in its directions, and B likewise
    B: Array
    A_turned: Array  # without the camera's place
    B_turned: Array
    arm: Array  # (n, 3) from the origin of R_e to B, in R_b
    R_camera: Array  # (n, 3, 3)
    R_pose: Array

    def with_radius(self, slope: Array) -> tuple[Array, Array]:
        """Return the same with what comes after the ends: radius, biases, intrinsics."""
        J, J_pose = self.by_unknowns(slope[..., :6])
        return np.concatenate([J, slope[..., 6:]], axis=-1), J_pose

    def by_unknowns(self, slope: Array) -> tuple[Array, Array]:
        """Return derivatives by A, B, camera and by the pose from those by both ends."""
        by_A, by_B = slope[..., :3], slope[..., 3:6]
        a, b = by_A @ self.R_camera, by_B @ self.R_camera
        turn = _cross(self.A_turned[:, None], by_A) + _cross(self.B_turned[:, None], by_B)
        J = np.concatenate([a, b @ self.R_pose, turn, by_A + by_B], axis=-1)
        return J, np.concatenate([_cross(self.arm[:, None], b), b], axis=-1)


def linearize(problem: FitProblem, state: State, whitening: Array) -> Linearization:
    """Return whitened residuals and derivatives of all measurements at a state.

    Parameters
    ----------
    problem : FitProblem
    state : State
    whitening : (n_outlines, 2, 2) array
        Lower triangular T of each outline: T C T^T = 1 [1/px]; zero leaves an outline out.
    """
    r, J = problem.priors.linearize(state, problem.legs)
    return Linearization(
        outline_rows(problem, state).whitened(whitening),
        _reading_rows(problem, state),
        _axis_rows(problem, state),
        corner_rows(problem, state),
        r,
        J,
    )


def outline_rows(problem: FitProblem, state: State) -> Rows:
    """Return the offsets (n, 2) [px] of all outlines with their derivatives."""
    o = problem.outlines
    ends = _ends_in_camera(state, o.leg, o.view, o.pose)
    xy, by_intrinsics = problem.measured_ends(state)
    n = len(o)
    radius = state.radii[o.radius, None]
    local = np.concatenate([ends.A, ends.B, radius, xy.reshape(n, 4)], axis=1)
    r, slope = outline_residual().evaluate(local, o.constants)
    if not o.bias_index.shape[1] and not by_intrinsics.shape[-1]:
        return Rows(r, slope[..., :7], ends.with_radius)
    r = r - np.einsum("nc,ncq->nq", state.biases[o.bias_index], o.bias_shift)
    along = slope[..., 7:].reshape(n, 2, 2, 2)  # by (end, coordinate)
    others = [
        -np.swapaxes(o.bias_shift, 1, 2),
        np.einsum("nqec,neck->nqk", along, by_intrinsics),
    ]
    return Rows(r, np.concatenate([slope[..., :7], *others], axis=-1), ends.with_radius)


def offsets_of(problem: FitProblem, state: State) -> Array:
    """Return the offsets (n, 2) [px] of all outlines at a state."""
    return outline_rows(problem, state).r


def _reading_rows(problem: FitProblem, state: State) -> Rows:
    """Return the whitened closures of all legs with readings."""
    e = problem.readings
    arm = _arms(state)[e.pose, e.leg]
    R_pose = state.R_pose[e.pose]
    local = np.column_stack([state.A[e.leg], state.t_pose[e.pose] + arm, state.lengths[e.leg]])
    r, slope = encoder_residual().evaluate(local, e.length[:, None])

    def chain(slope: Array) -> tuple[Array, Array]:
        b = slope[..., 3:6]
        J = np.concatenate([slope[..., :3], b @ R_pose, slope[..., 6:]], axis=-1)
        return J, np.concatenate([_cross(arm[:, None], b), b], axis=-1)

    return Rows(r, slope, chain).scaled(1.0 / e.sigma)


def _axis_rows(problem: FitProblem, state: State) -> Rows:
    """Return the whitened residuals of all measured axes."""
    a = problem.axes
    ends = _ends_in_camera(state, a.leg, a.view, a.pose)
    r, slope = axis_residual().evaluate(
        np.concatenate([ends.A, ends.B], axis=1),
        np.concatenate([a.M, a.basis.reshape(-1, 6)], axis=1),
    )
    return Rows(r, slope, ends.by_unknowns).whitened(a.whitening)


def corner_rows(problem: FitProblem, state: State) -> Rows:
    """Return the whitened residuals of the corners of a calibration board; no pose moves them."""
    c = problem.board
    R_camera = state.R_camera[c.view]
    arm = c.point @ state.R_board[0].T
    grown = state.board_scale[0] * arm
    turned = _times(R_camera, grown + state.t_board)
    xy, by_intrinsics = problem.measured_corners(state)
    local = np.concatenate([turned + state.t_camera[c.view], xy], axis=1)
    r, slope = corner_residual().evaluate(local, c.constants)

    def chain(slope: Array) -> tuple[Array, Array]:
        in_camera = slope[..., :3]
        in_base = in_camera @ R_camera
        J = np.concatenate(
            [
                _cross(turned[:, None], in_camera),
                in_camera,
                _cross(grown[:, None], in_base),
                in_base,
                in_base @ arm[..., None],
                slope[..., 3:] @ by_intrinsics,
            ],
            axis=-1,
        )
        return J, np.zeros((*slope.shape[:2], 6))

    by_sigma = 1.0 / c.sigma[:, None]
    return Rows(by_sigma * r, by_sigma[..., None] * slope, chain)


def _ends_in_camera(state: State, leg: IntArray, view: IntArray, pose: IntArray) -> _Ends:
    """Return both ends of legs in the camera frames of views at poses."""
    R_camera, t = state.R_camera[view], state.t_camera[view]
    arm = _arms(state)[pose, leg]
    A = (state.A @ np.swapaxes(state.R_camera, 1, 2))[view, leg]
    B = _times(R_camera, state.t_pose[pose] + arm)
    return _Ends(A + t, B + t, A, B, arm, R_camera, state.R_pose[pose])


def _arms(state: State) -> Array:
    """Return what leads from the origin of R_e to B in R_b, (n_poses, n_legs, 3)."""
    return np.asarray(state.B @ np.swapaxes(state.R_pose, 1, 2))


def _times(R: Array, v: Array) -> Array:
    """Return R v of rows, (n, 3)."""
    return np.asarray((R @ v[..., None])[..., 0])


def _cross(a: Array, b: Array) -> Array:
    """Return vector products along the last axis; np.cross is slow."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    i, j, k = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * k - z * j, z * i - x * k, x * j - y * i], axis=-1)
