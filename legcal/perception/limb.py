"""The limb model: what a profile across the outline of a cylinder may look like.

A background, flat or sloped, ends where the surface begins. What a surface of a cylinder sends to
the camera depends on the direction of its normal: by r, the cosine between normal and line of
sight, which is sqrt(rho (2 - rho)) at the depth rho = D / R inside the outline of a cylinder of
half-width R. Diffuse light gives sums of 1, r and r^2, darkening towards the limb higher powers,
and a highlight near the limb is a bump in r. All is blurred by a Gaussian.

Powers of r up to r^4 are expanded in powers of rho up to rho^2, which is good to a part in a
hundred up to rho = 0.8. All blocks of an outline are fitted together with seven functions
(:func:`profile_functions` of :func:`powers`):

    background      everywhere
    its slope       outside, by the depth that is looked at
    five surfaces   inside, less the background: sums of 1, r, ..., r^4

How much of each there may be depends on the finish. Matte to glossy cylinders under lamps anywhere
have five surfaces in the principal directions of what they send, with the sizes of the median
cylinder. A polished cylinder reflects its surroundings besides, at
the limb those close behind it and 90 degrees away where r = 0.7: stripes, taken as a random process
of r with the correlation length ``REFLECTION_LENGTH``. Single blocks are fitted with five functions
that most limbs are made of (:func:`simple_functions`).
"""

from functools import cache

import numpy as np
from scipy.special import gamma, ndtr, pbdv

from legcal.geometry.types import Array, IntArray

# Columns: 1, z, the Gaussian g(z), z g(z), and blurred powers of max(z, 0) or their products by z.
ONE, Z, GAUSS, Z_GAUSS, STEP, MINUS_HALF, Z_MINUS_HALF, HALF, RAMP, THREE_HALVES, SQUARE = range(11)
N_POWERS = 11

_REACH, _PER_BLUR = 24.0, 256  # range of the table on both sides, and entries per unit


@cache  # where no image is measured nothing is tabulated
def _tabulate_powers() -> tuple[Array, Array]:
    """Tabulate the functions and their slopes over the range, (n, N_POWERS) each.

    The mean of max(z + n, 0)^p over unit Gaussian noise n is
    Gamma(p + 1) exp(-z^2 / 4) D_(-p-1)(-z) / sqrt(2 pi), with parabolic cylinder functions D.
    """
    z = np.arange(-_REACH, _REACH + 1e-9, 1.0 / _PER_BLUR)
    gauss, step = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi), ndtr(z)
    minus_half, half = (
        gamma(p + 1.0) * np.exp(-0.25 * z * z) / np.sqrt(2.0 * np.pi) * pbdv(-p - 1.0, -z)[0]
        for p in (-0.5, 0.5)
    )
    ramp = z * step + gauss
    three_halves, square = z * half + 0.5 * minus_half, z * ramp + step
    columns = [
        np.ones_like(z), z, gauss, z * gauss, step, minus_half, z * minus_half, half, ramp,
        three_halves, square,
    ]  # fmt: skip
    values = np.stack(columns, axis=1)
    return values, np.gradient(values, 1.0 / _PER_BLUR, axis=0)


def powers(z: Array) -> tuple[Array, Array]:
    """Return the functions at distances z (...) in units of the blur, and their slopes by z.

    Both are (..., N_POWERS).
    """
    values, slopes = _tabulate_powers()
    entry = np.clip((z + _REACH) * _PER_BLUR, 0.0, len(values) - 1.0)
    node = np.rint(entry)
    index, rest = node.astype(np.intp), ((entry - node) / _PER_BLUR)[..., None]
    slope = slopes.take(index, axis=0)
    return values.take(index, axis=0) + rest * slope, slope


BACKGROUND, SLOPE, SURFACE = 0, 1, 2
N_AMPLITUDES = 7
# Prior of matte surfaces: rows are principal directions of r^0 to r^4, standard deviations in
# contrasts, by benchmarks/limb_light.py.
MATTE_DIRECTIONS = np.array(
    [
        [-0.400, -0.363, -0.506, -0.500, -0.450],
        [-0.632, -0.520, 0.136, 0.369, 0.419],
        [-0.660, 0.680, 0.250, -0.044, -0.194],
        [0.070, -0.360, 0.696, 0.055, -0.615],
        [0.000, 0.077, -0.423, 0.780, -0.454],
    ]
)
MATTE_SIGMA = np.array([0.59, 0.98, 1.13, 0.95, 7.26])
# Reflections of polished surfaces besides: standard deviation in contrasts, correlation length in
# r, and the largest r, which is that of the depth that is looked at.
REFLECTION, REFLECTION_LENGTH, REFLECTION_REACH = 0.3, 0.4, 0.7


def _reflections() -> Array:
    """Return the covariance (5, 5) of r^0 to r^4 by what polished surfaces reflect, in contrasts.

    The powers are fitted to the process by least squares over the depth.
    """
    r = np.linspace(0.0, REFLECTION_REACH, 200)
    process = REFLECTION**2 * np.exp(-np.abs(r[:, None] - r) / REFLECTION_LENGTH)
    weight = np.sqrt(r / np.sqrt(1.0 - r**2) + 0.05)  # depth by r, and not nothing at the limb
    fitted = np.linalg.pinv(weight[:, None] * r[:, None] ** np.arange(5)) * weight
    return np.asarray(fitted @ process @ fitted.T)


_OF_MATTE = MATTE_DIRECTIONS.T @ (MATTE_SIGMA**2 * MATTE_DIRECTIONS.T).T
_POLISHED_VARIANCE, _POLISHED_DIRECTIONS = np.linalg.eigh(_OF_MATTE + _reflections())
MATTE, POLISHED = 0, 1  # finishes, by which the following are ordered
SURFACES = np.stack([MATTE_DIRECTIONS, _POLISHED_DIRECTIONS.T])
SURFACE_SIGMA = np.stack([MATTE_SIGMA, np.sqrt(_POLISHED_VARIANCE)])

_ROOT = float(np.sqrt(2.0))
# Rows: r^0 to r^4 by rho^0, rho^(1/2), rho, rho^(3/2), rho^2.
_OF_DEPTH = np.array(
    [
        [1.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, _ROOT, 0.0, -0.25 * _ROOT, 0.0],
        [0.0, 0.0, 2.0, 0.0, -1.0],
        [0.0, 0.0, 0.0, 2.0 * _ROOT, 0.0],
        [0.0, 0.0, 0.0, 0.0, 4.0],
    ]
)


# The functions of profiles by finish, by those below.
_PROFILE = np.zeros((len(SURFACES), N_AMPLITUDES, N_AMPLITUDES))
_PROFILE[:, BACKGROUND, [BACKGROUND, SURFACE]] = 1.0
_PROFILE[:, SLOPE, SLOPE] = 1.0
_PROFILE[:, SURFACE:, SURFACE:] = SURFACES


def profile_functions(
    half_width: Array, blur: Array, depth: Array | float, finish: IntArray | int = 0
) -> tuple[Array, Array, Array]:
    """Return the functions of profiles as coefficients (n, N_AMPLITUDES, N_POWERS) of powers.

    The functions above, their derivatives by the distance inside the outline [1/px], and by the
    logarithm of the blur. Half-widths and blurs (n,) in px; ``depth`` is the unit of the
    background's slope [px], and ``finish`` that of surfaces, of all or of each (n,).
    """
    values, slopes, widenings = _functions_of_r(half_width, blur, depth)
    profile = _PROFILE[finish]
    return profile @ values, profile @ slopes, profile @ widenings


def polish_evidence(finish: IntArray, information: Array, right: Array) -> Array:
    """Return the log likelihood ratio (n,) of polished over matte surfaces.

    By what profiles say of the amplitudes of surfaces of a ``finish`` (n,), in contrasts: normal
    matrices (n, 5, 5) and right sides (n, 5), other unknowns eliminated.
    """
    of_powers = SURFACES[finish]
    likelihood = []
    for directions, sigma in zip(SURFACES, SURFACE_SIGMA, strict=True):
        turn = (of_powers @ directions.T) * sigma  # amplitudes by unit ones of this finish
        system = turn.swapaxes(1, 2) @ information @ turn + np.eye(len(sigma))
        pull = (turn.swapaxes(1, 2) @ right[..., None])[..., 0]
        explained = np.sum(pull * np.linalg.solve(system, pull[..., None])[..., 0], axis=1)
        likelihood.append(0.5 * (explained - np.linalg.slogdet(system)[1]))
    return np.asarray(likelihood[1] - likelihood[0])


def _functions_of_r(
    half_width: Array, blur: Array, depth: Array | float
) -> tuple[Array, Array, Array]:
    """Return the background and its slope, both outside, and r^0 to r^4, as profile_functions."""
    n = len(blur)
    values, slopes, widenings = (np.zeros((n, N_AMPLITUDES, N_POWERS)) for _ in range(3))
    values[:, BACKGROUND, [ONE, STEP]] = 1.0, -1.0
    slopes[:, BACKGROUND, GAUSS] = -1.0 / blur
    widenings[:, BACKGROUND, Z_GAUSS] = 1.0
    values[:, SLOPE, Z], values[:, SLOPE, RAMP] = blur / depth, -blur / depth
    slopes[:, SLOPE, ONE], slopes[:, SLOPE, STEP] = 1.0 / depth, -1.0 / depth
    widenings[:, SLOPE, GAUSS] = -blur / depth
    value, slope, widening = (np.zeros((n, 5, N_POWERS)) for _ in range(3))
    scale = blur / half_width
    root = np.sqrt(scale)
    value[:, 0, STEP], slope[:, 0, GAUSS], widening[:, 0, Z_GAUSS] = 1.0, 1.0 / blur, -1.0
    value[:, 1, HALF], slope[:, 1, MINUS_HALF] = root, 0.5 * root / blur
    widening[:, 1, HALF], widening[:, 1, Z_MINUS_HALF] = 0.5 * root, -0.5 * root
    value[:, 2, RAMP], slope[:, 2, STEP], widening[:, 2, GAUSS] = scale, scale / blur, scale
    value[:, 3, THREE_HALVES], slope[:, 3, HALF] = scale * root, 1.5 * scale * root / blur
    widening[:, 3, MINUS_HALF] = 0.75 * scale * root
    value[:, 4, SQUARE], slope[:, 4, RAMP] = scale**2, 2.0 * scale**2 / blur
    widening[:, 4, STEP] = 2.0 * scale**2
    for of_surface, all_of_it in ((value, values), (slope, slopes), (widening, widenings)):
        all_of_it[:, SURFACE:] = _OF_DEPTH @ of_surface
    return values, slopes, widenings


N_SIMPLE = 5
# Constant, slope of the background, step, limb, and depth, by the functions of r.
_SIMPLE = np.zeros((N_SIMPLE, N_AMPLITUDES))
_SIMPLE[0, [BACKGROUND, SURFACE]] = 1.0
_SIMPLE[1, SLOPE] = _SIMPLE[2, SURFACE] = _SIMPLE[3, SURFACE + 1] = 1.0
_SIMPLE[4, [SURFACE + 2, SURFACE + 4]] = 0.5, 0.125  # rho = r^2 / 2 + r^4 / 8


def simple_functions(half_width: Array, blur: Array) -> tuple[Array, Array]:
    """Return the functions of single blocks as coefficients (n, N_SIMPLE, N_POWERS) of powers.

    Constant, slope of the background, step, limb r, and depth, both as parts of the half-width; and
    their derivatives by the distance inside the outline [1/px]. Half-widths and blurs (n,) in px.
    """
    values, slopes, _ = _functions_of_r(half_width, blur, half_width)
    return _SIMPLE @ values, _SIMPLE @ slopes
