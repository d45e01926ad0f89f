"""Axes as two angles from a nominal one: rotations about its normal basis.

The angles w of an axis v turn it by exp([w_1 e_1 + w_2 e_2]_x), with e_1, e_2 the
:func:`~legcal.geometry.lines.normal_basis` of v. Axes are lines: v and -v have the same angles.
"""

import numpy as np

from legcal.geometry.lines import cross, normal_basis
from legcal.geometry.types import Array


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
