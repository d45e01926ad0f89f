"""Powers of the depth inside an outline, blurred by a lens: what profiles are made of.

With z the distance inside an outline in units of the blur, these are the means of max(z + e, 0)^p
over a Gaussian e of unit width, for p from -1/2 to 2 in halves, with the Gaussian itself. Every
derivative of a blurred power with respect to the distance, and to the blur, is again a sum of
these, so that one table serves all profiles:

    d P_p / d z = p P_(p-1),    P_(p+1) = z P_p + p P_(p-1),    P_0' = g
"""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import ndtr

from legcal.geometry.types import Array, IntArray

# Columns: 1, z, the Gaussian g(z), z g(z), and blurred powers; the last letter is the power.
ONE, Z, GAUSS, Z_GAUSS, STEP, LESS_HALF, Z_LESS_HALF, HALF, RAMP, THREE_HALVES, SQUARE = range(11)
N_POWERS = 11

_BEFORE, _AFTER, _PER_UNIT = 24.0, 24.0, 256  # range of the table, and entries per unit


def _tabulate() -> Array:
    """Tabulate the functions for z in [-_BEFORE, _AFTER], (n, N_POWERS + 1)."""
    coarse = np.arange(-_BEFORE, _AFTER + 1e-9, 1.0 / 32.0)
    root = np.linspace(0.0, 7.0, 1401)  # substitute x = root^2: the integrands are smooth
    kernel = np.exp(-0.5 * (root**2 - coarse[:, None]) ** 2) / np.sqrt(2.0 * np.pi)
    kernel *= 2.0 * (root[1] - root[0])
    kernel[:, 0] *= 0.5
    z = np.arange(-_BEFORE, _AFTER + 1e-9, 1.0 / _PER_UNIT)
    less_half = CubicSpline(coarse, kernel.sum(axis=1))(z)
    half = CubicSpline(coarse, kernel @ root**2)(z)
    gauss, step = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi), ndtr(z)
    ramp = z * step + gauss
    three_halves, square = z * half + 0.5 * less_half, z * ramp + step
    columns = [
        np.ones_like(z), z, gauss, z * gauss, step, less_half, z * less_half, half, ramp,
        three_halves, square,
    ]  # fmt: skip
    return np.stack([*columns, np.zeros_like(z)], axis=1)


_TABLE_WITH_ROOM = _tabulate()
_TABLE = np.ascontiguousarray(_TABLE_WITH_ROOM[:, :N_POWERS])


def powers(z: Array) -> Array:
    """Return the functions at distances z (...) in units of the blur, (..., N_POWERS)."""
    return np.asarray(_TABLE.take(_places(z), axis=0))


def powers_with_room(z: Array) -> Array:
    """Return the functions, and a column of zeros beside them, (..., N_POWERS + 1)."""
    return np.asarray(_TABLE_WITH_ROOM.take(_places(z), axis=0))


def _places(z: Array) -> IntArray:
    """Return the nearest entries of the tables."""
    place = np.clip((z + _BEFORE) * _PER_UNIT + 0.5, 0.0, len(_TABLE) - 1.0)
    return place.astype(np.intp)
