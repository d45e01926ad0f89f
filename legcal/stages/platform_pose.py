"""Section 3.5: the transformation between camera and platform frame, eq (18).

The ends B of three legs or more, known in the frame of a camera by (13) and in R_e by (16),
tell where the platform is. As printed, (18) puts R B_e + t on the ray through the camera centre
and B_c: three legs leave up to four solutions, and how far away B_c is counts for nothing. Point
equality R B_e + t = B_c has the same unknowns and more equations, in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import NotIdentifiable
from legcal.geometry.types import Array, IntArray
from legcal.stages.least_squares import LeastSquares, Term
from legcal.stages.leg_directions import LegDirections
from legcal.stages.motion import moved, register_groups, register_in_plane
from legcal.stages.nominal import Criteria
from legcal.stages.platform_residuals import miss_of_ray
from legcal.stages.solve import solve_least_squares

Transformation = Literal["points", "cross_product"]

_FLAT = 1e-3  # of their largest distance from their centre: how far points of a line are off it


@dataclass(frozen=True, eq=False)
class PlatformPoses:
    """Poses of the platform in the frames of the groups of legs that tell them.

    Attributes
    ----------
    pose : (n,) array of int
        The pose of each leg of the directions; -1 where its group tells none.
    R, t : (n_poses, 3, 3) and (n_poses, 3) array
        Rotation and position [m] of R_e in the frame of the group.
    """

    pose: IntArray
    R: Array
    t: Array

    def stepped(self, steps: Array, poses: IntArray) -> tuple[Array, Array]:
        """Return R and t of some poses after steps (n_poses, 6) of all, as ``moved`` has them."""
        found = [
            moved(
                steps[k],
                RigidTransform.from_components(self.t[k], Rotation.from_matrix(self.R[k])),
            )
            for k in poses
        ]
        return (
            np.array([T.rotation.as_matrix() for T in found]).reshape(-1, 3, 3),
            np.array([T.translation for T in found]).reshape(-1, 3),
        )


def chosen_transformation(
    transformation: Transformation | None, criteria: Criteria
) -> Transformation:
    """Return how (18) is solved: point equality by default, as printed in the literal steps."""
    if transformation is not None:
        return transformation
    return "cross_product" if criteria == "literal" else "points"


def locate_platform(
    directions: LegDirections,
    ends: Array,
    B_Re: Array,
    *,
    centre: Array,
    transformation: Transformation,
    spatial: bool = True,
    on_a_line: bool = False,
    weight: Array | None = None,
) -> PlatformPoses:
    """Locate the platform in the frame of every group that shows enough leg ends.

    Parameters
    ----------
    directions : LegDirections
        Legs of each pose.
    ends : (n, 3) array
        Their ends by (13) in the frame of the group [m]; NaN for passive legs.
    B_Re : (n_legs, 3) array
        Platform joint centres in R_e [m].
    centre : (n, 3) array
        Centre of the camera that saw each leg, in the frame of its group [m].
    transformation : {"points", "cross_product"}
        Point equality, or the form in which (18) is printed, started from the former.
    spatial : bool
        False for a planar mechanism: two ends are enough, in R_b.
    on_a_line : bool
        Take ends in one line too, about which nothing says how the platform is turned.
    weight : (n,) array, optional
        Weights of the ends in point equality.

    Returns
    -------
    PlatformPoses

    Raises
    ------
    DidNotConverge
        If IPOPT does not.
    """
    known = np.isfinite(ends[:, 0])
    pose, n_poses = np.full(len(directions), -1), 0
    for rows in directions.groups():
        points = B_Re[directions.leg[rows[known[rows]]]]
        if _span_a_frame(points, spatial=spatial) or (on_a_line and len(points) > 2):
            pose[rows], n_poses = n_poses, n_poses + 1
    used = np.flatnonzero(known & (pose >= 0))
    if not len(used):
        return PlatformPoses(pose, np.zeros((0, 3, 3)), np.zeros((0, 3)))
    points, group = B_Re[directions.leg[used]], pose[used]
    register = register_groups if spatial else register_in_plane
    R, t = register(points, ends[used], group, None if weight is None else weight[used])
    if transformation == "cross_product" and spatial:
        problem = build_rays(points, ends[used], centre[used], group, (R, t))
        steps = solve_least_squares(problem).x.reshape(-1, 6)
        R, t = PlatformPoses(pose, R, t).stepped(steps, np.arange(n_poses))
    return PlatformPoses(pose, R, t)


def build_rays(
    points: Array, ends: Array, centre: Array, group: IntArray, start: tuple[Array, Array]
) -> LeastSquares:
    """Build (18) as printed: (R B_e + t) x B_c = 0 for the legs of all groups.

    Parameters
    ----------
    points : (n, 3) array
        Joint centres in their own frame [m].
    ends, centre : (n, 3) array
        Where they were seen, and from where, in the frame of the group [m]: both sides of the
        product begin at the camera centre.
    group : (n,) array of int
        The group of each point, 0, 1 and so on.
    start : (n_groups, 3, 3) and (n_groups, 3) array
        Motions to start from.

    Returns
    -------
    LeastSquares
        The unknowns are the steps of the motions.
    """
    R, t = start
    index = 6 * group[:, None] + np.arange(6)
    term = Term(miss_of_ray(), index, (R[group], t[group], points, ends, centre))
    return LeastSquares("The pose of the platform (eq 18)", (term,), np.zeros(6 * len(R)))


def register_by_rays(P_from: Array, P_camera: Array, start: RigidTransform) -> RigidTransform:
    """Return T_camera_from by (18) as printed, for points seen from a camera."""
    R, t = start.rotation.as_matrix()[None], np.array(start.translation)[None]
    group = np.zeros(len(P_from), dtype=np.intp)
    problem = build_rays(P_from, P_camera, np.zeros_like(P_camera), group, (R, t))
    return moved(solve_least_squares(problem).x, start)


def check_located(poses: PlatformPoses, what: str, names: str, *, spatial: bool) -> None:
    """Refuse where no pose could be located, which is needed to identify something of legs."""
    if len(poses.R):
        return
    number = "three" if spatial else "two"
    shape = " that do not lie on one line" if spatial else ""
    raise NotIdentifiable(
        f"{what} of {names} could not be identified: no pose shows {number} legs of known length "
        f"at once with ends{shape}, needed to know where the platform is (eq 18); add images that "
        "show several legs at once."
    )


def _span_a_frame(points: Array, *, spatial: bool) -> bool:
    """Say whether points tell where a rigid body is: three not in one line, or two in a plane."""
    if len(points) < 2:
        return False
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if not spatial:
        return bool(singular[0] > 0.0)
    return bool(len(points) > 2 and singular[1] > _FLAT * singular[0])
