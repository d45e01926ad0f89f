"""Section 3.3: base joint centres and revolute axes in the base frame R_b, eqs (8) and (9).

The set V of a view is A_j A_g of all pairs of its legs and its revolute axes v (8), and products of
all pairs of vectors of V, squares included, are equal in the camera and in R_b (9):

    C_1 = sum over views and pairs of (V_p . V_q in R_b - V_p . V_q in R_c)^2

Scalar products are even in a coordinate normal to coplanar joints, and equal for a mirror image:
(9) determines neither z nor the handedness. With weights, directions with less information in (9)
than in the nominal model stay nominal, until (18) of all joints in all cameras determines them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.data.measurements import Measurements
from legcal.errors import NotIdentifiable
from legcal.geometry.motions import components, motion_of
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.leg import LegColumns
from legcal.paper.equations import (
    LegInView,
    pairs_of_vectors,
    products_in_base,
    stepped_poses,
    vectors_of_view,
)
from legcal.paper.joints_in_camera import (
    JointsInCamera,
    adjusted_to_base,
    candidate_camera_poses,
    points_in_both,
)
from legcal.paper.least_squares import (
    LeastSquares,
    Term,
    derivatives,
    evaluated,
    solve_least_squares,
)
from legcal.paper.platform_pose import SeenPoints, poses_on_rays
from legcal.paper.unknowns import NominalMachine, Unknowns, hold_at_nominal, left_near_nominal

_PLACES = np.r_[LegColumns.A, LegColumns.BASE_AXIS]  # the numbers of a leg that are in (9)


Cameras = tuple[RigidTransform | None, ...]


@dataclass(frozen=True, eq=False)
class JointsInBase:
    """Base joint centres and revolute axes in R_b, and the cameras."""

    machine: NominalMachine  # with located A and revolute axes at the base
    T_Rb_camera: Cameras  # None for a view with too few joints
    in_cameras: JointsInCamera  # the input of this step
    diagnostics: tuple[str, ...]  # omissions and nominal values, with their reasons


def locate_joints_in_base(
    machine: NominalMachine, joints: JointsInCamera, measurements: Measurements, *, weighted: bool
) -> JointsInBase:
    """Locate base joint centres and revolute axes in R_b from the results in the camera frames.

    With weights, joints in the cameras are replaced by the joints in R_b. Raises NotIdentifiable if
    a joint or an axis is in no product, or products are too few, and DidNotConverge.
    """
    unknowns = Unknowns.of_base(machine)
    _check_products(machine, joints)
    problem = build_scalar_products(machine, joints, weighted=weighted)
    if problem.n_residuals < len(problem.start):
        raise NotIdentifiable(
            f"The base could not be located (eq 9): found {problem.n_residuals} scalar "
            f"products in all views for {len(problem.start)} unknowns (joints located by view: "
            f"{_counts(joints.located)}), needed at least as many; turn a camera so that it "
            "shows more legs at once."
        )
    held = np.zeros(0, dtype=np.intp)
    if weighted:
        problem, held = hold_at_nominal(problem, machine, unknowns, weighted=True)
    x = solve_least_squares(problem, weighted=weighted).x
    located = replace(machine, legs=unknowns.legs(x, machine.legs))
    found = list[RigidTransform | None]()
    for v, with_axis in enumerate(joints.axis_located):
        A_Rb, A_camera = points_in_both(located, joints, v)
        v_Rb, v_camera = located.base_normals[with_axis], joints.v[v, with_axis]
        poses, is_all = candidate_camera_poses(A_Rb, v_Rb, A_camera, v_camera)
        found.append(poses[0] if is_all and len(poses) == 1 else None)
    cameras = tuple(found)
    if machine.spatial and any(T is not None for T in cameras):
        if weighted:
            located, cameras, shown = _joints_on_rays(located, unknowns, joints, cameras)
            joints = _joints_of_base(located, joints, cameras, measurements)
            held = np.setdiff1d(held, shown)
        else:
            points, start, placed = _points_on_rays(located, joints, cameras)
            R, t, _ = poses_on_rays(points, start, weighted=weighted)
            cameras = _placed(cameras, placed, R, t)
    left = left_near_nominal("Step 2", machine, unknowns, held)
    return JointsInBase(located, cameras, joints, (*joints.diagnostics, *left))


def build_scalar_products(
    machine: NominalMachine, joints: JointsInCamera, *, weighted: bool
) -> LeastSquares:
    """Build C_1 of (9), products of all pairs of vectors; the squares v . v = 1 are left out.

    They are weighted individually: there are more products than degrees of freedom of the joints
    and axes of a view, so that their joint covariance is singular.
    """
    unknowns = Unknowns.of_base(machine)
    revolute, terms = joints.axis_located & machine.revolute, []
    alike = dict[tuple[LegInView, ...], list[int]]()  # views of the same legs
    for v, located in enumerate(joints.located):
        legs = tuple(
            LegInView(
                tuple(unknowns.place[j, _PLACES].tolist()),
                bool(revolute[v, j]),
            )
            for j in np.flatnonzero(located).tolist()
        )
        alike.setdefault(legs, []).append(v)
    for legs, views in alike.items():
        if len(legs) < 2:
            continue
        products, sigma = _products_seen(joints, legs, views)
        view_legs = np.flatnonzero(joints.located[views[0]])
        known_values = (
            unknowns.known_A[view_legs].T,
            np.hstack(list(unknowns.base_frames[view_legs])),
        )
        unit = sigma if weighted else np.ones_like(sigma)
        observed = *(np.tile(values, (len(views), 1, 1)) for values in known_values), products, unit
        index = np.tile(np.arange(len(unknowns)), (len(views), 1))
        terms.append(Term(products_in_base(legs, len(unknowns)), index, observed))
    start = unknowns.vector(machine.legs)
    return LeastSquares(
        "The base joints in the base frame (eq 9)", tuple(terms), start, exact_hessian=True
    )


def _products_seen(
    joints: JointsInCamera, legs: tuple[LegInView, ...], views: list[int]
) -> tuple[Array, Array]:
    """Return the products (n_views, m) of (9) in views of the same legs, and standard deviations.

    They are of second order: products of parallel unit vectors do not change to first order.
    """
    view_legs = np.flatnonzero(joints.located[views[0]]).tolist()
    columns, C = (
        np.zeros((len(views), 6, len(view_legs))),
        np.zeros((len(views), *[6 * len(view_legs)] * 2)),
    )
    for k, v in enumerate(views):
        for i, j in enumerate(view_legs):
            columns[k, :, i] = *joints.A[v, j], *joints.v[v, j]
            C[k, 6 * i : 6 * i + 6, 6 * i : 6 * i + 6] = joints.covariance[v, j]
    function, none = vectors_of_view(legs), np.zeros((len(views), 0))
    V = evaluated(function, none, columns).reshape(len(views), -1, 3)
    by_error = derivatives(function, 1, none, columns)
    C = by_error @ C @ np.swapaxes(by_error, 1, 2)
    C = np.moveaxis(C.reshape(*V.shape, *V.shape[1:]), 3, 2)  # (n_views, p, q, 3, 3)
    p, q = np.array(pairs_of_vectors(legs), dtype=np.intp).T
    of_p, of_q, of_both = C[:, p, p], C[:, q, q], C[:, p, q]
    Vp, Vq = V[:, p], V[:, q]
    variance = (
        np.einsum("vmi,vmij,vmj->vm", Vq, of_p, Vq)
        + np.einsum("vmi,vmij,vmj->vm", Vp, of_q, Vp)
        + 2.0 * np.einsum("vmi,vmij,vmj->vm", Vq, of_both, Vp)
        + np.einsum("vmij,vmji->vm", of_p, of_q)
        + np.einsum("vmij,vmji->vm", of_both, of_both)
    )
    return np.einsum("vmi,vmi->vm", Vp, Vq), np.sqrt(variance)


# Cameras, and joints with them


def _joints_on_rays(
    machine: NominalMachine, unknowns: Unknowns, joints: JointsInCamera, cameras: Cameras
) -> tuple[NominalMachine, Cameras, IntArray]:
    """Return base joints and cameras by (18) together, and the unknowns that it determines.

    Directions with less information in (18) than in the nominal model keep the result of (9).
    """
    points, (R, t), placed = _points_on_rays(machine, joints, cameras)
    leg = np.nonzero(joints.located[placed])[1]
    place = unknowns.place[leg, LegColumns.A]
    wanted = np.unique(place[place >= 0])
    renumbered = np.full(len(unknowns) + 1, -1)
    renumbered[wanted] = np.arange(len(wanted))
    steps = len(wanted) + np.arange(6 * len(R)).reshape(-1, 6)
    term = points.term((R, t), steps[points.group], renumbered[place], unknowns.known_A[leg])
    x = unknowns.vector(machine.legs)
    start = np.concatenate([x[wanted], np.zeros(steps.size)])
    problem = LeastSquares("The base joints and the cameras (eq 18)", (term,), start)
    problem, held = hold_at_nominal(problem, machine, unknowns, weighted=True, wanted=wanted)
    solution = solve_least_squares(problem, weighted=True).x
    x[wanted] = solution[: len(wanted)]
    machine = replace(machine, legs=unknowns.legs(x, machine.legs))
    cameras = _placed(cameras, placed, *stepped_poses(R, t, solution[steps]))
    return machine, cameras, np.setdiff1d(wanted, held)


def _joints_of_base(
    machine: NominalMachine, joints: JointsInCamera, cameras: Cameras, measurements: Measurements
) -> JointsInCamera:
    """Return the joints in the cameras of placed views, averaged over all of these views.

    Errors of the camera poses are not included.
    """
    A, C = joints.A.copy(), joints.covariance[:, :, :3, :3].copy()
    information = np.zeros((machine.n_legs, 3, 3))
    turns = [(v, T.rotation.as_matrix()) for v, T in enumerate(cameras) if T is not None]
    for v, R in turns:
        is_located = joints.located[v]
        information[is_located] += R @ np.linalg.inv(C[v, is_located]) @ R.T
    for v, R in turns:
        is_located, T = joints.located[v], cameras[v]
        C[v, is_located] = R.T @ np.linalg.inv(information[is_located]) @ R
        A[v, is_located] = A[v, is_located] if T is None else T.inv().apply(machine.A[is_located])
    return adjusted_to_base(machine, joints, A, C, measurements)


def _points_on_rays(
    machine: NominalMachine, joints: JointsInCamera, cameras: Cameras
) -> tuple[SeenPoints, tuple[Array, Array], IntArray]:
    """Return the base joints in placed cameras, R and t of R_b in these, and their views."""
    poses = {v: T.inv() for v, T in enumerate(cameras) if T is not None}
    placed = np.array(list(poses), dtype=np.intp)
    group, leg = np.nonzero(joints.located[placed])
    view = placed[group]
    A, C = joints.A[view, leg], joints.covariance[view, leg, :3, :3]
    A_Rb = machine.A[leg]
    return SeenPoints(group, A_Rb, A, C, np.zeros_like(A)), components(list(poses.values())), placed


def _placed(cameras: Cameras, placed: IntArray, R: Array, t: Array) -> Cameras:
    """Return cameras, T_Rb_camera, with new ones for some views from the poses of R_b in them."""
    poses = list(cameras)
    for v, view_R, view_t in zip(placed.tolist(), R, t, strict=True):
        poses[v] = motion_of(view_R, view_t).inv()
    return tuple(poses)


# Refusals


def _check_products(machine: NominalMachine, joints: JointsInCamera) -> None:
    """Refuse if a joint or an axis is in no product of (9), which would leave it at nominal."""
    several = joints.located.sum(axis=1) > 1
    shown = joints.located[several].any(axis=0)
    turning = machine.revolute & ~joints.axis_located[several].any(axis=0)
    missing_in_words = [
        f"{kind} of {', '.join(np.array(machine.leg_names)[missing])}"
        for kind, missing in (("base joints", ~shown), ("revolute axes", turning & shown))
        if missing.any()
    ]
    if missing_in_words:
        raise NotIdentifiable(
            f"The base could not be located (eq 9): found no view that locates the "
            f"{' and the '.join(missing_in_words)} together with the base joint of another leg "
            f"(joints located by view: {_counts(joints.located)}), needed one; turn a camera so "
            "that it shows more legs at once."
        )


def _counts(located: BoolArray) -> str:
    """Return the number of located joints in each view, in words."""
    return ", ".join(str(int(n)) for n in located.sum(axis=1))
