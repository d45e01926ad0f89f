"""What a profile across an outline may look like, as sums of blurred powers of the depth.

A background, flat or sloped, ends where the surface begins. What a surface of a cylinder sends to
the camera depends on the direction of its normal: by r, the cosine between normal and line of
sight, which is sqrt(rho (2 - rho)) at the depth rho = D / R inside the outline of a cylinder of
half-width R. Diffuse light gives sums of 1, r and r^2, darkening towards the limb higher powers,
and a highlight near the limb is a bump in r. So there are amplitudes of

    background      outside the outline
    its slope       outside, by the depth that is looked at
    surface         inside, as it is seen edge-on
    r, ..., r^4     inside

expanded in powers of rho up to rho^2, which is good to a part in a hundred up to rho = 0.8.
"""

import numpy as np

from legcal.detection.powers import (
    GAUSS,
    HALF,
    LESS_HALF,
    N_POWERS,
    ONE,
    RAMP,
    SQUARE,
    STEP,
    THREE_HALVES,
    Z_GAUSS,
    Z_LESS_HALF,
    Z,
)
from legcal.geometry.types import Array

BACKGROUND, SLOPE, SURFACE = 0, 1, 2
N_AMPLITUDES = 7

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


def profile_functions(half_width: Array, blur: Array, depth: float) -> tuple[Array, Array, Array]:
    """Return what profiles are made of, as coefficients of :func:`legcal.detection.powers.powers`.

    Parameters
    ----------
    half_width, blur : (n,) array
        Half-widths of cylinders in the image, and the standard deviations of the blur [px].
    depth : float
        Distance from an outline that is looked at [px], the unit of the background's slope.

    Returns
    -------
    values, slopes, widenings : (n, N_AMPLITUDES, N_POWERS) array
        Of the functions above, of their derivatives with respect to the distance inside the
        outline [1/px], and with respect to the logarithm of the blur.
    """
    n = len(blur)
    values, slopes, widenings = (np.zeros((n, N_AMPLITUDES, N_POWERS)) for _ in range(3))
    values[:, BACKGROUND, [ONE, STEP]] = 1.0, -1.0
    slopes[:, BACKGROUND, GAUSS] = -1.0 / blur
    widenings[:, BACKGROUND, Z_GAUSS] = 1.0
    values[:, SLOPE, Z], values[:, SLOPE, RAMP] = blur / depth, -blur / depth
    slopes[:, SLOPE, [ONE, STEP]] = 1.0 / depth, -1.0 / depth
    widenings[:, SLOPE, GAUSS] = -blur / depth
    value, slope, widening = (np.zeros((n, 5, N_POWERS)) for _ in range(3))
    scale = blur / half_width
    root = np.sqrt(scale)
    value[:, 0, STEP], slope[:, 0, GAUSS], widening[:, 0, Z_GAUSS] = 1.0, 1.0 / blur, -1.0
    value[:, 1, HALF], slope[:, 1, LESS_HALF] = root, 0.5 * root / blur
    widening[:, 1, HALF], widening[:, 1, Z_LESS_HALF] = 0.5 * root, -0.5 * root
    value[:, 2, RAMP], slope[:, 2, STEP], widening[:, 2, GAUSS] = scale, scale / blur, scale
    value[:, 3, THREE_HALVES], slope[:, 3, HALF] = scale * root, 1.5 * scale * root / blur
    widening[:, 3, LESS_HALF] = 0.75 * scale * root
    value[:, 4, SQUARE], slope[:, 4, RAMP] = scale**2, 2.0 * scale**2 / blur
    widening[:, 4, STEP] = 2.0 * scale**2
    for of_surface, all_of_it in ((value, values), (slope, slopes), (widening, widenings)):
        all_of_it[:, SURFACE:] = _OF_DEPTH @ of_surface
    return values, slopes, widenings
