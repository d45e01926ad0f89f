"""The residuals of steps 2, 3 and 4, one small pure CasADi function for each kind.

Every function takes the unknowns that one observation depends on, as one column, and then what
was observed; see :class:`legcal.stages.least_squares.Term`. Lengths are in m. An observed leg
is a column of seven: A, u and reading of eq (13).
"""

from __future__ import annotations

from functools import cache

import casadi as ca

from legcal.stages.motion import moved_points


@cache
def centre_in_camera() -> ca.Function:
    """Return (A and step; R, t, A_camera, W) -> W times the miss of A in a camera frame, (3,)."""
    local, A_camera, W = ca.SX.sym("local", 9), ca.SX.sym("A_camera", 3), ca.SX.sym("W", 3, 3)
    R, t = ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3)
    miss = W @ (moved_points(local[3:], R, t, local[:3]) - A_camera)
    return ca.Function("centre", [local, R, t, A_camera, W], [miss])


@cache
def distance_of_joints() -> ca.Function:
    """Return (two joints; distance, sigma) -> their distance less the one seen, in sigmas."""
    local, distance, sigma = ca.SX.sym("local", 6), ca.SX.sym("distance"), ca.SX.sym("sigma")
    miss = (ca.norm_2(local[3:] - local[:3]) - distance) / sigma
    return ca.Function("joints", [local, distance, sigma], [miss])


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


@cache
def direction_of_leg() -> ca.Function:
    """Return (B and step; R, t, A, u, basis, W) -> A B against the direction u, in deviations."""
    local, u, basis = ca.SX.sym("local", 9), ca.SX.sym("u", 3), ca.SX.sym("basis", 2, 3)
    R, t, A, W = ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3), ca.SX.sym("A", 3), ca.SX.sym("W", 2, 2)
    leg = moved_points(local[3:], R, t, local[:3]) - A
    miss = W @ (basis @ leg / ca.dot(u, leg))
    return ca.Function("direction", [local, R, t, A, u, basis, W], [miss])


@cache
def length_of_leg() -> ca.Function:
    """Return (B, step and q0; R, t, A, reading, sigma) -> |A B| less reading + q0, in sigmas."""
    local, reading, sigma = ca.SX.sym("local", 10), ca.SX.sym("reading"), ca.SX.sym("sigma")
    R, t, A = ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3), ca.SX.sym("A", 3)
    leg = moved_points(local[3:9], R, t, local[:3]) - A
    miss = (ca.norm_2(leg) - (reading + local[9])) / sigma
    return ca.Function("length", [local, R, t, A, reading, sigma], [miss])


def _distance_of_ends(q0: ca.SX, legs: ca.SX) -> ca.SX:
    """Return the distance between the ends A + (q + q0) u of two legs, one a column, eq (13)."""
    ends = [legs[:3, k] + (legs[6, k] + q0[k]) * legs[3:6, k] for k in range(2)]
    return ca.norm_2(ends[0] - ends[1])
