"""Section 3.3: base joint centres and revolute axes in the base frame R_b, eqs (8) and (9).

Each camera saw a part of the same rigid body, the base. Laying these parts on each other
gives the joint centres and axes in R_b, and where each camera stood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, BoolArray
from legcal.stages.base_unknowns import BaseUnknowns
from legcal.stages.camera_starts import CameraStart
from legcal.stages.joints_in_camera import JointsInCamera
from legcal.stages.laid_together import lay_together, register_views
from legcal.stages.motion import moved
from legcal.stages.nominal import Criteria, NominalMechanism
from legcal.stages.scalar_products import build_scalar_products
from legcal.stages.solution import Solution
from legcal.stages.solve import solve_least_squares

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
        :class:`legcal.stages.base_unknowns.BaseUnknowns` first.
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
