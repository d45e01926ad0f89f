"""Section 3.5: the transformation between camera and platform frame, eq (18).

The ends B of three legs or more, known in the frame of a camera by (13) and in R_e by (16),
fix the pose of the platform. As printed,

    (R B_e + t) x B_c = 0   (18)

puts R B_e + t on the ray through the camera centre and B_c: three legs leave up to four solutions,
and the known distance of B_c is not used. Point equality R B_e + t = B_c has the same unknowns
and more equations, in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.geometry.motions import register_groups, register_in_plane
from legcal.geometry.types import Array, IntArray
from legcal.paper.criteria import Transformation
from legcal.paper.gibbs import motion_after, moved_points, stepped_poses
from legcal.paper.least_squares import LeastSquares, Term, solve_least_squares
from legcal.paper.leg_directions import LegDirections

_FLAT = 1e-3  # of their largest distance from their centre: how far points of a line are off it


@dataclass(frozen=True, eq=False)
class PlatformPoses:
    """Poses of R_e in the frames of the groups of legs that fix them."""

    pose: IntArray  # (n,): the pose of each leg of the directions; -1 where its group fixes none
    R: Array  # (n_poses, 3, 3)
    t: Array  # (n_poses, 3) [m]

    def stepped(self, steps: Array, poses: IntArray) -> tuple[Array, Array]:
        """Return R and t of some poses after steps (n_poses, 6) of all, as ``moved`` has them."""
        return stepped_poses(self.R[poses], self.t[poses], steps[poses])


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
    """Locate the platform in the frame of every group that shows enough leg ends (n, 3).

    Ends are NaN for passive legs; ``centre`` (n, 3) is the camera that saw each leg, both in the
    frame of the group [m]. In a plane two ends are enough, in R_b. ``on_a_line`` takes ends in one
    line too, about which the turn of the platform is arbitrary. ``weight`` (n,) counts in point
    equality, from which the printed form starts. Raises DidNotConverge.
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


def _span_a_frame(points: Array, *, spatial: bool) -> bool:
    """Say whether points fix a rigid body: three not on one line, or two in a plane."""
    if len(points) < 2:
        return False
    singular = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if not spatial:
        return bool(singular[0] > 0.0)
    return bool(len(points) > 2 and singular[1] > _FLAT * singular[0])


def build_rays(
    points: Array, ends: Array, centre: Array, group: IntArray, start: tuple[Array, Array]
) -> LeastSquares:
    """Build (18) as printed for all groups 0, 1...: unknown are steps from R (g, 3, 3), t (g, 3).

    ``points`` (n, 3) are in their own frame, ``ends`` and camera centres in that of the group [m]:
    both sides of the product begin at the camera centre.
    """
    R, t = start
    index = 6 * group[:, None] + np.arange(6)
    term = Term(_ray_residual(), index, (R[group], t[group], points, ends, centre))
    return LeastSquares("The pose of the platform (eq 18)", (term,), np.zeros(6 * len(R)))


def register_by_rays(P_from: Array, P_camera: Array, start: RigidTransform) -> RigidTransform:
    """Return T_camera_from by (18) as printed, for points (n, 3) seen from a camera."""
    R, t = start.rotation.as_matrix()[None], np.array(start.translation)[None]
    group = np.zeros(len(P_from), dtype=np.intp)
    problem = build_rays(P_from, P_camera, np.zeros_like(P_camera), group, (R, t))
    return motion_after(solve_least_squares(problem).x, start)


@cache
def _ray_residual() -> ca.Function:
    """Return (step; R, t, point, end, centre) -> (R point + t) x end of (18) [m^2], (3,)."""
    step, R, t = ca.SX.sym("step", 6), ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3)
    point, end, centre = (ca.SX.sym(name, 3) for name in ("point", "end", "centre"))
    residual = ca.cross(moved_points(step, R, t, point) - centre, end - centre)
    return ca.Function("ray", [step, R, t, point, end, centre], [residual])
