"""The residuals of steps 2 and 3 and of pairs of leg ends, one small CasADi function each.

Every function takes the unknowns that one observation depends on, as one column, and then what
was observed; see :class:`legcal.stages.least_squares.Term`. Lengths are in m. An observed leg
is a column of seven: A, u and reading of eq (13).
"""

from __future__ import annotations

from functools import cache

import casadi as ca

from legcal.stages.base_unknowns import turned_axis
from legcal.stages.motion import moved_points


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
    of :func:`legcal.stages.base_unknowns.turned_axis`, for v in R_b and in the camera.
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
