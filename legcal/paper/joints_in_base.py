"""Axes that are known to belong to a joint: through its centre A, and normal to its axis v."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import combinations, combinations_with_replacement, product
from typing import Any

import casadi as ca
import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data import LegAxes
from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry import Array, BoolArray, IntArray, normal_basis
from legcal.paper.base_unknowns import (
    BaseUnknowns,
    CameraStart,
    camera_starts,
    nominal_axes,
    signs_seen,
    turned_axis,
)
from legcal.paper.joints_in_camera import JointsInCamera, miss_of_joint, with_signs
from legcal.paper.nominal import Criteria, NominalMechanism
from legcal.paper.solver import (
    LeastSquares,
    Solution,
    Term,
    moved,
    moved_points,
    solve_least_squares,
    whitener,
)


@cache
def centre_in_camera() -> ca.Function:
    """Return (A, step; known, R, t, A_camera, W) -> W times the miss of A in a camera, (3,).

    *known* are the coordinates of A that are no unknowns.
    """
    local, known, R, t = _camera(9)
    A_camera, W = ca.SX.sym("A_camera", 3), ca.SX.sym("W", 3, 3)
    miss = moved_points(local[3:], R, t, local[:3] + known) - A_camera
    return ca.Function("centre", [local, known, R, t, A_camera, W], [W @ miss])


@cache
def joint_in_camera() -> ca.Function:
    """Return (A, step, turns; known, R, t, A_camera, frame, v_camera, W) -> W times the miss, (5,).

    The miss of A, and the turns of v about its normal basis in the camera. The frames are those
    of :func:`legcal.paper.base_unknowns.turned_axis`, for v in R_b and in the camera.
    """
    local, known, R, t = _camera(11)
    A_camera, frame = ca.SX.sym("A_camera", 3), ca.SX.sym("frame", 3, 3)
    v_camera, W = ca.SX.sym("v_camera", 3, 3), ca.SX.sym("W", 5, 5)
    miss = moved_points(local[3:9], R, t, local[:3] + known) - A_camera
    turns = _turns_in_camera(local[3:9], R, turned_axis(local[9:], frame), v_camera)
    return ca.Function(
        "joint", [local, known, R, t, A_camera, frame, v_camera, W], [W @ ca.vertcat(miss, turns)]
    )


@cache
def centre_with_normal() -> ca.Function:
    """Return (A, step; known, R, t, A_camera, v_camera, G, W) -> W times the miss of A, (3,).

    A leg of a planar mechanism: its centre is the one seen if the normal of the plane is; it
    follows turns of the normal by G (3, 2).
    """
    local, known, R, t = _camera(9)
    A_camera, v_camera = ca.SX.sym("A_camera", 3), ca.SX.sym("v_camera", 3, 3)
    G, W = ca.SX.sym("G", 3, 2), ca.SX.sym("W", 3, 3)
    turns = _turns_in_camera(local[3:9], R, ca.SX([0.0, 0.0, 1.0]), v_camera)
    miss = moved_points(local[3:9], R, t, local[:3] + known) - A_camera - G @ turns
    return ca.Function("centre", [local, known, R, t, A_camera, v_camera, G, W], [W @ miss])


@cache
def normal_in_camera() -> ca.Function:
    """Return (step; R, v_camera, W) -> W times the turns of the normal of a plane, (2,)."""
    local, R = ca.SX.sym("local", 6), ca.SX.sym("R", 3, 3)
    v_camera, W = ca.SX.sym("v_camera", 3, 3), ca.SX.sym("W", 2, 2)
    turns = _turns_in_camera(local, R, ca.SX([0.0, 0.0, 1.0]), v_camera)
    return ca.Function("normal", [local, R, v_camera, W], [W @ turns])


@cache
def distance_of_known_joints() -> ca.Function:
    """Return (two joints; known, distance, sigma) -> their distance less the one seen, in sigmas.

    *known* (3, 2) are the coordinates that are no unknowns.
    """
    local, known = ca.SX.sym("local", 6), ca.SX.sym("known", 3, 2)
    distance, sigma = ca.SX.sym("distance"), ca.SX.sym("sigma")
    apart = local[3:] + known[:, 1] - local[:3] - known[:, 0]
    miss = (ca.norm_2(apart) - distance) / sigma
    return ca.Function("joints", [local, known, distance, sigma], [miss])


@cache
def change_of_distance() -> ca.Function:
    """Return (q0 of two legs; legs before, legs after) -> the change of eq (14)."""
    q0 = ca.SX.sym("q0", 2)
    before, after = ca.SX.sym("before", 7, 2), ca.SX.sym("after", 7, 2)
    change = _distance_of_ends(q0, after) - _distance_of_ends(q0, before)
    return ca.Function("change", [q0, before, after], [change])


@cache
def constant_distance() -> ca.Function:
    """Return (q0 of two legs and d_jg; legs, sigma) -> distance seen less d_jg, in sigmas."""
    local, legs, sigma = ca.SX.sym("local", 3), ca.SX.sym("legs", 7, 2), ca.SX.sym("sigma")
    miss = (_distance_of_ends(local[:2], legs) - local[2]) / sigma
    return ca.Function("constant", [local, legs, sigma], [miss])


@cache
def distance_of_ends_and_joints() -> ca.Function:
    """Return (q0 and B of two legs; legs, sigma) -> distance seen less that of B, in sigmas."""
    local, legs, sigma = ca.SX.sym("local", 8), ca.SX.sym("legs", 7, 2), ca.SX.sym("sigma")
    miss = (_distance_of_ends(local[:2], legs) - ca.norm_2(local[2:5] - local[5:])) / sigma
    return ca.Function("ends", [local, legs, sigma], [miss])


def _distance_of_ends(q0: ca.SX, legs: ca.SX) -> ca.SX:
    """Return the distance between the ends A + (q + q0) u of two legs, one a column, eq (13)."""
    ends = [legs[:3, k] + (legs[6, k] + q0[k]) * legs[3:6, k] for k in range(2)]
    return ca.norm_2(ends[0] - ends[1])


def _camera(n_local: int) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Return symbols of local unknowns, of known coordinates of A, and of R and t at step zero."""
    local, known = ca.SX.sym("local", n_local), ca.SX.sym("known", 3)
    return local, known, ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3)


def _turns_in_camera(step: ca.SX, R: ca.SX, v: ca.SX, v_camera: ca.SX) -> ca.SX:
    """Return by how much an axis is turned from the one seen, about its normal basis (2,)."""
    seen = moved_points(step, R, ca.SX.zeros(3), v) - step[:3]
    return ca.vertcat(-ca.dot(v_camera[:, 2], seen), ca.dot(v_camera[:, 1], seen))


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
        :class:`legcal.paper.base_unknowns.BaseUnknowns` are the first.
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


_MOST_TRIALS = 32  # of places of cameras that look alike
_DECIDED = 4.5  # half of a squared error: a difference in cost that decides between two places


def register_views(
    A_Rb: Array, v_Rb: Array, joints: JointsInCamera
) -> tuple[RigidTransform | None, ...]:
    """Return T_Rb_camera of each view whose joints and axes fix it, in closed form, unweighted.

    Parameters
    ----------
    A_Rb, v_Rb : (n_legs, 3) array
        Base joint centres [m] and revolute axes in R_b.
    joints : JointsInCamera
        The result of step 1.
    """
    starts = _starts(A_Rb, v_Rb, joints)
    return tuple(
        places[0].T_Rb_camera if len(places) == 1 and places[0].fixed else None for places in starts
    )


def _starts(A_Rb: Array, v_Rb: Array, joints: JointsInCamera) -> list[list[CameraStart]]:
    """Return where the camera of each view may have stood."""
    return [
        camera_starts(
            A_Rb[located], v_Rb[axis], A_camera[located], v_camera[axis], signed=bool(sided)
        )
        for A_camera, located, v_camera, axis, sided in zip(
            joints.A_camera,
            joints.located,
            joints.v_camera,
            joints.axis_located,
            joints.sided,
            strict=True,
        )
    ]


def lay_together(
    mechanism: NominalMechanism, joints: JointsInCamera
) -> tuple[Solution, JointsInCamera, tuple[CameraStart | None, ...]]:
    """Return the rigid solution, joints with the signs of their axes, and where cameras started."""
    A_Rb, v_Rb = mechanism.parameters.base_joints, nominal_axes(mechanism)
    starts: list[Sequence[CameraStart | None]] = []
    n_trials = 1
    for places, located in zip(_starts(A_Rb, v_Rb, joints), joints.located, strict=True):
        usable = places and (places[0].fixed or located.sum() > 2)
        if usable and n_trials * len(places) <= _MOST_TRIALS:
            n_trials *= len(places)
            starts.append(places)
        else:
            starts.append([None])
    trials = [_Trial.of(mechanism, joints, v_Rb, choice) for choice in product(*starts)]
    best = min(trials, key=lambda trial: trial.cost)
    doubtful = np.zeros(len(starts), dtype=np.bool_)
    for trial in trials:
        if trial.cost < best.cost + _DECIDED:
            doubtful |= [a is not b for a, b in zip(trial.starts, best.starts, strict=True)]
    if doubtful.any():
        choice = [None if d else a for a, d in zip(best.starts, doubtful, strict=True)]
        best = _Trial.of(mechanism, joints, v_Rb, choice)
    if isinstance(best.solution, DidNotConverge):
        raise best.solution
    return best.solution, best.joints, best.starts


@dataclass(frozen=True, eq=False)
class _Trial:
    """The rigid criterion, begun from one place of each camera."""

    starts: tuple[CameraStart | None, ...]
    joints: JointsInCamera
    solution: Solution | DidNotConverge

    @classmethod
    def of(
        cls,
        mechanism: NominalMechanism,
        joints: JointsInCamera,
        v_Rb: Array,
        starts: Sequence[CameraStart | None],
    ) -> _Trial:
        """Return what the criterion gives."""
        signs = np.ones(joints.located.shape)
        for v, start in enumerate(starts):
            if start is not None:
                axes = np.flatnonzero(joints.axis_located[v])
                signs[v, axes] = signs_seen(v_Rb[axes], joints.v_camera[v, axes], start.T_Rb_camera)
        joints = with_signs(joints, signs)
        places = [None if start is None else start.T_Rb_camera for start in starts]
        solution: Solution | DidNotConverge
        try:
            solution = solve_least_squares(build_rigid(mechanism, joints, places))
        except DidNotConverge as failure:  # the wrong one of two places may end anywhere
            solution = failure
        return cls(tuple(starts), joints, solution)

    @property
    def cost(self) -> float:
        """Half the sum of squares, infinite where there is no solution."""
        return self.solution.cost if isinstance(self.solution, Solution) else np.inf


Legs = tuple[tuple[int, ...], ...]


def build_scalar_products(mechanism: NominalMechanism, joints: JointsInCamera) -> LeastSquares:
    """Build C_1 of (9), with all products of all pairs of vectors, squares included.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its nominal base joints and axes are the start.
    joints : JointsInCamera
        The result of step 1, its axes with the signs of the nominal ones.

    Returns
    -------
    LeastSquares
        Residuals as printed [m^2, m, -]; the squares v . v = 1 are left out.
    """
    unknowns = BaseUnknowns.of(mechanism)
    legs = tuple(tuple(np.flatnonzero(located).tolist()) for located in joints.located)
    revolute = joints.axis_located & mechanism.revolute
    axes = tuple(tuple(np.flatnonzero(located).tolist()) for located in revolute)
    seen = [
        product
        for v in range(len(legs))
        for product in _products(
            _vectors(joints.A_camera[v], joints.v_camera[v], legs[v], axes[v]), len(axes[v])
        )
    ]
    x = tuple(unknowns.joints.ravel().tolist()), tuple(unknowns.axes.ravel().tolist())
    function = _differences(x, legs, axes)
    n_legs = mechanism.n_legs
    observed = (
        np.array(seen)[None, :],
        unknowns.known.T.reshape(1, 3, n_legs),
        np.hstack(list(unknowns.frames)).reshape(1, 3, 3 * n_legs),
    )
    return LeastSquares(
        "The base joints in the base frame (eq 9)",
        (Term(function, np.arange(len(unknowns))[None, :], observed),),
        unknowns.start,
        exact_hessian=True,
    )


@lru_cache(maxsize=4)
def _differences(
    places: tuple[tuple[int, ...], tuple[int, ...]], legs: Legs, axes: Legs
) -> ca.Function:
    """Return (A, turns of v; products seen, known, frames) -> products of all views, less seen."""
    n_legs = len(places[0]) // 3
    x = ca.SX.sym("x", max(*places[0], *places[1]) + 1)
    known, frames = ca.SX.sym("known", 3, n_legs), ca.SX.sym("frames", 3, 3 * n_legs)
    padded = ca.vertcat(x, 0.0)
    A = ca.reshape(padded[list(places[0])], 3, n_legs) + known
    turns = ca.reshape(padded[list(places[1])], 2, n_legs)
    joints = [A[:, j] for j in range(n_legs)]
    turned = [turned_axis(turns[:, j], frames[:, 3 * j : 3 * j + 3]) for j in range(n_legs)]
    products = [
        product
        for of_view, with_axis in zip(legs, axes, strict=True)
        for product in _products(_vectors(joints, turned, of_view, with_axis), len(with_axis))
    ]
    seen = ca.SX.sym("seen", len(products))
    return ca.Function("products", [x, seen, known, frames], [ca.vertcat(*products) - seen])


def _vectors(A: Any, v: Any, legs: Sequence[int], axes: Sequence[int]) -> list[Any]:
    """Return the set V of (8) in one view, axes last."""
    return [A[g] - A[j] for j, g in combinations(legs, 2)] + [v[j] for j in axes]


def _products(vectors: list[Any], n_axes: int) -> list[Any]:
    """Return the products of all pairs of vectors, and the squares of those that are no axes."""
    last = len(vectors) - n_axes
    return [
        vectors[p].T @ vectors[q]
        for p, q in combinations_with_replacement(range(len(vectors)), 2)
        if p != q or p < last
    ]


_LARGEST_TURN = 1.0  # [rad] of an axis; beyond, nothing is known of it


@dataclass(frozen=True, eq=False)
class JointsInBase:
    """Base joint centres and revolute axes in R_b, and the cameras.

    Attributes
    ----------
    A_Rb : (n_legs, 3) array
        Base joint centres [m].
    T_Rb_camera : tuple of RigidTransform or None, length n_views
        Poses of the cameras; None for a view whose joints and axes do not fix it.
    solution : Solution
        The converged problem: the unknowns of
        :class:`legcal.paper.base_unknowns.BaseUnknowns` first.
    base_axes : (n_legs, 3) array
        Unit revolute axes, on the side of the nominal ones; NaN for legs without one, and in planar
        mechanisms, where all axes are z.
    """

    A_Rb: Array
    T_Rb_camera: tuple[RigidTransform | None, ...]
    solution: Solution
    base_axes: Array


def locate_joints_in_base(
    mechanism: NominalMechanism, joints: JointsInCamera, *, criteria: Criteria = "default"
) -> JointsInBase:
    """Locate base joint centres and revolute axes in R_b from those in the camera frames.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its nominal base joints and axes are the start.
    joints : JointsInCamera
        The result of step 1.
    criteria : {"default", "literal"}
        ``literal`` minimises (9) as printed, with the vectors A_j A_g of all pairs of legs of a
        view, its revolute axes and all their products, squares included.

    Returns
    -------
    JointsInBase

    Raises
    ------
    NotIdentifiable
        If the views do not tie all joints and axes together; of the ``literal`` criterion, if one
        of them is in none of its products, or these are fewer than the unknowns.
    DidNotConverge
        If IPOPT does not.

    Notes
    -----
    Scalar products are even in a coordinate normal to coplanar joints, and equal for a
    mirror image: (9) decides neither z nor the handedness. The camera frames hold points and
    directions with both, so the default lays them on each other, rigidly and weighted
    by their covariances, with one camera pose a view. A view of two joints whose axes do not fix
    the camera says how far they are from each other. Where axes leave two places of a camera, both
    are tried; where they fit alike, the view says no more than distances.
    """
    if criteria == "literal":
        _check_products(mechanism, joints)
        problem = build_scalar_products(mechanism, joints)
        if problem.n_residuals < len(problem.start):
            raise NotIdentifiable(
                f"The base could not be located (eq 9): found {problem.n_residuals} scalar "
                f"products in all views for {len(problem.start)} unknowns (joints located by view: "
                f"{_counts(joints.located)}), needed at least as many; turn a camera so that it "
                "shows more legs at once."
            )
        solution = solve_least_squares(problem)
        return _found(mechanism, joints, solution, None)
    solution, oriented, placed = lay_together(mechanism, joints)
    _check_identifiable(mechanism, joints, solution)
    return _found(mechanism, oriented, solution, placed)


def _found(
    mechanism: NominalMechanism,
    joints: JointsInCamera,
    solution: Solution,
    starts: Sequence[CameraStart | None] | None,
) -> JointsInBase:
    """Return the result; without starts, cameras are placed afterwards."""
    unknowns = BaseUnknowns.of(mechanism)
    A_Rb, axes = unknowns.joints_at(solution.x), unknowns.axes_at(solution.x)
    if starts is None:
        cameras = register_views(A_Rb, axes, joints)
    else:
        steps = iter(solution.x[len(unknowns) :].reshape(-1, 6))
        moves = [None if start is None else next(steps) for start in starts]
        cameras = tuple(
            moved(move, start.T_Rb_camera.inv()).inv()
            if start is not None and move is not None and start.fixed
            else None
            for start, move in zip(starts, moves, strict=True)
        )
    return JointsInBase(
        A_Rb, cameras, solution, np.where(mechanism.revolute[:, None], axes, np.nan)
    )


def _check_products(mechanism: NominalMechanism, joints: JointsInCamera) -> None:
    """Refuse when a joint or an axis is in no product of (9), which would leave it at nominal."""
    several = joints.located.sum(axis=1) > 1
    shown = joints.located[several].any(axis=0)
    turning = mechanism.revolute & ~joints.axis_located[several].any(axis=0)
    what = [
        f"{kind} of {', '.join(np.array(mechanism.leg_names)[missing])}"
        for kind, missing in (("base joints", ~shown), ("revolute axes", turning & shown))
        if missing.any()
    ]
    if what:
        raise NotIdentifiable(
            f"The base could not be located (eq 9): found no view that locates the "
            f"{' and the '.join(what)} together with the base joint of another leg (joints located "
            f"by view: {_counts(joints.located)}), needed one; turn a camera so that it shows more "
            "legs at once."
        )


def _check_identifiable(
    mechanism: NominalMechanism, joints: JointsInCamera, solution: Solution
) -> None:
    """Refuse when base joints or axes can move without any camera noticing."""
    unknowns = BaseUnknowns.of(mechanism)
    loose = np.append(_loose(unknowns, solution), False)
    names = np.array(mechanism.leg_names)
    moving = names[loose[unknowns.joints].any(axis=1)]
    turning = names[loose[unknowns.axes].any(axis=1)]
    if not len(moving) and not len(turning):
        return
    what = "base joints" if len(moving) else "revolute axes at the base"
    can = [f"those of {', '.join(moving)} can move"] if len(moving) else []
    if len(turning):
        of_axes = "the revolute axes" if len(moving) else "those"
        can.append(f"{of_axes} of {', '.join(turning)} can turn")
    counts = f"joints located by view: {_counts(joints.located)}"
    if mechanism.revolute.any():
        counts += f"; axes: {_counts(joints.axis_located)}"
    needed = "views of three or more legs that share three legs with the others"
    if mechanism.revolute.any():
        needed += ", or two legs and a revolute axis across the line between them"
    if not mechanism.spatial:
        needed = "views of two or more legs that share two legs with the others"
    raise NotIdentifiable(
        [
            f"The {what} could not be tied together: {' and '.join(can)} without any view noticing "
            f"({counts}); needed {needed}; turn a camera so that it shows more legs at once, or "
            "fix a calibration board to the base.",
            *joints.diagnostics,
        ]
    )


def _loose(unknowns: BaseUnknowns, solution: Solution) -> BoolArray:
    """Return which unknowns nothing shows to better than the size of the base or a radian."""
    n = len(unknowns)
    A = unknowns.A_nominal
    limit = np.full(n, _LARGEST_TURN)
    limit[: int(np.sum(unknowns.joints >= 0))] = np.ptp(A, axis=0).max(initial=0.0)
    sigma = np.sqrt(np.diag(solution.covariance())[:n])
    return solution.unseen(n) | (sigma > limit)


def _counts(located: BoolArray) -> str:
    """Return how many were located in each view."""
    return ", ".join(str(int(n)) for n in located.sum(axis=1))


_NO_AXIS = 1e6  # [rad^2] of the angle to an axis that a leg does not have
_EXACT = 1e-12  # [rad^2]: no axis is known better


def condition_on_joint(
    axes: LegAxes, A: Array, v: Array, covariance: Array
) -> tuple[Array, Array, Array]:
    """Return axes that are known to pass through points and to be normal to directions.

    Parameters
    ----------
    axes : LegAxes
        Axes.
    A : (n, 3) array
        A point of each in the same frame [m].
    v : (n, 3) array
        A unit normal of each; zero where there is none.
    covariance : (n, 3, 3) array
        Covariance of the normals [rad^2].

    Returns
    -------
    u : (n, 3) array
        Unit directions.
    basis : (n, 2, 3) array
        e1 and e2 normal to u.
    covariance : (n, 2, 2) array
        Covariance of u along e1 and e2 [rad^2].
    """
    here = np.arange(len(axes))
    residual, spread, cross = miss_of_joint(axes, here, A, v)
    doubt = np.einsum("ni,nij,nj->n", axes.u, covariance, axes.u) + _EXACT
    spread[:, 2, 2] += np.where(np.any(v != 0.0, axis=1), doubt, _NO_AXIS)
    gain = cross @ np.linalg.inv(spread)
    alpha = (gain @ residual[..., None])[..., 0]
    left = axes.covariance[:, :2, :2] - gain @ np.swapaxes(cross, 1, 2)
    u = axes.u + np.einsum("nia,ni->na", axes.basis, alpha)
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    e1 = axes.basis[:, 0] - u * np.sum(u * axes.basis[:, 0], axis=-1, keepdims=True)
    e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
    symmetric = 0.5 * (left + np.swapaxes(left, 1, 2))
    return u, np.stack([e1, np.cross(u, e1)], axis=1), symmetric


def known_normals(
    mechanism: NominalMechanism,
    joints: JointsInCamera,
    base: JointsInBase,
    view: IntArray,
    leg: IntArray,
) -> tuple[Array, Array]:
    """Return what legs are normal to, in R_b where the view is placed there, else in its frame.

    Parameters
    ----------
    mechanism : NominalMechanism
        Its joints.
    joints, base : JointsInCamera, JointsInBase
        The results of steps 1 and 2.
    view, leg : (n,) array of int
        The view and the leg of each.

    Returns
    -------
    (n, 3) array, (n, 3, 3) array
        Unit vectors, zero where there is none, and their covariances [rad^2].

    Notes
    -----
    In R_b the normal is the axis of step 2; in a planar mechanism it is z, which is as uncertain as
    the camera of the view is about it.
    """
    v, C = joints.v_camera[view, leg].copy(), np.zeros((len(leg), 3, 3))
    seen = joints.axis_located[view, leg]
    N = normal_basis(v[seen])
    C[seen] = np.swapaxes(N, 1, 2) @ joints.covariance[view, leg, 3:, 3:][seen] @ N
    in_base, of_base = nominal_axes(mechanism), np.zeros((mechanism.n_legs, 3, 3))
    if mechanism.revolute.any():
        unknowns = BaseUnknowns.of(mechanism)
        in_base, of_base = base.base_axes, unknowns.axis_covariance(base.solution)
    for i, T in enumerate(base.T_Rb_camera):
        here = np.flatnonzero(view == i)
        if T is None or not len(here):
            continue
        with_axis = np.isfinite(in_base[leg[here], 0])
        if mechanism.spatial:
            C[here] = np.where(with_axis[:, None, None], of_base[leg[here]], 0.0)
        else:
            with_axis &= joints.axis_located[i].any()
            C[here] = _turned(T, _common(joints, i))
        v[here] = np.where(with_axis[:, None], in_base[leg[here]], 0.0)
    return v, C


def _common(joints: JointsInCamera, view: int) -> Array:
    """Return the covariance (3, 3) of the common normal of a view, in the camera."""
    legs = np.flatnonzero(joints.axis_located[view])
    if not len(legs):
        return np.zeros((3, 3))
    N = normal_basis(joints.v_camera[view, legs[0]])
    return np.asarray(N.T @ joints.covariance[view, legs[0], 3:, 3:] @ N)


def _turned(T: RigidTransform, covariance: Array) -> Array:
    """Return a covariance of directions in another frame."""
    R = T.rotation.as_matrix()
    return np.asarray(R @ covariance @ R.T)
