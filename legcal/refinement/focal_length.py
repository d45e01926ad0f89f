"""Whether the measurements agree with the focal lengths that cameras were given.

Encoders carry the absolute scale, and a focal length that is wrong makes perspective wrong in a way
that nothing else in the fit can imitate altogether. What is left in the residuals then has a slope
by the focal length: Rao's score test, which needs no further fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.geometry.types import Array, IntArray
from legcal.refinement.influence import reduced_jacobian
from legcal.refinement.linearize import Linearization
from legcal.refinement.normal import NormalEquations, normal_equations
from legcal.refinement.problem import FitProblem
from legcal.refinement.sensitivity import corners_change, offsets_change
from legcal.refinement.state import State, intrinsic_of
from legcal.vision.intrinsics import shared_cameras, undistort_derivatives

_SIGNIFICANT = 5.0  # standard deviations
_ROUNDED = 1e-9  # relative: what is left of a difference of equals
_KEYS = ("fx", "fy")


@dataclass(frozen=True)
class FocalLength:
    """What the measurements say of the focal length of a camera that was taken as known.

    Attributes
    ----------
    view : str
        The view, the first one by name if several have the camera.
    given : float
        fx of the camera [px].
    change : float
        What would have to be added to fx and fy, as a part of them.
    sigma : float
        Standard deviation of that.
    """

    view: str
    given: float
    change: float
    sigma: float

    @property
    def is_doubtful(self) -> bool:
        """Whether the measurements disagree with what was given."""
        return abs(self.change) > _SIGNIFICANT * self.sigma

    def __str__(self) -> str:
        found, sigma = self.given * (1.0 + self.change), self.given * self.sigma
        away = abs(self.change) / self.sigma
        return (
            f"The focal length of {self.view} does not agree with the measurements: found fx = "
            f"{found:.1f} +- {sigma:.1f} px, given {self.given:.1f} px, {away:.0f} standard "
            f"deviations and {1e2 * self.change:+.2f} % apart; the stated uncertainty knows "
            "nothing of it; calibrate the camera again, look for pictures that were scaled or "
            f"focused anew, or let the fit find it (--free {self.view}.fx --free {self.view}.fy)."
        )


def focal_lengths(
    problem: FitProblem, state: State, linear: Linearization, whitening: Array
) -> tuple[FocalLength, ...]:
    """Return what the measurements say of the focal lengths that the fit took as known.

    Parameters
    ----------
    problem : FitProblem
        With the shifts that outlines share, so that these are not taken for a focal length.
    state : State
        Where the fit ended.
    linear : Linearization
        There.
    whitening : (n_outlines, 2, 2) array
        What *linear* was taken with.

    Returns
    -------
    tuple of FocalLength
        One a camera; those are left out of which the measurements say nothing.
    """
    layout, o = problem.layout, problem.outlines
    known = [
        v
        for v in np.unique(o.view).tolist()
        if not any(
            x < layout.size
            for key, x in zip(layout.intrinsic_keys, layout.intrinsic[v].tolist(), strict=True)
            if key in _KEYS
        )
    ]
    owners = shared_cameras(o.views, state.cameras)
    tested = sorted({owners[v] for v in known})
    if not tested:
        return ()
    changes = []
    for owner in tested:
        views = np.array([v for v in known if owners[v] == owner], dtype=np.intp)
        changes.append(_by_focal_length(problem, state, views))
    columns = whitening @ np.stack([offsets for offsets, _ in changes], axis=-1)
    of_corners = np.stack([corners for _, corners in changes], axis=-1)
    normal = normal_equations(problem, state, linear, 0.0)
    score, information = _left_by_the_fit(problem, linear, normal, columns, of_corners)
    whole = np.sum(columns**2, axis=(0, 1)) + np.sum(of_corners**2, axis=(0, 1))
    seen = np.flatnonzero(np.diagonal(information) > _ROUNDED * whole)
    covariance = np.linalg.pinv(information[np.ix_(seen, seen)], rcond=_ROUNDED, hermitian=True)
    change, sigma = -covariance @ score[seen], np.sqrt(np.diagonal(covariance))
    return tuple(
        FocalLength(
            tested[i],
            intrinsic_of(state.cameras[owners.index(tested[i])], "fx"),
            float(d),
            float(s),
        )
        for i, d, s in zip(seen.tolist(), change, sigma, strict=True)
    )


def _by_focal_length(problem: FitProblem, state: State, views: IntArray) -> tuple[Array, Array]:
    """Return the change by a relative change of the views' focal length.

    Of offsets (n, 2) [px], and of the whitened residuals of corners (m, 2).
    """
    o, c = problem.outlines, problem.board
    moved, corners = np.zeros(o.feet.shape), np.zeros(c.feet.shape)
    for v in views.tolist():
        camera, of_view, shown = state.cameras[v], o.view == v, c.view == v
        lengths = np.array([intrinsic_of(camera, key) for key in _KEYS])
        moved[of_view] = undistort_derivatives(camera, o.pixels[of_view], _KEYS) @ lengths
        corners[shown] = undistort_derivatives(camera, c.pixels[shown], _KEYS) @ lengths
    return offsets_change(problem, state, moved), corners_change(problem, corners)


def _left_by_the_fit(
    problem: FitProblem,
    linear: Linearization,
    normal: NormalEquations,
    columns: Array,
    of_corners: Array,
) -> tuple[Array, Array]:
    """Return what the fit leaves of v^T r (c,) and v^T v (c, c).

    The v are whitened columns (n, 2, c) of outlines and (m, 2, c) of corners, which no pose moves.
    """
    where, rows = problem.couplings.outlines, linear.outlines
    corners = reduced_jacobian(problem.couplings.corners, linear.corners, normal)
    kept = np.einsum("nqk,nqc->kc", reduced_jacobian(where, rows, normal), columns, optimize=True)
    kept += np.einsum("nqk,nqc->kc", corners, of_corners, optimize=True)
    J_pose = rows.J_pose
    if normal.tangent is not None:
        J_pose = J_pose @ normal.tangent.Z[where.pose]
    by_pose = np.zeros((len(normal.V), J_pose.shape[-1], columns.shape[-1]))
    np.add.at(by_pose, where.pose, np.swapaxes(J_pose, 1, 2) @ columns)
    following = normal.V_inverse @ by_pose
    covariance = normal.kept_covariance()
    g_kept = normal.g_kept - np.einsum(
        "akp,kpq,kq->a", normal.W, normal.V_inverse, normal.g_pose, optimize=True
    )
    score = np.einsum("nqc,nq->c", columns, rows.r) - kept.T @ covariance @ g_kept
    score += np.einsum("nqc,nq->c", of_corners, linear.corners.r)
    score -= np.einsum("kpc,kp->c", following, normal.g_pose)
    information = np.einsum("nqc,nqd->cd", columns, columns) - kept.T @ covariance @ kept
    information += np.einsum("nqc,nqd->cd", of_corners, of_corners)
    return score, information - np.einsum("kpc,kpd->cd", following, by_pose)
