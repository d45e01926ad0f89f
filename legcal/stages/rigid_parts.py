"""The rigid criterion of step 2: parts of the base that cameras saw, laid on each other.

Each view saw some joint centres and revolute axes of the base, with covariances. Unknown are
all of them in R_b, and one pose a camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.stages.base_unknowns import BaseUnknowns
from legcal.stages.joints_in_camera import JointsInCamera
from legcal.stages.least_squares import LeastSquares, Term
from legcal.stages.motion import whitener
from legcal.stages.nominal import NominalMechanism
from legcal.stages.residuals import (
    centre_in_camera,
    centre_with_normal,
    distance_of_known_joints,
    joint_in_camera,
    normal_in_camera,
)

_APART = 1e-3  # of the size of the base: nearer joints count as one, whose distance says nothing


def build_rigid(
    mechanism: NominalMechanism,
    joints: JointsInCamera,
    start: Sequence[RigidTransform | None],
) -> LeastSquares:
    """Build the rigid criterion: unknown are A and v in R_b and the poses of cameras.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its nominal base joints and axes are the start.
    joints : JointsInCamera
        The result of step 1.
    start : sequence of RigidTransform or None
        T_Rb_camera to start from. A view without one tells distances between its joints.

    Returns
    -------
    LeastSquares
        Residuals in standard deviations of what step 1 found. The unknowns of
        :class:`legcal.stages.base_unknowns.BaseUnknowns` are the first.
    """
    unknowns = BaseUnknowns.of(mechanism)
    placed = np.array([T is not None for T in start], dtype=np.bool_)
    cameras = [T.inv() for T in start if T is not None]
    pose = _Cameras(unknowns, cameras, np.cumsum(placed) - 1)
    seen = joints.located & placed[:, None]
    with_axis = seen & joints.axis_located
    terms = [
        _distances(unknowns, joints, np.flatnonzero(~placed)),
        _centres(pose, joints, seen & ~with_axis),
    ]
    if mechanism.spatial:
        terms.append(_centres_and_axes(pose, joints, with_axis))
    else:
        terms.append(_centres_in_plane(pose, joints, with_axis))
        terms.append(_normals(pose, joints, with_axis))
    return LeastSquares(
        "The base joints in the base frame (step 2)",
        tuple(terms),
        np.concatenate([unknowns.start, np.zeros(6 * len(cameras))]),
        n_shared=len(unknowns),
    )


class _Cameras:
    """Which unknowns each camera has, and where it starts."""

    def __init__(
        self, unknowns: BaseUnknowns, T_camera_Rb: Sequence[RigidTransform], which: IntArray
    ) -> None:
        self.unknowns, self.which = unknowns, which
        self.R = np.array([T.rotation.as_matrix() for T in T_camera_Rb]).reshape(-1, 3, 3)
        self.t = np.array([T.translation for T in T_camera_Rb]).reshape(-1, 3)

    def steps(self, view: IntArray) -> IntArray:
        """Return the places of the steps of the cameras of views, (n, 6)."""
        return len(self.unknowns) + 6 * self.which[view][:, None] + np.arange(6)

    def known(self, view: IntArray, leg: IntArray) -> tuple[Array, Array, Array]:
        """Return known coordinates of A, and R and t of the cameras."""
        which = self.which[view]
        return self.unknowns.known[leg], self.R[which], self.t[which]


def _centres(pose: _Cameras, joints: JointsInCamera, seen: BoolArray) -> Term:
    """Return the residuals of joints without an axis."""
    view, leg = np.nonzero(seen)
    index = np.hstack([pose.unknowns.joints[leg], pose.steps(view)])
    W = whitener(joints.covariance[view, leg, :3, :3])
    return Term(centre_in_camera(), index, (*pose.known(view, leg), joints.A_camera[view, leg], W))


def _centres_and_axes(pose: _Cameras, joints: JointsInCamera, seen: BoolArray) -> Term:
    """Return the residuals of revolute joints, centre and axis together."""
    view, leg = np.nonzero(seen)
    places = pose.unknowns.joints[leg], pose.steps(view), pose.unknowns.axes[leg]
    observed = (
        *pose.known(view, leg),
        joints.A_camera[view, leg],
        pose.unknowns.frames[leg],
        _frames(joints.v_camera[view, leg]),
        whitener(joints.covariance[view, leg]),
    )
    return Term(joint_in_camera(), np.hstack(places), observed)


def _centres_in_plane(pose: _Cameras, joints: JointsInCamera, seen: BoolArray) -> Term:
    """Return the residuals of the joints of a planar mechanism, given the normal of each view."""
    view, leg = np.nonzero(seen)
    C = joints.covariance[view, leg]
    G = C[:, :3, 3:] @ np.linalg.inv(C[:, 3:, 3:])
    W = whitener(C[:, :3, :3] - G @ C[:, 3:, :3])
    observed = (
        *pose.known(view, leg),
        joints.A_camera[view, leg],
        _frames(joints.v_camera[view, leg]),
        G,
        W,
    )
    index = np.hstack([pose.unknowns.joints[leg], pose.steps(view)])
    return Term(centre_with_normal(), index, observed)


def _normals(pose: _Cameras, joints: JointsInCamera, seen: BoolArray) -> Term:
    """Return the residuals of the normals of a planar mechanism, one a view."""
    view = np.flatnonzero(seen.any(axis=1))
    leg = np.argmax(seen[view], axis=1)
    W = whitener(joints.covariance[view, leg, 3:, 3:])
    observed = (pose.R[pose.which[view]], _frames(joints.v_camera[view, leg]), W)
    return Term(normal_in_camera(), pose.steps(view), observed)


def _distances(unknowns: BaseUnknowns, joints: JointsInCamera, views: IntArray) -> Term:
    """Return the residuals of distances between the joints of views without a camera pose."""
    A = unknowns.A_nominal
    size = float(np.linalg.norm(A - A.mean(axis=0), axis=1).max(initial=0.0))
    pairs = np.array(
        [
            (v, j, g)
            for v in views.tolist()
            for j, g in combinations(np.flatnonzero(joints.located[v]).tolist(), 2)
            if np.linalg.norm(A[g] - A[j]) > _APART * size
        ],
        dtype=np.intp,
    ).reshape(-1, 3)
    view, j, g = pairs.T
    apart = joints.A_camera[view, g] - joints.A_camera[view, j]
    distance = np.linalg.norm(apart, axis=1)
    C = (joints.covariance[view, j] + joints.covariance[view, g])[:, :3, :3]
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", apart, C, apart)) / distance
    known = np.stack([unknowns.known[j], unknowns.known[g]], axis=2)
    index = np.hstack([unknowns.joints[j], unknowns.joints[g]])
    return Term(distance_of_known_joints(), index, (known, distance, sigma))


def _frames(v: Array) -> Array:
    """Return axes and their normal bases as columns, (n, 3, 3)."""
    return np.concatenate([v[:, :, None], np.swapaxes(normal_basis(v), 1, 2)], axis=2)
