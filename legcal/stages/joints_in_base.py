"""Section 3.3: the base joint centres in the base frame R_b, eqs (8) and (9).

Each camera saw a part of the same rigid body, the base. Laying these parts on each other
gives the joint centres in R_b, and where each camera stood.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, combinations_with_replacement

import casadi as ca
import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, IntArray
from legcal.stages.free_joints import (
    free_values,
    joint_positions,
    joints_from,
    loose_joints,
    n_free_coordinates,
)
from legcal.stages.joints_in_camera import JointsInCamera
from legcal.stages.least_squares import LeastSquares, Term
from legcal.stages.motion import moved, register_points, whitener
from legcal.stages.nominal import Criteria, NominalMechanism
from legcal.stages.residuals import centre_in_camera, distance_of_joints
from legcal.stages.solution import Solution
from legcal.stages.solve import solve_least_squares


@dataclass(frozen=True, eq=False)
class JointsInBase:
    """Base joint centres in R_b, and the cameras.

    Attributes
    ----------
    A_Rb : (n_legs, 3) array
        Base joint centres [m].
    T_Rb_camera : tuple of RigidTransform or None, length n_views
        Poses of the cameras; None for a view that locates fewer than three joints.
    solution : Solution
        The converged problem: free coordinates of A_Rb first.
    """

    A_Rb: Array
    T_Rb_camera: tuple[RigidTransform | None, ...]
    solution: Solution


def locate_joints_in_base(
    mechanism: NominalMechanism, joints: JointsInCamera, *, criteria: Criteria = "default"
) -> JointsInBase:
    """Locate the base joint centres in R_b from those in the camera frames.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its nominal base joints are the start.
    joints : JointsInCamera
        The result of step 1.
    criteria : {"default", "literal"}
        ``literal`` minimises (9) as printed, with the vectors A_j A_g of all pairs of legs of a
        view and all their products, squares included.

    Returns
    -------
    JointsInBase

    Raises
    ------
    NotIdentifiable
        If the views do not tie all joints together.
    DidNotConverge
        If IPOPT does not.

    Notes
    -----
    Scalar products are even in a coordinate normal to coplanar joints, and equal for a
    mirror image: (9) decides neither z nor the handedness. The camera frames hold points
    with both, so the default lays the points themselves on each other, rigidly and weighted
    by their covariances, with one camera pose a view. A view that locates two joints says how
    far they are from each other.
    """
    if criteria == "literal":
        solution = solve_least_squares(build_scalar_products(mechanism, joints))
        A_Rb = joints_from(mechanism, solution.x)
        return JointsInBase(A_Rb, register_views(A_Rb, joints), solution)
    start = register_views(mechanism.parameters.base_joints, joints)
    problem = build_rigid(mechanism, joints, start)
    solution = solve_least_squares(problem)
    _check_identifiable(mechanism, joints, solution)
    A_Rb = joints_from(mechanism, solution.x)
    steps = iter(solution.x[n_free_coordinates(mechanism) :].reshape(-1, 6))
    cameras = tuple(None if T is None else moved(next(steps), T).inv() for T in _inverses(start))
    return JointsInBase(A_Rb, cameras, solution)


def register_views(A_Rb: Array, joints: JointsInCamera) -> tuple[RigidTransform | None, ...]:
    """Return T_Rb_camera of each view that locates three joints, by closed-form registration."""
    poses: list[RigidTransform | None] = []
    for A_camera, located in zip(joints.A_camera, joints.located, strict=True):
        enough = located.sum() >= 3
        poses.append(register_points(A_camera[located], A_Rb[located]) if enough else None)
    return tuple(poses)


def build_rigid(
    mechanism: NominalMechanism,
    joints: JointsInCamera,
    start: tuple[RigidTransform | None, ...],
) -> LeastSquares:
    """Build the rigid criterion: unknown are A in R_b and the pose of every camera.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its nominal base joints are the start.
    joints : JointsInCamera
        The result of step 1.
    start : tuple of RigidTransform or None
        T_Rb_camera to start from.

    Returns
    -------
    LeastSquares
        Residuals in standard deviations of the centres of step 1.
    """
    positions, n_free = joint_positions(mechanism), n_free_coordinates(mechanism)
    cameras = [T for T in _inverses(start) if T is not None]
    known = np.array([T is not None for T in start])
    which = np.cumsum(known) - 1
    view, leg = np.nonzero(joints.located & known[:, None])
    steps = n_free + 6 * which[view, None] + np.arange(6)
    centres = Term(
        centre_in_camera(),
        np.hstack([positions[leg], steps]),
        (
            np.array([T.rotation.as_matrix() for T in cameras]).reshape(-1, 3, 3)[which[view]],
            np.array([T.translation for T in cameras]).reshape(-1, 3)[which[view]],
            joints.A_camera[view, leg],
            whitener(joints.covariance[view, leg]),
        ),
    )
    two = ~known & (joints.located.sum(axis=1) == 2)
    base = free_values(mechanism, mechanism.parameters.base_joints)
    return LeastSquares(
        "The base joints in the base frame (step 2)",
        (centres, _distances(mechanism, joints, np.flatnonzero(two))),
        np.concatenate([base, np.zeros(6 * len(cameras))]),
        n_shared=n_free,
    )


def build_scalar_products(mechanism: NominalMechanism, joints: JointsInCamera) -> LeastSquares:
    """Build the criterion C_1 of (9): scalar products do not depend on the frame."""
    positions = joint_positions(mechanism)
    legs = tuple(tuple(np.flatnonzero(located).tolist()) for located in joints.located)
    seen = [
        (A[g] - A[j]) @ (A[n] - A[m])
        for A, of_view in zip(joints.A_camera, legs, strict=True)
        for (j, g), (m, n) in _pairs_of_vectors(of_view)
    ]
    function = _scalar_products(tuple(positions.ravel().tolist()), legs)
    index = np.arange(n_free_coordinates(mechanism))[None, :]
    return LeastSquares(
        "The base joints in the base frame (eq 9)",
        (Term(function, index, (np.array(seen)[None, :],)),),
        free_values(mechanism, mechanism.parameters.base_joints),
        exact_hessian=True,
    )


@lru_cache(maxsize=4)
def _scalar_products(positions: tuple[int, ...], legs: tuple[tuple[int, ...], ...]) -> ca.Function:
    """Return (A; products seen) -> the scalar products of (9) of all views, less those seen."""
    x = ca.SX.sym("A", max(positions) + 1)
    A = ca.reshape(ca.vertcat(x, 0.0)[list(positions)], 3, len(positions) // 3)
    products = [
        ca.dot(A[:, g] - A[:, j], A[:, n] - A[:, m])
        for of_view in legs
        for (j, g), (m, n) in _pairs_of_vectors(of_view)
    ]
    seen = ca.SX.sym("seen", len(products))
    return ca.Function("products", [x, seen], [ca.vertcat(*products) - seen])


def _pairs_of_vectors(
    legs: tuple[int, ...],
) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Return the pairs of the set V of (8) in one view, a vector with itself included."""
    return combinations_with_replacement(combinations(legs, 2), 2)


def _distances(mechanism: NominalMechanism, joints: JointsInCamera, views: IntArray) -> Term:
    """Return the weighted distance residuals of views that locate two joints."""
    legs = np.array([np.flatnonzero(joints.located[v]) for v in views], dtype=np.intp)
    j, g = legs.reshape(-1, 2).T
    apart = joints.A_camera[views, g] - joints.A_camera[views, j]
    distance = np.linalg.norm(apart, axis=1)
    covariance = joints.covariance[views, j] + joints.covariance[views, g]
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", apart, covariance, apart)) / distance
    positions = joint_positions(mechanism)
    return Term(distance_of_joints(), np.hstack([positions[j], positions[g]]), (distance, sigma))


def _inverses(poses: tuple[RigidTransform | None, ...]) -> list[RigidTransform | None]:
    """Return the inverse of every known pose."""
    return [None if T is None else T.inv() for T in poses]


def _check_identifiable(
    mechanism: NominalMechanism, joints: JointsInCamera, solution: Solution
) -> None:
    """Refuse when base joints can move without any camera noticing."""
    loose = loose_joints(mechanism, solution)
    if loose:
        counts = ", ".join(str(int(n)) for n in joints.located.sum(axis=1))
        raise NotIdentifiable(
            f"The base joints could not be tied together: those of {', '.join(loose)} can move "
            f"without any view noticing (joints located by view: {counts}); needed views of "
            "three or more legs that share three legs with the others; turn a camera so "
            "that it shows more legs at once."
        )
