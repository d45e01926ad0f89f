"""The paper's equations (6) to (19), each as one CasADi expression.

Every function depends on the unknowns, on errors of the observed values, and on these values:
(local, error, *observed) -> residuals. Errors are zero in the evaluation of residuals; covariances
of axes become weights by the derivatives with respect to them. Of the three residuals of a vector
product two are independent: (6), (18) and (19) have the two across the direction.

Unknown rotations are Gibbs vectors w = tan(angle / 2) along the axis, counted from a start: they
have no branches and no square root. It is the chart of ``Frames``, except that a small w is half of
a rotation vector, and that steps begin with the translation. An unknown axis is turned about its
normal basis e1, e2 by two turns, w = (turn_1 e1 + turn_2 e2) / 2: its
:func:`~legcal.geometry.lines.axis_angles` but for a factor near one (:func:`gibbs_of`).

An observed direction is u + e1 alpha1 + e2 alpha2, its normal basis E being e1, e2 as rows. An
error of a pose is a step of :func:`~legcal.paper.equations.moved_points`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, combinations_with_replacement
from math import comb

import casadi as ca
import numpy as np

from legcal.geometry.lines import normal_basis, turned_axis
from legcal.geometry.motions import turned
from legcal.geometry.types import Array
from legcal.machine.equations import VectorOps, axis_in_leg, twist_residual
from legcal.machine.leg import JointType

END_ERRORS = 3  # errors of the end of a leg (13): two of its direction, one of its reading


@cache
def joint_on_axis() -> ca.Function:
    """Return (6): (A; alpha, beta; u, M, E) -> (M - A) x u (2,) [m]."""
    A, error, M = ca.SX.sym("A", 3), ca.SX.sym("error", 4), ca.SX.sym("M", 3)
    u, E = _direction()
    residual = ca.cross(M + E.T @ error[2:] - A, u + E.T @ error[:2])
    return ca.Function("joint_on_axis", [A, error, u, M, E], [E @ residual])


@cache
def leg_across_axis() -> ca.Function:
    """Return (7): (turns of v; alpha, step; u, E, R, frame) -> v . u.

    R takes the body of v to the frame of u; the frame (3, 3) of v has it and its normal basis as
    columns.
    """
    turns, error, u, E = (ca.SX.sym("turns", 2), ca.SX.sym("error", 8), *_direction())
    R, frame = ca.SX.sym("R", 3, 3), ca.SX.sym("frame", 3, 3)
    v = turned_points(error[5:], R @ turned_frame(turns, frame)[:, 0])
    residual = ca.dot(v, u + E.T @ error[:2])
    return ca.Function("leg_across_axis", [turns, error, u, E, R, frame], [residual])


@dataclass(frozen=True)
class LegInView:
    """A leg in a view, and its vectors in V (8)."""

    places: tuple[int, ...]  # of A (3) and the turns of v among the unknowns
    has_axis: bool  # its revolute axis v is located


def pairs_of_vectors(legs: Sequence[LegInView]) -> list[tuple[int, int]]:
    """Return the pairs of vectors of V that (9) multiplies: all but squares of unit vectors."""
    n_units, n_others = sum(leg.has_axis for leg in legs), comb(len(legs), 2)
    pairs = combinations_with_replacement(range(n_others + n_units), 2)
    return [(p, q) for p, q in pairs if p != q or p < n_others]


@cache
def vectors_of_view(legs: tuple[LegInView, ...]) -> ca.Function:
    """Return (8): (-; errors of A, v of each leg; A, v of each leg) -> the vectors of V."""
    n = len(legs)
    none, error, observed = (
        ca.SX.sym("local", 0),
        ca.SX.sym("error", 6 * n),
        ca.SX.sym("seen", 6, n),
    )
    shifted = observed + ca.reshape(error, 6, n)
    of_legs = [(shifted[:3, j], shifted[3:, j]) for j in range(n)]
    return ca.Function("vectors", [none, error, observed], [ca.vertcat(*_vectors(legs, of_legs))])


@cache
def products_in_base(legs: tuple[LegInView, ...], n_unknowns: int) -> ca.Function:
    """Return (9) of a view: (unknowns; -; ...) -> V_p . V_q in R_b minus R_c.

    Observed are, a column a leg, the known coordinates of A and the frames of v; then the products
    of :func:`pairs_of_vectors` in the camera, and the units of residuals.
    """
    n, pairs = len(legs), pairs_of_vectors(legs)
    x, error, products, unit = (ca.SX.sym("x", m) for m in (n_unknowns, 0, len(pairs), len(pairs)))
    known_A, frames = ca.SX.sym("known", 3, n), ca.SX.sym("frames", 3, 3 * n)
    padded, of_legs = ca.vertcat(x, 0.0), list[tuple[ca.SX, ca.SX]]()
    for j, leg in enumerate(legs):
        values = padded[list(leg.places)]
        v = turned_frame(values[3:5], frames[:, 3 * j : 3 * j + 3])[:, 0]
        of_legs.append((values[:3] + known_A[:, j], v))
    V = _vectors(legs, of_legs)
    residuals = ca.vertcat(*[ca.dot(V[p], V[q]) for p, q in pairs]) - products
    observed = [known_A, frames, products, unit]
    return ca.Function("products", [x, error, *observed], [residuals / unit])


def _vectors(legs: Sequence[LegInView], of_legs: Sequence[tuple[ca.SX, ca.SX]]) -> list[ca.SX]:
    """Return V of (A, v) of each leg: between joints, then the unit vectors."""
    V = [of_legs[g][0] - of_legs[j][0] for j, g in combinations(range(len(legs)), 2)]
    return V + [v for leg, (_, v) in zip(legs, of_legs, strict=True) if leg.has_axis]


def leg_end(q0: ca.SX, leg: ca.SX, error: ca.SX) -> ca.SX:
    """Return (13): the end B = A + (q + q0) u of a leg (A, u, q, e1, e2), errors of u and q."""
    u = leg[3:6] + leg[7:10] * error[0] + leg[10:13] * error[1]
    return leg[:3] + (leg[6] + error[2] + q0) * u


@cache
def end_of_leg() -> ca.Function:
    """Return (13): (q0; error; leg) -> B (3,) [m]."""
    q0, error, leg = ca.SX.sym("q0"), ca.SX.sym("error", END_ERRORS), ca.SX.sym("leg", 13)
    return ca.Function("end_of_leg", [q0, error, leg], [leg_end(q0, leg, error)])


@cache
def distance_of_ends() -> ca.Function:
    """Return (q0 of two legs; errors; both legs) -> the distance of their ends [m]."""
    q0, error, legs = ca.SX.sym("q0", 2), ca.SX.sym("error", 2 * END_ERRORS), _two_legs("legs")
    return ca.Function("distance", [q0, error, legs], [_distance(q0, legs, error)])


@cache
def change_of_distance() -> ca.Function:
    """Return (14): (q0 of two legs; errors; both before, after) -> the change of |B_j B_g| [m]."""
    q0, error = ca.SX.sym("q0", 2), ca.SX.sym("error", 4 * END_ERRORS)
    before, after = _two_legs("before"), _two_legs("after")
    first, second = ca.vertsplit(error, 2 * END_ERRORS)
    change = _distance(q0, after, second) - _distance(q0, before, first)
    return ca.Function("change", [q0, error, before, after], [change])


@cache
def mean_distance() -> ca.Function:
    """Return (16): (B_j, B_g; error; known, mean) -> |B_j B_g| in R_e minus the mean [m].

    *known* (3, 2) are the known coordinates, zero for unknown ones.
    """
    local, error, known_B = ca.SX.sym("local", 6), ca.SX.sym("error"), ca.SX.sym("known", 3, 2)
    mean = ca.SX.sym("mean")
    apart = local[3:] + known_B[:, 1] - local[:3] - known_B[:, 0]
    residual = ca.norm_2(apart) - (mean + error)
    return ca.Function("mean_distance", [local, error, known_B, mean], [residual])


@cache
def point_on_ray() -> ca.Function:
    """Return (18): (P, step; error; known, R, t, centre, N, seen) -> (R P + t) x P_c (2,), range.

    Both sides of the product [m^2] begin at the centre of the camera; N has two directions across
    it. The third residual is missing in the product: the error of the point along the ray [m].
    *known* are the known coordinates of P, zero for unknown ones.
    """
    local, error, observed = ca.SX.sym("local", 9), ca.SX.sym("error", 3), ca.SX.sym("seen", 3)
    known_point, (R, t), (centre, N) = ca.SX.sym("known", 3), _pose(), _ray()
    point = moved_points(local[3:], R, t, local[:3] + known_point)
    residual = _off_ray(point, observed + error, centre, N)
    return ca.Function("ray", [local, error, known_point, R, t, centre, N, observed], [residual])


@cache
def end_on_ray() -> ca.Function:
    """Return (18) of the end of a leg (13): (q0, B, step; error; known, R, t, centre, N, leg).

    The residuals are as in :func:`point_on_ray`; errors are of u, the reading, and A.
    """
    local, error = ca.SX.sym("local", 10), ca.SX.sym("error", END_ERRORS + 3)
    known_B, (R, t), (centre, N) = ca.SX.sym("known", 3), _pose(), _ray()
    leg = ca.SX.sym("leg", 13)
    point = moved_points(local[4:], R, t, local[1:4] + known_B)
    end = leg_end(local[0], leg, error) + error[END_ERRORS:]
    residual = _off_ray(point, end, centre, N)
    return ca.Function("end_on_ray", [local, error, known_B, R, t, centre, N, leg], [residual])


@cache
def end_on_axis() -> ca.Function:
    """Return (19): (B; alpha, step; known, R, t, A, u, E) -> u x (B - A) (2,) [m]."""
    B, error, known_B = ca.SX.sym("B", 3), ca.SX.sym("error", 8), ca.SX.sym("known", 3)
    (R, t), A, (u, E) = _pose(), ca.SX.sym("A", 3), _direction()
    end = moved_points(error[2:], R, t, B + known_B)
    residual = E @ ca.cross(u + E.T @ error[:2], end - A)
    return ca.Function("end_on_axis", [B, error, known_B, R, t, A, u, E], [residual])


@cache
def closure_of_leg(base_joint: JointType, platform_joint: JointType) -> ca.Function:
    """Return the closure of a leg without an S joint, which determines universal axes in 3.5.

    (rotations of a, of b, change of the twist; alpha, step; u, E, R, a, b, twist, unit) -> the sine
    of the deviation of the leg from its twist, over the unit. a and b are the frames (3, 3) of the
    axes at base and platform; for a leg fixed to the platform b has its direction there.
    """
    local, error, (u, E) = ca.SX.sym("local", 5), ca.SX.sym("error", 8), _direction()
    R, a, b = (ca.SX.sym(name, 3, 3) for name in ("R", "a", "b"))
    twist, unit = ca.SX.sym("twist"), ca.SX.sym("unit")
    base = turned_frame(local[:2], a)[:, 0]
    outer = turned_frame(local[2:4], b)[:, 1 if platform_joint is JointType.FIXED else 0]
    direction = u + E.T @ error[:2]
    p, w = (
        axis_in_leg(joint, axis, direction, _SYMBOLS)
        for joint, axis in (
            (base_joint, base),
            (platform_joint, turned_points(error[5:], R @ outer)),
        )
    )
    sine = twist_residual(p, w, direction, twist + local[4], _SYMBOLS)
    observed = [u, E, R, a, b, twist, unit]
    return ca.Function("closure", [local, error, *observed], [sine / unit])


@cache
def nominal_value(n: int) -> ca.Function:
    """Return (x (n,); -; row, target) -> row . x - target: a prior from the nominal model."""
    x, row, target = ca.SX.sym("x", n), ca.SX.sym("row", n), ca.SX.sym("target")
    none = ca.SX.sym("error", 0)
    return ca.Function("nominal", [x, none, row, target], [ca.dot(row, x) - target])


_SYMBOLS = VectorOps(ca.dot, ca.cross, lambda v: v / ca.norm_2(v), ca.cos, ca.sin)


def _distance(q0: ca.SX, legs: ca.SX, error: ca.SX) -> ca.SX:
    """Return the distance between the ends of two legs (13, 2), (13)."""
    errors = ca.vertsplit(error, END_ERRORS)
    first, second = (leg_end(q0[k], legs[:, k], errors[k]) for k in range(2))
    return ca.norm_2(first - second)


def _off_ray(point: ca.SX, observed: ca.SX, centre: ca.SX, N: ca.SX) -> ca.SX:
    """Return the offset of a point from the observed one: across its ray as in (18), and along."""
    along = ca.cross(N[0, :].T, N[1, :].T)
    return ca.vertcat(
        N @ ca.cross(point - centre, observed - centre), ca.dot(along, point - observed)
    )


def _two_legs(name: str) -> ca.SX:
    return ca.SX.sym(name, 13, 2)


def _pose() -> tuple[ca.SX, ca.SX]:
    return ca.SX.sym("R", 3, 3), ca.SX.sym("t", 3)


def _ray() -> tuple[ca.SX, ca.SX]:
    return ca.SX.sym("centre", 3), ca.SX.sym("N", 2, 3)


def _direction() -> tuple[ca.SX, ca.SX]:
    return ca.SX.sym("u", 3), ca.SX.sym("E", 2, 3)


# Unknown motions


def moved_points(step: ca.SX, R: ca.SX, t: ca.SX, points: ca.SX) -> ca.SX:
    """Return points (3, n) after R, t and a step (6,): translation [m], then Gibbs vector."""
    return turned_points(step[3:], R @ points) + ca.repmat(t + step[:3], 1, points.shape[1])


def turned_points(w: ca.SX, points: ca.SX) -> ca.SX:
    """Return points (3, n) turned by the rotation that has the Gibbs vector w (3,)."""
    cross = ca.skew(w)
    turn = ca.SX.eye(3) + 2.0 / (1.0 + ca.dot(w, w)) * (cross + ca.mtimes(cross, cross))
    return turn @ points


def stepped_poses(R: Array, t: Array, steps: Array) -> tuple[Array, Array]:
    """Return the poses (n, 3, 3), (n, 3) of :func:`moved_points` for numbers, steps (n, 6)."""
    return turned(R, 2.0 * steps[:, 3:]), t + steps[:, :3]


# Unknown axes


def axis_frames(v: Array) -> Array:
    """Return axes (n, 3) and their normal bases as columns, (n, 3, 3)."""
    return np.concatenate([v[:, :, None], np.swapaxes(normal_basis(v), 1, 2)], axis=2)


def turned_frame(turns: ca.SX, frame: ca.SX) -> ca.SX:
    """Return an axis and its normal basis, columns (3, 3), after two turns of the axis."""
    return turned_points(0.5 * frame[:, 1:] @ turns, frame)


def gibbs_of(angles: Array) -> Array:
    """Return the turns (..., 2) of an axis that is turned by angles (..., 2) [rad]."""
    half = 0.5 * np.linalg.norm(angles, axis=-1, keepdims=True)
    return np.asarray(angles * np.where(half > 0.0, np.tan(half) / np.where(half, half, 1.0), 1.0))


def angles_of(turns: Array) -> Array:
    """Return the angles (..., 2) [rad] of turns, the inverse of :func:`gibbs_of`."""
    half = 0.5 * np.linalg.norm(turns, axis=-1, keepdims=True)
    return np.asarray(
        turns * np.where(half > 0.0, np.arctan(half) / np.where(half, half, 1.0), 1.0)
    )


def axis_slope(nominal: Array, turns: Array) -> Array:
    """Return the derivative (3, 2) of the first column of :func:`turned_frame` by the turns."""
    by_turns = np.array([-0.5 * turns, [0.0, 1.0], [-1.0, 0.0]])
    axis = turned_axis(nominal, angles_of(turns))
    frame = np.vstack([nominal, normal_basis(nominal)])
    return np.asarray(
        (frame.T @ by_turns - 0.5 * np.outer(axis, turns)) / (1.0 + 0.25 * float(turns @ turns))
    )
