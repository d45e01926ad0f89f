"""Section 3.5: the transformation between camera and platform frame, eq (18).

The ends B of three legs or more, known in the frame of a camera by (13) and in R_e by (16),
fix the pose of the platform. As printed,

    (R B_e + t) x B_c = 0   (18)

puts R B_e + t on the ray through the camera centre and B_c: three legs leave up to four solutions,
and the known distance of B_c is not used. So it starts from point equality R B_e + t = B_c, in
closed form, and with weights the distance along the ray counts too. In a plane there is point
equality only.

With weights the points themselves are unknown in a second solution of (18): unlike (9) and (16) it
determines z of coplanar joints, and the handedness. Directions with less information in it than in
the nominal model keep the results of (9), (14) and (16).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.geometry.lines import normal_basis
from legcal.geometry.motions import register_groups, register_in_plane
from legcal.geometry.types import Array, IntArray
from legcal.paper.equations import point_on_ray, stepped_poses
from legcal.paper.least_squares import LeastSquares, Term, solve_least_squares

_FLAT = 1e-3  # maximum deviation of collinear points, relative to their distance from the centre


@dataclass(frozen=True, eq=False)
class PlatformPoses:
    """Poses of R_e in the frames of the groups of legs that determine them."""

    pose: IntArray  # (n,): the pose of each leg of the directions; -1 where its group fixes none
    R: Array  # (n_poses, 3, 3)
    t: Array  # (n_poses, 3) [m]
    covariance: Array  # (n_poses, 6, 6) of steps from them; zero without weights and in a plane


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Observed points of rigid bodies."""

    group: IntArray  # (n,) index of the body and frame of each point
    body_points: Array  # (n, 3) in the frame of the body [m]
    observed: Array  # (n, 3) positions in the frame of the group [m]
    covariance: Array  # (n, 3, 3) of the positions
    centre: Array  # (n, 3) of the camera, in the frame of the group [m]

    def term(
        self,
        start: tuple[Array, Array],
        steps: IntArray,
        index_of_point: IntArray,
        known_points: Array,
    ) -> Term:
        """Return (18) with unknown coordinates of points.

        *index_of_point* (n, 3) are the indices of the unknowns, -1 for coordinates in
        *known_points*. *steps* (n, 6) are the indices of steps of the bodies from a start
        R (g, 3, 3), t.
        """
        (R, t), across = start, across_rays(self.observed, self.centre)
        observed = known_points, R[self.group], t[self.group], self.centre, across, self.observed
        index = np.hstack([index_of_point, steps])
        return Term(point_on_ray(), index, observed, self.covariance, n_printed=2)


def across_rays(points: Array, centre: Array) -> Array:
    """Return two unit vectors (n, 2, 3) across the rays to points; their product is along these."""
    ray = points - centre
    return normal_basis(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def poses_on_rays(
    points: SeenPoints, start: tuple[Array, Array], *, weighted: bool
) -> tuple[Array, Array, Array]:
    """Return R (g, 3, 3), t (g, 3) and covariances (g, 6, 6) of all bodies by (18), from a start.

    The covariances are of the steps; zero without weights.
    """
    R, t = start
    n, group, columns = len(R), points.group, np.arange(6 * len(R)).reshape(-1, 6)
    term = points.term(start, columns[group], np.full((len(group), 3), -1), points.body_points)
    problem = LeastSquares("The poses (eq 18)", (term,), np.zeros(6 * n), exact_hessian=weighted)
    solution = solve_least_squares(problem, weighted=weighted)
    covariance = solution.covariances(columns) if weighted else np.zeros((n, 6, 6))
    return *stepped_poses(R, t, solution.x[columns]), covariance


def _span_a_frame(points: Array, *, spatial: bool) -> bool:
    """Return whether points determine a rigid motion: three not on one line, or two in a plane."""
    if len(points) < 2:
        return False
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if not spatial:
        return bool(singular[0] > 0.0)
    return bool(len(points) > 2 and singular[1] > _FLAT * singular[0])


def locate_platform(
    groups: list[IntArray],  # legs of one pose in one frame, each
    B_Re: Array,  # (n, 3) the end of each leg in R_e [m]
    ends: Array,  # (n, 3) the same in the frames of the groups; NaN for passive legs
    covariance: Array,  # (n, 3, 3) of the ends
    centre: Array,  # (n, 3) of the camera, in the frame of the group [m]
    *,
    spatial: bool,
    weighted: bool,
    by_rays: bool,  # by (18); point equality alone without it, and in a plane
) -> PlatformPoses:
    """Locate the platform in the frame of every group that shows enough ends, by (18).

    In a plane two ends are enough, in R_b. Raises DidNotConverge.
    """
    is_known = np.isfinite(ends[:, 0])
    pose, n_poses = np.full(len(ends), -1), 0
    for rows in groups:
        if _span_a_frame(B_Re[rows[is_known[rows]]], spatial=spatial):
            pose[rows], n_poses = n_poses, n_poses + 1
    used = np.flatnonzero(is_known & (pose >= 0))
    if not len(used):
        return PlatformPoses(pose, *(np.zeros((0, *n)) for n in ((3, 3), (3,), (6, 6))))
    points_in_Re, seen_points, group = B_Re[used], ends[used], pose[used]
    weight = 1.0 / np.einsum("nii->n", covariance[used]) if weighted else None
    if not spatial:
        R, t = register_in_plane(points_in_Re, seen_points, group, weight)
        return PlatformPoses(pose, R, t, np.zeros((n_poses, 6, 6)))
    points = SeenPoints(group, points_in_Re, seen_points, covariance[used], centre[used])
    start = register_groups(points_in_Re, seen_points, group, weight)
    if not by_rays:
        return PlatformPoses(pose, *start, np.zeros((n_poses, 6, 6)))
    return PlatformPoses(pose, *poses_on_rays(points, start, weighted=weighted))
