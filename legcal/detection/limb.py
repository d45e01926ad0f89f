"""The shape of the picture across an outline: a background, a blurred step, a lit limb.

At depth D inside the outline of a cylinder of half-width R the surface normal leans towards the
camera by sqrt(rho (2 - rho)) with rho = D / R, which grows like the square root of the depth;
a lit surface shades in proportion to it. The lens blurs outline and shading with a Gaussian.
Basis functions of d, the distance inside the outline in pixels:

    background      1
    its slope       outside the outline only
    step            the surface where it is seen edge-on
    limb            the square-root shading
    lean            shading in proportion to the depth
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Samples = NDArray[np.float32]

N_BASIS = 5
_BEFORE, _AFTER, _PER_UNIT = 6.0, 40.0, 1024  # range of the table, and entries per unit


def _gauss(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi))


def _tabulate() -> Samples:
    """Tabulate blurred functions of x, (4, n).

    The step and its derivative, and sqrt(max(x, 0)) and its derivative, all blurred by a Gaussian
    of unit width, for x in [-_BEFORE, _AFTER].
    """
    coarse = np.arange(-_BEFORE, _AFTER + 1e-9, 1.0 / 32.0)
    root = np.linspace(0.0, 7.0, 2801)  # substitute x = root^2: the integrands are smooth
    kernel = 2.0 * (root[1] - root[0]) * root**2 * _gauss(coarse[:, None] - root**2)
    x = np.arange(-_BEFORE, _AFTER + 1e-9, 1.0 / _PER_UNIT)
    value = np.interp(x, coarse, np.sum(kernel, axis=1))
    slope = np.interp(x, coarse, np.sum(kernel * (root**2 - coarse[:, None]), axis=1))
    return np.stack([ndtr(x), _gauss(x), value, slope]).astype(np.float32)


_TABLE = _tabulate()


def _look_up(x: Samples) -> list[Samples]:
    """Return the four functions at x (n, m), from the nearest entries of the table."""
    place = np.clip((x + _BEFORE) * _PER_UNIT + 0.5, 0.0, _TABLE.shape[1] - 1.0)
    index = place.astype(np.intp)  # the type that needs no conversion: take is slower with others
    return [function.take(index, mode="clip") for function in _TABLE]


def basis(d: Samples, half_width: Samples, blur: Samples | float) -> tuple[Samples, Samples]:
    """Return the basis functions and their derivatives with respect to d.

    Parameters
    ----------
    d : (n, m) array of float32
        Distances inside the outline [px], negative outside.
    half_width : (n, 1) array of float32
        Half-width of the cylinder in the image [px].
    blur : float or (n, 1) array of float32
        Standard deviation of the blur [px].

    Returns
    -------
    values, slopes : (n, 5, m) array of float32
        In the order of the list above; the limb is one at the depth ``half_width``.
    """
    blur = np.asarray(blur, dtype=np.float32)
    z = d / blur
    step, peak, root, root_slope = _look_up(z)
    depth = blur * (z * step + peak)  # the blurred ramp max(d, 0)
    rho = depth / half_width
    bend = np.sqrt(2.0 - np.clip(rho, 0.0, 1.0))
    root_scale = np.sqrt(blur / half_width)
    root *= root_scale
    root_slope *= root_scale / blur
    values = np.empty((len(d), N_BASIS, d.shape[1]), dtype=np.float32)
    slopes = np.empty_like(values)
    values[:, 0], slopes[:, 0] = 1.0, 0.0
    values[:, 1], slopes[:, 1] = (depth - d) / half_width, (step - 1.0) / half_width
    values[:, 2], slopes[:, 2] = step, peak / blur
    values[:, 3] = root * bend
    slopes[:, 3] = root_slope * bend - root * step / (2.0 * half_width * bend)
    values[:, 4], slopes[:, 4] = rho, step / half_width
    return values, slopes
