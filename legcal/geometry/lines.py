"""Oriented lines in space: a unit direction u and any point M of the line.

The sign of eq (1) is defined here only: the moment of a line is ``u x M``, with M measured from the
origin of the frame (the camera centre C in a camera frame). Renaud, Andreff, Gogu, Martinet (2002),
eq (1).

Axes are lines: v and -v are one axis. Two angles w turn an axis v by exp([w_1 e_1 + w_2 e_2]_x),
with e_1, e_2 the :func:`normal_basis` of v.
"""

import numpy as np

from legcal.geometry.types import Array

_COORDINATE_AXES = np.eye(3)


def cross(a: Array, b: Array) -> Array:
    """Return vector products a x b along the last axis; np.cross is slow on few vectors."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    i, j, k = b[..., 0], b[..., 1], b[..., 2]
    first = y * k - z * j
    product = np.empty((*first.shape, 3))
    product[..., 0], product[..., 1], product[..., 2] = first, z * i - x * k, x * j - y * i
    return product


def moment(
    u: Array,  # (..., 3) unit directions
    M: Array,  # (..., 3) any point of each line [m]
) -> Array:
    """Return the moment h = u x M of oriented lines, eq (1), (..., 3) [m]."""
    return cross(u, M)


def nearest_point_to_origin(
    u: Array,  # (..., 3) unit directions
    M: Array,  # (..., 3) any point of each line [m]
) -> Array:
    """Return the point of each line nearest to the origin of the frame, (..., 3) [m]."""
    return np.asarray(M - u * np.sum(u * M, axis=-1, keepdims=True))


def distance_to_line(
    P: Array,  # (..., 3) points [m]
    u: Array,  # (..., 3)
    M: Array,  # (..., 3)
) -> Array:
    """Return the distance of points to lines, the norm of (M - P) x u of eq (6), (...) [m]."""
    return np.asarray(np.linalg.norm(cross(M - P, u), axis=-1))


def normal_basis(
    u: Array,  # (..., 3) unit directions
) -> Array:
    """Return two unit vectors that complete each direction to a right-handed basis, (..., 2, 3).

    The choice is a fixed function of u: the coordinate axis least aligned with u, made
    orthogonal to it, comes first; u x e1 comes second.
    """
    axis = _COORDINATE_AXES[np.abs(u).round(9).argmin(axis=-1)]  # ties independent of rounding
    basis = np.empty((*u.shape[:-1], 2, 3))
    e1, e2 = basis[..., 0, :], basis[..., 1, :]
    np.subtract(axis, u * (u * axis).sum(axis=-1, keepdims=True), out=e1)
    e1 /= np.sqrt((e1 * e1).sum(axis=-1, keepdims=True))
    ahead, behind = [1, 2, 0], [2, 0, 1]  # np.cross is slow on single vectors
    e2[...] = u[..., ahead] * e1[..., behind] - u[..., behind] * e1[..., ahead]
    return basis


def direction_above(up: Array, turn: float, lift: float) -> Array:
    """Return the unit direction (3,) at an angle around *up* and a height above its plane [rad]."""
    x, y = normal_basis(up)
    level = np.cos(turn) * x + np.sin(turn) * y
    return np.asarray(np.cos(lift) * level + np.sin(lift) * up)


def nearest_point_to_line(u: Array, M: Array, d: Array, P: Array) -> Array:
    """Return the point of each line (u, M) nearest to a line along d through P.

    All are (..., 3); u and d are unit directions, not parallel.
    """
    across = u - d * np.sum(u * d, axis=-1, keepdims=True)
    t = np.sum(across * (P - M), axis=-1) / np.sum(across * across, axis=-1)
    return np.asarray(M + t[..., None] * u)


def segment_distance(start_1: Array, span_1: Array, start_2: Array, span_2: Array) -> Array:
    """Return the distances of pairs of segments start + s span, 0 <= s <= 1."""

    def dot(first: Array, second: Array) -> Array:
        return np.asarray(np.einsum("ni,ni->n", first, second))

    between = start_1 - start_2
    a, e, b = dot(span_1, span_1), dot(span_2, span_2), dot(span_1, span_2)
    c, f = dot(span_1, between), dot(span_2, between)
    square = a * e - b * b
    lines_cross = square > 1e-12 * a * e
    s = np.where(lines_cross, (b * f - c * e) / np.where(lines_cross, square, 1.0), 0.0)
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((b * s + f) / e, 0.0, 1.0)
    s = np.clip((b * t - c) / a, 0.0, 1.0)
    return np.asarray(np.linalg.norm(between + s[:, None] * span_1 - t[:, None] * span_2, axis=1))


def turned_axis(v: Array, angles: Array) -> Array:
    """Return unit vectors (..., 3) turned about their normal bases by angles (..., 2) [rad]."""
    w = np.einsum("...i,...ia->...a", angles, normal_basis(v))
    size = np.sqrt(np.einsum("...a,...a->...", w, w))[..., None]
    return np.asarray(np.cos(size) * v + np.sinc(size / np.pi) * cross(w, v))


def axis_angles(axis: Array, nominal: Array) -> Array:
    """Return the two angles [rad] from a nominal axis (3,) to an axis."""
    axis = -axis if axis @ nominal < 0.0 else axis
    turn = cross(nominal, axis)
    sine = float(np.sqrt(turn @ turn))
    scale = 1.0 if sine == 0.0 else float(np.arctan2(sine, axis @ nominal)) / sine
    return np.asarray(normal_basis(nominal) @ (scale * turn))


def axis_angles_slope(axis: Array, nominal: Array) -> Array:
    """Return the derivative (2, 2) of :func:`axis_angles` by small angles from the axis itself."""
    seen = -axis if axis @ nominal < 0.0 else axis
    by_turn = cross(normal_basis(axis), seen)
    turn, d_turn = cross(nominal, seen), cross(nominal, by_turn)
    sine, cosine = float(np.sqrt(turn @ turn)), float(nominal @ seen)
    if sine == 0.0:
        return np.asarray(normal_basis(nominal) @ d_turn.T)
    scale = float(np.arctan2(sine, cosine)) / sine
    d_sine = d_turn @ turn / sine
    d_scale = (cosine * d_sine - sine * (by_turn @ nominal) - scale * d_sine) / sine
    return np.asarray(normal_basis(nominal) @ (scale * d_turn + np.outer(d_scale, turn)).T)
