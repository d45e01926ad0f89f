"""Section 3.3: the base joint centres in the base frame R_b, eqs (8) and (9).

Each camera saw a part of the same rigid body, the base. Laying these parts on each other
gives the joint centres in R_b, and where each camera stood.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, combinations_with_replacement

import casadi as ca
import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.mechanism.parameters import free_coordinates
from legcal.stages.joints_in_camera import JointsInCamera
from legcal.stages.motion import moved, moved_points, register_points, whitener
from legcal.stages.nominal import Criteria, NominalMechanism
from legcal.stages.solve import LeastSquares, Solution, solve_least_squares


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
        A_Rb = _joints(mechanism, solution.x)
        return JointsInBase(A_Rb, register_views(A_Rb, joints), solution)
    start = register_views(mechanism.parameters.base_joints, joints)
    problem = build_rigid(mechanism, joints, start)
    solution = solve_least_squares(problem)
    _check_identifiable(mechanism, joints, solution)
    A_Rb = _joints(mechanism, solution.x)
    steps = iter(solution.x[_n_free(mechanism) :].reshape(-1, 6))
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
    x, A = _unknown_joints(mechanism)
    unknowns, residuals = [x], []
    for v, T_camera_Rb in enumerate(_inverses(start)):
        legs = np.flatnonzero(joints.located[v])
        if T_camera_Rb is None:
            residuals += [_distance_residual(A, joints, v, legs)] if len(legs) == 2 else []
            continue
        step = ca.SX.sym(f"view{v}", 6)
        predicted = moved_points(step, T_camera_Rb, A[:, legs.tolist()])
        for column, j in enumerate(legs):
            W = ca.DM(whitener(joints.covariance[v, j]))
            residuals.append(W @ (predicted[:, column] - ca.DM(joints.A_camera[v, j])))
        unknowns.append(step)
    n_cameras = len(unknowns) - 1
    return LeastSquares(
        "The base joints in the base frame (step 2)",
        ca.vertcat(*unknowns),
        ca.vertcat(*residuals),
        np.concatenate([_start(mechanism), np.zeros(6 * n_cameras)]),
    )


def build_scalar_products(mechanism: NominalMechanism, joints: JointsInCamera) -> LeastSquares:
    """Build the criterion C_1 of (9): scalar products do not depend on the frame."""
    x, A = _unknown_joints(mechanism)
    residuals = []
    for A_camera, located in zip(joints.A_camera, joints.located, strict=True):
        pairs = list(combinations(np.flatnonzero(located).tolist(), 2))  # the set V of (8)
        for (j, g), (m, n) in combinations_with_replacement(pairs, 2):
            in_camera = float((A_camera[g] - A_camera[j]) @ (A_camera[n] - A_camera[m]))
            residuals.append(ca.dot(A[:, g] - A[:, j], A[:, n] - A[:, m]) - in_camera)
    return LeastSquares(
        "The base joints in the base frame (eq 9)",
        x,
        ca.vertcat(*residuals),
        _start(mechanism),
        exact_hessian=True,
    )


def _distance_residual(A: ca.SX, joints: JointsInCamera, view: int, legs: IntArray) -> ca.SX:
    """Return the weighted distance residual of a view that locates two joints."""
    j, g = (int(leg) for leg in legs)
    apart = joints.A_camera[view, g] - joints.A_camera[view, j]
    distance = float(np.linalg.norm(apart))
    n = apart / distance
    sigma = float(np.sqrt(n @ (joints.covariance[view, j] + joints.covariance[view, g]) @ n))
    return (ca.norm_2(A[:, g] - A[:, j]) - distance) / sigma


def _unknown_joints(mechanism: NominalMechanism) -> tuple[ca.SX, ca.SX]:
    """Return the free coordinates of A as unknowns, and A (3, n_legs) built of them."""
    free = free_coordinates(mechanism.n_legs, mechanism.frame_legs)
    x = ca.SX.sym("A", int(free.sum()))
    A = ca.SX.zeros(3, mechanism.n_legs)
    for k, (leg, axis) in enumerate(np.argwhere(free)):
        A[int(axis), int(leg)] = x[k]
    return x, A


def _joints(mechanism: NominalMechanism, x: Array) -> Array:
    """Return A_Rb from the free coordinates at the head of x."""
    free = free_coordinates(mechanism.n_legs, mechanism.frame_legs)
    A_Rb = np.zeros((mechanism.n_legs, 3))
    A_Rb[free] = x[: _n_free(mechanism)]
    return A_Rb


def _start(mechanism: NominalMechanism) -> Array:
    """Return the free coordinates of the nominal base joints."""
    free = free_coordinates(mechanism.n_legs, mechanism.frame_legs)
    return mechanism.parameters.base_joints[free]


def _n_free(mechanism: NominalMechanism) -> int:
    """Return the number of free coordinates."""
    return int(free_coordinates(mechanism.n_legs, mechanism.frame_legs).sum())


def _inverses(poses: tuple[RigidTransform | None, ...]) -> list[RigidTransform | None]:
    """Return the inverse of every known pose."""
    return [None if T is None else T.inv() for T in poses]


def _check_identifiable(
    mechanism: NominalMechanism, joints: JointsInCamera, solution: Solution
) -> None:
    """Refuse when base joints can move without any camera noticing."""
    free = free_coordinates(mechanism.n_legs, mechanism.frame_legs)
    unseen: BoolArray = np.zeros_like(free)
    unseen[free] = solution.unseen(_n_free(mechanism))
    loose = [mechanism.leg_names[int(j)] for j in np.flatnonzero(unseen.any(axis=1))]
    if loose:
        counts = ", ".join(str(int(n)) for n in joints.located.sum(axis=1))
        raise NotIdentifiable(
            f"The base joints could not be tied together: those of {', '.join(loose)} can move "
            f"without any view noticing (joints located by view: {counts}); needed views of "
            "three or more legs that share three legs with the others; turn a camera so "
            "that it shows more legs at once."
        )
