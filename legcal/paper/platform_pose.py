"""Section 3.5: the transformation between camera and platform frame, eq (18).

The ends B of three legs or more, known in the frame of a camera by (13) and in R_e by (16),
fix the pose of the platform. As printed,

    (R B_e + t) x B_c = 0   (18)

puts R B_e + t on the ray through the camera centre and B_c: three legs leave up to four solutions,
and the known distance of B_c is not used. So it starts from point equality R B_e + t = B_c, in
closed form, and with weights the distance along the ray counts too. In a plane point equality is
all.

With weights the points themselves are unknown in a second solution of (18): unlike (9) and (16) it
decides z of coplanar joints, and the handedness. What it says less of than the nominal model stays
where (9), (14) and (16) have it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from legcal.geometry.lines import normal_basis
from legcal.geometry.motions import register_groups, register_in_plane
from legcal.geometry.types import Array, IntArray
from legcal.paper.equations import point_on_ray
from legcal.paper.gibbs import stepped_poses
from legcal.paper.least_squares import LeastSquares, Term, solve_least_squares

_FLAT = 1e-3  # of their largest distance from their centre: how far points of a line are off it


@dataclass(frozen=True, eq=False)
class PlatformPoses:
    """Poses of R_e in the frames of the groups of legs that fix them."""

    pose: IntArray  # (n,): the pose of each leg of the directions; -1 where its group fixes none
    R: Array  # (n_poses, 3, 3)
    t: Array  # (n_poses, 3) [m]
    covariance: Array  # (n_poses, 6, 6) of steps from them; zero without weights and in a plane


@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points of bodies that cameras see."""

    group: IntArray  # (n,) of points of one body in one frame: 0, 1 and so on
    own: Array  # (n, 3) in the frame of the body [m]
    seen: Array  # (n, 3) where they are, in the frame of the group [m]
    covariance: Array  # (n, 3, 3) of that
    centre: Array  # (n, 3) of the camera, in the frame of the group [m]

    def term(
        self, start: tuple[Array, Array], steps: IntArray, own: IntArray, known: Array
    ) -> Term:
        """Return (18) of points whose coordinates *own* (n, 3) are unknown, -1 where *known*.

        *steps* (n, 6) are the places of the steps of their bodies from a start R (g, 3, 3), t.
        """
        (R, t), across = start, across_rays(self.seen, self.centre)
        observed = known, R[self.group], t[self.group], self.centre, across, self.seen
        index = np.hstack([own, steps])
        return Term(point_on_ray(), index, observed, self.covariance, n_printed=2)


def across_rays(seen: Array, centre: Array) -> Array:
    """Return two directions (n, 2, 3) across the rays to points; their product is along these."""
    ray = seen - centre
    return normal_basis(ray / np.linalg.norm(ray, axis=1, keepdims=True))


def poses_on_rays(
    points: SeenPoints, start: tuple[Array, Array], *, weighted: bool
) -> tuple[Array, Array, Array]:
    """Return R (g, 3, 3), t (g, 3) and covariances (g, 6, 6) of all bodies by (18), from a start.

    The covariances are those of steps; zero without weights.
    """
    R, t = start
    n, group, columns = len(R), points.group, np.arange(6 * len(R)).reshape(-1, 6)
    term = points.term(start, columns[group], np.full((len(group), 3), -1), points.own)
    problem = LeastSquares("The poses (eq 18)", (term,), np.zeros(6 * n), exact_hessian=weighted)
    solution = solve_least_squares(problem, weighted=weighted)
    covariance = solution.covariances(columns) if weighted else np.zeros((n, 6, 6))
    return *stepped_poses(R, t, solution.x[columns]), covariance


def _span_a_frame(points: Array, *, spatial: bool) -> bool:
    """Say whether points fix a rigid body: three not on one line, or two in a plane."""
    if len(points) < 2:
        return False
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if not spatial:
        return bool(singular[0] > 0.0)
    return bool(len(points) > 2 and singular[1] > _FLAT * singular[0])


def locate_platform(
    groups: list[IntArray],  # of legs that belong to one pose, in one frame
    B_Re: Array,  # (n, 3) the end of each leg in R_e [m]
    ends: Array,  # (n, 3) the same in the frames of the groups; NaN of passive legs
    covariance: Array,  # (n, 3, 3) of that
    centre: Array,  # (n, 3) of the camera, in the frame of the group [m]
    *,
    spatial: bool,
    weighted: bool,
    by_rays: bool,  # by (18); point equality alone without it, and in a plane
) -> PlatformPoses:
    """Locate the platform in the frame of every group that shows enough ends, by (18).

    In a plane two ends are enough, in R_b. Raises DidNotConverge.
    """
    known = np.isfinite(ends[:, 0])
    pose, n_poses = np.full(len(ends), -1), 0
    for rows in groups:
        if _span_a_frame(B_Re[rows[known[rows]]], spatial=spatial):
            pose[rows], n_poses = n_poses, n_poses + 1
    used = np.flatnonzero(known & (pose >= 0))
    if not len(used):
        return PlatformPoses(pose, *(np.zeros((0, *n)) for n in ((3, 3), (3,), (6, 6))))
    own, seen, group = B_Re[used], ends[used], pose[used]
    weight = 1.0 / np.einsum("nii->n", covariance[used]) if weighted else None
    if not spatial:
        R, t = register_in_plane(own, seen, group, weight)
        return PlatformPoses(pose, R, t, np.zeros((n_poses, 6, 6)))
    points = SeenPoints(group, own, seen, covariance[used], centre[used])
    start = register_groups(own, seen, group, weight)
    if not by_rays:
        return PlatformPoses(pose, *start, np.zeros((n_poses, 6, 6)))
    return PlatformPoses(pose, *poses_on_rays(points, start, weighted=weighted))
