"""Section 3.3: base joint centres and revolute axes in the base frame R_b, eqs (8) and (9).

As printed (``literal``), the set V of a view is A_j A_g of all pairs of its legs and its revolute
axes v (8), and the products of all pairs of vectors of V, squares included, are equal in the
camera and in R_b (9):

    C_1 = sum over views and pairs of (V_p . V_q in R_b - V_p . V_q in R_c)^2

Scalar products are even in a coordinate normal to coplanar joints, and equal for a mirror image:
(9) decides neither z nor the handedness. The camera frames hold points and directions with both,
so the default lays them on each other, rigidly and weighted by their covariances, with one camera
pose a view. A view of two joints whose axes do not fix the camera gives their distance only.

Where actuators move joints at A (ours, not the paper's) these count at reading 0, and what carries
them is laid on each other with them. As printed (8', 9'), V has also the axis of every actuator of
the view, and the arm from that of a revolute to the joint.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from itertools import combinations, combinations_with_replacement, product
from typing import Any

import casadi as ca
import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge, NotIdentifiable
from legcal.geometry.covariances import whitener
from legcal.geometry.motions import components
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.actuator import ActuatorColumns
from legcal.machine.leg import LegColumns
from legcal.paper.camera_poses import candidate_camera_poses, signs_seen
from legcal.paper.criteria import Criteria
from legcal.paper.gibbs import (
    axis_frames,
    axis_slope,
    motion_after,
    moved_points,
    turned_frame,
    turned_points,
)
from legcal.paper.joints_in_camera import JointsInCamera, points_in_both, with_signs
from legcal.paper.least_squares import IpoptSolution, LeastSquares, Term, solve_least_squares
from legcal.paper.nominal import NominalMachine
from legcal.paper.unknowns import Unknowns

_MAX_SIGMA_TURN = 1.0  # [rad] of an axis; beyond, nothing is known of it
_APART = (
    1e-3  # of the size of the base: nearer joints count as one, whose distance is no information
)
_MAX_TRIALS = 32  # of combinations of candidate poses of the cameras
_MIN_DIFFERENCE = 4.5  # of the cost: three standard deviations decide between two candidates


@dataclass(frozen=True, eq=False)
class JointsInBase:
    """Base joint centres and revolute axes in R_b, and the cameras."""

    # with A, the revolute axes at the base and actuators as they were located
    machine: NominalMachine
    T_Rb_camera: tuple[RigidTransform | None, ...]  # None for a view whose joints do not fix it
    in_cameras: JointsInCamera  # what they were located from
    axis_covariance: Array  # (n_legs, 3, 3) of the axes [rad^2]; zero without one, and literal

    @property
    def A_Rb(self) -> Array:
        """Base joint centres, (n_legs, 3) [m]."""
        return self.machine.parameters.base_joints

    @property
    def base_axes(self) -> Array:
        """Revolute axes, (n_legs, 3), on the side of the nominal ones; NaN without one."""
        return self.machine.base_axes


def locate_joints_in_base(
    machine: NominalMachine, joints: JointsInCamera, *, criteria: Criteria = "default"
) -> JointsInBase:
    """Locate base joint centres and revolute axes in R_b from those in the camera frames.

    Raises NotIdentifiable if the views do not tie all joints and axes together (of the literal
    criterion: if one is in no product, or products are too few), and DidNotConverge.
    """
    unknowns = Unknowns.of_base(machine)
    axis_covariance = np.zeros((machine.n_legs, 3, 3))
    if criteria == "literal":
        _check_products(machine, joints)
        problem = build_scalar_products(machine, joints)
        if problem.n_residuals < len(problem.start):
            raise NotIdentifiable(
                f"The base could not be located (eq 9): found {problem.n_residuals} scalar "
                f"products in all views for {len(problem.start)} unknowns (joints located by view: "
                f"{_counts(joints.located)}), needed at least as many; turn a camera so that it "
                "shows more legs at once."
            )
        solution = solve_least_squares(problem)
    else:
        solution, cameras = _registered(machine, joints)
        _check_identifiable(machine, joints, solution)
        of_turns, place = solution.covariance(), unknowns.place[:, LegColumns.BASE_AXIS]
        for j in np.flatnonzero(machine.revolute):
            slope = axis_slope(machine.base_axes[j], solution.x[place[j]])
            axis_covariance[j] = slope @ of_turns[np.ix_(place[j], place[j])] @ slope.T
    located = replace(machine, legs=unknowns.legs(solution.x, machine.legs))
    if criteria == "literal":
        cameras = register_views(located, joints)
    return JointsInBase(located, cameras, joints, axis_covariance)


# As printed


def build_scalar_products(machine: NominalMachine, joints: JointsInCamera) -> LeastSquares:
    """Build C_1 of (9), products of all pairs of vectors; the squares v . v = 1 are left out."""
    unknowns = Unknowns.of_base(machine)
    legs = tuple(tuple(np.flatnonzero(located).tolist()) for located in joints.located)
    revolute = joints.axis_located & machine.revolute
    axes = tuple(tuple(np.flatnonzero(located).tolist()) for located in revolute)
    carried = tuple(
        tuple(j for j in of_view if (v, j) in joints.carriers) for v, of_view in enumerate(legs)
    )
    turning = tuple(j for j, leg in enumerate(machine.legs) if leg.reads_angle)
    seen = list[float]()
    for v, of_view in enumerate(zip(legs, axes, carried, strict=True)):
        w, c = np.zeros((2, machine.n_legs, 3))
        for j in carried[v]:
            actuator = joints.carriers[v, j].actuator
            w[j], c[j] = actuator.axis, actuator.point
        seen += _products(joints.A_camera[v], joints.v_camera[v], w, c, *of_view, turning)
    places = tuple(
        tuple(unknowns.place[:, columns].ravel().tolist())
        for columns in (
            LegColumns.A,
            LegColumns.BASE_AXIS,
            ActuatorColumns.AXIS,
            ActuatorColumns.POINT,
        )
    )
    n_legs = machine.n_legs
    observed = (
        np.array(seen)[None, :],
        unknowns.known_A.T.reshape(1, 3, n_legs),
        np.hstack(list(unknowns.base_frames)).reshape(1, 3, 3 * n_legs),
        np.hstack(list(unknowns.actuator_frames)).reshape(1, 3, 3 * n_legs),
        unknowns.actuator_points.T.reshape(1, 3, n_legs),
    )
    index = np.arange(len(unknowns))[None, :]
    return LeastSquares(
        "The base joints in the base frame (eq 9)",
        (Term(_product_differences(places, legs, axes, carried, turning), index, observed),),
        unknowns.vector(machine.legs),
        exact_hessian=True,
    )


def _products(
    A: Any,
    v: Any,
    w: Any,
    c: Any,
    legs: Sequence[int],
    axes: Sequence[int],
    carried: Sequence[int],
    turning: Sequence[int],
) -> list[Any]:
    """Return the products of pairs of the set V of (8) in one view, but the squares of axes.

    w and c are the axes of actuators and points of them, of the legs that are *carried*.
    """
    vectors = [A[g] - A[j] for j, g in combinations(legs, 2)]
    for j in carried:
        if j in turning:
            arm = A[j] - c[j]
            vectors.append(arm - (arm.T @ w[j]) * w[j])
    n_joints = len(vectors)
    vectors += [v[j] for j in axes] + [w[j] for j in carried]
    return [
        vectors[p].T @ vectors[q]
        for p, q in combinations_with_replacement(range(len(vectors)), 2)
        if p != q or p < n_joints
    ]


_Places = tuple[tuple[int, ...], ...]


@lru_cache(maxsize=4)
def _product_differences(
    places: _Places, legs: _Places, axes: _Places, carried: _Places, turning: tuple[int, ...]
) -> ca.Function:
    """Return (unknowns of step 2; products, known A, frames of v, of w, points of w) -> residuals.

    They are the products of all views, less those observed.
    """
    n_legs = len(places[0]) // 3
    x = ca.SX.sym("x", max(max(place) for place in places) + 1)
    known, frames = ca.SX.sym("known", 3, n_legs), ca.SX.sym("frames", 3, 3 * n_legs)
    of_actuators, points = ca.SX.sym("of_actuators", 3, 3 * n_legs), ca.SX.sym("points", 3, n_legs)
    padded = ca.vertcat(x, 0.0)
    A = ca.reshape(padded[list(places[0])], 3, n_legs) + known
    turns, of_w, shifts = (ca.reshape(padded[list(p)], 2, n_legs) for p in places[1:])
    each = [slice(3 * j, 3 * j + 3) for j in range(n_legs)]
    joints = [A[:, j] for j in range(n_legs)]
    v = [turned_frame(turns[:, j], frames[:, each[j]])[:, 0] for j in range(n_legs)]
    w = [turned_frame(of_w[:, j], of_actuators[:, each[j]])[:, 0] for j in range(n_legs)]
    c = [points[:, j] + of_actuators[:, each[j]][:, 1:] @ shifts[:, j] for j in range(n_legs)]
    products = [
        product
        for of_view in zip(legs, axes, carried, strict=True)
        for product in _products(joints, v, w, c, *of_view, turning)
    ]
    seen = ca.SX.sym("seen", len(products))
    observed = [seen, known, frames, of_actuators, points]
    return ca.Function("products", [x, *observed], [ca.vertcat(*products) - seen])


def register_views(
    machine: NominalMachine, joints: JointsInCamera
) -> tuple[RigidTransform | None, ...]:
    """Return T_Rb_camera of each view whose joints and axes fix it, in closed form, unweighted."""
    candidates = [_candidates(machine, joints, v) for v in range(len(joints.located))]
    return tuple(poses[0] if fixed and len(poses) == 1 else None for poses, fixed in candidates)


def _candidates(
    machine: NominalMachine, joints: JointsInCamera, view: int
) -> tuple[list[RigidTransform], bool]:
    """Return the candidate poses of the camera of a view, and whether there are no others."""
    A_Rb, A_camera = points_in_both(machine, joints, view)
    with_axis = joints.axis_located[view]
    return candidate_camera_poses(
        A_Rb,
        machine.base_normals[with_axis],
        A_camera,
        joints.v_camera[view, with_axis],
        signed=bool(joints.sided[view]),
    )


# Rigid registration of all views


def _registered(
    machine: NominalMachine, joints: JointsInCamera
) -> tuple[IpoptSolution, tuple[RigidTransform | None, ...]]:
    """Return the rigid solution and the cameras that it fixes.

    Where axes leave several candidates of a camera, all are tried; where they fit alike, the view
    gives distances only.
    """
    v_Rb = machine.base_normals
    starts: list[Sequence[RigidTransform | None]] = []
    fixed, n_trials = [], 1
    for view, located in enumerate(joints.located):
        poses, is_fixed = _candidates(machine, joints, view)
        fixed.append(is_fixed)
        usable = poses and (is_fixed or located.sum() > 2)
        if usable and n_trials * len(poses) <= _MAX_TRIALS:
            n_trials *= len(poses)
            starts.append(poses)
        else:
            starts.append([None])

    def trial(start: Sequence[RigidTransform | None]) -> IpoptSolution | DidNotConverge:
        signs = np.ones(joints.located.shape)
        for v, T in enumerate(start):
            if T is not None:
                axes = np.flatnonzero(joints.axis_located[v])
                signs[v, axes] = signs_seen(v_Rb[axes], joints.v_camera[v, axes], T)
        try:
            return solve_least_squares(build_rigid_base(machine, with_signs(joints, signs), start))
        except DidNotConverge as failure:  # the wrong one of two candidates may end anywhere
            return failure

    choices = list(product(*starts))
    solutions = [trial(choice) for choice in choices]
    costs = np.array(
        [found.cost if isinstance(found, IpoptSolution) else np.inf for found in solutions]
    )
    best = int(np.argmin(costs))
    start, solution = choices[best], solutions[best]
    ambiguous = np.zeros(len(starts), dtype=np.bool_)
    for choice, cost in zip(choices, costs, strict=True):
        if cost < costs[best] + _MIN_DIFFERENCE:
            ambiguous |= [a is not b for a, b in zip(choice, start, strict=True)]
    if ambiguous.any():
        start = tuple(None if d else T for T, d in zip(start, ambiguous, strict=True))
        solution = trial(start)
    if isinstance(solution, DidNotConverge):
        raise solution
    steps = iter(solution.x[solution.n_shared :].reshape(-1, 6))
    cameras = [None if T is None else motion_after(next(steps), T.inv()).inv() for T in start]
    return solution, tuple(
        T if is_fixed else None for T, is_fixed in zip(cameras, fixed, strict=True)
    )


def build_rigid_base(
    machine: NominalMachine,
    joints: JointsInCamera,
    start: Sequence[RigidTransform | None],
) -> LeastSquares:
    """Build the rigid criterion in standard deviations: A and v in R_b and camera poses.

    ``start`` are T_Rb_camera; a view without one gives distances between its joints. Axes have the
    signs of the nominal ones.
    """
    unknowns = Unknowns.of_base(machine)
    n_shared = len(unknowns)
    placed = np.array([T is not None for T in start], dtype=np.bool_)
    cameras = [T.inv() for T in start if T is not None]
    number = np.cumsum(placed) - 1
    R, t = components(cameras)
    seen = joints.located & placed[:, None]
    with_axis = seen & joints.axis_located
    terms = [_distances(machine, unknowns, joints, np.flatnonzero(~placed))]

    def steps(view: IntArray) -> IntArray:
        return n_shared + 6 * number[view][:, None] + np.arange(6)

    carried = seen & machine.carried
    terms += _carried_terms(unknowns, joints, carried, (R, t), steps, number)
    for chosen, kind in (
        (seen & ~with_axis & ~carried, "point"),
        (with_axis & ~carried, "axis"),
    ):
        view, leg = np.nonzero(chosen)
        C, v = joints.covariance[view, leg], joints.v_camera[view, leg]
        index = np.hstack([unknowns.place[leg, LegColumns.A], steps(view)])
        A_camera = joints.A_camera[view, leg]
        observed = (unknowns.known_A[leg], R[number[view]], t[number[view]], A_camera)
        if kind == "point":
            terms.append(Term(_centre(), index, (*observed, whitener(C[:, :3, :3]))))
        elif machine.spatial:
            index = np.hstack([index, unknowns.place[leg, LegColumns.BASE_AXIS]])
            more = (unknowns.base_frames[leg], axis_frames(v), whitener(C))
            terms.append(Term(_centre_and_axis(), index, (*observed, *more)))
        else:  # the centre follows turns of the normal by G
            G = C[:, :3, 3:] @ np.linalg.inv(C[:, 3:, 3:])
            W = whitener(C[:, :3, :3] - G @ C[:, 3:, :3])
            terms.append(Term(_centre_in_plane(), index, (*observed, axis_frames(v), G, W)))
            view = np.flatnonzero(with_axis.any(axis=1))
            leg = np.argmax(with_axis[view], axis=1)
            W = whitener(joints.covariance[view, leg, 3:, 3:])
            normals = (R[number[view]], axis_frames(joints.v_camera[view, leg]), W)
            terms.append(Term(_normal_of_plane(), steps(view), normals))
    start_x = np.concatenate([unknowns.vector(machine.legs), np.zeros(6 * len(cameras))])
    return LeastSquares(
        "The base joints in the base frame (step 2)", tuple(terms), start_x, n_shared=n_shared
    )


def _carried_terms(
    unknowns: Unknowns,
    joints: JointsInCamera,
    carried: BoolArray,
    cameras: tuple[Array, Array],
    steps: Callable[[IntArray], IntArray],
    number: IntArray,
) -> list[Term]:
    """Return the residuals of joints that actuators move, *carried* (n_views, n_legs)."""
    (R, t), terms = cameras, []
    kinds: dict[tuple[bool, bool], list[tuple[int, int]]] = {}
    for v, j in np.argwhere(carried).tolist():
        carrier = joints.carriers[v, j]
        with_axis = bool(joints.axis_located[v, j])
        kinds.setdefault((with_axis, carrier.actuator.turns), []).append((v, j))
    for (with_axis, turns), places in sorted(kinds.items()):
        view, leg = np.array(places, dtype=np.intp).T
        found = [joints.carriers[at] for at in places]
        place = unknowns.place[leg]
        index = [place[:, LegColumns.A], steps(view), place[:, ActuatorColumns.AXIS]]
        columns = [0, 1, 2, 5, 6]
        axis, point = (
            np.array([getattr(carrier.actuator, name) for carrier in found])
            for name in ("axis", "point")
        )
        frames, camera = unknowns.actuator_frames[leg], number[view]
        A = np.array([carrier.A for carrier in found])
        observed = [unknowns.known_A[leg], R[camera], t[camera], A, frames, axis_frames(axis)]
        if turns:
            index.append(place[:, ActuatorColumns.POINT])
            columns += [7, 8]
            observed += [unknowns.actuator_points[leg], point]
        if with_axis:
            index.append(place[:, LegColumns.BASE_AXIS])
            columns += [3, 4]
            own = np.array([carrier.v for carrier in found])
            observed += [unknowns.base_frames[leg], axis_frames(own)]
        C = np.array([carrier.covariance[np.ix_(columns, columns)] for carrier in found])
        observed.append(whitener(C))
        function = _carried_joint(turns=turns, with_axis=with_axis)
        terms.append(Term(function, np.hstack(index), tuple(observed)))
    return terms


@cache
def _carried_joint(*, turns: bool, with_axis: bool) -> ca.Function:
    """Return (A, step, turns of w, place of w, turns of v; observed) -> whitened errors.

    They are those of A at reading 0 in the camera, of the turns of the actuator's axis w about its
    normal basis, of a revolute the place where w crosses the plane across the seen one at its
    point, and, of a revolute joint at A, the turns of v.
    """
    local, given, error = _centre_residual(11 + 2 * turns + 2 * with_axis)
    _, R, t, _ = given
    step = local[3:9]
    frame, w_camera = ca.SX.sym("frame", 3, 3), ca.SX.sym("w_camera", 3, 3)
    w = turned_frame(local[9:11], frame)[:, 0]
    observed, errors = [*given, frame, w_camera], [error, _turns_in_camera(step, R, w, w_camera)]
    if turns:
        point, point_camera = ca.SX.sym("point", 3), ca.SX.sym("point_camera", 3)
        place = point + frame[:, 1:] @ local[11:13]
        apart = moved_points(step, R, t, place) - point_camera
        along = turned_points(step[3:], R @ w)
        seen = w_camera[:, 0]
        crossing = apart - ca.dot(apart, seen) / ca.dot(along, seen) * along
        errors.append(w_camera[:, 1:].T @ crossing)
        observed += [point, point_camera]
    if with_axis:
        base, v_camera = ca.SX.sym("base", 3, 3), ca.SX.sym("v_camera", 3, 3)
        v = turned_frame(local[-2:], base)[:, 0]
        errors.append(_turns_in_camera(step, R, v, v_camera))
        observed += [base, v_camera]
    W = ca.SX.sym("W", 5 + 2 * turns + 2 * with_axis, 5 + 2 * turns + 2 * with_axis)
    return ca.Function("carried", [local, *observed, W], [W @ ca.vertcat(*errors)])


def _distances(
    machine: NominalMachine, unknowns: Unknowns, joints: JointsInCamera, views: IntArray
) -> Term:
    """Return the residuals of distances between the joints of views without a camera pose."""
    A = machine.parameters.base_joints
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
    known = np.stack([unknowns.known_A[j], unknowns.known_A[g]], axis=2)
    index = np.hstack([unknowns.place[j, LegColumns.A], unknowns.place[g, LegColumns.A]])
    return Term(distance_of_joints(), index, (known, distance, sigma))


@cache
def _centre() -> ca.Function:
    """Return (A, step; known, R, t, A_camera, W) -> W times the error of A in a camera, (3,)."""
    local, given, error = _centre_residual(9)
    W = ca.SX.sym("W", 3, 3)
    return ca.Function("centre", [local, *given, W], [W @ error])


@cache
def _centre_and_axis() -> ca.Function:
    """Return (A, step, turns; known, R, t, A_camera, frame, v_camera, W) -> W times errors, (5,).

    The error of A, and the turns of v about its normal basis in the camera; the frames are those
    of :func:`axis_frames`, for v in R_b and in the camera.
    """
    local, given, error = _centre_residual(11)
    frame, v_camera, W = ca.SX.sym("frame", 3, 3), ca.SX.sym("v_camera", 3, 3), ca.SX.sym("W", 5, 5)
    turns = _turns_in_camera(local[3:9], given[1], turned_frame(local[9:], frame)[:, 0], v_camera)
    observed = [*given, frame, v_camera, W]
    return ca.Function("joint", [local, *observed], [W @ ca.vertcat(error, turns)])


@cache
def _centre_in_plane() -> ca.Function:
    """Return (A, step; known, R, t, A_camera, v_camera, G, W) -> W times the error of A, (3,).

    A leg of a planar machine: its centre is the one seen if the normal of the plane is; it
    follows turns of the normal by G (3, 2).
    """
    local, given, error = _centre_residual(9)
    v_camera, G, W = ca.SX.sym("v_camera", 3, 3), ca.SX.sym("G", 3, 2), ca.SX.sym("W", 3, 3)
    turns = _turns_in_camera(local[3:9], given[1], ca.SX([0.0, 0.0, 1.0]), v_camera)
    return ca.Function("centre", [local, *given, v_camera, G, W], [W @ (error - G @ turns)])


@cache
def _normal_of_plane() -> ca.Function:
    """Return (step; R, v_camera, W) -> W times the turns of the normal of a plane, (2,)."""
    step, R = ca.SX.sym("step", 6), ca.SX.sym("R", 3, 3)
    v_camera, W = ca.SX.sym("v_camera", 3, 3), ca.SX.sym("W", 2, 2)
    turns = _turns_in_camera(step, R, ca.SX([0.0, 0.0, 1.0]), v_camera)
    return ca.Function("normal", [step, R, v_camera, W], [W @ turns])


@cache
def distance_of_joints() -> ca.Function:
    """Return (two joints; known (3, 2), distance, sigma) -> distance less the one seen, in sigmas.

    *known* are the coordinates that are no unknowns.
    """
    local, known = ca.SX.sym("local", 6), ca.SX.sym("known", 3, 2)
    distance, sigma = ca.SX.sym("distance"), ca.SX.sym("sigma")
    apart = local[3:] + known[:, 1] - local[:3] - known[:, 0]
    residual = (ca.norm_2(apart) - distance) / sigma
    return ca.Function("joints", [local, known, distance, sigma], [residual])


def _centre_residual(n_local: int) -> tuple[ca.SX, list[ca.SX], ca.SX]:
    """Return local unknowns, symbols (known, R, t, A_camera) and the error of A in the camera."""
    local, known, t = ca.SX.sym("local", n_local), ca.SX.sym("known", 3), ca.SX.sym("t", 3)
    R, A_camera = ca.SX.sym("R", 3, 3), ca.SX.sym("A_camera", 3)
    error = moved_points(local[3:9], R, t, local[:3] + known) - A_camera
    return local, [known, R, t, A_camera], error


def _turns_in_camera(step: ca.SX, R: ca.SX, v: ca.SX, v_camera: ca.SX) -> ca.SX:
    """Return by how much an axis is turned from the one seen, about its normal basis (2,)."""
    seen = turned_points(step[3:], R @ v)
    return ca.vertcat(-ca.dot(v_camera[:, 2], seen), ca.dot(v_camera[:, 1], seen))


# Refusals


def _check_products(machine: NominalMachine, joints: JointsInCamera) -> None:
    """Refuse when a joint or an axis is in no product of (9), which would leave it at nominal."""
    several = joints.located.sum(axis=1) > 1
    shown = joints.located[several].any(axis=0)
    turning = machine.revolute & ~joints.axis_located[several].any(axis=0)
    what = [
        f"{kind} of {', '.join(np.array(machine.leg_names)[missing])}"
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
    machine: NominalMachine, joints: JointsInCamera, solution: IpoptSolution
) -> None:
    """Refuse when base joints or axes can move without any camera noticing.

    That is known worse than the size of the base, or a radian.
    """
    unknowns = Unknowns.of_base(machine)
    n = len(unknowns)
    size = np.ptp(machine.parameters.base_joints, axis=0).max(initial=0.0)
    limit = np.where(unknowns.is_angle, _MAX_SIGMA_TURN, size)
    sigma = np.sqrt(np.diag(solution.covariance())[:n])
    loose = np.append(solution.undetermined(n) | (sigma > limit), False)
    names = np.array(machine.leg_names)
    moving = names[loose[unknowns.place[:, LegColumns.A]].any(axis=1)]
    turning = names[loose[unknowns.place[:, LegColumns.BASE_AXIS]].any(axis=1)]
    carried = loose[unknowns.place[:, LegColumns.OWN :]].any(axis=1)
    if not len(moving) and carried.any():
        raise NotIdentifiable(
            f"The actuators at the base could not be located: those of {', '.join(names[carried])} "
            "can move without any view noticing; needed views that show each of them together "
            "with three other joints; turn a camera so that it shows more legs at once."
        )
    if not len(moving) and not len(turning):
        return
    what = "base joints" if len(moving) else "revolute axes at the base"
    can = [f"those of {', '.join(moving)} can move"] if len(moving) else []
    if len(turning):
        of_axes = "the revolute axes" if len(moving) else "those"
        can.append(f"{of_axes} of {', '.join(turning)} can turn")
    counts = f"joints located by view: {_counts(joints.located)}"
    needed = "views of three or more legs that share three legs with the others"
    if machine.revolute.any():
        counts += f"; axes: {_counts(joints.axis_located)}"
        needed += ", or two legs and a revolute axis across the line between them"
    if not machine.spatial:
        needed = "views of two or more legs that share two legs with the others"
    raise NotIdentifiable(
        [
            f"The {what} could not be tied together: {' and '.join(can)} without any view noticing "
            f"({counts}); needed {needed}; turn a camera so that it shows more legs at once, or "
            "fix a calibration board to the base.",
            *joints.diagnostics,
        ]
    )


def _counts(located: BoolArray) -> str:
    """Return how many were located in each view."""
    return ", ".join(str(int(n)) for n in located.sum(axis=1))
