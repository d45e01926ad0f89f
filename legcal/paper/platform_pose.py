"""Section 3.5: the transformation between camera and platform frame, eq (18).

The ends B of three legs or more, known in the frame of a camera by (13) and in R_e by (16),
tell where the platform is. As printed, (18) puts R B_e + t on the ray through the camera centre
and B_c: three legs leave up to four solutions, and how far away B_c is counts for nothing. Point
equality R B_e + t = B_c has the same unknowns and more equations, in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import casadi as ca
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import NotIdentifiable
from legcal.geometry import Array, IntArray, register_groups, register_in_plane
from legcal.paper.leg_directions import LegDirections
from legcal.paper.nominal import Criteria
from legcal.paper.solver import (
    LeastSquares,
    Term,
    moved,
    moved_points,
    solve_least_squares,
    turned_points,
)


@cache
def direction_of_leg() -> ca.Function:
    """Return (B, step; held, R, t, A, u, basis, W) -> A B against u, in deviations (2,)."""
    local, known = ca.SX.sym("local", 9), _known()
    u, basis, W = ca.SX.sym("u", 3), ca.SX.sym("basis", 2, 3), ca.SX.sym("W", 2, 2)
    leg = _leg(local, known)
    miss = W @ (basis @ leg / ca.dot(u, leg))
    return ca.Function("direction", [local, *known, u, basis, W], [miss])


@cache
def length_of_leg() -> ca.Function:
    """Return (B, step, q0; held, R, t, A, reading, sigma) -> |A B| less reading + q0, in sigmas."""
    local, known = ca.SX.sym("local", 10), _known()
    reading, sigma = ca.SX.sym("reading"), ca.SX.sym("sigma")
    miss = (ca.norm_2(_leg(local, known)) - (reading + local[9])) / sigma
    return ca.Function("length", [local, *known, reading, sigma], [miss])


@cache
def revolute_on_platform() -> ca.Function:
    """Return (B, step, turns; held, R, t, A, v, basis, sigma) -> v . u of (7), in sigmas."""
    local, known, v, basis = ca.SX.sym("local", 11), _known(), *_axis("v")
    sigma = ca.SX.sym("sigma")
    axis = _carried(local, known, turned(local[9:], v, basis, v))
    miss = ca.dot(axis, _direction(local, known)) / sigma
    return ca.Function("revolute", [local, *known, v, basis, sigma], [miss])


@cache
def fixed_on_platform() -> ca.Function:
    """Return (B, step, turns; held, R, t, A, v, basis, sigma) -> u across v, in sigmas (2,)."""
    local, known, v, basis = ca.SX.sym("local", 11), _known(), *_axis("v")
    sigma = ca.SX.sym("sigma")
    across = turned(local[9:], v, basis, basis.T)
    across = turned_points(local[6:9], known[1] @ across)
    miss = across.T @ _direction(local, known) / sigma
    return ca.Function("fixed", [local, *known, v, basis, sigma], [miss])


@cache
def twist_of_leg(base_joint: str, platform_joint: str) -> ca.Function:
    """Return (B, step, turns of b, of a, twist; held, R, t, A, a, basis, b, basis, twist, sigma).

    The residual is sin(angle - twist) of the inner axes about u, in sigmas; see
    :mod:`legcal.machine.equations`.
    """
    local, known, a, b = ca.SX.sym("local", 14), _known(), _axis("a"), _axis("b")
    twist, sigma = ca.SX.sym("twist"), ca.SX.sym("sigma")
    first = b[1][0, :].T if platform_joint == "" else b[0]
    outer = _carried(local, known, turned(local[9:11], *b, first))
    base = turned(local[11:13], *a, a[0])
    u, tau = _direction(local, known), twist + local[13]
    miss = twist_sine((base_joint, platform_joint), base, outer, u, tau) / sigma
    return ca.Function("twist", [local, *known, *a, *b, twist, sigma], [miss])


@cache
def closure_of_leg(base_joint: str, platform_joint: str) -> ca.Function:
    """Return (turns of b, of a, twist; u, R, a, basis, b, basis, twist, unit) -> sine over unit.

    The residual of :func:`twist_of_leg` where leg direction u and rotation R of the platform are
    known.
    """
    local, a, b = ca.SX.sym("local", 5), _axis("a"), _axis("b")
    u, R, twist = ca.SX.sym("u", 3), ca.SX.sym("R", 3, 3), ca.SX.sym("twist")
    unit = ca.SX.sym("unit")
    first = b[1][0, :].T if platform_joint == "" else b[0]
    outer, base = R @ turned(local[:2], *b, first), turned(local[2:4], *a, a[0])
    miss = twist_sine((base_joint, platform_joint), base, outer, u, twist + local[4])
    return ca.Function("closure", [local, u, R, *a, *b, twist, unit], [miss / unit])


@cache
def miss_of_ray() -> ca.Function:
    """Return (step; R, t, point, end, centre) -> (R point + t) x end of (18) [m^2], (3,).

    Both vectors begin at the camera *centre*, from which the point's *end* was seen.
    """
    step, R, t = ca.SX.sym("step", 6), ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3)
    point, end, centre = (ca.SX.sym(name, 3) for name in ("point", "end", "centre"))
    miss = ca.cross(moved_points(step, R, t, point) - centre, end - centre)
    return ca.Function("ray", [step, R, t, point, end, centre], [miss])


def twist_sine(joints: tuple[str, str], a: ca.SX, b: ca.SX, u: ca.SX, twist: ca.SX) -> ca.SX:
    """Return sin(angle - twist) of the inner axes of a leg about its direction u.

    The inner axis is the outer one across u for a universal joint, and the axis itself otherwise;
    a and b are those of base and platform in one frame.
    """
    p, w = (
        _unit(ca.cross(axis, u)) if joint == "U" else axis
        for joint, axis in zip(joints, (a, b), strict=True)
    )
    return ca.cos(twist) * ca.dot(u, ca.cross(p, w)) - ca.sin(twist) * ca.dot(p, w)


def turned(turns: ca.SX, axis: ca.SX, basis: ca.SX, vectors: ca.SX) -> ca.SX:
    """Return vectors (3, n) after the turns that move an axis with its basis (2, 3)."""
    return turned_points(0.5 * (basis.T @ turns), vectors)


def _known() -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Return symbols of the known part of B, of R and t at step zero, and of A."""
    return ca.SX.sym("held", 3), ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3), ca.SX.sym("A", 3)


def _axis(name: str) -> tuple[ca.SX, ca.SX]:
    """Return symbols of a nominal axis and of its basis."""
    return ca.SX.sym(name, 3), ca.SX.sym(f"{name}_basis", 2, 3)


def _leg(local: ca.SX, known: tuple[ca.SX, ca.SX, ca.SX, ca.SX]) -> ca.SX:
    """Return the vector from A to B."""
    held, R, t, A = known
    return moved_points(local[3:9], R, t, local[:3] + held) - A


def _direction(local: ca.SX, known: tuple[ca.SX, ca.SX, ca.SX, ca.SX]) -> ca.SX:
    """Return the unit vector from A to B."""
    return _unit(_leg(local, known))


def _carried(local: ca.SX, known: tuple[ca.SX, ca.SX, ca.SX, ca.SX], vector: ca.SX) -> ca.SX:
    """Return a direction of the platform in the frame of the group."""
    return turned_points(local[6:9], known[1] @ vector)


def _unit(vector: ca.SX) -> ca.SX:
    return vector / ca.norm_2(vector)


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
